"""What draws a row, and pictures as JPEG. Arrays in, arrays out."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from avatar.play.rows import Row

LAYERS = "layers"
"""Representation that is drawn in one compiled pass; every other is a field, whose rays are marched."""
LIVE_PX, FIELD_PX = 512, 96
"""Longer side that the page begins with: a field needs about a second for the smaller one."""


class Drawer(Protocol):
    """Draws one avatar through one camera: `avatar.live.Live`."""

    milliseconds: dict[str, float]
    """Of the last frame: all of it, head model and networks included, as `frame`, and its stages."""

    def frame(self, row: Row) -> np.ndarray:
        """RGB on white, uint8 [H, W, 3]; ValueError where a row or the picture is not finite."""
        ...


def first_size(representation: str) -> int:
    """Pixels on the longer side that the page begins with."""
    return LIVE_PX if representation == LAYERS else FIELD_PX


def jpeg(image: np.ndarray, quality: int) -> bytes:
    """An image uint8 [H, W, 3] RGB as JPEG."""
    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Height and width that a JPEG's header states, None where it is none: read before anything is allocated for it."""
    if data[:2] != b"\xff\xd8":
        return None
    place = 2
    while place + 9 <= len(data):
        if data[place] != 0xFF:
            return None
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(data[place + 5 : place + 7], "big"), int.from_bytes(data[place + 7 : place + 9], "big")
        place += 1 if marker == 0xFF else 2 + length
    return None


def read_jpeg(data: bytes, largest_px: int) -> np.ndarray:
    """Pixels uint8 [H, W, 3] RGB; ValueError for what is no JPEG or larger than `largest_px` on a side."""
    size = jpeg_size(data)
    if size is None or min(size) < 1:
        raise ValueError("a picture of the camera must be a JPEG")
    if max(size) > largest_px:
        raise ValueError(f"a picture of the camera has {size[1]}x{size[0]} pixels; at most {largest_px} on a side are taken")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError("a picture of the camera must be a JPEG; this one is damaged")
    return np.ascontiguousarray(image[..., ::-1])
