"""Training frames first, a contiguous test tail last (the paper's: section 4, the rest after the training part)."""

from __future__ import annotations

from fitting.config import SplitConfig
from workflow import step


def split(frames: int, train_fraction: float, max_train_frames: int, test_frames: int | None) -> tuple[list[int], list[int]]:
    """Frame numbers for training and for testing.

    Args:
        frames: frames of the subject.
        train_fraction: part of them, from the start, that trains.
        max_train_frames: upper bound of the training frames.
        test_frames: where given, exactly this many last frames test and all before them may train.

    Returns:
        Training and test lists, both non-empty, disjoint, growing.

    Raises:
        ValueError: there are too few frames for both.
    """
    if test_frames is not None:
        first_test = frames - test_frames
        train = min(first_test, max_train_frames)
    else:
        train = first_test = min(int(train_fraction * frames), max_train_frames)
    if train < 1 or first_test >= frames:
        raise ValueError(f"{frames} frames leave {max(train, 0)} for training and {max(frames - first_test, 0)} for testing")
    return list(range(train)), list(range(first_test, frames))


def run(job: step.Job) -> None:
    """Write split.json."""
    frames, config = len(step.read_json(job.input.index)["time_s"]), job.config
    try:
        train, test = split(frames, config.train_fraction, config.max_train_frames, config.test_frames)
    except ValueError as error:
        raise step.StepError(f"{job.input.index}: {error}; lower split.test_frames or film a longer video") from None
    job.write_json(job.output.split, {"train": train, "test": test})
    job.log.info("%d training frames, %d test frames", len(train), len(test))


if __name__ == "__main__":
    step.main(run, SplitConfig)
