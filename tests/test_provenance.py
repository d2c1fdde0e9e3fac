"""What a rendered video says of itself, read back from the file by a second reader as well."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from avatar import provenance
from fitting.video import write_video


@pytest.fixture
def avatar(tmp_path: Path) -> Path:
    path = tmp_path / "avatar.pt"
    path.write_bytes(b"weights")
    return path


def made(path: Path, comment: str | None) -> Path:
    write_video(path, [np.full((32, 32, 3), 90, np.uint8)] * 3, 10.0, comment)
    return path


def test_comment_is_read_back(tmp_path: Path, avatar: Path) -> None:
    comment = provenance.synthetic_comment(avatar)
    video = made(tmp_path / "a.mp4", comment)
    assert "synthetic" in comment.lower() and comment.endswith(f"avatar sha256:{hashlib.sha256(b'weights').hexdigest()}")
    assert provenance.read_comment(video) == comment
    assert provenance.avatar_of(comment) == hashlib.sha256(b"weights").hexdigest()
    assert comment.encode() in video.read_bytes()  # whoever reads the container without this project finds it too
    provenance.check(video, avatar)


def test_another_avatar_another_comment_and_none_are_told_apart(tmp_path: Path, avatar: Path) -> None:
    video = made(tmp_path / "a.mp4", provenance.synthetic_comment(avatar))
    avatar.write_bytes(b"other weights")
    with pytest.raises(ValueError, match="was rendered by avatar"):
        provenance.check(video, avatar)
    for comment in (None, provenance.FILMED, "avatar sha256:" + 64 * "0"):
        plain = made(tmp_path / "b.mp4", comment)
        assert provenance.read_comment(plain) == comment and provenance.avatar_of(comment) is None
        with pytest.raises(ValueError, match="does not say that it is synthetic"):
            provenance.check(plain, avatar)


def test_command(tmp_path: Path, avatar: Path) -> None:
    video = made(tmp_path / "a.mp4", provenance.synthetic_comment(avatar))
    run = subprocess.run(
        [sys.executable, "-m", "avatar.provenance", video, avatar],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent.parent,
    )
    assert run.returncode == 0 and run.stdout.startswith("Synthetic")
    avatar.write_bytes(b"x")
    assert provenance.main([str(video), str(avatar)]) == 1


def test_command_without_a_video(tmp_path: Path, avatar: Path, capsys: pytest.CaptureFixture) -> None:
    for words, status, sentence in (
        ([], 2, "usage"),
        ([str(tmp_path / "no.mp4")], 1, "no.mp4"),
        ([str(avatar)], 1, "avatar.pt"),
        ([str(made(tmp_path / "a.mp4", None)), str(tmp_path / "no.pt")], 1, "no.pt"),
    ):
        assert provenance.main(words) == status and sentence in capsys.readouterr().err
