"""Step: one cell of the ablation, that is one training, the render of the test frames and their scores (paper, section 4.4).

    python -m avatar.ablation.cell --config '{"train": {"representation": "ours_c"}}' --input head=... frames=... alpha=... \\
        track=... split=... lpips=... doubled=... --output row=results/ablation/rows/ann/ours_c/0.json picture=...

The training is `avatar.train`'s own, checkpoint and resume included. Where there are true pictures of doubled codes (`doubled`,
simulated subjects only), the avatar is driven by the track's codes times two as well.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from avatar import evaluate, lpips, render, train
from avatar.ablation.config import AblationConfig
from avatar.config import RenderConfig
from avatar.networks import best_precision
from avatar.report import pictures
from fitting.files import load_head
from fitting.synthetic_motion import exaggerated
from workflow import step

SHOWN = 6  # test frames in the picture
INSIDE = 250  # of 255: the matte inside the head, without its rim
METRICS = ("lpips", "ssim", "psnr")


def run(job: step.Job) -> None:
    """Write the row and the picture. A training that diverges is a row with its reason; the other cells do not wait for it."""
    work = job.final.row.with_suffix("")  # outlives a kill
    work.mkdir(parents=True, exist_ok=True)
    row = {"load": round(os.getloadavg()[0], 2)}
    try:
        train.run(training(job, work))
    except train.TrainingFailed as error:
        shutil.rmtree(work)
        job.output.picture.write_bytes(pictures.png(np.full((1, 1, 3), 255, np.uint8)))
        job.write_json(job.output.row, row | {"failed": str(error)})
        return
    report = step.read_json(work / "train.json")
    kept = ("steps", "train_seconds", "skipped_steps", "training_frames", "evaluations_per_step", "parameters")
    row |= {name: report[name] for name in kept}
    scores, shown = scored(job, work)
    job.output.picture.write_bytes(pictures.png(np.concatenate(shown)))
    job.write_json(job.output.row, row | {"scores": scores})
    shutil.rmtree(work)
    job.log.info("%s", ", ".join(f"{name}: lpips {found['lpips']:.4f}" for name, found in scores.items()))


def training(job: step.Job, work: Path) -> step.Job:
    """The job of `avatar.train`, with its files in the folder `work`."""
    outputs = SimpleNamespace(avatar=work / "avatar.pt", curve=work / "curve.tsv", report=work / "train.json")
    return replace(job, config=job.config.train, output=outputs, final=outputs)


def scored(job: step.Job, work: Path) -> tuple[dict[str, dict[str, float]], list[np.ndarray]]:
    """Scores by set of test frames, and strips [H, W, 3] uint8 of truth above render."""
    network = lpips.load(job.input.lpips, job.device)
    frames, alpha = np.load(job.input.frames, mmap_mode="r"), np.load(job.input.alpha, mmap_mode="r")
    sets: dict[str, tuple[Path, Any, Any]] = {}
    test = step.read_json(job.input.split)["test"]
    sets["test"] = job.input.track, frames[test], alpha[test]
    if hasattr(job.input, "doubled"):
        with np.load(job.input.doubled, allow_pickle=False) as file:
            if file["numbers"].tolist() != test:
                raise step.StepError(f"{job.input.doubled}: not of the frames of {job.input.split}; run snakemake again")
            sets["doubled"] = doubled_track(job, work), file["frames"], file["alpha"]
    scores, shown = {}, []
    for name, (track, truth, matte) in sets.items():
        drawn = rendered(job, work, track, truth.shape[1:3])
        inside = [opaque > INSIDE for opaque in matte]
        filmed, made, mask = (evaluate.images(part, job.device) for part in (truth, drawn, matte[..., None]))
        rows = evaluate.score(filmed, made, mask[:, 0], inside, network)
        scores[name] = {metric: round(float(np.mean([row[metric] for row in rows])), 6) for metric in METRICS}
        scores[name] |= {"psnr_inside": round(float(np.mean([row["psnr_face"] for row in rows])), 6), "frames": len(rows)}
        places = np.linspace(0, len(rows) - 1, min(SHOWN, len(rows))).round().astype(int)
        shown.append(pictures.strip([pictures.on_white(truth[place], matte[place]) for place in places]))
        shown.append(pictures.strip([drawn[place, ..., :3] for place in places]))
    return scores, shown


def doubled_track(job: step.Job, work: Path) -> Path:
    """The cell's track with its codes multiplied."""
    with np.load(job.input.track, allow_pickle=False) as file:
        track = {name: file[name] for name in file.files}
    names = load_head(job.input.head).expression_names
    path = work / "doubled.npz"
    np.savez(path, **track | {"expression": exaggerated(track["expression"], names, job.config.factor)})
    return path


def rendered(job: step.Job, work: Path, track: Path, size: tuple[int, int]) -> np.ndarray:
    """The test frames [B, H, W, 4] uint8 of the trained avatar with the poses and codes of a track."""
    names = SimpleNamespace(head=job.input.head, avatar=work / "avatar.pt", track=track, split=job.input.split)
    avatar, scene, frames = render.load(replace(job, config=RenderConfig(sample_factor=job.config.sample_factor), input=names))
    precision = best_precision(job.device)
    drawn = [
        render.render_frame(avatar, scene, frame, size, precision, job.device)[0] for frame in job.progress(frames, "rendering")
    ]
    return np.stack(drawn)


if __name__ == "__main__":
    step.main(run, AblationConfig)
