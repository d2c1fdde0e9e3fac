"""A motion rendered with an avatar: camera, viewpoints, and pictures with depth. The avatar's own rays."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from avatar.dataset import Scene
from avatar.uses.motion import PARTS, Motion
from fitting.camera import exp_rotation
from fitting.head_model import REGIONS, HeadModel

MARGIN = 0.05  # of the head's size, around it


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: pixel = focal_px * X / Z + centre_px, pixel centres at +0.5."""

    focal_px: float
    centre_px: np.ndarray  # [2] column, row
    size: tuple[int, int]  # H, W

    def resized(self, longer_px: int) -> Camera:
        """The same view with `longer_px` on the longer side, on a grid of whole pixels; never larger than it is."""
        if longer_px < 1:
            raise ValueError(f"a picture has at least one pixel, found {longer_px}")
        scale = min(1.0, longer_px / max(self.size))
        size = tuple(max(1, round(side * scale)) for side in self.size)
        return Camera(self.focal_px * scale, np.asarray(self.centre_px, np.float64) * scale, size)

    def window(self, box: dict[str, int], size: tuple[int, int]) -> Camera:
        """What this camera sees in a box (x, y, width, height; whole pixels) of its picture, on a grid of `size` (H, W)."""
        across, down = size[1] / box["width"], size[0] / box["height"]
        if abs(across - down) * max(box["width"], box["height"]) > 1:
            raise ValueError(f"a box of {box['width']}x{box['height']} does not fit {size[1]}x{size[0]} pixels unstretched")
        corner = np.array([box["x"], box["y"]])
        return Camera(self.focal_px * across, (np.asarray(self.centre_px, np.float64) - corner) * across, size)


class Picture(NamedTuple):
    """One rendered frame."""

    image: np.ndarray  # [H, W, 4] uint8, RGB on white and opacity
    depth_m: np.ndarray  # [H, W] float32 along the camera's axis; 0 where the opacity is 0
    milliseconds: float  # all work of this frame but the head model's posing, which `scene_of` does for all frames at once
    evaluations: int  # of the field


def scene_of(head: HeadModel, shape: np.ndarray, camera: Camera, motion: Motion) -> Scene:
    """The head of one identity, shape [S], posed through a motion before a camera.

    Raises ValueError where the motion is not of this head model (number of expression codes) or not finite.
    """
    if motion.expression.shape[1] != len(head.expression_names):
        have, want = motion.expression.shape[1], len(head.expression_names)
        raise ValueError(f"the motion has {have} expression codes, the head model {head.name} {want}")
    track = {name: getattr(motion, name).astype(np.float32) for name in PARTS}
    track |= {"shape": shape, "focal_px": np.float32(camera.focal_px), "centre_px": np.asarray(camera.centre_px, np.float32)}
    return Scene(head, track, range(len(motion)))


def head_centre_m(scene: Scene) -> np.ndarray:
    """Middle of the face's and scalp's box [T, 3] in camera axes: what a viewer's eye takes for the head's centre."""
    chosen = torch.isin(scene.head.region, torch.tensor([REGIONS.index("face"), REGIONS.index("scalp")]))
    points = (scene.neutral_m[chosen] if chosen.any() else scene.neutral_m).double().numpy()
    middle = (points.min(0) + points.max(0)) / 2
    return np.einsum("tij,j->ti", scene.rotation, middle) + scene.offset_m


def viewpoint(yaw_rad: np.ndarray, pitch_rad: np.ndarray) -> np.ndarray:
    """Turns [T, 3, 3] of the world for a camera that goes `yaw_rad` [T] to its right and `pitch_rad` [T] up around the head."""
    zeros = np.zeros(np.shape(yaw_rad))
    sideways = exp_rotation(np.stack([zeros, np.asarray(yaw_rad), zeros], -1))
    return exp_rotation(np.stack([np.asarray(pitch_rad), zeros, zeros], -1)) @ sideways


def turn(scene: Scene, turns: np.ndarray, pivot_m: np.ndarray) -> Scene:
    """Turn the whole scene [T, 3, 3] about a point [3] or [T, 3] in camera axes: as if the camera went around it. In place."""
    scene.rotation = turns @ scene.rotation
    scene.offset_m = np.einsum("tij,tj->ti", turns, scene.offset_m - pivot_m) + pivot_m
    return scene


def camera_angles(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Where the camera stands as the head sees it: yaw [T] and pitch [T] rad, 0 straight before the face.

    Positive yaw is the subject's left, as a camera that goes to its right; positive pitch is above the eyes' level.
    """
    towards = -np.einsum("tji,tj->ti", scene.rotation, head_centre_m(scene))
    x, y, z = towards.T
    return np.arctan2(x, -z), np.arctan2(-y, np.hypot(x, z))


def framed(scene: Scene, longer_px: int, clearance_m: np.ndarray) -> Camera:
    """Move the scene's camera (its lens, not its place) so that the head fills the picture in all frames. In place.

    clearance_m: [V] how far hair stands off each vertex. Vertices of the neck are left out: it is cut anyway.
    Returns the camera: even sides, at most about `longer_px`. Raises ValueError where a part of the head is behind the camera.
    """
    kept = (scene.head.region != REGIONS.index("neck")).numpy()
    kept = kept if kept.any() else np.ones_like(kept)
    vertices = scene.vertices_m[:, kept].double().numpy()
    points = np.einsum("tij,tvj->tvi", scene.rotation, vertices) + scene.offset_m[:, None]
    if (points[..., 2] <= 0).any():
        raise ValueError("a part of the head lies behind the camera; look at the motion's translation")
    on_plane, reach = points[..., :2] / points[..., 2:], (np.asarray(clearance_m)[kept] / points[..., 2])[..., None]
    low, high = (on_plane - reach).min((0, 1)), (on_plane + reach).max((0, 1))
    low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
    focal = longer_px / float((high - low).max())
    size = tuple(max(2, 2 * round(side / 2)) for side in ((high - low) * focal)[::-1])
    middle = np.array([size[1], size[0]]) / 2 - focal * (low + high) / 2
    scene.focal_px, scene.centre_px = focal, middle
    return Camera(focal, middle, size)


def render(
    avatar: torch.nn.Module, scene: Scene, frame: int, size: tuple[int, int], precision: torch.dtype, device: str
) -> Picture:
    """One frame of the scene at a size (H, W).

    Raises ValueError naming the frame where the render is not finite.
    """
    started = time.perf_counter()
    view = scene.view(frame, size)
    rendered, evaluations = avatar.picture(avatar.pose(*scene.heads([frame], device)), view, precision)
    colour = torch.cat([rendered.colour, rendered.opacity[:, None]], 1).clamp(0, 1)
    if not (torch.isfinite(colour).all() and torch.isfinite(rendered.depth).all()):
        raise ValueError(f"the render of frame {frame} is not finite; train the avatar again")
    image = (colour * 255 + 0.5).byte().numpy().reshape(*size, 4)
    rays, along = view.rays(), rendered.depth.numpy()[:, None] * (image[..., 3].reshape(-1, 1) > 0)
    ends = (rays.origins_m + along * rays.directions) @ view.rotation[2] + view.offset_m[2]
    depth = np.where(along[:, 0] > 0, ends, 0).astype(np.float32).reshape(size)
    return Picture(image, depth, 1000 * (time.perf_counter() - started), evaluations)


def render_all(
    avatar: torch.nn.Module,
    scene: Scene,
    frames: Sequence[int],
    size: tuple[int, int],
    precision: torch.dtype,
    device: str,
) -> Iterator[Picture]:
    """`render` frame by frame; the first after a small one that compiles and allocates, so that times are the frames' own."""
    if frames:
        render(avatar, scene, frames[0], (8, 8), precision, device)
    for frame in frames:
        yield render(avatar, scene, frame, size, precision, device)
