"""A toy head with landmarks, and a made sequence of detected landmarks with known truth."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from fitting import camera, energy, stages
from fitting.fit import WEIGHTS
from fitting.head_model import HeadModel
from fitting.landmark_model import LandmarkModel
from tests.toy_head import toy_head

CENTRE_PX = np.array([128.0, 120.0])
SIZE = (240, 256)


def landmarked_head(seed: int = 0, expressions: int = 3) -> HeadModel:
    """The toy head with all 478 points placed on its front, the pupils in front of the eye joints."""
    head = toy_head(expressions=expressions, shapes=4)
    random = np.random.default_rng(seed)
    triangles, template = head.triangles.numpy(), head.template.numpy()
    front = np.flatnonzero((template[triangles][..., 2] < -0.02).all(1))
    chosen = random.choice(front, 478)
    weight = random.dirichlet([2, 2, 2], 478)
    middle = template[triangles].mean(1)
    for landmark, joint in ((473, 3), (468, 4), (263, 3), (33, 4)):
        target = (
            head.joints.numpy()[joint]
            + [0, 0, -0.05]
            + ([0.02 * np.sign(head.joints.numpy()[joint][0]), 0, 0] if landmark in (33, 263) else [0, 0, 0])
        )
        chosen[landmark] = front[np.linalg.norm(middle[front] - target, axis=1).argmin()]
    return dataclasses.replace(
        head, landmark_triangles=torch.from_numpy(chosen), landmark_barycentric=torch.from_numpy(weight.astype(np.float32))
    )


def random_state(model: LandmarkModel, frames: int, seed: int = 1, amount: float = 1.0) -> energy.State:
    """A plausible state: head 0.6 m away, turning, expressions inside their range."""
    random = np.random.default_rng(seed)
    angle = (
        np.stack(
            [0.15 * np.sin(np.arange(frames) / 7), 0.45 * np.sin(np.arange(frames) / 11), 0.05 * np.cos(np.arange(frames) / 5)], 1
        )
        * amount
    )
    phase = random.uniform(0, 6, len(model.low))
    return energy.State(
        camera.exp_rotation(angle),
        np.array([0.01, -0.01, 0.6]) + 0.01 * random.normal(size=(1, 3)) + 0.01 * np.sin(np.arange(frames) / 9)[:, None],
        0.5 + 0.35 * np.sin(np.arange(frames)[:, None] / 6 + phase),
        0.1 * np.sin(np.arange(frames)[:, None] / 8 + np.arange(4)) * amount,
        float(np.log(420.0)),
        random.normal(size=len(model.shape_basis)),
        np.zeros_like(model.base),
    )


def detected(model: LandmarkModel, state: energy.State, noise_px: float, seed: int = 2) -> stages.Observed:
    """What a detector with that noise would report of a state."""
    random = np.random.default_rng(seed)
    points = np.einsum("bij,blj->bli", state.rotation, energy.head_points(model, state)) + state.translation[:, None]
    pixel = camera.project(points, state.focal_px, CENTRE_PX) + noise_px * random.normal(size=(*points.shape[:2], 2))
    frames = len(pixel)
    span = np.linalg.norm(model.base[np.flatnonzero(model.ids == 33)] - model.base[np.flatnonzero(model.ids == 263)])
    scale = np.full(frames, state.focal_px * span / 0.6)
    return stages.Observed(
        pixel, np.ones(frames, bool), scale, np.full(state.expression.shape, 0.5), np.ones(pixel.shape[:2], bool), CENTRE_PX
    )


__all__ = ["CENTRE_PX", "SIZE", "WEIGHTS", "detected", "landmarked_head", "random_state"]
