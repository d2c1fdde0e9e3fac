"""Step: test frames of one avatar drawn in one way: their error, their time, and the evaluations and operations behind them.

    python -m avatar.speed_error.rendering --config '{"samples": 8}' --input head=... avatar=... report=... frames=... \\
        alpha=... landmarks=... track=... split=... lpips=... --output row=... render=...

Time counts all work of a frame never seen before, as the step `render` counts it. Evaluations are counted over all rays, and
once more over the rays of the head alone (the matte, cut at one half): the share of white differs from clip to clip.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch

from avatar import build, evaluate, lpips, marching, regions
from avatar.config import RenderConfig
from avatar.dataset import Scene
from avatar.frames import chosen_frames
from avatar.networks import best_precision
from avatar.operations import operations
from avatar.speed_error import dense
from avatar.speed_error.config import RenderingConfig
from avatar.volume import Rays, Rendered
from fitting import extract
from fitting.files import load_head
from workflow import step

SAMPLE_FACTOR = RenderConfig().sample_factor
OPAQUE = 127  # of 255: a ray of the head
HEAD_FRAMES = 2  # whose head is drawn once more, to count
METRICS = ("psnr", "ssim", "lpips", "iou", "psnr_face", "lpips_face", "psnr_mouth", "lpips_mouth")
Draw = Callable[[Any, Any], tuple[Rendered, int]]
"""Posed head and view -> its rays and the evaluations."""


def run(job: step.Job) -> None:
    """Write the row, and the frames [B, H, W, 4] uint8 as they were drawn."""
    report = step.read_json(job.input.report)
    if "failed" in report:
        save(job, np.zeros((0, 1, 1, 4), np.uint8))
        job.write_json(job.output.row, {"failed": report["failed"]})
        return
    truth = Truth(job)
    avatar, head = load(job)
    kept = ("steps", "train_seconds", "evaluations_per_step", "peak_memory_mb", "probe_psnr", "parameters")
    row: dict[str, Any] = {"training": {name: report.get(name) for name in kept}}
    drawn, timed = draw(job, avatar, head, truth)
    row |= timed | counted(avatar, head, timed, truth)
    row["memory_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)  # before the networks of LPIPS
    row["scores"] = scores(job, truth, drawn)
    save(job, drawn)
    job.write_json(job.output.row, row)
    job.log.info("%.2f dB, LPIPS %.4f, %.0f ms", row["scores"]["psnr"], row["scores"]["lpips"], row["ms_per_frame"])


def save(job: step.Job, drawn: np.ndarray) -> None:
    """Write frames under the temporary name as it is, without another suffix."""
    with open(job.output.render, "wb") as file:
        np.save(file, drawn)


class Truth:
    """The test frames that are drawn, at the size that is asked for."""

    def __init__(self, job: step.Job) -> None:
        """Raises StepError when no test frame could be tracked."""
        with np.load(job.input.track, allow_pickle=False) as file:
            track = {name: file[name] for name in file.files}
        frames, alpha = np.load(job.input.frames, mmap_mode="r"), np.load(job.input.alpha, mmap_mode="r")
        test = [frame for frame in step.read_json(job.input.split)["test"] if track["usable"][frame]]
        if not test:
            raise step.StepError(f"{job.input.track}: none of the test frames could be tracked")
        self.chosen = chosen_frames(test, job.config.frames)
        whole = {"x": 0, "y": 0, "width": frames.shape[2], "height": frames.shape[1]}
        crop, self.size, scale = extract.fit_crop(whole, job.config.size)
        self.frames = np.stack([extract.cut(frames[frame], crop, self.size) for frame in self.chosen])
        self.alpha = np.stack([extract.cut(alpha[frame], crop, self.size) for frame in self.chosen])
        corner = np.array([crop["x"], crop["y"]])
        self.track = track | {"centre_px": (track["centre_px"] - corner) * scale, "focal_px": track["focal_px"] * scale}
        with np.load(job.input.landmarks, allow_pickle=False) as file:
            found, points = file["found"], (file["points"][self.chosen, :, :2] - corner) * scale
        self.points = [points[place] if found[frame] else None for place, frame in enumerate(self.chosen)]


def load(job: step.Job) -> tuple[torch.nn.Module, Any]:
    """The avatar, sampling as the config asks, and its head model."""
    head, config = load_head(job.input.head), job.config
    avatar = build.restore(torch.load(job.input.avatar, map_location=job.device, weights_only=True), head).to(job.device)
    if config.end is not None:
        marching.END = config.end  # of this process alone
    if config.sampling == "own" and hasattr(avatar, "sharpen"):
        most = getattr(avatar, "coarse_samples" if getattr(avatar, "hierarchical", False) else "max_samples", None)
        guided = 1.0 if getattr(avatar, "hierarchical", False) else marching.GUIDED
        avatar.sharpen(SAMPLE_FACTOR if config.samples is None or most is None else config.samples / (most * guided))
    return avatar, head


def drawer(job: step.Job, avatar: torch.nn.Module) -> Draw:
    """How the avatar is drawn."""
    precision, config = best_precision(job.device), job.config
    if config.sampling == "own":
        return lambda posed, view: avatar.picture(posed, view, precision)
    march = partial(dense.march, avatar, precision=precision, uniform=config.samples or 64, fine=config.fine_samples)
    return lambda posed, view: march(posed, view.rays())


def draw(job: step.Job, avatar: torch.nn.Module, head: Any, truth: Truth) -> tuple[np.ndarray, dict[str, Any]]:
    """The frames [B, H, W, 4] uint8 and their milliseconds and evaluations; of the head's rays alone where rays can be chosen."""
    make, milliseconds, evaluations, alone = drawer(job, avatar), [], 0, []
    drawn = np.empty((len(truth.chosen), *truth.size, 4), np.uint8)
    first = Scene(head, truth.track, truth.chosen[:1])
    make(avatar.pose(*first.heads(truth.chosen[:1], job.device)), first.view(truth.chosen[0], (8, 8)))  # compiles
    for place, frame in enumerate(job.progress(truth.chosen, "rendering")):
        started = time.perf_counter()
        scene = Scene(head, truth.track, [frame])
        posed, view = avatar.pose(*scene.heads([frame], job.device)), scene.view(frame, truth.size)
        rendered, count = make(posed, view)
        image = torch.cat([rendered.colour, rendered.opacity[:, None]], 1).clamp(0, 1)
        drawn[place] = (image * 255 + 0.5).byte().cpu().numpy().reshape(*truth.size, 4)
        milliseconds.append(1000 * (time.perf_counter() - started))
        if not torch.isfinite(image).all():
            raise step.StepError(f"the render of frame {frame} is not finite; delete {job.input.avatar} and run snakemake again")
        evaluations += count
        if job.config.sampling == "own" and hasattr(avatar, "march") and place < HEAD_FRAMES:
            rays, inside = view.rays(), truth.alpha[place].ravel() > OPAQUE
            some = Rays(*(array[inside] for array in rays))
            alone.append(avatar.march(posed, some, best_precision(job.device))[1] / max(int(inside.sum()), 1))
    pixels = truth.size[0] * truth.size[1] * len(truth.chosen)
    per_ray = evaluations / pixels
    return drawn, {
        "frames": truth.chosen,
        "size": list(truth.size),
        "threads": torch.get_num_threads(),
        "ms_per_frame": round(float(np.median(milliseconds)), 1),
        "ms": [round(value, 1) for value in milliseconds],
        "evaluations_per_ray": round(per_ray, 4),
        "evaluations_per_head_ray": round(float(np.mean(alone)), 4) if alone else head_share(job, per_ray, truth),
    }


def head_share(job: step.Job, per_ray: float, truth: Truth) -> float:
    """Evaluations a ray of the head, where rays cannot be chosen: whole rays cost the same anywhere, others nothing on white."""
    return round(per_ray if job.config.sampling != "own" else per_ray / float((truth.alpha > OPAQUE).mean()), 4)


def counted(avatar: torch.nn.Module, head: Any, timed: dict[str, Any], truth: Truth) -> dict[str, Any]:
    """GFLOP of a frame, and of its rays on the head alone; what is done once a frame is in both."""
    found = operations(avatar, head)
    if found is None:
        return {"gflop_per_frame": None, "gflop_of_head": None}
    sample, frame = found
    heads = float((truth.alpha > OPAQUE).sum() / len(truth.alpha))
    rays = {"gflop_per_frame": timed["evaluations_per_ray"] * truth.size[0] * truth.size[1]}
    rays["gflop_of_head"] = timed["evaluations_per_head_ray"] * heads
    return {name: round((count * sample + frame) / 1e9, 3) for name, count in rays.items()}


def scores(job: step.Job, truth: Truth, drawn: np.ndarray) -> dict[str, float]:
    """Means over the frames of the project's own metrics, in its own regions."""
    network = lpips.load(job.input.lpips, job.device)
    parts = [regions.find(points, truth.size) for points in truth.points]
    pictures = (evaluate.images(array, job.device) for array in (truth.frames, drawn, truth.alpha[..., None]))
    filmed, made, mask = pictures
    rows = evaluate.score_regions(filmed, made, mask[:, 0], parts, {"lpips": network})
    found = {name: [row[name] for row in rows if name in row] for name in METRICS}
    return {name: round(float(np.mean(values)), 6) for name, values in found.items() if values}


if __name__ == "__main__":
    step.main(run, RenderingConfig)
