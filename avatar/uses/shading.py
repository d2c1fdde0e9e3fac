"""Depth, normals and the tracked mesh as pictures, with scales and captions. Arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy import ndimage

from avatar.report.pictures import ERROR_RANGE

SEEN = 0.5
"""Opacity from which a pixel has a depth: below it the mean distance along the ray is no surface."""
SMOOTH_M, EDGE_M = 0.004, 0.010
"""Normals: standard deviation on the surface of what is averaged, and depth step that counts as another surface."""
STEP_M = 0.004
"""Normals: depth samples this far apart give the slope."""
NEAR_QUANTILE, FAR_QUANTILE = 0.005, 0.98
TEXT_GAP_PX = 3
INK = (40, 40, 40)
LINE_OF_WIDTH = 0.08  # height of a caption over the width of its picture
ERROR_BAR = ("0", f"{ERROR_RANGE:g} or more")


def seen(opacity: np.ndarray) -> np.ndarray:
    """opacity: [...] uint8. Returns bool [...], where there is a surface."""
    return opacity > 255 * SEEN


def depth_range(depths_m: Sequence[np.ndarray], opacities: Sequence[np.ndarray]) -> tuple[float, float]:
    """Nearest and farthest depth of several pictures [H, W], outliers aside; (0, 1) where nothing is seen."""
    values = np.concatenate([depth[seen(opacity)] for depth, opacity in zip(depths_m, opacities, strict=True)])
    if not len(values):
        return 0.0, 1.0
    near, far = (float(value) for value in np.quantile(values, (NEAR_QUANTILE, FAR_QUANTILE)))
    return near, max(far, near + 1e-3)


def depth_picture(depth_m: np.ndarray, opacity: np.ndarray, near_m: float, far_m: float) -> np.ndarray:
    """Depth [H, W] as colour uint8 [H, W, 3]: yellow near, violet far (viridis), white where the opacity is at most 0.5."""
    level = np.clip((far_m - depth_m) / (far_m - near_m), 0, 1)
    colour = _viridis(level)
    colour[~seen(opacity)] = 255
    return colour


def _viridis(level: np.ndarray) -> np.ndarray:
    """level: [...] in [0, 1]. Returns uint8 [..., 3] RGB."""
    index = (255 * level).round().astype(np.uint8)
    return cv2.applyColorMap(index.reshape(-1, 1), cv2.COLORMAP_VIRIDIS)[..., ::-1].reshape(*level.shape, 3).copy()


def smooth_depth(depth_m: np.ndarray, opacity: np.ndarray, focal_px: float) -> np.ndarray:
    """Depth [H, W] with the shell's noise averaged out on each surface, steps between surfaces kept (a bilateral filter).

    Pixels that are not seen hold the depth of the nearest one that is; all zero where nothing is seen.
    """
    mask = seen(opacity)
    if not mask.any():
        return np.zeros_like(depth_m)
    nearest = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    filled = ndimage.median_filter(depth_m[tuple(nearest)].astype(np.float32), 3, mode="nearest")
    sigma_px = max(1.0, SMOOTH_M * focal_px / float(np.median(depth_m[mask])))
    return cv2.bilateralFilter(filled, 2 * int(np.ceil(2 * sigma_px)) + 1, EDGE_M, sigma_px, borderType=cv2.BORDER_REPLICATE)


def normals(depth_m: np.ndarray, opacity: np.ndarray, focal_px: float, centre_px: np.ndarray) -> np.ndarray:
    """Unit normals [H, W, 3] in camera axes of the surface in a depth picture, towards the camera; 0 where none is seen.

    Depth is smoothed first (see `smooth_depth`): a difference of neighbours of raw depth shows the shell's samples.
    """
    depth = smooth_depth(depth_m, opacity, focal_px).astype(np.float64)
    mask = seen(opacity)
    if not mask.any():
        return np.zeros((*depth.shape, 3))
    rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    points = np.stack([(columns - centre_px[0]) / focal_px, (rows - centre_px[1]) / focal_px, np.ones_like(depth)], -1)
    points *= depth[..., None]
    reach = max(1, round(STEP_M / 2 * focal_px / float(np.median(depth[mask]))))
    down, right = (_difference(points, axis, reach) for axis in (0, 1))
    normal = np.cross(down, right)  # y down, x right: this order looks to the camera, -z
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    unit = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    return np.where(mask[..., None], unit, 0.0)


def _difference(points: np.ndarray, axis: int, reach: int) -> np.ndarray:
    """Central differences [H, W, 3] over 2 * reach pixels, edges repeated."""
    width = [(reach, reach) if k == axis else (0, 0) for k in range(3)]
    padded, count = np.pad(points, width, mode="edge"), points.shape[axis]
    ahead, behind = (np.take(padded, np.arange(start, start + count), axis) for start in (2 * reach, 0))
    return ahead - behind


def normal_picture(normal: np.ndarray) -> np.ndarray:
    """Normals [H, W, 3] as colour uint8: red to the picture's right, green up, blue to the camera; white where there is none."""
    colour = (0.5 + 0.5 * normal * np.array([1, -1, -1])) * 255
    picture = colour.round().clip(0, 255).astype(np.uint8)
    picture[~normal.any(-1)] = 255
    return picture


def opacity_picture(opacity: np.ndarray) -> np.ndarray:
    """Opacity uint8 [H, W] as grey [H, W, 3], white for opaque."""
    return np.repeat(opacity[..., None], 3, -1)


def captioned(image: np.ndarray, text: str) -> np.ndarray:
    """An image uint8 [H, W, 3] with a line of text above it, in smaller letters where it is long."""
    line = _line(image.shape[1], text)
    return np.concatenate([line, image])


def _line(width: int, text: str) -> np.ndarray:
    """A white strip [h, W, 3] with text on its left."""
    strip = np.full((max(14, round(LINE_OF_WIDTH * min(width, 640))), width, 3), 255, np.uint8)
    scale = len(strip) / 38
    while scale > 0.2 and _width(text, scale) > width - 2 * TEXT_GAP_PX:
        scale *= 0.95
    _write(strip, text, TEXT_GAP_PX, scale)
    return strip


def _width(text: str, scale: float) -> int:
    return cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0]


def _write(strip: np.ndarray, text: str, left: int, scale: float) -> None:
    """Text into a strip, on one base line whatever its letters."""
    base = (len(strip) + cv2.getTextSize("0", cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][1]) // 2 - len(strip) // 16
    cv2.putText(strip, text, (left, base), cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1 + (scale > 0.9), cv2.LINE_AA)


def with_bar(image: np.ndarray, low: str, high: str, colours: np.ndarray) -> np.ndarray:
    """An image uint8 [H, W, 3] with a scale below it: colours [K, 3] from left to right between two texts."""
    width = image.shape[1]
    strip = _line(width, "")
    height, scale = len(strip), 0.8 * len(strip) / 38
    start, end = _width(low, scale) + 3 * TEXT_GAP_PX, width - _width(high, scale) - 3 * TEXT_GAP_PX
    _write(strip, low, TEXT_GAP_PX, scale)
    _write(strip, high, end + 2 * TEXT_GAP_PX, scale)
    if end > start:
        bar = colours[np.linspace(0, len(colours) - 1, end - start).round().astype(int)]
        strip[height // 4 : height - height // 4, start:end] = bar
    return np.concatenate([image, strip])


def with_depth_bar(image: np.ndarray, near_m: float, far_m: float) -> np.ndarray:
    """`with_bar` for `depth_picture`."""
    return with_bar(image, f"{100 * near_m:.1f} cm", f"{100 * far_m:.1f} cm", _viridis(np.linspace(1, 0, 256)))


def with_error_bar(image: np.ndarray) -> np.ndarray:
    """`with_bar` for `pictures.error_map`."""
    ramp = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_INFERNO)[:, 0, ::-1]
    return with_bar(image, *ERROR_BAR, ramp)


def grid(rows: Sequence[Sequence[np.ndarray]], gap_px: int = 6) -> np.ndarray:
    """Images uint8 [H, W, 3] in rows, top left aligned, white between and around them."""
    heights = [max(image.shape[0] for image in row) for row in rows]
    widths = [max((row[k].shape[1] for row in rows if k < len(row)), default=0) for k in range(max(map(len, rows)))]
    size = (sum(heights) + gap_px * (len(rows) + 1), sum(widths) + gap_px * (len(widths) + 1), 3)
    page, top = np.full(size, 255, np.uint8), gap_px
    for row, height in zip(rows, heights, strict=True):
        left = gap_px
        for image, width in zip(row, widths, strict=False):
            page[top : top + image.shape[0], left : left + image.shape[1]] = image
            left += width + gap_px
        top += height + gap_px
    return page
