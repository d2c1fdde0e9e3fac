"""What trains each kind of avatar, one module each, behind one small interface; `avatar.train` has the loop.

A module offers `learner(job, data) -> Learner`; it is a part of the step and may read the step's inputs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from avatar import coverage, losses
from avatar.dataset import Scene, on_white
from fitting.head_model import HeadModel

PROBE_STRIDE = 4
LOOKED_AT = 24  # training frames whose mattes shape the shell


@dataclass
class Data:
    """Everything a step of training reads; frames stay on disk."""

    head: HeadModel
    scene: Scene
    frames: np.ndarray  # [T, H, W, 3] uint8, memory-mapped
    alpha: np.ndarray  # [T, H, W] uint8, memory-mapped
    train: list[int]
    probe: list[int]


class Loss(NamedTuple):
    """What a step of training minimises."""

    value: Tensor  # scalar with gradients
    frames: list[int]  # that it is of
    evaluations: int  # of the networks or of the textures; 0 where nothing met the head


class Learner(Protocol):
    """An avatar in training. A step is a pure function of the seed, the step's number and the state of avatar and optimiser."""

    avatar: nn.Module
    optimiser: torch.optim.Optimizer
    device: str  # that the avatar learns on

    def rates(self, number: int) -> None:
        """Set the optimiser's learning rates for step `number`."""

    def loss(self, number: int) -> Loss:
        """The loss of step `number`."""

    def gradients(self) -> list[Tensor]:
        """All gradients after the backward pass of the step's loss, to see whether they are finite and not all zero."""

    def precision(self) -> torch.dtype:
        """What large products are computed in."""


def measured_shell(data: Data) -> np.ndarray:
    """Thickness [V] m of the shell around the mesh, such that it holds what the mattes of LOOKED_AT training frames show."""
    looked_at = data.train[:: max(1, len(data.train) // LOOKED_AT)]
    neutral, triangles = data.scene.neutral_m.numpy().astype(np.float64), data.head.triangles.numpy()
    base = coverage.base_thickness(data.head.region.numpy(), neutral, triangles)
    return coverage.measured_thickness(data.scene, data.alpha, looked_at, base)


@torch.no_grad()
def probe_psnr(learner: Learner, data: Data) -> float:
    """Mean PSNR in dB over the held-out training frames, on every PROBE_STRIDE-th pixel."""
    values = []
    for frame in data.probe:
        image = on_white(data.frames[frame][::PROBE_STRIDE, ::PROBE_STRIDE], data.alpha[frame][::PROBE_STRIDE, ::PROBE_STRIDE])
        view = data.scene.view(frame, data.alpha.shape[1:]).every(PROBE_STRIDE)
        posed = learner.avatar.pose(*data.scene.heads([frame], learner.device))
        colour = learner.avatar.picture(posed, view, learner.precision())[0].colour.cpu()
        values.append(losses.psnr(colour, torch.from_numpy(image.reshape(-1, 3))))
    return float(np.mean(values))
