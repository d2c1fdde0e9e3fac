"""Step: one training of `snakemake speed_error`; the step `train` itself, but for a training that fails.

    python -m avatar.speed_error.training --config '{"train": {"steps": 450}}' --input head=... frames=... alpha=... track=... \\
        split=... --output avatar=... curve=... report=...

A training that diverges is a report with its reason and an empty avatar: the other rows do not wait for it.
"""

from __future__ import annotations

from dataclasses import replace

from avatar import train
from avatar.speed_error.config import TrainingConfig
from workflow import step


def run(job: step.Job) -> None:
    """Inputs and outputs are those of `avatar.train`; the checkpoint stands beside the outputs: an interrupted one goes on."""
    try:
        train.run(replace(job, config=job.config.train))
    except train.TrainingFailed as error:
        job.output.avatar.write_bytes(b"")
        job.output.curve.write_text("step\tseconds\tloss\tprobe_psnr\n", encoding="utf-8")
        job.write_json(job.output.report, {"failed": str(error)})


if __name__ == "__main__":
    step.main(run, TrainingConfig)
