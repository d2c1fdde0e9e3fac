"""Reading what phones write: turns, time stamps, bit depths, odd sizes, damage; and writing what browsers play."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
import video_files

from fitting import video
from fitting.stack import StackWriter


def all_rgb(path: Path) -> np.ndarray:
    return np.stack([frame.rgb() for frame in video.read_frames(path)])


@pytest.mark.parametrize("hflip", [False, True])
@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_display_matrix_is_applied_in_all_eight_orientations(tmp_path: Path, degrees: int, hflip: bool) -> None:
    picture = video_files.quadrants()
    path = video_files.write(
        tmp_path / "turned.mp4", [picture] * 4, prepare=lambda stream: stream.set_display_rotation(degrees, hflip=hflip)
    )
    wanted = np.rot90(picture, degrees // 90)
    wanted = wanted[:, ::-1] if hflip else wanted
    found = all_rgb(path)[0]
    assert found.shape == wanted.shape
    assert np.abs(found[4::8, 4::8].astype(int) - wanted[4::8, 4::8]).max() < 12
    facts = video.inspect(path)
    assert facts.size == wanted.shape[:2]
    assert facts.mirrored == hflip
    if not hflip:
        assert facts.rotation_degrees == degrees


def test_upright_equals_the_matrix_applied_pixel_by_pixel() -> None:
    picture = np.arange(3 * 5 * 1).reshape(3, 5, 1)
    straight = [(1, 0, 0, 1), (-1, 0, 0, 1), (1, 0, 0, -1), (-1, 0, 0, -1)]
    for a, b, c, d in [*straight, (0, 1, -1, 0), (0, -1, 1, 0), (0, 1, 1, 0), (0, -1, -1, 0)]:
        places = {}
        for y in range(3):
            for x in range(5):
                places[(x * a + y * c, x * b + y * d)] = picture[y, x]
        left, top = min(p for p, _ in places), min(q for _, q in places)
        found = video.upright(picture, np.array([[a, b], [c, d]], float))
        for (p, q), value in places.items():
            assert found[q - top, p - left] == value, (a, b, c, d)


def test_variable_frame_rate_keeps_the_timestamps(tmp_path: Path) -> None:
    stamps = [0, 33, 66, 150, 400, 433, 466, 500, 700, 733]
    path = video_files.write(tmp_path / "vfr.mkv", [video_files.quadrants()] * len(stamps), stamps=stamps)
    times = [frame.time_s for frame in video.read_frames(path)]
    assert np.allclose(times, np.array(stamps) / 1000.0, atol=2e-3)
    assert video.inspect(path).variable_frame_rate


def test_constant_frame_rate_is_not_called_variable(tmp_path: Path) -> None:
    path = video_files.write(tmp_path / "cfr.mp4", [video_files.quadrants()] * 12)
    facts = video.inspect(path)
    assert not facts.variable_frame_rate
    assert facts.fps == pytest.approx(30.0, rel=1e-6)
    assert facts.packets == 12
    assert facts.duration_s == pytest.approx(0.4, rel=1e-3)


@pytest.mark.parametrize(
    ("codec", "pixel_format", "suffix"),
    [
        ("libx264", "yuv420p10le", "mp4"),
        ("libx265", "yuv420p10le", "mp4"),
        ("ffv1", "yuv444p10le", "mkv"),
        ("libvpx-vp9", "yuv420p", "webm"),
        ("mjpeg", "yuvj420p", "avi"),
        ("ffv1", "gray", "mkv"),
        ("libx264", "yuvj420p", "mp4"),
    ],
)
def test_bit_depths_ranges_and_codecs_give_the_same_colours(tmp_path: Path, codec: str, pixel_format: str, suffix: str) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV has no {codec} encoder")
    picture = video_files.quadrants()
    found = all_rgb(video_files.write(tmp_path / f"a.{suffix}", [picture] * 3, codec, pixel_format))
    assert found.dtype == np.uint8 and found.shape == (3, 48, 64, 3)
    inner = found[0][12::24, 16::32].astype(int)
    wanted = picture[12::24, 16::32].astype(int)
    if pixel_format == "gray":
        wanted = np.repeat((wanted @ [0.299, 0.587, 0.114])[..., None], 3, axis=2)
    assert np.abs(inner - wanted).max() <= 6


def test_tagged_bt709_is_decoded_as_bt709(tmp_path: Path) -> None:
    path = tmp_path / "hd.mp4"
    video.write_video(path, [video_files.quadrants()] * 3, fps=25.0, quality=4)  # tags BT.709
    assert np.abs(all_rgb(path)[0][12::24, 16::32].astype(int) - video_files.quadrants()[12::24, 16::32]).max() <= 4


@pytest.mark.parametrize(("height", "width"), [(47, 63), (48, 63), (33, 64), (1, 1)])
def test_odd_sizes_are_read_whole_and_written_padded(tmp_path: Path, height: int, width: int) -> None:
    picture = np.full((height, width, 3), (200, 100, 50), np.uint8)
    path = video_files.write(tmp_path / "odd.mkv", [picture] * 2, codec="ffv1", pixel_format="yuv444p")
    assert all_rgb(path).shape == (2, height, width, 3)
    out = tmp_path / "out.mp4"
    assert video.write_video(out, [picture] * 5, fps=29.97, comment="made by a test") == 5
    back = all_rgb(out)
    assert back.shape == (5, height + height % 2, width + width % 2, 3)
    assert np.abs(back.astype(int) - picture[0, 0]).max() <= 6
    with av.open(str(out)) as container:
        assert container.metadata["comment"] == "made by a test"
        assert container.streams.video[0].codec_context.pix_fmt == "yuv420p"
        assert float(container.streams.video[0].average_rate) == pytest.approx(29.97, abs=2e-3)


def test_writing_nothing_or_mixed_sizes_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no frames"):
        video.write_video(tmp_path / "a.mp4", [], fps=30.0)
    with pytest.raises(ValueError, match="frame 1 is"):
        video.write_video(tmp_path / "b.mp4", [np.zeros((8, 8, 3), np.uint8), np.zeros((8, 10, 3), np.uint8)], fps=30.0)


def test_anamorphic_pixels_become_square(tmp_path: Path) -> None:
    def squeeze(stream: av.VideoStream) -> None:
        stream.codec_context.sample_aspect_ratio = 2

    path = video_files.write(tmp_path / "wide.mp4", [video_files.quadrants(48, 64)] * 3, prepare=squeeze)
    assert all_rgb(path).shape[1:3] == (24, 64)


@pytest.mark.parametrize(("make", "says"), [
    (lambda path: path.write_text("this is not a video\n" * 50), "not readable as a video"),
    (lambda path: path.write_bytes(b""), "not readable as a video"),
    (lambda path: path.write_bytes(bytes(range(256)) * 40), "not readable as a video"),
    (video_files.write_audio, "no video stream, only audio"),
    (video_files.write_no_frames, "from which no frame decodes|not readable as a video|no video stream"),
])  # fmt: skip
def test_what_is_no_video_says_so(tmp_path: Path, make, says: str) -> None:
    path = tmp_path / "clip.mp4"
    make(path)
    with pytest.raises(video.VideoError, match=says):
        video.inspect(path)


def noisy(count: int) -> list[np.ndarray]:
    generator = np.random.default_rng(0)
    return [generator.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(count)]


def test_a_truncated_file_gives_the_frames_before_the_cut(tmp_path: Path) -> None:
    whole = video_files.write(tmp_path / "whole.mp4", noisy(40), container_options={"movflags": "faststart"})
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    frames = [frame.index for frame in video.read_frames(cut)]
    assert 5 < len(frames) < 40
    assert frames == list(range(len(frames)))


def test_a_file_cut_before_its_index_is_not_a_video(tmp_path: Path) -> None:
    whole = video_files.write(tmp_path / "whole.mp4", noisy(40))
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.raises(video.VideoError, match="not readable"):
        video.inspect(cut)


def test_damaged_bytes_in_the_middle_do_not_stop_reading(tmp_path: Path) -> None:
    path = video_files.write(tmp_path / "a.mp4", noisy(40), codec="mpeg4")
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = bytes(2000)
    path.write_bytes(data)
    times = [frame.time_s for frame in video.read_frames(path)]
    assert len(times) > 20
    assert np.all(np.diff(times) > 0)


def test_stack_writer_equals_numpy_save(tmp_path: Path) -> None:
    items = np.random.default_rng(0).integers(0, 255, (7, 5, 3), dtype=np.uint8)
    with StackWriter(tmp_path / "a.npy") as writer:
        for item in items:
            writer.append(item)
    assert np.array_equal(np.load(tmp_path / "a.npy", mmap_mode="r"), items)
    with StackWriter(tmp_path / "b.npy") as writer:
        writer.append(items[0])
        with pytest.raises(ValueError, match="item 1 is"):
            writer.append(items[0, :2])
