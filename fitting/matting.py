"""From a segmentation network's confidence to a matte: steady over time, on the image's edges, one person, no holes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import mediapipe
import numpy as np
from mediapipe.tasks.python.core.base_options import BaseOptions
from mediapipe.tasks.python.vision import ImageSegmenter, ImageSegmenterOptions, RunningMode

NETWORK_PX = 256
GUIDE_RADIUS = 0.012
"""Of the longer side: about the error of the 256 px network at the outline."""
GUIDE_EPSILON = 2e-4
"""Variance of the picture (0-1) below which the guided filter smooths instead of following edges."""
COLOUR_RADIUS = 0.04
"""Of the longer side: how far the colours of hair and background are gathered around an unknown pixel."""
SURE = 0.95
FIRM = 0.8
STEADY_SIGMA = 0.035
"""Difference of a neighbouring frame after motion compensation (0-1) at which its matte hardly counts."""
OUTLINE_PX = 5
"""The outline is averaged this wide around soft pixels."""
REMAP_WIDTH = 1024
SOLID = 0.04
"""Opacities this close to 0 or 1 become 0 or 1: no ghosts, no veil over the face."""
HAIR_REACH, HAIR_END = 0.04, 0.08
"""Of the longer side: soft pixels this far from solid ones begin to fade, and have gone: further out is no hair but a ghost."""
HOLE_FRACTION = 0.004
"""Of the picture: larger gaps, such as between arm and body, are kept."""


class PersonSegmenter:
    """MediaPipe's selfie segmentation; use as a context manager."""

    def __init__(self, model: bytes) -> None:
        """Open the task.

        Args:
            model: content of selfie_segmentation.tflite.

        Raises:
            RuntimeError, ValueError: the model is not one that MediaPipe reads.
        """
        self._task = ImageSegmenter.create_from_options(
            ImageSegmenterOptions(
                base_options=BaseOptions(model_asset_buffer=model), running_mode=RunningMode.IMAGE, output_confidence_masks=True
            )
        )

    def __enter__(self) -> PersonSegmenter:
        return self

    def __exit__(self, *_: object) -> None:
        self._task.close()

    def confidence(self, rgb: np.ndarray) -> np.ndarray:
        """Confidence that a pixel shows a person.

        Args:
            rgb: (H, W, 3) uint8.

        Returns:
            (H, W) float32 in [0, 1].
        """
        # Handing over the frame itself displaces the mask by (W / 256 - 1) / 2 px to the right and as much down (measured with
        # mirrored frames), and aliases; an area-averaged square of the network's own size does neither.
        square = cv2.resize(rgb, (NETWORK_PX, NETWORK_PX), interpolation=cv2.INTER_AREA)
        masks = self._task.segment(mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=square)).confidence_masks
        mask = masks[-1].numpy_view().reshape(NETWORK_PX, NETWORK_PX).astype(np.float32)
        return cv2.resize(mask, (rgb.shape[1], rgb.shape[0]), interpolation=cv2.INTER_LINEAR)


@dataclass(frozen=True)
class Plate:
    """A frame and its matte, with the half-size pictures that the motion is found in."""

    matte: np.ndarray
    """(H, W) float32."""
    small: np.ndarray
    """(H/2, W/2, 3) uint8."""
    grey: np.ndarray
    """(H/2, W/2) uint8."""

    @staticmethod
    def of(rgb: np.ndarray, matte: np.ndarray) -> Plate:
        """From a frame (H, W, 3) uint8 and its matte (H, W) float32."""
        small = half(rgb)
        return Plate(matte, small, cv2.cvtColor(small, cv2.COLOR_RGB2GRAY))


class Steadier:
    """Averages a frame's matte with its neighbours' along the motion, on both sides of it, so that nothing lags behind."""

    def __init__(self) -> None:
        self._flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def steady(self, frame: Plate, neighbours: list[Plate]) -> np.ndarray:
        """One frame's matte, averaged around its outline.

        A neighbour counts at a pixel as far as its picture, moved onto this frame, looks the same there: where the motion is
        not understood (fast, occluded, flying hair) the frame keeps its own matte.

        Returns:
            (H, W) float32.
        """
        matte = frame.matte
        unsure = cv2.dilate(((matte > 0.01) & (matte < 0.99)).astype(np.uint8), np.ones((OUTLINE_PX, OUTLINE_PX), np.uint8))
        rows, columns = np.nonzero(unsure)
        if not len(rows) or not neighbours:
            return matte
        scale = np.float32([frame.grey.shape[1] / matte.shape[1], frame.grey.shape[0] / matte.shape[0]])
        here = np.column_stack([columns, rows]).astype(np.float32)
        here_small = (here + 0.5) * scale - 0.5
        own = sample(frame.small, here_small)
        total, weights = matte[rows, columns].copy(), np.ones(len(rows), np.float32)
        for other in neighbours:
            flow = self._flow.calc(frame.grey, other.grey, None)
            moved = sample(flow, here_small)
            difference = np.abs(sample(other.small, here_small + moved) - own).mean(axis=1)
            weight = np.exp(-((difference / (255.0 * STEADY_SIGMA)) ** 2))
            total += weight * sample(other.matte, here + moved / scale)
            weights += weight
        result = matte.copy()
        result[rows, columns] = total / weights
        return result


def sample(picture: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Bilinear values of a picture at some places, the border repeated.

    Args:
        picture: (H, W) or (H, W, C).
        places: (N, 2) float32, x and y with pixel centres at whole numbers (OpenCV's own convention).

    Returns:
        (N,) or (N, C) float32.
    """
    lines = -(-len(places) // REMAP_WIDTH)  # OpenCV refuses rows of 32767 and more
    padded = np.zeros((lines * REMAP_WIDTH, 2), np.float32)
    padded[: len(places)] = places
    values = cv2.remap(picture, padded.reshape(lines, REMAP_WIDTH, 2), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(lines * REMAP_WIDTH, *picture.shape[2:])[: len(places)].astype(np.float32)


def half(picture: np.ndarray) -> np.ndarray:
    """Area-averaged picture or matte of half the size: (H, W, ...) -> (H', W', ...)."""
    height, width = picture.shape[:2]
    return cv2.resize(picture, (max(width // 2, 16), max(height // 2, 16)), interpolation=cv2.INTER_AREA)


def refine(rgb: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Move a coarse matte onto the picture's edges.

    A guided filter (He et al. 2010) follows edges that the network saw roughly; where the colours of person and background
    around an unknown pixel are far apart, its place on the line between them gives single strands of hair.

    Args:
        rgb: (H, W, 3) uint8.
        confidence: (H, W) float32 in [0, 1].

    Returns:
        (H, W) float32 in [0, 1].
    """
    longer = max(rgb.shape[:2])
    radius = max(2, round(GUIDE_RADIUS * longer))
    around = cv2.blur(confidence, (2 * radius + 1, 2 * radius + 1))
    # OpenCV clamps small epsilons, so the guide goes in as 0-255: with a 0-1 guide the filter is a plain blur (seen).
    # scale 0.5 solves for the coefficients at half size: a third of the time, no difference seen.
    alpha = cv2.ximgproc.guidedFilter(rgb, confidence, radius, GUIDE_EPSILON * 255.0**2, scale=0.5 if longer >= 256 else 1.0)
    alpha = np.clip(alpha, 0.0, 1.0)
    rows, columns = np.nonzero((around > 0.02) & (around < 0.98))
    if len(rows):
        by_colour, trust = place_between_colours(rgb, confidence, rows, columns, max(3, round(COLOUR_RADIUS * longer)))
        trust = trust * np.clip(2.0 - 4.0 * np.abs(around[rows, columns] - 0.5), 0.0, 1.0)
        alpha[rows, columns] += trust * (by_colour - alpha[rows, columns])
    alpha[around < 1e-3] = 0.0
    alpha[around > 1.0 - 1e-3] = 1.0
    return np.clip((alpha - SOLID) / (1.0 - 2.0 * SOLID), 0.0, 1.0)


def place_between_colours(
    rgb: np.ndarray, confidence: np.ndarray, rows: np.ndarray, columns: np.ndarray, radius: int
) -> tuple[np.ndarray, np.ndarray]:
    """Some pixels' place on the line from the local background colour to the local person colour.

    Args:
        rgb: (H, W, 3) uint8.
        confidence: (H, W) float32.
        rows, columns: (N,) the pixels.
        radius: px, of the window in which the two colours are gathered.

    Returns:
        Opacity (N,) in [0, 1], and how far to trust it (N,): near 1 where the colours are far apart and each is uniform.
    """
    small, mask = half(rgb).astype(np.float32) / 255.0, half(confidence)
    near = (
        np.minimum(rows * mask.shape[0] // confidence.shape[0], mask.shape[0] - 1),
        np.minimum(columns * mask.shape[1] // confidence.shape[1], mask.shape[1] - 1),
    )
    window = (2 * max(1, radius // 2) + 1,) * 2
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(1, radius // 8) + 1,) * 2)
    means, spread, supported = [], np.float32(0.0), True
    for sure in (mask > SURE, mask < 1.0 - SURE):
        weight = cv2.erode(sure.astype(np.uint8), kernel)
        chosen = cv2.copyTo(small, weight)
        count = cv2.blur(weight.astype(np.float32), window)[near]
        safe = np.maximum(count, 1e-6)
        means.append(cv2.blur(chosen, window)[near] / safe[:, None])
        spread = spread + np.maximum(
            cv2.sqrBoxFilter(chosen, cv2.CV_32F, window)[near].sum(axis=1) / safe - (means[-1] ** 2).sum(axis=1), 0.0
        )
        supported = supported & (count > 1e-3)
    line = means[0] - means[1]
    separation = (line**2).sum(axis=1)
    along = ((rgb[rows, columns].astype(np.float32) / 255.0 - means[1]) * line).sum(axis=1) / np.maximum(separation, 1e-6)
    return np.clip(along, 0.0, 1.0), separation / (separation + 4.0 * spread + 1e-3) * supported


def one_person(alpha: np.ndarray) -> np.ndarray:
    """Keep the largest connected region with what hangs on to it, and close its small holes.

    The crop is around the subject's head, so the subject is the largest; whoever stands apart in the background goes.

    Args:
        alpha: (H, W) float32 in [0, 1].

    Returns:
        (H, W) float32 in [0, 1].
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats((alpha > 0.05).astype(np.uint8), connectivity=8)
    if count < 2:
        return alpha
    solid = np.bincount(labels[alpha > FIRM], minlength=count)
    solid[0] = 0
    kept = np.where(labels == int(solid.argmax()), alpha, 0.0).astype(np.float32)
    distance = cv2.distanceTransform((kept < FIRM).astype(np.uint8), cv2.DIST_L2, 3) / max(alpha.shape)
    kept *= np.clip((HAIR_END - distance) / (HAIR_END - HAIR_REACH), 0.0, 1.0)
    holes, hole_labels, hole_stats, _ = cv2.connectedComponentsWithStats((kept < SURE).astype(np.uint8), connectivity=4)
    height, width = alpha.shape
    left, top = hole_stats[:, cv2.CC_STAT_LEFT], hole_stats[:, cv2.CC_STAT_TOP]
    right, bottom = left + hole_stats[:, cv2.CC_STAT_WIDTH], top + hole_stats[:, cv2.CC_STAT_HEIGHT]
    closed = (left > 0) & (top > 0) & (right < width) & (bottom < height)
    closed &= hole_stats[:, cv2.CC_STAT_AREA] < HOLE_FRACTION * alpha.size
    closed[0] = False
    if closed.any():
        kept[closed[hole_labels]] = 1.0
    return kept
