"""Step `published_place`: test frames of a trivial predictor in the pixels of a comparison video's driving panel.

Input: index (frames.json), split, render, report (of step `baseline`). Output: png, opacity, report, as `published_render` has.
"""

from __future__ import annotations

import numpy as np

from avatar.published.config import PublishedPlaceConfig
from avatar.published.protocol import Grid, write_pictures
from workflow import step


def run(job: step.Job) -> None:
    """Place every `stride`-th test frame on the panel's grid."""
    index, report = step.read_json(job.input.index), step.read_json(job.input.report)
    chosen, grid = step.read_json(job.input.split)["test"][:: job.config.stride], Grid(index)
    if missing := set(chosen) - set(report["frames"]):
        raise step.StepError(f"{job.input.report}: test frame {min(missing)} is missing; delete it and run snakemake again")
    images = np.load(job.input.render, mmap_mode="r")
    images = {frame: np.asarray(images[report["frames"].index(frame)]) for frame in chosen}
    write_pictures(job.output.png, {index["source_frame"][f]: grid.place(image[..., :3], 255) for f, image in images.items()})
    with open(job.output.opacity, "wb") as file:
        np.save(file, np.stack([grid.place(image[..., 3], 0) for image in images.values()]))
    numbers = [index["source_frame"][frame] for frame in chosen]
    job.write_json(job.output.report, {"frames": chosen, "source_frames": numbers, "ms_per_frame": report["ms_per_frame"]})


if __name__ == "__main__":
    step.main(run, PublishedPlaceConfig)
