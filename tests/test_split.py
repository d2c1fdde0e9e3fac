"""Splits: the paper's, an exact tail, and what is too short."""

from __future__ import annotations

import pytest

from fitting.split import split


@pytest.mark.parametrize(
    ("frames", "test_frames", "train", "test"),
    [
        (400, None, 300, 100),
        (2000, None, 1500, 500),
        (3000, None, 1500, 1500),
        (504, 150, 354, 150),
        (2, 1, 1, 1),
        (4000, 500, 1500, 500),
    ],
)
def test_lengths_order_and_contiguity(frames: int, test_frames: int | None, train: int, test: int) -> None:
    first, last = split(frames, 0.75, 1500, test_frames)
    assert (len(first), len(last)) == (train, test)
    assert first == list(range(train))
    assert last == list(range(frames - test, frames))
    assert not set(first) & set(last)


@pytest.mark.parametrize(("frames", "test_frames"), [(100, 100), (100, 150), (1, None), (0, None)])
def test_too_few_frames(frames: int, test_frames: int | None) -> None:
    with pytest.raises(ValueError, match="frames leave"):
        split(frames, 0.75, 1500, test_frames)
