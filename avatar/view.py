"""What a picture is seen through: a pinhole camera before one posed head, in the head's neck-normalised frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar.volume import Rays


class View(NamedTuple):
    """Camera of one picture of H x W pixels: camera axes = rotation @ head frame + offset; pixel = focal * xy / z + centre."""

    focal_px: float
    centre_px: np.ndarray  # [2] column, row; pixel centres at +0.5
    rotation: np.ndarray  # [3, 3] head frame to camera axes
    offset_m: np.ndarray  # [3] the head frame's origin in camera axes
    size: tuple[int, int]  # H, W
    stride: int = 1  # how many widths of a pixel lie from one to the next: more than one where pixels are left out

    def every(self, stride: int) -> View:
        """The picture of every `stride`-th pixel, each seen along its own ray: rows and columns 0, stride, 2 stride..."""
        size = tuple(-(-side // stride) for side in self.size)
        # The centre of the new pixel i, i + 0.5, is that of the old one i * stride.
        centre = (np.asarray(self.centre_px, np.float64) - 0.5) / stride + 0.5
        return View(self.focal_px / stride, centre, self.rotation, self.offset_m, size, self.stride * stride)

    def window(self, column: int, row: int, size: tuple[int, int]) -> View:
        """What it sees in a window of `size` (H, W) whose first pixel is (column, row)."""
        centre = np.asarray(self.centre_px, np.float64) - (column, row)
        return self._replace(centre_px=centre, size=size)

    def through(self, columns: np.ndarray, rows: np.ndarray) -> Rays:
        """Rays through the centres of pixels; columns, rows: [N] integers."""
        pixels = np.stack([columns, rows], -1) + 0.5 - self.centre_px
        directions = np.concatenate([pixels / self.focal_px, np.ones((len(pixels), 1))], -1) @ self.rotation
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = np.broadcast_to(-self.rotation.T @ self.offset_m, directions.shape)
        return Rays(origins.astype(np.float32), directions.astype(np.float32))

    def rays(self) -> Rays:
        """Rays of all pixels, row by row."""
        rows, columns = np.mgrid[: self.size[0], : self.size[1]]
        return self.through(columns.ravel(), rows.ravel())

    def pixels_of(self, points_m: np.ndarray) -> np.ndarray:
        """Column, row and depth in metres [..., 3] of head-frame points [..., 3]; no check that they lie before the camera."""
        camera = points_m @ self.rotation.T + self.offset_m
        return np.concatenate([camera[..., :2] / camera[..., 2:] * self.focal_px + self.centre_px, camera[..., 2:]], -1)
