"""Step `half_data`: the split with the first half of the training frames (the paper's section 4.4: less expression coverage).

Input: split. Output: half. The test frames stay what they are, so that both trainings are scored alike.
"""

from __future__ import annotations

from avatar.uses.config import HalfDataConfig
from workflow import step


def run(job: step.Job) -> None:
    """Write the split; StepError where one frame alone would train."""
    split = step.read_json(job.input.split)
    half = split["train"][: (len(split["train"]) + 1) // 2]
    if len(half) < 2:
        raise step.StepError(f"{job.input.split}: {len(split['train'])} training frames have no half to train on")
    job.write_json(job.output.half, {"train": half, "test": split["test"]})
    job.log.info("%d of %d training frames", len(half), len(split["train"]))


if __name__ == "__main__":
    step.main(run, HalfDataConfig)
