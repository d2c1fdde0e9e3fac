"""Step: the matte without clothes: head, hair and neck only, cut with the fitted mesh.

    python -m fitting.trim --input head=resources/heads/anny.npz alpha=results/ann/matte/alpha.npy track=... \\
        --output alpha=results/ann/trim/alpha.npy report=results/ann/trim/trim.json

What is kept, along the head's own down axis: everything of the person above the mouth (hair is as wide as it likes), and below it
what lies within a margin of jaw and neck, down to where the mesh's neck ends.  Hair that falls beside the neck goes with the
clothes there: nothing in a matte tells them apart.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from fitting import raster
from fitting.config import TrimConfig
from fitting.files import load_head
from fitting.head_model import REGIONS, HeadModel
from fitting.stack import StackWriter
from workflow import step

FADE_M = 0.006  # the cut is soft over this length
MOUTH_ABOVE_CHIN_M = 0.035  # beside the neck the cut lies at mouth level: raised shoulders reach the chin's


def run(job: step.Job) -> None:
    """Trim every frame of one subject."""
    head = load_head(job.input.head)
    alpha = np.load(job.input.alpha, mmap_mode="r")
    with np.load(job.input.track, allow_pickle=False) as file:
        track = {name: file[name] for name in file.files}
    if str(track["head_digest"]) != head.digest:
        raise step.StepError(
            f"{job.input.track}: fitted with head model {track['head_digest']}, but {job.input.head} is {head.digest}; fit again"
        )
    if len(track["usable"]) != len(alpha):
        raise step.StepError(
            f"{job.input.track}: {len(track['usable'])} rows for {len(alpha)} mattes; delete it and run snakemake again"
        )
    kept, outside = [], []
    with StackWriter(job.output.alpha) as writer:
        for row in job.progress(range(len(alpha)), "trim"):
            trimmed, mesh = trim(head, track, row, alpha[row], job.config.neck_margin_m)
            writer.append(trimmed)
            if track["usable"][row]:
                kept.append(float(trimmed.sum() / max(int(alpha[row].sum()), 1)))
                outside.append(float((alpha[row][mesh] < 128).mean()) if mesh.any() else 1.0)
    job.write_json(
        job.output.report,
        {
            "frames": len(alpha),
            "matte_kept": round(float(np.median(kept)), 4),
            "mesh_outside_matte_percent": {
                "median": round(100 * float(np.median(outside)), 3),
                "p95": round(100 * float(np.percentile(outside, 95)), 3),
            },
        },
    )


def trim(
    head: HeadModel, track: dict[str, np.ndarray], row: int, alpha: np.ndarray, neck_margin_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """The matte [H, W] uint8 of one frame of a track without clothes, and the pixels [H, W] bool of the mesh."""
    vertices = posed(head, track, row)
    projected = raster.project(vertices, float(track["focal_px"]), track["centre_px"])
    mesh = raster.rasterise(projected, head.triangles.numpy(), alpha.shape)[0] >= 0
    px_per_m = float(track["focal_px"]) / float(np.median(vertices[:, 2]))
    lengths = (length * px_per_m for length in (neck_margin_m, FADE_M, MOUTH_ABOVE_CHIN_M))
    chin = head.region.numpy() == REGIONS.index("face")
    return head_and_neck(alpha, mesh, projected[chin, :2], down_axis(track["rotation"][row]), *lengths), mesh


def posed(head: HeadModel, track: dict[str, np.ndarray], row: int) -> np.ndarray:
    """Vertices [V, 3] m in camera axes of one frame of a track."""
    value = lambda name: torch.from_numpy(track[name][row : row + 1])  # noqa: E731
    return (
        head.forward(
            torch.from_numpy(track["shape"]),
            value("expression"),
            value("rotation"),
            value("neck"),
            value("jaw"),
            value("eyes"),
            value("translation"),
        )[0]
        .numpy()
        .astype(np.float64)
    )


def down_axis(rotation: np.ndarray) -> np.ndarray:
    """Unit image direction [2] of the head's own down axis; straight down where the head looks up or down along the view."""
    direction = cv2.Rodrigues(rotation.astype(np.float64))[0][:2, 1]
    length = np.linalg.norm(direction)
    return direction / length if length > 0.2 else np.array([0.0, 1.0])


def head_and_neck(
    alpha: np.ndarray,
    mesh: np.ndarray,
    face_points: np.ndarray,
    down: np.ndarray,
    margin_px: float,
    fade_px: float,
    mouth_px: float,
) -> np.ndarray:
    """Cut one matte.

    Args:
        alpha: [H, W] uint8, the whole person; mesh: [H, W] bool, pixels of the fitted mesh.
        face_points: [N, 2] px, projected face vertices: their lowest is the chin.
        down: [2] unit vector, the head's down axis in the image.
        margin_px: how far beside the neck skin may reach; fade_px: softness of the cut; mouth_px: how far
            above the chin the mouth is.

    Returns:
        [H, W] uint8, nowhere above alpha; zero where the mesh is not in the picture.
    """
    if not mesh.any():
        return np.zeros_like(alpha)
    rows, columns = np.mgrid[: alpha.shape[0], : alpha.shape[1]] + 0.5
    along = (columns * down[0] + rows * down[1]).astype(np.float32)
    across = (columns * down[1] - rows * down[0]).astype(np.float32)
    mouth = float((face_points @ down).max()) - mouth_px
    start = int(np.floor(across.min()))
    column = np.floor(across).astype(int) - start
    bottom = np.full(column.max() + 1, -np.inf)
    np.maximum.at(bottom, column[mesh], along[mesh])
    reach = maximum_filter1d(bottom, 2 * int(round(margin_px)) + 1, mode="nearest")  # as deep beside the mesh as the mesh itself
    limit = gaussian_filter1d(np.maximum(reach, mouth), max(fade_px, 0.1), mode="nearest")  # no hard vertical edges
    keep = np.clip((limit[column] - along) / max(fade_px, 1.0) + 0.5, 0, 1)
    trimmed = alpha * keep
    count, label = cv2.connectedComponents((trimmed > 127).astype(np.uint8), connectivity=4)
    if count > 2:  # what the cut has parted from the head: shoulders beside it, a hand; strands of hair end above it
        touching = np.bincount(label[mesh], minlength=count)
        touching[0] = 0
        deepest = np.full(count, -np.inf)
        np.maximum.at(deepest, label.ravel(), along.ravel())
        parted = (touching < 0.1 * touching.max()) & (deepest > mouth - 2 * fade_px)
        parted[0] = False
        others = parted[label]
        trimmed = trimmed * (cv2.dilate(others.astype(np.uint8), np.ones((7, 7), np.uint8)) == 0)
    return np.round(trimmed).astype(np.uint8)


if __name__ == "__main__":
    step.main(run, TrimConfig)
