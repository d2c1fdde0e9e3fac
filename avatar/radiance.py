"""The radiance-field avatar: a source of vertex features, the k-NN field and volume rendering.

What a representation offers (the same for every one): `pose` a head once a frame, then draw a `picture` of it without
gradients; what trains it is in `avatar.learning`. Here also `render`, rays of posed heads with gradients and with loss terms of
their own, and `march`, the rays of one without. All in the neck-normalised head frame.

Two ways to sample: `shell` (ours: one network, stratified samples in a shell around the posed mesh) and `hierarchical` (the
paper's: a coarse network at uniform samples, a fine one where the first saw something).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from avatar import marching, sampling, shell
from avatar.features import Condition, Features
from avatar.field import Field
from avatar.neighbours import (
    keep_mates,
    nearest_by_blocks,
    nearest_by_tree,
    nearest_mates,
    resting_and_shut,
    surface_mates,
    tree_of,
)
from avatar.sampling import Packed
from avatar.view import View
from avatar.volume import CLOSED, Rays, Rendered, composite
from avatar.warp import WarpField, elastic, magnitude
from fitting.head_model import HeadModel

# Density's start on whole rays: softplus(CLEAR) / 3 mm over 0.6 m of air is an optical depth of 0.2. From a fog (0, -3 and -5
# were tried, toy subject) the first thing learned is to clear it everywhere, and the network dies of it.
CLEAR = -7.0
CLEAR_DENSITY = 0.02  # per metre: what is farther away than the shell may have it, half a metre of it lets 99 % of the light pass
CANDIDATES = 3  # times the neighbours: as many nearest vertices are looked at for mates


@dataclass
class Posed:
    """Work done once for B posed heads, without gradients."""

    vertices_m: Tensor  # [B, V, 3] with eye pose
    condition: Condition
    grids: list[shell.Grid]  # none for hierarchical sampling
    trees: list[cKDTree]


class Outcome(NamedTuple):
    """What a step of training compares with the truth and adds to the loss."""

    renders: list[Rendered]  # N rays each; the last is the picture, before it the coarse network's
    terms: dict[str, Tensor]  # scalars by name, unweighted (weights in `avatar.losses`)
    evaluations: int  # of the field's networks


def clearing(density: Tensor) -> Tensor:
    """What is wrong with densities [P] per metre where nothing may be: mean of log(density / CLEAR_DENSITY), at least 0 each.

    So that a rendering of whole rays with the same weights shows the same head. By the logarithm, because the density's own
    gradient is gone long before it is small enough.
    """
    return torch.log(density.clamp_min(CLEAR_DENSITY) / CLEAR_DENSITY).mean()


class RadianceAvatar(nn.Module):
    """Features at vertices -> field -> rays."""

    def __init__(self, source: nn.Module, settings: dict, head: HeadModel) -> None:
        """source: `Condition` -> `Features` of `source.channels`; settings: see `avatar.build.settings_of`."""
        super().__init__()
        self.source = source
        sizes = ("mlp_width", "mlp_depth", "colour_width", "neighbours", "bands", "view_bands")
        self.hierarchical = settings["sampling"] == "hierarchical"
        self.field = Field(source.channels, *(settings[name] for name in sizes))
        self.coarse = None
        if self.hierarchical:
            self.coarse = Field(source.channels, *(settings[name] for name in sizes))
            for field in (self.coarse, self.field):
                nn.init.constant_(field.density.bias, CLEAR)
        self.coarse_samples, self.fine_samples = settings["coarse_samples"], settings["fine_samples"]
        self.step_m, self.max_samples = settings["sample_step_m"], settings["max_samples"]
        self.warp: WarpField | None = None  # of training alone: see `correct_errors`
        surface = settings["neighbourhood"] == "surface"
        self.mates = surface_mates(resting_and_shut(head), head.triangles.cpu().numpy()) if surface else None
        self.register_buffer("thickness_m", torch.zeros(head.vertex_count))
        self.register_buffer("core_m", torch.zeros(0, 3))
        self.core_tree: cKDTree | None = None  # of core_m, when training first asks

    def shape_shell(self, thickness_m: Tensor, core_m: Tensor) -> None:
        """Set the shell's thickness [V] and the core's points [Q, 3]; both are part of the weights file."""
        self.thickness_m, self.core_m, self.core_tree = thickness_m.to(self.thickness_m), core_m.to(self.core_m), None

    def correct_errors(self, frames: int) -> None:
        """Add the error-correction warp (supplement A) with a latent for each of `frames` training frames."""
        self.warp = WarpField(frames).to(self.thickness_m.device)

    def sharpen(self, factor: float) -> None:
        """Take `factor` times as many samples on a ray from now on."""
        counts = (self.max_samples, self.coarse_samples, self.fine_samples)
        self.max_samples, self.coarse_samples, self.fine_samples = (max(1, round(count * factor)) for count in counts)
        self.step_m /= factor

    @property
    def jitter_width(self) -> int:
        """Random numbers that a ray of `render` takes."""
        return self.coarse_samples + self.fine_samples if self.hierarchical else self.max_samples + 1

    def grid(self, vertices_m: np.ndarray) -> shell.Grid:
        """The shell of one posed head, vertices [V, 3]."""
        return shell.occupancy(vertices_m, self.thickness_m.cpu().numpy(), self.core_m.cpu().numpy())

    def pose(self, vertices_m: Tensor, condition: Condition, grids: list[shell.Grid] | None = None) -> Posed:
        """vertices_m: [B, V, 3]; grids: kept from an earlier call."""
        arrays = vertices_m.detach().cpu().numpy()
        if grids is None:
            grids = [] if self.hierarchical else [self.grid(array) for array in arrays]
        return Posed(vertices_m, condition, grids, [tree_of(array) for array in arrays])

    def render(
        self,
        posed: Posed,
        rays: list[Rays],
        precision: torch.dtype,
        jitter: list[np.ndarray] | None = None,
        window: float | None = None,
        features: Features | None = None,
    ) -> Outcome:
        """All rays of all posed heads in one pass with gradients.

        rays: one entry a head; jitter: [N, jitter_width] a head in [0, 1), None takes the middle of each stratum.
        window: of the warp's encoding (`losses.warp_window`); None leaves the warp out.
        features: of these heads, where they are known already.
        """
        features = self.source(posed.condition) if features is None else features
        if self.hierarchical:
            renders, terms, evaluations = self._coarse_to_fine(features.values, posed, rays, precision, jitter, window)
            return Outcome(renders, features.terms | terms, evaluations)
        offsets, heads = jitter or [None] * len(rays), range(len(rays))
        found = [sampling.in_shell(posed.grids[i], rays[i], self.step_m, self.max_samples, offsets[i]) for i in heads]
        met, clear = sum(len(part.ray) for part in found), None
        if jitter and met:  # in training: the rays' last random number
            clear = [self._outside(posed, i, jitter[i][:, -1]) for i in heads]
        rendered, _, terms = self._pass(self.field, features.values, posed, rays, found, precision, window, clear=clear)
        return Outcome([rendered], features.terms | terms, met + sum(len(part.ray) for part in clear or []))

    def _outside(self, posed: Posed, head: int, numbers: np.ndarray) -> Packed:
        """Places outside the shell of one head, a random one for each three numbers [N] in [0, 1)."""
        few = numbers[: len(numbers) // 3 * 3].reshape(-1, 3)
        if self.core_tree is None and len(self.core_m):
            self.core_tree = cKDTree(self.core_m.cpu().numpy())
        return sampling.outside(posed.grids[head], posed.vertices_m[head].cpu().numpy(), few, head, self.core_tree)

    def _coarse_to_fine(
        self,
        features: Tensor,
        posed: Posed,
        rays: list[Rays],
        precision: torch.dtype,
        jitter: list[np.ndarray] | None,
        window: float | None,
    ) -> tuple[list[Rendered], dict[str, Tensor], int]:
        """The coarse network at uniform samples, the fine one at these and where the first saw something. features: [B, V, C].

        Returns both renderings, the warp's loss terms (of the coarse samples, as in Nerfies), and the number of evaluations.
        """
        split, heads = self.coarse_samples, range(len(rays))
        first = [None if jitter is None else jitter[i][:, :split] for i in heads]
        rest = [None if jitter is None else jitter[i][:, split:] for i in heads]
        limits = [sampling.bounds(posed.vertices_m[i].cpu().numpy(), rays[i].origins_m) for i in heads]
        found = [sampling.uniform(*limits[i], split, first[i]) for i in heads]
        rough, weights, terms = self._pass(self.coarse, features, posed, rays, found, precision, window)
        ends = np.cumsum([len(part.origins_m) for part in rays])[:-1]
        seen = np.split(weights.detach().cpu().numpy().reshape(-1, split), ends)
        finer = [
            sampling.by_weight(*limits[i], found[i].distance_m.reshape(-1, split), seen[i], self.fine_samples, rest[i])
            for i in heads
        ]
        rendered, _, _ = self._pass(self.field, features, posed, rays, finer, precision, window, regularise=False)
        return [rough, rendered], terms, sum(len(part.ray) for part in found + finer)

    def _pass(
        self,
        field: Field,
        features: Tensor,
        posed: Posed,
        rays: list[Rays],
        found: list[shell.Samples],
        precision: torch.dtype,
        window: float | None,
        regularise: bool = True,
        clear: list[Packed] | None = None,
    ) -> tuple[Rendered, Tensor, dict[str, Tensor]]:
        """One network at the samples of all heads. features: [B, V, C]; clear: places of each head where nothing may be.

        Returns the rays, the weight [P] of each sample, and loss terms: of these places, of the warp unless not asked for.
        """
        firsts = np.cumsum([0, *(len(part.origins_m) for part in rays)])
        parts = [[sampling.pack(rays[i], found[i], i, firsts[i]), *(clear[i : i + 1] if clear else [])] for i in range(len(rays))]
        packed = sampling.join([part for of_head in parts for part in of_head])
        device, vertices = features.device, posed.vertices_m.flatten(0, 1)
        points, directions, distance, step, ray, slot, closed, head = (torch.from_numpy(array).to(device) for array in packed)
        frame = self._latent_of(posed.condition)[head] if self.warp is not None and window is not None else None
        moved = points if frame is None else self.warp(points, frame, window)
        index = torch.from_numpy(self._indices(posed, moved.detach().cpu().numpy(), packed)).to(device)
        terms = field.vertex_terms(features, precision).flatten(0, 1)
        density, colour = field(moved, directions, vertices, index, terms, precision)
        outside, extra = slot == sampling.OUTSIDE_SLOT, {}
        if outside.any():
            extra = {"outside": clearing(density[outside])}
            density, colour, distance, step, ray, slot, closed = (
                array[~outside] for array in (density, colour, distance, step, ray, slot, closed)
            )
        rendered, weight = composite(density * step + CLOSED * closed, colour, distance, ray, slot, firsts[-1])
        if frame is None or not regularise:
            return rendered, weight, extra
        # Nerfies' own reduction to one sample a ray: the Jacobian at all of them costs ten times as much as all else of the warp.
        kept = (~outside).nonzero()[:, 0]
        median = kept[torch.from_numpy(sampling.median_samples(weight.detach().cpu().numpy(), ray.cpu().numpy())).to(device)]
        bent = elastic(self.warp.with_jacobian(points[median], frame[median], window)[1])
        return rendered, weight, extra | {"elastic": bent.sum() / max(len(bent), 1), "magnitude": magnitude(points, moved)}

    def _latent_of(self, condition: Condition) -> Tensor:
        """Rows [B] int64 of the warp's latents."""
        if condition.time is None:
            raise ValueError("the warp corrects training frames only: these have no place in time")
        return (condition.time * (len(self.warp.latents) - 1)).round().long()

    def _indices(self, posed: Posed, points_m: np.ndarray, packed: Packed) -> np.ndarray:
        """Neighbours [P, K] of points of several heads, into the vertices of all of them."""
        count = posed.vertices_m.shape[1]
        ends = np.searchsorted(packed.head, np.arange(len(posed.trees) + 1))
        parts = [self.nearest(posed, i, points_m[ends[i] : ends[i + 1]]) + i * count for i in range(len(posed.trees))]
        return np.concatenate(parts)

    def march(self, posed: Posed, rays: Rays, precision: torch.dtype) -> tuple[Rendered, int]:
        """Render the first posed head without gradients: N rays and the number of field evaluations."""
        return marching.march(self, posed, rays, precision)

    def picture(self, posed: Posed, view: View, precision: torch.dtype) -> tuple[Rendered, int]:
        """All pixels of a view of the first posed head, row by row, without gradients, and the number of field evaluations."""
        return self.march(posed, view.rays(), precision)

    def nearest(self, posed: Posed, head: int, points_m: np.ndarray) -> np.ndarray:
        """Vertices [P, K] that the field reads at points [P, 3] of one posed head, nearest first."""
        points_m = np.where(np.isfinite(points_m), points_m, 0)  # a tree refuses others; the field makes them a bad loss
        wanted, vertices_m = self.field.neighbours, posed.vertices_m[head]
        most = wanted if self.mates is None else min(CANDIDATES * wanted, len(vertices_m))
        if vertices_m.device.type == "cpu":
            threads = torch.get_num_threads()
            if self.mates is None:
                return nearest_by_tree(posed.trees[head], points_m, wanted, threads)
            return nearest_mates(posed.trees[head], points_m, wanted, most, self.mates, threads)
        there = torch.from_numpy(points_m).to(vertices_m.device)
        found = nearest_by_blocks(vertices_m, there, most).cpu().numpy()
        return found if self.mates is None else keep_mates(found, self.mates, wanted)
