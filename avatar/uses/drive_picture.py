"""What `drive` shows: driver, avatar, avatar from the side and its depth beside each other. Arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from avatar.uses import shading
from avatar.uses.sequence import Picture


def fitted(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture uint8 [h, w, 3] scaled into (H, W) with its proportions, centred on white: uint8 [H, W, 3]."""
    scale = min(size[0] / picture.shape[0], size[1] / picture.shape[1])
    height, width = (max(1, min(side, round(scale * old))) for side, old in zip(size, picture.shape[:2], strict=True))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    small = cv2.resize(np.ascontiguousarray(picture), (width, height), interpolation=method)
    canvas = np.full((*size, 3), 255, np.uint8)
    top, left = (size[0] - height) // 2, (size[1] - width) // 2
    canvas[top : top + height, left : left + width] = small
    return canvas


def rows_of(
    driver: Sequence[np.ndarray], ahead: Sequence[Picture], aside: Sequence[Picture], yaw_degrees: np.ndarray, use: str
) -> Iterator[np.ndarray]:
    """One row of four captioned panels a frame, uint8 [h, w, 3] all of one size; depth on one scale over all of them.

    driver: frames uint8 [., ., 3] as filmed; yaw_degrees: [T] of the moving viewpoint; use: what is taken from the driver.
    """
    near, far = shading.depth_range([seen.depth_m for seen in aside], [seen.image[..., 3] for seen in aside])
    named = "driver, as filmed" if use == "both" else f"driver ({use} taken)"
    for frame, front, side, angle in zip(driver, ahead, aside, yaw_degrees.tolist(), strict=True):
        panels = (
            (named, fitted(frame, front.image.shape[:2])),
            ("avatar", front.image[..., :3]),
            (f"avatar, {round(angle):+d} deg", side.image[..., :3]),
            (f"depth {100 * near:.0f} to {100 * far:.0f} cm", shading.depth_picture(side.depth_m, side.image[..., 3], near, far)),
        )
        yield shading.grid([[shading.captioned(picture, name) for name, picture in panels]], 4)
