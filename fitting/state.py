"""The unknowns of a clip: poses of T frames and what all frames share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fitting import camera
from fitting.energy import Camera
from fitting.landmark_model import LandmarkModel
from fitting.rig import GAZE, JAW, Pose

PER_FRAME = ("rotation", "translation", "expression", "gaze", "jaw")


@dataclass(frozen=True)
class State:
    """Poses of T frames and the shared unknowns."""

    rotation: np.ndarray  # [T, 3, 3]
    translation: np.ndarray  # [T, 3] m
    expression: np.ndarray  # [T, E]
    gaze: np.ndarray  # [T, 4] rad
    jaw: np.ndarray  # [T, 3] rad
    log_focal: float
    shape: np.ndarray  # [S]
    bias: np.ndarray  # [L, 3] m in the head frame, constant per landmark: detector and embedding disagree

    @property
    def focal_px(self) -> float:
        return float(np.exp(self.log_focal))

    def __len__(self) -> int:
        return len(self.rotation)

    def lens(self, centre_px: np.ndarray) -> Camera:
        """The camera with this focal length."""
        return Camera(self.focal_px, centre_px)

    def pose(self, row: int) -> Pose:
        """Unknowns of one frame."""
        return Pose(*(getattr(self, name)[row] for name in PER_FRAME))

    @property
    def turns(self) -> np.ndarray:
        """Rotation vectors [T - 1, 3] from each frame to the next."""
        return camera.log_rotation(self.rotation[1:] @ self.rotation[:-1].swapaxes(1, 2))

    def frames(self, rows: slice | np.ndarray) -> State:
        """The same shared unknowns, some of the frames."""
        return replace(self, **{name: getattr(self, name)[rows] for name in PER_FRAME})

    def with_poses(self, poses: Sequence[Pose]) -> State:
        """The same shared unknowns, other frames."""
        return replace(self, **{name: np.stack([getattr(pose, name) for pose in poses]) for name in PER_FRAME})

    def replaced(self, rows: np.ndarray, other: State) -> State:
        """A copy in which some frames come from another state."""
        values = {name: getattr(self, name).copy() for name in PER_FRAME}
        for name, value in values.items():
            value[rows] = getattr(other, name)
        return replace(self, **values)

    def fold(self, model: LandmarkModel) -> LandmarkModel:
        """The landmark model with this identity and these biases folded in."""
        return replace(model, surface=model.surface.folded(self.shape, self.bias))


def neutral(model: LandmarkModel, count: int, log_focal: float) -> State:
    """Mean head, no expression, identity poses half a metre away."""
    return State(
        np.tile(np.eye(3), (count, 1, 1)),
        np.tile([0, 0, 0.5], (count, 1)),
        np.zeros((count, len(model.low))),
        np.zeros((count, GAZE)),
        np.zeros((count, JAW)),
        log_focal,
        np.zeros(model.surface.shape_basis.shape[2]),
        np.zeros_like(model.surface.base),
    )


def rotation_degrees(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Geodesic angle [...] degrees between rotation matrices [..., 3, 3]."""
    return np.degrees(np.linalg.norm(camera.log_rotation(first @ np.swapaxes(second, -1, -2)), axis=-1))
