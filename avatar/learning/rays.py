"""Training of a radiance field: rays of a few frames a step, the paper's losses (section 3.3) and opacity against the matte."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor, nn

from avatar import build, coverage, losses, shell
from avatar.config import TrainConfig
from avatar.dataset import Cells, cells_of, draw, on_white, shrink_any
from avatar.learning import Data, Loss, measured_shell
from avatar.networks import best_precision, train_in
from fitting.raster import vertex_normals
from workflow import step


def make_avatar(job: step.Job, data: Data) -> nn.Module:
    """A fresh avatar whose shell fits the mattes."""
    torch.manual_seed(job.config.seed)
    avatar = build.build(build.settings_of(job.config), data.head)
    neutral, thickness = data.scene.neutral_m.numpy().astype(np.float64), measured_shell(data)
    core = shell.core_points(neutral, vertex_normals(neutral, data.head.triangles.numpy()))
    avatar.shape_shell(torch.from_numpy(thickness), torch.from_numpy(core))
    if job.config.warp:
        avatar.correct_errors(len(data.scene.frames))
    job.log.info("shell: %.0f to %.0f mm, median %.0f mm", *(1000 * np.quantile(thickness, (0, 1, 0.5))))
    return train_in(avatar.to(job.device), best_precision(job.device))


def make_optimiser(config: TrainConfig, avatar: nn.Module) -> torch.optim.Optimizer:
    """Adam (paper, supplement B) with a group of parameters for each entry of `losses.RATES` that the avatar has."""
    groups: dict[str, list[nn.Parameter]] = {}
    for name, parameter in avatar.named_parameters():
        groups.setdefault(losses.group_of(name), []).append(parameter)
    chosen = [{"params": parameters, "name": name} for name, parameters in groups.items()]
    return torch.optim.Adam(chosen, lr=config.learning_rate, betas=(0.9, 0.999), fused=True)


class Batches:
    """Rays and colours of a step, a pure function of the seed and the step's number."""

    def __init__(self, config: TrainConfig, data: Data, avatar: nn.Module) -> None:
        self.config, self.data, self.avatar = config, data, avatar
        self.cells: dict[int, Cells] = {}
        self.grids: dict[int, shell.PackedGrid] = {}  # 5 ms each to make, 60 kB to keep

    def posed(self, frames: list[int], device: str):  # noqa: ANN201 - whatever `pose` returns
        """The posed heads of some frames; also finds where their rays are drawn when a frame is new."""
        vertices_m, condition = self.data.scene.heads(frames, device, training=True)
        grids = None
        if not self.avatar.hierarchical:
            grids = [self._grid(frame, vertices_m[place]) for place, frame in enumerate(frames)]
        posed = self.avatar.pose(vertices_m, condition, grids)
        for place, frame in enumerate(frames):
            if frame not in self.cells:
                self.cells[frame] = self._cells(frame, posed.grids[place] if posed.grids else None)
        return posed

    def _grid(self, frame: int, vertices_m: Tensor) -> shell.Grid:
        """The shell of a training frame, which never changes."""
        if frame not in self.grids:
            self.grids[frame] = shell.pack(self.avatar.grid(vertices_m.cpu().numpy()))
        return shell.unpack(self.grids[frame])

    def _cells(self, frame: int, grid: shell.Grid | None) -> Cells:
        """Where rays of a frame are drawn: where they meet the shell; anywhere when there is none."""
        size = self.data.alpha.shape[1:]
        near = ndimage.binary_dilation(shrink_any(self.data.alpha[frame]), iterations=2)
        hit = np.ones_like(near) if grid is None else coverage.hit_blocks(grid, self.data.scene, frame, size)
        return cells_of(ndimage.binary_dilation(hit), near, coverage.feature_blocks(self.data.scene, frame, size))

    def at(self, number: int, device: str):  # noqa: ANN201
        """Frames, posed heads, rays, jitter and truth [N, 4] (colour on white, opacity) of step `number`."""
        random = np.random.default_rng([self.config.seed, number])
        count = min(self.config.frames_per_step, len(self.data.train))
        frames = [self.data.train[i] for i in random.choice(len(self.data.train), count, replace=False)]
        posed = self.posed(frames, device)
        rays, jitter, truth = [], [], []
        for frame in frames:
            columns, rows = draw(self.cells[frame], max(1, self.config.rays // count), self.data.alpha.shape[1:], random)
            rays.append(self.data.scene.rays(frame, columns, rows))
            alpha = self.data.alpha[frame][rows, columns]
            truth.append(
                np.concatenate([on_white(self.data.frames[frame][rows, columns], alpha), alpha[:, None] / np.float32(255)], 1)
            )
            jitter.append(random.random((len(columns), self.avatar.jitter_width), dtype=np.float32))
        return frames, posed, rays, jitter, torch.from_numpy(np.concatenate(truth)).to(device)


class RayLearner:
    """A radiance field in training; see `avatar.learning.Learner`."""

    def __init__(self, job: step.Job, data: Data) -> None:
        """A fresh avatar, or what `avatar.checkpoint` then loads into it."""
        self.config, self.device, self.avatar = job.config, job.device, make_avatar(job, data)
        self.optimiser = make_optimiser(job.config, self.avatar)
        self.batches = Batches(job.config, data, self.avatar)

    def rates(self, number: int) -> None:
        """Learning rates of step `number`."""
        for group in self.optimiser.param_groups:
            rate = losses.learning_rate(self.config.learning_rate, number, self.config.steps)
            group["lr"] = losses.RATES[group["name"]] * rate

    def loss(self, number: int) -> Loss:
        """The loss of step `number`."""
        config = self.config
        frames, posed, rays, jitter, truth = self.batches.at(number, self.device)
        window = losses.warp_window(number, config.steps) if losses.warp_on(number, config.steps) else None
        outcome = self.avatar.render(posed, rays, self.precision(), jitter, window)
        value = sum(losses.weight_of(name, number, config.steps) * term for name, term in outcome.terms.items())
        squared = number < losses.squared_until(config.steps, config.sampling == "hierarchical")
        for rendered in outcome.renders:
            value = value + losses.photometric(rendered.colour, truth[:, :3], squared)
            value = value + config.opacity_weight * losses.opacity(rendered.opacity, truth[:, 3])
        return Loss(value, frames, outcome.evaluations)

    def gradients(self) -> list[Tensor]:
        """Of all parameters that took part."""
        parameters = [parameter for group in self.optimiser.param_groups for parameter in group["params"]]
        return [parameter.grad for parameter in parameters if parameter.grad is not None]

    def precision(self) -> torch.dtype:
        """Of the matrix products."""
        return best_precision(self.device)


def learner(job: step.Job, data: Data) -> RayLearner:
    """What trains a radiance field."""
    return RayLearner(job, data)
