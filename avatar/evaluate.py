"""Step `evaluate`: scores of every rendered test frame, and their means.

Input: frames, alpha (trim), landmarks, track, split, render, report, lpips; train (train.json) where there is a training.
Output: per_frame (csv), metrics (json). The render is scored as it is: no test-time fitting, no alignment, no colour transfer.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch
from torch import Tensor

from avatar import lpips, metrics
from avatar.config import EvaluateConfig
from workflow import step

BATCH_FRAMES = 8
HULL_POINTS = 468  # the face mesh; MediaPipe's last ten points are the irises, inside it
HEAD_METRICS = ("psnr", "ssim", "lpips", "l1", "iou")
FACE_METRICS = ("psnr_face", "lpips_face")


def protocol(size: tuple[int, int]) -> dict[str, str]:
    """What the figures mean, in words, for frames of [H, W]."""
    return {
        "background": "white, input and render alike",
        "mask": "input composited with the trimmed alpha (head and neck); render as it is",
        "crop": "whole frame of the pipeline's crop; face: hull of the input's MediaPipe landmarks, white outside",
        "resolution": f"{size[1]}x{size[0]}",
        "psnr": f"dB over RGB in [0, 1]; equal images count as {metrics.PSNR_CAP_DB:g} dB",
        "ssim": "Gaussian window 11 px, sigma 1.5 px, mean over channels, 5 px border left out (as scikit-image)",
        "lpips": f"{lpips.NETWORK}; {lpips.INPUT_RANGE}",
        "lpips_face": f"on the hull's bounding box, widened with white to {lpips.MIN_SIZE_PX} px where it is smaller",
        "l1": "mean absolute error over RGB in [0, 1]",
        "iou": "render opacity and trimmed alpha, both cut at 0.5",
        "test_time_fitting": "none",
    }


def face_hull(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Mask of the convex hull of the face landmarks.

    Args:
        points: [478, 2 or 3] px, pixel centres at +0.5.
        size: H, W.

    Returns:
        bool [H, W]; empty where the face is outside the frame.
    """
    corners = np.round(points[:HULL_POINTS, :2] - 0.5).astype(np.int32)
    mask = np.zeros(size, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(corners), 1)
    return mask.astype(bool)


def face_crop(image: Tensor, hull: np.ndarray) -> Tensor:
    """The hull's bounding box of image [3, H, W], white outside the hull, at least LPIPS's smallest size: [1, 3, h, w]."""
    rows, columns = np.flatnonzero(hull.any(1)), np.flatnonzero(hull.any(0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    inside = torch.from_numpy(hull[box]).to(image.device)
    crop = torch.where(inside, image[(slice(None), *box)], torch.ones_like(image[(slice(None), *box)]))
    height, width = crop.shape[1:]
    short = (max(0, lpips.MIN_SIZE_PX - width), max(0, lpips.MIN_SIZE_PX - height))
    return torch.nn.functional.pad(crop, (0, short[0], 0, short[1]), value=1.0)[None]


def images(array: np.ndarray, device: str) -> Tensor:
    """uint8 [B, H, W, C] -> float [B, C, H, W] in [0, 1] on the device."""
    return torch.from_numpy(array).to(device).float().div(255).permute(0, 3, 1, 2)


def score(
    truth: Tensor, render: Tensor, alpha: Tensor, hulls: list[np.ndarray | None], network: lpips.Lpips
) -> list[dict[str, float]]:
    """Scores of a batch of frames, one dict a frame; face metrics only where there is a hull.

    Args:
        truth: [B, 3, H, W] RGB in [0, 1], as filmed.
        render: [B, 4, H, W] colour on white and opacity.
        alpha: [B, H, W] trimmed alpha.
        hulls: B masks bool [H, W], None where no face was found.
        network: LPIPS.
    """
    truth = truth * alpha[:, None] + (1 - alpha[:, None])
    colour = render[:, :3]
    whole = {
        "psnr": metrics.psnr(colour, truth),
        "ssim": metrics.ssim(colour, truth),
        "lpips": network(colour, truth),
        "l1": metrics.l1(colour, truth),
        "iou": metrics.mask_iou(render[:, 3], alpha),
    }
    rows = [{name: float(values[index]) for name, values in whole.items()} for index in range(len(truth))]
    for index, (row, hull) in enumerate(zip(rows, hulls, strict=True)):
        if hull is not None:
            mask = torch.from_numpy(hull).to(truth.device)[None]
            row["psnr_face"] = float(metrics.psnr(colour[index : index + 1], truth[index : index + 1], mask))
            row["lpips_face"] = float(network(face_crop(colour[index], hull), face_crop(truth[index], hull)))
    return rows


def summary(table: pd.DataFrame) -> dict[str, dict[str, float | int]]:
    """Mean, standard deviation over frames (population) and count of each metric."""
    return {
        name: {"mean": float(table[name].mean()), "std": float(table[name].std(ddof=0)), "n": int(table[name].count())}
        for name in (*HEAD_METRICS, *FACE_METRICS)
        if table[name].count()
    }


def _check(rows: list[dict[str, Any]], render: Path) -> None:
    """StepError naming the frame when a score is NaN or infinite."""
    for row in rows:
        for name, value in row.items():
            if isinstance(value, float) and not math.isfinite(value):
                where = f"{render}: frame {row['frame']} has {name} = {value}"
                raise step.StepError(f"{where}; the render is broken, delete it and run snakemake again")


def _load(job: step.Job) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
    """frames, alpha, render, usable, found, points and the render's report; StepError when they do not belong together."""
    frames, alpha, render = (np.load(path, mmap_mode="r") for path in (job.input.frames, job.input.alpha, job.input.render))
    report = step.read_json(job.input.report)
    expected = (len(report["frames"]), *frames.shape[1:3], 4)
    if render.shape != expected:
        raise step.StepError(f"{job.input.render}: expected shape {expected}, found {render.shape}; delete it and run again")
    foreign = set(report["frames"]) - set(step.read_json(job.input.split)["test"])
    if foreign:
        raise step.StepError(f"{job.input.report}: frame {min(foreign)} is not a test frame; delete it and run again")
    with np.load(job.input.track, allow_pickle=False) as track, np.load(job.input.landmarks, allow_pickle=False) as landmarks:
        return frames, alpha, render, track["usable"], landmarks["found"], landmarks["points"], report


def run(job: step.Job) -> None:
    """Score the rendered frames that the fit could track."""
    frames, alpha, render, usable, found, points, report = _load(job)
    try:
        network = lpips.load(job.input.lpips, job.device)
    except ValueError as error:
        raise step.StepError(f"{error}; delete it and run snakemake again to fetch it") from None
    scored = [(place, frame) for place, frame in enumerate(report["frames"]) if usable[frame]]
    excluded = [frame for frame in report["frames"] if not usable[frame]]
    if not scored:
        what = f"none of the {len(excluded)} test frames of {job.subject} could be tracked"
        raise step.StepError(f"{job.input.track}: {what}; keep the face in view in the last quarter of the video")
    size = frames.shape[1:3]
    rows: list[dict[str, Any]] = []

    for start in job.progress(range(0, len(scored), BATCH_FRAMES), "batches of test frames"):
        batch = scored[start : start + BATCH_FRAMES]
        places, chosen = [place for place, _ in batch], [frame for _, frame in batch]
        mask = images(alpha[chosen][..., None], job.device)[:, 0]
        hulls = [face_hull(points[frame], size) if found[frame] else None for frame in chosen]
        hulls = [hull if hull is not None and hull.any() else None for hull in hulls]
        scores = score(images(frames[chosen], job.device), images(render[places], job.device), mask, hulls, network)
        for frame, row, hull in zip(chosen, scores, hulls, strict=True):
            rows.append({"frame": frame} | row | {"note": "" if hull is not None else "no face landmarks: face scores left out"})
    _check(rows, job.input.render)
    table = pd.DataFrame(rows, columns=["frame", *HEAD_METRICS, *FACE_METRICS, "note"])
    table.to_csv(job.output.per_frame, index=False, float_format="%.6f")
    train = step.read_json(job.input.train) if hasattr(job.input, "train") else {}
    job.write_json(
        job.output.metrics,
        {
            "predictor": bool(report.get("predictor", False)),
            "metrics": summary(table),
            "test_frames": len(report["frames"]),
            "scored_frames": len(rows),
            "excluded": {
                "count": len(excluded),
                "reason": "the fit could not track them (track.npz: usable)",
                "frames": excluded,
            },
            "ms_per_frame": float(report["ms_per_frame"]),
            "training_seconds": train.get("train_seconds"),
            "protocol": protocol(size) | {"frames": f"{len(rows)} of {len(report['frames'])} rendered test frames"},
        },
    )
    job.log.info("%d frames: %s", len(rows), ", ".join(f"{name} {value['mean']:.4g}" for name, value in summary(table).items()))


if __name__ == "__main__":
    step.main(run, EvaluateConfig)
