"""Soft mask of the whole person in every frame, from the frames alone."""

from __future__ import annotations

import numpy as np

from fitting.config import MatteConfig
from fitting.matting import PersonSegmenter, Plate, Steadier, one_person, refine
from fitting.stack import StackWriter
from workflow import step

REACH = 2
"""Frames on either side that a frame's matte is averaged with."""


def run(job: step.Job) -> None:
    """Write alpha.npy."""
    frames = np.load(job.input.frames, mmap_mode="r")
    refined: dict[int, Plate] = {}
    count, steadier = len(frames), Steadier()
    opaque = 0.0
    with PersonSegmenter(job.input.segmenter.read_bytes()) as segmenter, StackWriter(job.output.alpha) as writer:
        for t in job.progress(range(count), "matte"):
            for k in range(max(0, t - REACH), min(count, t + REACH + 1)):
                if k not in refined:
                    refined[k] = Plate.of(frames[k], refine(frames[k], segmenter.confidence(frames[k])))
            refined.pop(t - REACH - 1, None)
            neighbours = [refined[k] for k in sorted(refined) if k != t]
            alpha = one_person(steadier.steady(refined[t], neighbours))
            writer.append(np.rint(255.0 * alpha).astype(np.uint8))
            opaque += float(alpha.mean())
    if opaque < 0.01 * count:
        raise step.StepError(f"{job.input.frames}: no person found by the segmentation; check the crop in probe.json")
    job.log.info("%d frames, person covers %.0f %%, %.1f ms each", count, 100.0 * opaque / count, 1e3 * job.seconds() / count)


if __name__ == "__main__":
    step.main(run, MatteConfig)
