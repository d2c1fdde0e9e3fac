"""Step `published_render`: test frames of an avatar in the pixels of a comparison video's driving panel, as PNGs.

Input: head, avatar, index (frames.json), track, split. Output: png (folder of NNNNN.png, on white), opacity (npy), report.
A crop that the pipeline shrank is rendered as filmed: the camera takes the panel's own pixels, nothing is resampled.
"""

from __future__ import annotations

import time

import numpy as np

from avatar import provenance, render
from avatar.dataset import Scene
from avatar.networks import best_precision
from avatar.published.config import PublishedRenderConfig
from avatar.published.protocol import Grid, write_pictures
from workflow import step


def run(job: step.Job) -> None:
    """Render every `stride`-th test frame on the panel's grid."""
    index = step.read_json(job.input.index)
    grid = Grid(index)
    avatar, scene, test = render.load(job)
    chosen = test[:: job.config.stride]
    track, precision = render.track_of(job), best_precision(job.device)
    track["focal_px"], track["centre_px"] = grid.camera(scene.focal_px, scene.centre_px)
    render.render_frame(avatar, scene, chosen[0], (8, 8), precision, job.device)  # compile and allocate before the clock runs
    pictures, opacity, milliseconds = {}, np.empty((len(chosen), *grid.size), np.uint8), []
    for place, frame in enumerate(job.progress(chosen, "rendering")):
        started = time.perf_counter()
        alone = Scene(scene.head, track, [frame])  # posed within the clock, as in `render`
        image = render.render_frame(avatar, alone, frame, grid.crop_size, precision, job.device)[0]
        milliseconds.append(1000 * (time.perf_counter() - started))
        pictures[index["source_frame"][frame]] = grid.place(image[..., :3], 255)
        opacity[place] = grid.place(image[..., 3], 0)
    write_pictures(job.output.png, pictures, provenance.synthetic_comment(job.input.avatar))
    with open(job.output.opacity, "wb") as file:
        np.save(file, opacity)
    facts = {"frames": chosen, "source_frames": list(pictures), "ms_per_frame": round(float(np.median(milliseconds)), 1)}
    job.write_json(job.output.report, facts | {"ms": [round(value, 1) for value in milliseconds], "ms_counts": render.COUNTED})


if __name__ == "__main__":
    step.main(run, PublishedRenderConfig)
