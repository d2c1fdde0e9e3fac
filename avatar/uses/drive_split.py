"""Step `drive_split`: training and test frames of a driving video, of which nothing is tested.

Input: landmarks. Output: split (json). The fit solves identity and focal length on training frames and wants a test part; a
driving video gives it all but a short tail.
"""

from __future__ import annotations

import numpy as np

from avatar.uses.config import DriveSplitConfig
from workflow import step

TAIL_FACES = 4  # faces in the tail: one that is lost may not cost the video


def driver_split(found: np.ndarray) -> tuple[list[int], list[int]]:
    """All frames but the shortest tail that holds TAIL_FACES frames with a face.

    found: [T] bool. Returns training and test frames. Raises ValueError where that leaves no face to learn from.
    """
    seen = np.flatnonzero(found)
    if len(seen) <= TAIL_FACES:
        raise ValueError(f"a face is found in {len(seen)} of {len(found)} frames; more than {TAIL_FACES} are needed")
    first = int(seen[-TAIL_FACES])
    return list(range(first)), list(range(first, len(found)))


def run(job: step.Job) -> None:
    """Write split.json."""
    with np.load(job.input.landmarks, allow_pickle=False) as file:
        found = file["found"]
    try:
        train, test = driver_split(found)
    except ValueError as error:
        raise step.StepError(f"{job.input.landmarks}: {error}; use another driving video") from None
    job.write_json(job.output.split, {"train": train, "test": test})
    job.log.info("%d frames determine the identity, the last %d are only tracked", len(train), len(test))


if __name__ == "__main__":
    step.main(run, DriveSplitConfig)
