"""Frames, mattes and tracks as rays with colours. Arrays in, arrays out; frames stay memory-mapped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avatar.features import Condition
from avatar.view import View
from avatar.volume import Rays
from fitting.head_model import HeadModel

TRACK_FIELDS = ("shape", "expression", "rotation", "neck", "jaw", "eyes", "translation", "focal_px", "centre_px")
POSE_BLOCK = 64


class Scene:
    """One tracked clip: camera and posed head of every frame, in the neck-normalised head frame."""

    def __init__(self, head: HeadModel, track: Mapping[str, np.ndarray], frames: Sequence[int]) -> None:
        """Pose the head in the given frames.

        track: the arrays of fit/track.npz.
        Raises ValueError naming a missing array, another head model, or the first frame whose pose is not finite.
        """
        if missing := [name for name in TRACK_FIELDS if name not in track]:
            raise ValueError(f"the track lacks {', '.join(missing)}")
        if (digest := str(track.get("head_digest", head.digest))) != head.digest:
            raise ValueError(f"the track belongs to head model {digest}, found {head.name} {head.digest}")
        values = {name: torch.from_numpy(np.asarray(track[name])).to(head.template.dtype) for name in TRACK_FIELDS}
        for name in ("expression", "rotation", "neck", "jaw", "eyes", "translation"):
            for frame in frames:
                if not torch.isfinite(values[name][frame]).all():
                    raise ValueError(f"the pose of frame {frame} is not finite ({name})")
        for name in ("shape", "focal_px", "centre_px"):
            if not torch.isfinite(values[name]).all():
                raise ValueError(f"{name} of the track is not finite")
        self.head, self.frames = head, list(frames)
        self.place = {frame: place for place, frame in enumerate(self.frames)}
        self.focal_px, self.centre_px = float(values["focal_px"]), values["centre_px"].numpy().astype(np.float64)
        self.neutral_m = head.shaped(values["shape"])  # [V, 3]
        chosen = {name: values[name][self.frames] for name in ("expression", "rotation", "neck", "jaw", "eyes", "translation")}
        where = (chosen[name] for name in ("rotation", "neck", "translation", "expression"))
        matrix, offset = head.rigid(values["shape"], *where)
        self.rotation, self.offset_m = matrix.double().numpy(), offset.double().numpy()
        vertices, displacement = [], []
        for start in range(0, len(self.frames), POSE_BLOCK):
            block = {name: value[start : start + POSE_BLOCK] for name, value in chosen.items()}
            shape, expression, jaw, neck = values["shape"], block["expression"], block["jaw"], block["neck"]
            vertices.append(head.local(shape, expression, jaw, block["eyes"], neck))
            # No neck here: the displacement must not depend on it, also not below the neck joint.
            displacement.append(head.local(shape, expression, jaw) - self.neutral_m)
        self.vertices_m, self.displacement_m = torch.cat(vertices), torch.cat(displacement)  # [T, V, 3] each
        self.codes = torch.cat([chosen["expression"], chosen["jaw"]], 1)  # [T, D]; eyes left out, neck normalised away

    def heads(self, frames: Sequence[int], device: str, training: bool = False) -> tuple[Tensor, Condition]:
        """Posed vertices [B, V, 3] with eye pose, and what a source of features may read of these frames.

        training: the scene's frames are the training frames, and each knows its place in time.
        """
        places = [self.place[frame] for frame in frames]
        time = torch.tensor(places, dtype=torch.float32, device=device) / max(len(self.frames) - 1, 1) if training else None
        neutral = self.neutral_m.to(device)
        condition = Condition(self.displacement_m[places].to(device), self.codes[places].to(device), neutral, time)
        return self.vertices_m[places].to(device), condition

    def view(self, frame: int, size: tuple[int, int]) -> View:
        """The camera of a frame for a picture of `size` (H, W)."""
        place = self.place[frame]
        return View(self.focal_px, self.centre_px, self.rotation[place], self.offset_m[place], size)

    def camera_centre_m(self, frame: int) -> np.ndarray:
        """Camera centre [3] in the head frame."""
        place = self.place[frame]
        return -self.rotation[place].T @ self.offset_m[place]

    def rays(self, frame: int, columns: np.ndarray, rows: np.ndarray) -> Rays:
        """Rays through pixel centres; columns, rows: [N] integers."""
        return self.view(frame, (0, 0)).through(columns, rows)

    def pixels_of(self, frame: int, points_m: np.ndarray) -> np.ndarray:
        """Projections [N, 2] (column, row; pixel centres at +0.5) of head-frame points [N, 3]."""
        return self.view(frame, (0, 0)).pixels_of(points_m)[:, :2]


def on_white(frame: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """frame: [..., 3] uint8; alpha: [...] uint8. Returns float32 [..., 3] in [0, 1] composited on white."""
    opacity = alpha[..., None].astype(np.float32) / 255
    return frame.astype(np.float32) / 255 * opacity + (1 - opacity)


@dataclass
class Cells:
    """Blocks of CELL x CELL pixels of one frame that may hold rays, with the chance of each."""

    columns: np.ndarray  # [Q] of the block's first pixel
    rows: np.ndarray
    cumulative: np.ndarray  # [Q] cumulative probability


CELL = 4
OUTSIDE_SHARE = 0.25  # weight of shell pixels away from the matte: always white, soon learned
FEATURE_SHARE = 0.3  # of a frame's rays that fall on mouth and eyes


def cells_of(hit: np.ndarray, near_matte: np.ndarray, features: np.ndarray | None = None) -> Cells:
    """Where a frame's rays are drawn.

    hit: [h, w] bool, blocks whose rays meet the shell; near_matte: [h, w] bool, blocks at or beside opaque pixels.
    features: [h, w] bool, blocks of mouth and eyes: they get at least FEATURE_SHARE of the rays.
    """
    rows, columns = np.nonzero(hit)
    weight = np.where(near_matte[rows, columns], 1.0, OUTSIDE_SHARE)
    if features is not None:
        chosen = features[rows, columns] & near_matte[rows, columns]
        inside, outside = weight[chosen].sum(), weight[~chosen].sum()
        if inside:
            weight[chosen] *= max(1.0, FEATURE_SHARE / (1 - FEATURE_SHARE) * outside / inside)
    total = weight.sum()
    cumulative = (np.cumsum(weight) / (total if total > 0 else 1)).astype(np.float32)
    return Cells((columns * CELL).astype(np.int16), (rows * CELL).astype(np.int16), cumulative)  # one for every frame: small


def draw(cells: Cells, count: int, size: tuple[int, int], random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """`count` pixels (columns, rows) of a frame of `size` (height, width); none where there are no cells."""
    if not len(cells.columns):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    cell = np.minimum(np.searchsorted(cells.cumulative, random.random(count)), len(cells.columns) - 1)
    within = random.integers(0, CELL, (2, count))
    columns = np.minimum(cells.columns[cell].astype(np.int64) + within[0], size[1] - 1)
    return columns, np.minimum(cells.rows[cell].astype(np.int64) + within[1], size[0] - 1)


def shrink_any(alpha: np.ndarray, threshold: int = 3) -> np.ndarray:
    """alpha: [H, W] uint8. Returns [ceil(H / CELL), ceil(W / CELL)] bool: any pixel of the block at least `threshold`."""
    height, width = (-(-side // CELL) for side in alpha.shape)
    padded = np.zeros((height * CELL, width * CELL), np.uint8)
    padded[: alpha.shape[0], : alpha.shape[1]] = alpha
    return (padded.reshape(height, CELL, width, CELL) >= threshold).any((1, 3))
