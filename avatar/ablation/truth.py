"""Step: what is known of a simulated clip, for the ablation: its true head and track, and its test frames with doubled codes.

    python -m avatar.ablation.truth --config '{"simulate": {"kind": "talk"}}' --input head=... index=... track=... \\
        split=results/ablation/data/.../split.json rich=... truth=simulated/truth/talk_0.npz \\
        --output head=... track=... doubled=...

The true head has the displaced skin as its template and the bumps as expressions, so that its track is exact. The doubled
frames are drawn by the simulator from the clip's own expressions times two, everything else as in the video.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from avatar.ablation import data as ablation_data
from avatar.ablation.config import AblationDataConfig
from fitting import extract, simulate, synthetic, trim
from fitting.files import load_head
from fitting.synthetic_motion import exaggerated
from fitting.synthetic_render import Renderer
from workflow import step

REMADE_M = 1e-5  # the clip made again is the truth file's, but for rounding


def run(job: step.Job) -> None:
    """Write the true head, the true track in the small frames' pixels, and the doubled test frames with their mattes."""
    tracked, track, index = load_head(job.input.head), ablation_data.load_track(job), step.read_json(job.input.index)
    clip = remade(job)
    split = step.read_json(job.input.split)
    frames, crop = split["test"], split["crop"]
    head = replace(clip.head, digest=clip.head.content_digest())
    head.save(job.output.head)
    true = ablation_data.shrink(true_track(clip, index) | {"head_digest": np.array(head.digest)}, crop)
    ablation_data.save_track(job.output.track, true | {"usable": track["usable"]})
    stronger = track | {"expression": exaggerated(track["expression"], tracked.expression_names, job.config.factor)}
    renderer = Renderer(synthetic.exaggerated(clip, job.config.factor), job.config.simulate.hair, job.config.simulate.noise)
    rgb, alpha = [], []
    for frame in job.progress(frames, "doubled codes"):
        picture, matte = (ablation_data.in_crop(part, index) for part in renderer.frame(index["source_frame"][frame]))
        matte = trim.trim(tracked, stronger, frame, matte, job.config.trim.neck_margin_m)[0]
        rgb.append(extract.cut(picture, crop[0], tuple(crop[1])))
        alpha.append(extract.cut(matte, crop[0], tuple(crop[1])))
    with open(job.output.doubled, "wb") as file:
        np.savez(file, frames=np.stack(rgb), alpha=np.stack(alpha), numbers=np.array(frames))


def remade(job: step.Job) -> synthetic.Clip:
    """The clip once more; StepError when it is not the one in the truth file, or no pinhole camera sees it."""
    if job.config.simulate.k1:
        raise step.StepError("simulate.k1: the ablation's true track has no lens distortion; set it to 0")
    clip = simulate.clip_of(job.config.simulate, load_head(job.input.rich))
    with np.load(job.input.truth, allow_pickle=False) as file:
        true = file["vertices"]
    if true.shape != clip.vertices.shape or np.abs(true - clip.vertices).max() > REMADE_M:
        raise step.StepError(f"{job.input.truth}: not the clip of this config; delete it and run snakemake again")
    return clip


def true_track(clip: synthetic.Clip, index: dict[str, Any]) -> dict[str, np.ndarray]:
    """The simulator's own parameters as a track of the pipeline's frames. index: content of frames.json."""
    rows, motion = np.asarray(index["source_frame"]), clip.motion
    corner = np.array([index["crop"]["x"], index["crop"]["y"]])
    real = {
        "shape": clip.shape,
        "expression": np.concatenate([motion.expression, motion.bumps], 1)[rows],
        "rotation": motion.rotation[rows],
        "neck": motion.neck[rows],
        "jaw": np.zeros((len(rows), 3)),
        "eyes": motion.eyes[rows],
        "translation": motion.translation[rows],
        "focal_px": np.array(clip.camera.focal_px * index["scale"]),
        "centre_px": (clip.camera.centre_px - corner) * index["scale"],
    }
    return {name: np.asarray(value, np.float32) for name, value in real.items()}


if __name__ == "__main__":
    step.main(run, AblationDataConfig)
