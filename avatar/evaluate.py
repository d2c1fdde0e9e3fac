"""Step `evaluate`: scores of every rendered test frame, and their means, for the whole head and for face, mouth and eyes.

Input: frames, alpha (trim), landmarks, track, split, render, report, lpips (one checkpoint for each of the config's networks, in
its order); train (train.json) where there is a training. Output: per_frame (csv), metrics (json).
The render is scored as it is: no test-time fitting, no alignment, no colour transfer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from avatar import lpips, metrics, regions
from avatar.config import EvaluateConfig
from avatar.regions import Regions
from avatar.report.results import many
from workflow import step

BATCH_FRAMES = 8
HEAD_METRICS = ("psnr", "ssim", "lpips", "l1", "iou")
REGION_METRICS = ("psnr", "ssim", "lpips", "l1")
NOT_TIMED = "the report of the render does not say"


def columns(networks: Sequence[str]) -> list[str]:
    """Names of all metrics, in the order of the table."""
    names = [*HEAD_METRICS, *(f"{metric}_{region}" for region in regions.NAMES for metric in REGION_METRICS)]
    for network in networks:
        if (name := lpips.METRIC[network]) != "lpips":
            names += [name, *(f"{name}_{region}" for region in regions.NAMES)]
    return names


def protocol(size: tuple[int, int], networks: Sequence[str] = ("alexnet",)) -> dict[str, str]:
    """What the figures mean, in words, for frames of [H, W]."""
    named = {lpips.METRIC[name]: f"{lpips.NETWORKS[name].name}; {lpips.INPUT_RANGE}" for name in networks}
    return {
        "background": "white, input and render alike",
        "mask": "input composited with the trimmed alpha (head and neck); render as it is",
        "crop": "whole frame of the pipeline's crop; regions from the input's MediaPipe landmarks",
        "resolution": f"{size[1]}x{size[0]}",
        "face": "hull of the face mesh's landmarks",
        "mouth": f"box around the outer lips, {regions.MARGIN:g} of the face's length wider on each side",
        "eyes": f"box around each eye, as wide; mean of both, or of the one seen (corners at least {regions.TURNED_RATIO:g} "
        "as far apart as the other's)",
        "psnr": f"dB over RGB in [0, 1]; equal images count as {metrics.PSNR_CAP_DB:g} dB; region: its pixels alone",
        "ssim": "Gaussian window 11 px, sigma 1.5 px, mean over channels, 5 px border left out (as scikit-image); "
        "region: mean of the frame's map over its pixels",
        **named,
        "lpips_regions": "face: bounding box of the hull, white outside the hull; boxes: as they are; a crop under "
        f"{lpips.MIN_SIZE_PX} px is widened by the picture around it, never resampled",
        "l1": "mean absolute error over RGB in [0, 1]; region: its pixels alone",
        "iou": "render opacity and trimmed alpha, both cut at 0.5",
        "test_time_fitting": "none",
    }


def images(array: np.ndarray, device: str) -> Tensor:
    """uint8 [B, H, W, C] -> float [B, C, H, W] in [0, 1] on the device."""
    return torch.from_numpy(array).to(device).float().div(255).permute(0, 3, 1, 2)


def score(
    truth: Tensor, render: Tensor, alpha: Tensor, hulls: list[np.ndarray | None], network: lpips.Lpips
) -> list[dict[str, float]]:
    """`score_regions` inside one mask bool [H, W] a frame, under the name of the face (None: none), with AlexNet alone."""
    found = [Regions(face=hull, notes=()) for hull in hulls]
    return score_regions(truth, render, alpha, found, {"lpips": network})


def score_regions(
    truth: Tensor, render: Tensor, alpha: Tensor, found: Sequence[Regions], networks: Mapping[str, lpips.Lpips]
) -> list[dict[str, float]]:
    """Scores of a batch of frames, one dict a frame; a region that is left out has none.

    Args:
        truth: [B, 3, H, W] RGB in [0, 1], as filmed.
        render: [B, 4, H, W] colour on white and opacity.
        alpha: [B, H, W] trimmed alpha.
        found: B frames' regions.
        networks: LPIPS by the name of its metric.
    """
    truth = truth * alpha[:, None] + (1 - alpha[:, None])
    colour = render[:, :3]
    similarity = metrics.ssim_map(colour, truth)
    whole = {
        "psnr": metrics.psnr(colour, truth),
        "ssim": metrics.inner_mean(similarity),
        "l1": metrics.l1(colour, truth),
        "iou": metrics.mask_iou(render[:, 3], alpha),
    } | {name: network(colour, truth) for name, network in networks.items()}
    rows = [{name: float(values[index]) for name, values in whole.items()} for index in range(len(truth))]
    for index, (row, parts) in enumerate(zip(rows, found, strict=True)):
        frame = slice(index, index + 1)
        pair = colour[frame], truth[frame], similarity[frame]
        for region, several in (("face", [parts.face]), ("mouth", parts.mouth), ("eyes", parts.eyes)):
            scores = [region_scores(*pair, part, networks) for part in several if part is not None]
            for name in scores[0] if scores else ():
                row[f"{name}_{region}"] = sum(score[name] for score in scores) / len(scores)
    return rows


def region_scores(
    colour: Tensor, truth: Tensor, similarity: Tensor, part: np.ndarray | regions.Box, networks: Mapping[str, lpips.Lpips]
) -> dict[str, float]:
    """Scores of one region of one frame.

    Args:
        colour, truth: [1, 3, H, W] in [0, 1], on white.
        similarity: [1, H - 10, W - 10] of `metrics.ssim_map`.
        part: mask bool [H, W] or box.
    """
    size = (truth.shape[2], truth.shape[3])
    if isinstance(part, regions.Box):
        inside = np.zeros(size, bool)
        inside[part.slices] = True
        box, white = part, False
    else:
        inside, box, white = part, regions.around(part), True
    mask = torch.from_numpy(inside).to(truth.device)[None]
    crop = (slice(None), slice(None), *regions.widened(box, lpips.MIN_SIZE_PX, size).slices)
    crops = [torch.where(mask[:, None], image, 1)[crop] if white else image[crop] for image in (colour, truth)]
    return {
        "psnr": float(metrics.psnr(colour, truth, mask)),
        "ssim": float(metrics.inner_mean(similarity, mask)),
        "l1": float(metrics.l1(colour, truth, mask)),
    } | {name: float(network(*crops)) for name, network in networks.items()}


def summary(table: pd.DataFrame, names: Sequence[str]) -> dict[str, dict[str, float | int]]:
    """Mean, standard deviation over frames (population) and count of each metric that any frame has."""
    return {
        name: {"mean": float(table[name].mean()), "std": float(table[name].std(ddof=0)), "n": int(table[name].count())}
        for name in names
        if table[name].count()
    }


def left_out(rows: Sequence[dict[str, Any]]) -> dict[str, int]:
    """In how many frames each reason kept a region from being scored."""
    notes = [note for row in rows for note in row["note"].split("; ") if note]
    return {note: notes.count(note) for note in dict.fromkeys(notes)}


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
    if len(report.get("ms", report["frames"])) != len(report["frames"]):
        raise step.StepError(f"{job.input.report}: ms must have one value a frame; delete it and run again")
    foreign = set(report["frames"]) - set(step.read_json(job.input.split)["test"])
    if foreign:
        raise step.StepError(f"{job.input.report}: frame {min(foreign)} is not a test frame; delete it and run again")
    with np.load(job.input.track, allow_pickle=False) as track, np.load(job.input.landmarks, allow_pickle=False) as landmarks:
        return frames, alpha, render, track["usable"], landmarks["found"], landmarks["points"], report


def _networks(job: step.Job) -> dict[str, lpips.Lpips]:
    """LPIPS by the name of its metric; StepError where a checkpoint is not what its name says."""
    try:
        pairs = zip(job.config.lpips, many(job.input, "lpips"), strict=True)
        return {lpips.METRIC[name]: lpips.load(path, job.device, name) for name, path in pairs}
    except ValueError as error:
        raise step.StepError(f"{error}; delete it and run snakemake again to fetch it") from None


def run(job: step.Job) -> None:
    """Score the rendered frames that the fit could track."""
    frames, alpha, render, usable, found, points, report = _load(job)
    networks, names, size = _networks(job), columns(job.config.lpips), frames.shape[1:3]
    scored = [(place, frame) for place, frame in enumerate(report["frames"]) if usable[frame]]
    excluded = [frame for frame in report["frames"] if not usable[frame]]
    if not scored:
        what = f"none of the {len(excluded)} test frames of {job.subject} could be tracked"
        raise step.StepError(f"{job.input.track}: {what}; keep the face in view in the last quarter of the video")
    milliseconds = report.get("ms", [None] * len(report["frames"]))
    rows: list[dict[str, Any]] = []

    for start in job.progress(range(0, len(scored), BATCH_FRAMES), "batches of test frames"):
        batch = scored[start : start + BATCH_FRAMES]
        places, chosen = [place for place, _ in batch], [frame for _, frame in batch]
        mask = images(alpha[chosen][..., None], job.device)[:, 0]
        parts = [regions.find(points[frame] if found[frame] else None, size) for frame in chosen]
        scores = score_regions(images(frames[chosen], job.device), images(render[places], job.device), mask, parts, networks)
        for place, frame, row, part in zip(places, chosen, scores, parts, strict=True):
            rows.append({"frame": frame} | row | {"ms": milliseconds[place], "note": "; ".join(part.notes)})
    _check(rows, job.input.render)
    table = pd.DataFrame(rows, columns=["frame", *names, "ms", "note"])
    table.to_csv(job.output.per_frame, index=False, float_format="%.6f")
    train = step.read_json(job.input.train) if hasattr(job.input, "train") else {}
    speed = report.get("ms_per_frame")
    means = summary(table, names)
    counted = f"{len(rows)} of {len(report['frames'])} rendered test frames"
    words = {"speed": report.get("ms_counts", NOT_TIMED), "frames": counted}
    job.write_json(
        job.output.metrics,
        {
            "predictor": bool(report.get("predictor", False)),
            "metrics": means,
            "test_frames": len(report["frames"]),
            "scored_frames": len(rows),
            "excluded": {
                "count": len(excluded),
                "reason": "the fit could not track them (track.npz: usable)",
                "frames": excluded,
            },
            "regions_left_out": left_out(rows),
            "ms_per_frame": None if speed is None else float(speed),
            "training_seconds": train.get("train_seconds"),
            "protocol": protocol(size, job.config.lpips) | words,
        },
    )
    job.log.info("%d frames: %s", len(rows), ", ".join(f"{name} {value['mean']:.4g}" for name, value in means.items()))


if __name__ == "__main__":
    step.main(run, EvaluateConfig)
