"""Training of a layered avatar: one window of one frame a step, compared as a picture.

L1 against the frame on white, L1 of the opacity against the matte, and a perceptual distance of VGG16's first features.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from avatar import build, lpips
from avatar.dataset import on_white
from avatar.layered import composite, initial
from avatar.layered.model import SAMPLES
from avatar.layered.perceptual import Perceptual
from avatar.layered.texel_adam import BETAS, TexelAdam
from avatar.learning import Data, Loss, measured_shell
from avatar.learning.alignment import Alignment
from avatar.networks import best_precision
from fitting.head_model import REGIONS
from workflow import step

WINDOW_PX, LOOKED_AT_PX = 256, 128  # sides of a step's window, and of the part that the perceptual loss looks at
PROJECTED = 60  # training frames whose colours the textures start from
PERCEPTUAL_WEIGHT = 0.2
FACE_SHARE = 0.5  # of the windows are centred on a landmark, the others anywhere on the head
SPREAD_PX = 15.0
# Learning rates: of the networks, and of the textures' static logits and bases.
NETWORK_RATE, STATIC_RATE, BASIS_RATE = 1e-3, 0.03, 0.02
FINAL = 0.1  # of the rates, at the last step
WARM_UP = 100  # steps
STIR = 0.1  # standard deviation of how far the network's input is moved towards another frame's
PERCEPTUAL_FROM = 0.15  # of the steps: before, colours alone settle what moves, in steps of less time
ALIGNED_FROM = 0.25  # of the steps: before, the render says little


class ImageOptimiser:
    """Adam on the networks, `TexelAdam` on the textures and the frames' alignment: what a checkpoint holds beside the weights."""

    def __init__(self, avatar: torch.nn.Module, frames: int) -> None:
        """avatar: a `LayeredAvatar`; frames: of the scene."""
        self.networks = torch.optim.Adam(avatar.parameters(), lr=NETWORK_RATE, betas=BETAS, fused=True)
        self.texels = TexelAdam(avatar.textures)
        self.alignment = Alignment(frames)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget the gradients of a step that was not taken."""
        self.networks.zero_grad(set_to_none)
        self.texels.zero_grad()

    def step(self) -> None:
        """One step of both."""
        self.networks.step()
        self.texels.step()

    def state_dict(self) -> dict:
        """All that a continued run needs besides the weights."""
        return {
            "networks": self.networks.state_dict(),
            "texels": self.texels.state_dict(),
            "moves": torch.from_numpy(self.alignment.moves),
        }

    def load_state_dict(self, state: dict) -> None:
        """Take over what `state_dict` gave."""
        self.networks.load_state_dict(state["networks"])
        self.texels.load_state_dict(state["texels"])
        self.alignment.moves[...] = state["moves"].cpu().numpy()


class ImageLearner:
    """A layered avatar in training; see `avatar.learning.Learner`."""

    def __init__(self, job: step.Job, data: Data) -> None:
        """A fresh avatar with projected textures, or what `avatar.checkpoint` then loads into it."""
        # On the CPU whatever the device: compositing and textures learn in compiled passes. A GPU draws (`composite.reference`).
        self.config, self.data, self.device = job.config, data, "cpu"
        if REGIONS.index("mouth_cavity") not in data.head.region:
            job.log.warning(
                "the head model has no mouth cavity: an open mouth will show what lies behind; set head.mouth_cavity: true"
            )
        torch.manual_seed(job.config.seed)
        self.avatar = build.build(build.settings_of(job.config), data.head)
        self.avatar.shape_shell(torch.from_numpy(measured_shell(data)))
        chosen = data.train[:: max(1, len(data.train) // PROJECTED)]
        seen = self.avatar, data.scene, data.frames, data.alpha, chosen
        initial.project(*seen, initial.settle(*seen))
        self.optimiser = ImageOptimiser(self.avatar, len(data.scene.frames))
        self.perceptual = Perceptual(lpips.load(job.input.vgg, network="vgg16"), best_precision(self.device))

    def rates(self, number: int) -> None:
        """Exponential decay to a tenth, after a short linear rise."""
        factor = self.config.learning_rate / 1e-3  # the rates below are those at its default
        factor *= FINAL ** (number / self.config.steps) * min(1.0, (number + 1) / WARM_UP)
        for group in self.optimiser.networks.param_groups:
            group["lr"] = NETWORK_RATE * factor
        self.optimiser.texels.rates[:4], self.optimiser.texels.rates[4:] = STATIC_RATE * factor, BASIS_RATE * factor

    def window(self, frame: int, posed, view, random: np.random.Generator):  # noqa: ANN001, ANN201
        """A part of the view, WINDOW_PX a side or the whole of a smaller picture; its first column and row too."""
        height, width = view.size
        size = min(WINDOW_PX, height), min(WINDOW_PX, width)
        points = view.pixels_of(posed.layers_m[-1])[:, :2]
        marks = self.data.head.landmarks(torch.from_numpy(posed.layers_m[-1])).numpy()
        marks = view.pixels_of(marks[np.isfinite(marks).all(1)])[:, :2]
        if len(marks) and random.random() < FACE_SHARE:
            centre = marks[random.integers(len(marks))] + random.normal(0, SPREAD_PX, 2)
        else:
            centre = random.uniform(points.min(0), points.max(0))
        row = int(np.clip(centre[1] - size[0] / 2, 0, height - size[0]))
        column = int(np.clip(centre[0] - size[1] / 2, 0, width - size[1]))
        return view.window(column, row, size), np.s_[row : row + size[0], column : column + size[1]]

    def stirred(self, posed, view, random: np.random.Generator) -> Tensor:  # noqa: ANN001
        """What the network is told of a frame, moved a little towards, or away from, what it is told of another one.

        Expression and turn by themselves. A few hundred frames are few: it must not learn them one by one, nor tie what a face
        does to where it looked at the time.
        """
        frame = self.data.train[random.integers(len(self.data.train))]
        other = self.avatar.pose(*self.data.scene.heads([frame], self.device))
        own, others = self.avatar.told(posed, view), self.avatar.told(other, self.data.scene.view(frame, view.size))
        share = torch.from_numpy(random.normal(0, STIR, 2).astype(np.float32)).to(own.device)
        share = torch.cat([share[:1].expand(3), share[1:].expand(3), share[:1].expand(3), share.new_zeros(1)])
        return own + share[:, None, None] * (others - own)

    def loss(self, number: int) -> Loss:
        """The loss of step `number`."""
        random = np.random.default_rng([self.config.seed, number])
        frame = self.data.train[random.integers(len(self.data.train))]
        posed = self.avatar.pose(*self.data.scene.heads([frame], self.device, training=True))
        view, middle = self.data.scene.view(frame, self.data.alpha.shape[1:]), posed.layers_m[-1].mean(0).astype(np.float64)
        view = self.optimiser.alignment.applied(self.data.scene.place[frame], view, middle)
        view, place = self.window(frame, posed, view, random)
        texels, maps = self.optimiser.texels, self.avatar.maps(posed, view, self.stirred(posed, view, random))
        fragments = self.avatar.fragments(posed, view, SAMPLES)
        image, depth, count = composite.composite(self.avatar.textures, maps, fragments, texels.gradient, texels.touched)
        image, depth = composite.averaged(image, depth, SAMPLES)
        matte = torch.from_numpy(self.data.alpha[frame][place] / np.float32(255))
        truth = torch.from_numpy(on_white(self.data.frames[frame][place], self.data.alpha[frame][place]))
        if number >= ALIGNED_FROM * self.config.steps:
            drawn = image.detach().numpy(), depth.numpy(), truth.numpy()
            self.optimiser.alignment.learn(self.data.scene.place[frame], view, middle, *drawn)
        value = (image[..., :3] - truth).abs().mean() + self.config.opacity_weight * (image[..., 3] - matte).abs().mean()
        pair = [part.permute(2, 0, 1)[None] for part in (image[..., :3], truth)]
        if number < PERCEPTUAL_FROM * self.config.steps:
            return Loss(value, [frame], count)
        row, column = (int(random.integers(0, max(side - LOOKED_AT_PX, 0) + 1)) for side in truth.shape[:2])
        pair = [part[..., row : row + LOOKED_AT_PX, column : column + LOOKED_AT_PX] for part in pair]
        return Loss(value + PERCEPTUAL_WEIGHT * self.perceptual(*pair), [frame], count)

    def gradients(self) -> list[Tensor]:
        """Of the networks, and the largest of the texels'."""
        found = [parameter.grad for parameter in self.avatar.parameters() if parameter.grad is not None]
        return [*found, self.optimiser.texels.largest()]

    def precision(self) -> torch.dtype:
        """Of the perceptual network."""
        return self.perceptual.precision


def learner(job: step.Job, data: Data) -> ImageLearner:
    """What trains a layered avatar."""
    return ImageLearner(job, data)
