"""play: what is drawn and when; a filmed driver; the latest picture wins."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from avatar.play.config import Change
from avatar.play.drawing import jpeg, jpeg_size, read_jpeg
from avatar.play.filming import play_video
from avatar.play.session import Player
from avatar.play.solver import CALIBRATE_ON
from fitting.detection import Face
from tests import made_play
from tests.made_driver import SIZE as FILMED_SIZE
from tests.made_driver import face_of
from tests.made_play import FRAMES, MadeFinder, Painter, clip, read_back, session
from tests.small_face import true_head

PATIENCE_S = 20.0


def faces(grey: int) -> Face:
    """The jaw is open by as much as the picture is bright, the left eye shut in the brightest."""
    return face_of(true_head(), {"jawOpen": 0.8 * grey / 255, "eyeBlinkLeft": float(grey == 255)})


def filmed(grey: int) -> np.ndarray:
    return np.full((*FILMED_SIZE, 3), grey, np.uint8)


def until(running, good, after: int = 0):
    """The first picture that will do."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        shown = running.picture(after, 1.0)
        if shown is not None:
            if good(shown):
                return shown
            after = shown.number
    raise AssertionError("no such picture came")


def test_a_slider_changes_the_picture_and_its_version() -> None:
    with session() as running:
        first = running.picture(0, PATIENCE_S)
        jaw, _ = read_back(first.jpeg)
        version = running.change(Change(sliders={"jawOpen": 0.9, "eyeBlinkLeft": 0.5}))
        later = until(running, lambda shown: shown.facts["version"] == version, first.number)
        assert read_back(later.jpeg) == pytest.approx((0.9, 0.5), abs=0.02) and jaw < 0.7
        assert later.facts["ms"]["frame"] == 1.5 and later.facts["size"] == [made_play.SIZE] * 2
        assert running.state()["sliders"]["jawOpen"] == 0.9
        version = running.change(Change(reset=True))
        assert read_back(until(running, lambda shown: shown.facts["version"] == version).jpeg)[0] == pytest.approx(jaw, abs=0.02)


def test_nothing_is_drawn_twice_nor_for_nobody() -> None:
    painters: list[Painter] = []

    def make(size: int) -> Painter:
        painters.append(Painter(size))
        return painters[-1]

    with session(make=make) as running:
        time.sleep(0.1)
        assert not painters  # no page has asked
        shown = running.picture(0, PATIENCE_S)
        assert running.picture(shown.number, 0.2) is None and painters[0].drawn == 1
        running.change(Change(size=96))
        assert running.picture(shown.number, PATIENCE_S).facts["size"] == [96, 96]


def test_two_pages_that_wait_do_not_wake_each_other() -> None:
    with session() as running:
        after = running.picture(0, PATIENCE_S).number
        pages = [threading.Thread(target=running.picture, args=(after, 1.0)) for _ in range(2)]
        begun = time.process_time()
        for page in pages:
            page.start()
        for page in pages:
            page.join()
        assert time.process_time() - begun < 0.3


def test_the_clip_plays_in_a_loop_and_rests() -> None:
    with session() as running:
        running.change(Change(source="clip", place=0))
        seen, after, end = [], 0, time.monotonic() + 1.5
        while time.monotonic() < end:
            shown = running.picture(after, 1.0)
            if shown is not None and shown.facts["source"] == "clip":
                seen.append(shown.facts["place"])
                assert read_back(shown.jpeg)[0] == pytest.approx(seen[-1] / (FRAMES - 1), abs=0.02)
            after = shown.number if shown else after
        assert set(seen) <= set(range(FRAMES)) and len(set(seen)) >= 6
        assert (np.diff(seen) < 0).sum() >= 1  # began again
        version = running.change(Change(playing=False, place=7))
        still = until(running, lambda shown: shown.facts["version"] == version, after)
        assert still.facts["place"] == 7 and running.picture(still.number, 0.2) is None


def test_the_clock_of_a_player() -> None:
    player = Player(clip())
    player.go(True, 100.0)
    assert [player.now(100.0 + k / 25 + 1e-6) for k in (0, 1, FRAMES)] == [0, 1, 0]
    player.go(False, 100.2 + 1e-6)
    assert player.now(500.0) == 5
    player.go(True, 600.0)
    assert player.now(600.0 + 2 / 25 + 1e-6) == 7


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (Change(sliders={"jawOpen": 2.0}), "jawOpen goes from 0 to 1"),
        (Change(sliders={"nobody": 0.0}), "there is no slider"),
        (Change(source="file"), "there is no source file"),
        (Change(source="camera"), "there is no source camera"),
        (Change(source="clip", place=FRAMES), "there is no frame 12"),
        (Change(place=0), "there is no frame 0"),
    ],
)
def test_what_cannot_be_is_refused_and_changes_nothing(change: Change, sentence: str) -> None:
    with session() as running:
        before = running.state()
        with pytest.raises(ValueError, match=sentence):
            running.change(change)
        assert running.state() == before


def test_an_offered_file_plays() -> None:
    with session() as running:
        assert "file" not in running.sources()
        running.offer("file", clip())
        assert until(running, lambda shown: shown.facts["source"] == "file") and running.state()["frames"]["file"] == FRAMES


def test_a_fault_of_the_drawer_is_told_and_passes() -> None:
    class Faulty(Painter):
        def frame(self, row):
            if row.expression[self.names.index("jawOpen")] > 0.95:
                raise ValueError("the render of frame 0 is not finite; train the avatar again")
            return super().frame(row)

    with session(make=Faulty) as running:
        version = running.change(Change(sliders={"jawOpen": 1.0}))
        assert until(running, lambda shown: shown.facts["version"] == version).facts["fault"].startswith("the render of frame 0")
        version = running.change(Change(sliders={"jawOpen": 0.5}))
        assert "fault" not in until(running, lambda shown: shown.facts["version"] == version).facts


def test_a_filmed_face_moves_the_jaw_and_no_face_holds_it() -> None:
    finder = MadeFinder(faces)
    with session(finder) as running:
        running.change(Change(source="camera", smooth=False))
        running.picture(0, PATIENCE_S)

        def shown_for(picture):
            number = running.driven
            running.film(picture, "camera", PATIENCE_S)
            return until(running, lambda shown: shown.facts.get("driver", 0) > number)

        for grey in (40, 200, 120):
            image = filmed(grey)
            got = shown_for(image if grey == 200 else jpeg(image, 95))
            jaw, blink = read_back(got.jpeg)
            assert jaw == pytest.approx(0.8 * grey / 255, abs=0.08) and blink < 0.1
            assert got.facts["found"] and set(got.facts["ms"]) == {"frame", "raster", "jpeg", "detect", "solve"}
        lost = shown_for(filmed(0))
        assert not lost.facts["found"] and lost.facts["note"] == "no face in the picture"
        assert read_back(lost.jpeg)[0] == pytest.approx(0.8 * 120 / 255, abs=0.08)
        wink = shown_for(filmed(255))
        assert read_back(wink.jpeg)[1] > 0.8
        assert read_jpeg(running.preview(), 4096).shape == (180, 240, 3)
        damaged = shown_for(jpeg(filmed(90), 90)[:300])
        assert "cannot be used" in damaged.facts["note"]
        assert shown_for(filmed(90)).facts["found"]
        assert (np.diff(finder.times) > 0).all()  # as MediaPipe demands
    assert finder.closed


def test_a_face_is_got_to_know_once_and_again_when_asked() -> None:
    with session(MadeFinder(faces)) as running:
        running.change(Change(source="camera"))
        running.picture(0, PATIENCE_S)

        def note() -> str:
            number = running.driven
            running.film(filmed(60 + number), "camera", PATIENCE_S)
            return until(running, lambda shown: shown.facts.get("driver", 0) > number).facts["note"]

        notes = [note() for _ in range(CALIBRATE_ON + 1)]
        assert notes == ["getting to know the face"] * (CALIBRATE_ON - 1) + ["", ""]
        running.change(Change(calibrate=True))
        assert note() == "getting to know the face"


def test_the_latest_picture_wins() -> None:
    """While one is worked on, many come: only the last of them is looked at."""
    gate, seen = threading.Event(), []

    class Slow(MadeFinder):
        def find(self, rgb, time_ms=0):
            seen.append(int(rgb[0, 0, 0]))
            gate.wait(PATIENCE_S)
            return super().find(rgb, time_ms)

    with session(Slow(faces)) as running:
        running.change(Change(source="camera"))
        running.film(filmed(10), "camera", PATIENCE_S)
        for grey in range(20, 120, 10):
            running.film(filmed(grey), "camera")
        gate.set()
        until(running, lambda shown: shown.facts.get("driver") == 2)
        assert seen == [10, 110]
        assert not running.film(filmed(50), "video")  # another source
        running.change(Change(playing=False))
        assert not running.film(filmed(50), "camera")


def test_a_video_file_is_played_at_its_own_speed_while_somebody_watches() -> None:
    class Frame:
        def __init__(self, number: int) -> None:
            self.time_s, self.number = number / 20, number

        def rgb(self) -> np.ndarray:
            taken.append((time.monotonic(), self.number))
            return filmed(10 + 10 * self.number)

    taken: list[tuple[float, int]] = []
    with session(MadeFinder(faces)) as running:
        thread = play_video(running, lambda: (Frame(number) for number in range(10)))
        running.change(Change(source="video"))
        time.sleep(0.2)
        assert not taken  # nobody has asked for a picture
        until(running, lambda shown: shown.facts.get("driver", 0) > 3)
        until(running, lambda shown: len(taken) > 14)
        numbers = [number for _, number in taken]
        assert 0 in numbers[1:] and numbers[:3] == sorted(numbers[:3])  # in a loop
        begun = next(k for k in range(1, len(numbers)) if numbers[k] == 0)
        span = taken[begun - 1][0] - taken[0][0]
        assert span == pytest.approx((numbers[begun - 1] - numbers[0]) / 20, abs=0.2)
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


def test_jpeg_headers_are_read_before_pixels() -> None:
    data = jpeg(np.zeros((20, 30, 3), np.uint8), 90)
    assert jpeg_size(data) == (20, 30) and read_jpeg(data, 64).shape == (20, 30, 3)
    huge = bytearray(data)
    place = data.index(b"\xff\xc0")
    huge[place + 5 : place + 9] = b"\xff\xff\xff\xff"
    with pytest.raises(ValueError, match="65535x65535"):
        read_jpeg(bytes(huge), 4096)
    for junk in (b"", b"GIF89a", b"\xff\xd8", b"\xff\xd8\xff", data[:40], b"\xff\xd8" + b"\xff" * 99):
        with pytest.raises(ValueError, match="must be a JPEG"):
            read_jpeg(junk, 4096)
