"""play: what the command finds from a variant's folder alone, its sentences where something is missing, and its clean end."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from conftest import REPOSITORY
from toy_head import toy_head
from toy_run import train_in, write_subject

from avatar.play import __main__ as command
from avatar.play import assembly, subject
from avatar.play.config import PlayConfig
from avatar.play.rows import of_motion, rest_row
from fitting.video import write_video
from workflow.step import StepError


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """results/ann/fast of a toy, a little trained, as the pipeline lays it out; another head model lies beside its own."""
    root = tmp_path_factory.mktemp("project")
    paths = write_subject(root / "made", frames=10) if (root / "made").mkdir() is None else {}
    ann = root / "results" / "ann"
    places = {"track": "fit/track.npz", "index": "frames/frames.json", "frames": "frames/frames.npy", "split": "split.json"}
    for name, place in places.items():
        (ann / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(paths[name], ann / place)
    heads = root / "resources" / "heads"
    heads.mkdir(parents=True)
    shutil.copy(paths["head"], heads / "own.npz")
    toy_head(8, 12, seed=3).save(heads / "another.npz")
    (heads / "damaged.npz").write_bytes(b"PK")
    train_in(ann / "fast", paths, steps=1)
    return root


@pytest.fixture
def copy(project: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil; its variant's folder."""
    shutil.copytree(project, tmp_path / "project", ignore=shutil.ignore_patterns("made", "checkpoints"))
    return tmp_path / "project" / "results" / "ann" / "fast"


def test_everything_is_found_from_the_folder(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(project / "resources")  # not the project's folder
    opened = subject.open_subject(project / "results" / "ann" / "fast", 1)
    assert (opened.name, opened.variant, opened.representation) == ("ann", "fast", "ours_d")
    assert opened.room.head.digest == toy_head(24, 36).digest and len(opened.clip) == 10 and opened.landmarker is None
    monkeypatch.chdir(project / "results" / "ann")
    assert subject.open_subject(Path("fast"), 1).name == "ann"


@pytest.mark.parametrize("gone", ["fit/track.npz", "frames/frames.json", "frames/frames.npy", "split.json"])
def test_a_missing_file_is_named(copy: Path, gone: str) -> None:
    (copy.parent / gone).unlink()
    with pytest.raises(StepError, match=f"{re.escape(gone)}: this file belongs to the avatar .* is missing; run snakemake again"):
        subject.open_subject(copy, 1)


def test_a_folder_without_an_avatar_names_those_that_have_one(copy: Path) -> None:
    with pytest.raises(StepError, match="there is no such folder"):
        subject.open_subject(copy.parent / "slow", 1)
    for folder in (copy.parent / "fit", copy.parent):
        with pytest.raises(StepError, match=r"there is no avatar.pt in it; trained here are fast"):
            subject.open_subject(folder, 1)


def test_a_head_model_is_known_by_its_digest(copy: Path) -> None:
    (copy.parent.parent.parent / "resources" / "heads" / "own.npz").unlink()
    with pytest.raises(StepError, match=r"no head model with digest toy24x36s0, on which .* found another.npz \(toy8x12s3\)"):
        subject.open_subject(copy, 1)


def test_a_damaged_avatar_is_named(copy: Path) -> None:
    (copy / "avatar.pt").write_bytes(b"no avatar")
    with pytest.raises(StepError, match=r"avatar.pt: not readable as an avatar .*; train it again"):
        subject.open_subject(copy, 1)


def test_a_clip_without_a_tracked_frame_is_refused(copy: Path) -> None:
    path = copy.parent / "fit" / "track.npz"
    with np.load(path) as file:
        track = {name: file[name] for name in file.files}
    np.savez(path, **track | {"usable": np.zeros(10, bool)})
    with pytest.raises(StepError, match="no frame of this clip could be tracked"):
        subject.open_subject(copy, 1)


def test_parameter_files_are_read_with_the_subjects_rest(project: Path, tmp_path: Path) -> None:
    opened = subject.open_subject(project / "results" / "ann" / "fast", 1)
    row, _ = rest_row(opened.room.head, opened.room.track["shape"], opened.training)
    (tmp_path / "wave.csv").write_text("bump0\n0\n0.5\n1\n")
    motion = subject.open_motion(tmp_path / "wave.csv", opened, row)
    np.testing.assert_array_equal(motion.expression[:, 0], [0, 0.5, 1])
    np.testing.assert_allclose(of_motion(motion, 1).translation, row.translation)
    (tmp_path / "wave.csv").write_text("bump9\n0\n")
    with pytest.raises(StepError, match=r"wave.csv: the column bump9 is not known; did you mean"):
        subject.open_motion(tmp_path / "wave.csv", opened, row)
    with pytest.raises(StepError, match="no.csv: there is no such file"):
        subject.open_motion(tmp_path / "no.csv", opened, row)


def test_the_whole_draws_and_takes_a_file(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Session, field avatar, page and upload together; the driver is missing, for its model is."""
    monkeypatch.chdir(project)
    server, end = assembly.server_of(project / "results" / "ann" / "fast", PlayConfig(size=48, threads=1))
    try:
        session = server.session
        shown = session.picture(0, 60)
        assert "fault" not in shown.facts and max(shown.facts["size"]) == 40  # never larger than the frames
        assert session.sources() == ["sliders", "clip"]
        assert server.offer("my wave.csv", b"bump0\n0\n1\n")["frames"] == 2 and session.state()["source"] == "file"
        for name, data, said in (
            ("a.csv", b"bump0\nx\n", "a.csv: .*'x' is not a number"),
            ("a.npz", b"PK", "a.npz: not readable"),
            ("a.exe", b"", r"ends in .csv or .npz"),
            ("../../b.csv", b"", "^b.csv: "),
        ):
            with pytest.raises(ValueError, match=said):
                server.offer(name, data)
        page = server.page("n0nce")
        assert "synthetic rendering of ann" in page and "face_landmarker.task, which is missing" in page
        assert page.count('class="slider"') == 3 + 2 + 1 + 3  # turn, gaze, jaw, bumps
    finally:
        server.server_close()
        end()


def test_a_taken_port_is_a_sentence(project: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(StepError, match=f"port {port} cannot be used"):
            assembly.server_of(project / "results" / "ann" / "fast", PlayConfig(port=port, threads=1))


def test_ctrl_c_ends_it_cleanly(project: Path, tmp_path: Path) -> None:
    write_video(tmp_path / "driver.mp4", [np.zeros((48, 64, 3), np.uint8)] * 3, 10.0)
    words = [sys.executable, "-m", "avatar.play", str(project / "results" / "ann" / "fast"), "--no-browser", "--threads", "1"]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    process = subprocess.Popen(
        [*words, "--video", str(tmp_path / "driver.mp4")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    try:
        address = process.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{20,}/", address), process.stderr.read()
        with urllib.request.urlopen(address, timeout=60) as answer:
            assert answer.status == 200
        status = 204
        for _ in range(12):  # each waits ten seconds at most: the first picture may have to compile
            if status == 204:
                with urllib.request.urlopen(address + "picture", timeout=60) as answer:
                    status, start = answer.status, answer.read(2)
        assert status == 200 and start == b"\xff\xd8"
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0 and "Traceback" not in said and said.rstrip().endswith("ended")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["x", "--port", "70000"], "--port"),
        (["x", "--size", "3"], "--size"),
        (["x", "--threads", "many"], "--threads"),
        ([], "results/SUBJECT/VARIANT"),
    ],
)
def test_words_that_are_not_understood(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        command.main(words)
    assert ended.value.code == 2 and said in capsys.readouterr().err


def test_a_wrong_folder_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main([str(tmp_path / "none")]) == 1
    assert capsys.readouterr().err.count("\n") == 2  # what is opened, and why not
