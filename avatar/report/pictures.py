"""Strips of pictures for the subject's page: input, render and error beside each other. Arrays in, arrays out."""

from __future__ import annotations

import cv2
import numpy as np

ERROR_RANGE = 0.3
"""Mean absolute error over RGB in [0, 1] that the error map shows in its brightest colour."""
GAP_PX = 4


def on_white(colour: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Colour uint8 [H, W, 3] over white by alpha uint8 [H, W]: uint8 [H, W, 3]."""
    mask = alpha[..., None].astype(np.float32) / 255
    return (colour * mask + 255 * (1 - mask)).round().astype(np.uint8)


def error_map(render: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Absolute error, mean over channels, from black (0) to pale yellow (`ERROR_RANGE` and more): uint8 [H, W, 3] RGB."""
    error = np.abs(render.astype(np.float32) - truth).mean(-1) / 255
    level = (255 * np.clip(error / ERROR_RANGE, 0, 1)).round().astype(np.uint8)
    return cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1]


def strip(images: list[np.ndarray]) -> np.ndarray:
    """Images uint8 [H, W, 3] of one height beside each other with a white gap."""
    gap = np.full((images[0].shape[0], GAP_PX, 3), 255, np.uint8)
    parts = [part for image in images for part in (image, gap)]
    return np.concatenate(parts[:-1], 1)


def scored_strip(frame: np.ndarray, alpha: np.ndarray, render: np.ndarray) -> np.ndarray:
    """Input on white, render and error map of one test frame: uint8 [H, 3 W + gaps, 3]."""
    truth = on_white(frame, alpha)
    return strip([truth, render[..., :3], error_map(render[..., :3], truth)])


def trim_strip(frame: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Frame as filmed, its trimmed alpha and the two together on white."""
    return strip([frame, np.repeat(alpha[..., None], 3, -1), on_white(frame, alpha)])


def png(image: np.ndarray) -> bytes:
    """PNG of an image uint8 [H, W, 3] RGB."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not done:
        raise ValueError(f"OpenCV cannot write a PNG of shape {image.shape}")
    return data.tobytes()


def jpeg(image: np.ndarray, quality: int = 85) -> bytes:
    """JPEG of an image uint8 [H, W, 3] RGB."""
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"OpenCV cannot write a JPEG of shape {image.shape}")
    return data.tobytes()


def card(frame: np.ndarray, alpha: np.ndarray, render: np.ndarray, height_px: int) -> np.ndarray:
    """Input on white beside its render, small: uint8 [height_px, w, 3]."""
    whole = strip([on_white(frame, alpha), render[..., :3]])
    return cv2.resize(whole, (round(whole.shape[1] * height_px / whole.shape[0]), height_px), interpolation=cv2.INTER_AREA)
