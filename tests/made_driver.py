"""A made driver: what a detector would report of the small face in a known pose."""

from __future__ import annotations

import numpy as np
import torch

from fitting import camera, settings
from fitting.detection import BLENDSHAPE_NAMES, Face
from fitting.head_model import HeadModel
from fitting.landmark_model import IRIS_RINGS

SIZE = (480, 640)
FOCAL_PX = settings.FOCAL_OF_LONG_SIDE * max(SIZE)
NAMES = list(BLENDSHAPE_NAMES)


def landmarks_px(
    head: HeadModel,
    codes: dict[str, float],
    turn_rad: tuple[float, float, float] = (0, 0, 0),
    gaze_rad: tuple[float, float] = (0, 0),
    place_m: tuple[float, float, float] = (0.01, -0.02, 0.5),
    shape: np.ndarray | None = None,
) -> np.ndarray:
    """Landmarks [478, 3] px of a posed head; those without a place lie in the middle of the picture."""
    row = lambda values: torch.tensor([values], dtype=head.template.dtype)  # noqa: E731
    expression = [codes.get(name, 0.0) for name in head.expression_names]
    identity = torch.zeros(len(head.shape_basis)) if shape is None else torch.from_numpy(shape).float()
    eyes, zero = [[*gaze_rad, 0.0]] * 2, [0.0, 0.0, 0.0]
    # HeadModel turns about its root joint.
    vertices = head.forward(identity, row(expression), row(turn_rad), row(zero), row(zero), row(eyes), row(place_m))
    points = head.landmarks(vertices)[0].double().numpy()
    centre = np.array(SIZE[::-1]) / 2
    pixels = camera.project(points, FOCAL_PX, centre)
    for ring in IRIS_RINGS:  # the fit takes the mean of the ring
        pixels[list(ring)] = pixels[ring[0]]
    pixels = np.where(np.isfinite(pixels), pixels, centre)
    return np.concatenate([pixels, np.zeros((len(pixels), 1))], 1).astype(np.float32)


def scores_of(codes: dict[str, float]) -> np.ndarray:
    """Blendshape scores [51] of some codes."""
    return np.array([codes.get(name, 0.0) for name in NAMES], np.float32)


def face_of(head: HeadModel, codes: dict[str, float], **pose: object) -> Face:
    """A detected face."""
    return Face(landmarks_px(head, codes, **pose), scores_of(codes), np.eye(4, dtype=np.float32))
