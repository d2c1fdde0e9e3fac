"""The radiance-field avatar: a source of vertex features, the k-NN field and volume rendering.

What a representation offers (the same for every one): `pose` a head once a frame, then `render` rays of posed heads with
gradients and with its own loss terms, or `march` the rays of one without. All in the neck-normalised head frame.

Two ways to sample: `shell` (ours: one network, stratified samples in a shell around the posed mesh) and `hierarchical` (the
paper's: a coarse network at uniform samples, a fine one where the first saw something).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor, nn

from avatar import sampling, shell
from avatar.features import Condition, Features
from avatar.field import Field
from avatar.neighbours import keep_mates, nearest_by_blocks, nearest_by_tree, resting_and_shut, surface_mates, tree_of
from avatar.sampling import Packed
from avatar.volume import Rays, Rendered, composite
from avatar.warp import WarpField, elastic, magnitude
from fitting.head_model import HeadModel

RAY_CHUNK = 16384
SLOT_BLOCK = 4
FIELD_CHUNK = 4096
CLOSED = 20.0  # optical depth where a ray ends at the core: the head is opaque, white never shines through it
END = 0.004  # light behind a ray's end: one level of 8 bits
VOID = 0.01  # optical depth across a voxel below which its surroundings are skipped


# Density's start on whole rays: softplus(CLEAR) / 3 mm over 0.6 m of air is an optical depth of 0.2. From a fog (0, -3 and -5
# were tried, toy subject) the first thing learned is to clear it everywhere, and the network dies of it.
CLEAR = -7.0
CANDIDATES = 3  # times the neighbours: as many nearest vertices are looked at for mates
DENSE_CHUNK = 512  # rays at a time of a hierarchical rendering without gradients


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

    def shape_shell(self, thickness_m: Tensor, core_m: Tensor) -> None:
        """Set the shell's thickness [V] and the core's points [Q, 3]; both are part of the weights file."""
        self.thickness_m, self.core_m = thickness_m.to(self.thickness_m), core_m.to(self.core_m)

    def correct_errors(self, frames: int) -> None:
        """Add the error-correction warp (supplement A) with a latent for each of `frames` training frames."""
        self.warp = WarpField(frames).to(self.thickness_m.device)

    def sharpen(self, factor: float) -> None:
        """Take `factor` times as many samples on a ray from now on."""
        self.step_m, self.max_samples = self.step_m / factor, round(self.max_samples * factor)
        self.coarse_samples, self.fine_samples = round(self.coarse_samples * factor), round(self.fine_samples * factor)

    @property
    def jitter_width(self) -> int:
        """Random numbers that a ray of `render` takes."""
        return self.coarse_samples + self.fine_samples if self.hierarchical else self.max_samples

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
        offsets = jitter or [None] * len(rays)
        found = [sampling.in_shell(posed.grids[i], rays[i], self.step_m, self.max_samples, offsets[i]) for i in range(len(rays))]
        rendered, _, terms = self._pass(self.field, features.values, posed, rays, found, precision, window)
        return Outcome([rendered], features.terms | terms, sum(len(part.ray) for part in found))

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
    ) -> tuple[Rendered, Tensor, dict[str, Tensor]]:
        """One network at the samples of all heads. features: [B, V, C].

        Returns the rays, the weight [P] of each sample, and the warp's loss terms unless they are not asked for.
        """
        firsts = np.cumsum([0, *(len(part.origins_m) for part in rays)])
        packed = sampling.join([sampling.pack(rays[i], found[i], i, firsts[i]) for i in range(len(rays))])
        device, vertices = features.device, posed.vertices_m.flatten(0, 1)
        points, directions, distance, step, ray, slot, closed, head = (torch.from_numpy(array).to(device) for array in packed)
        frame = self._latent_of(posed.condition)[head] if self.warp is not None and window is not None else None
        moved = points if frame is None else self.warp(points, frame, window)
        index = torch.from_numpy(self._indices(posed, moved.detach().cpu().numpy(), packed)).to(device)
        terms = field.vertex_terms(features, precision).flatten(0, 1)
        density, colour = field(moved, directions, vertices, index, terms, precision)
        rendered, weight = composite(density * step + CLOSED * closed, colour, distance, ray, slot, firsts[-1])
        if frame is None or not regularise:
            return rendered, weight, {}
        # Nerfies' own reduction to one sample a ray: the Jacobian at all of them costs ten times as much as all else of the warp.
        median = torch.from_numpy(sampling.median_samples(weight.detach().cpu().numpy(), packed.ray)).to(device)
        bent = elastic(self.warp.with_jacobian(points[median], frame[median], window)[1])
        return rendered, weight, {"elastic": bent.sum() / max(len(bent), 1), "magnitude": magnitude(points, moved)}

    def _latent_of(self, condition: Condition) -> Tensor:
        """Rows [B] int64 of the warp's latents."""
        if condition.time is None:
            raise ValueError("the warp corrects training frames only: these have no place in time")
        return (condition.time * (len(self.warp.latents) - 1)).round().long()

    def _indices(self, posed: Posed, points_m: np.ndarray, packed: Packed) -> np.ndarray:
        """Neighbours [P, K] of points of several heads, into the vertices of all of them."""
        count = posed.vertices_m.shape[1]
        ends = np.searchsorted(packed.head, np.arange(len(posed.trees) + 1))
        parts = [self._nearest(posed, i, points_m[ends[i] : ends[i + 1]]) + i * count for i in range(len(posed.trees))]
        return np.concatenate(parts)

    def _nearest(self, posed: Posed, head: int, points: np.ndarray) -> np.ndarray:
        points = np.where(np.isfinite(points), points, 0)  # a tree refuses others; the field makes them a loss that is not finite
        wanted = self.field.neighbours
        searched = wanted if self.mates is None else min(CANDIDATES * wanted, posed.vertices_m.shape[1])
        if posed.vertices_m.device.type == "cpu":
            found = nearest_by_tree(posed.trees[head], points, searched, torch.get_num_threads())
        else:
            there = torch.from_numpy(points).to(posed.vertices_m.device)
            found = nearest_by_blocks(posed.vertices_m[head], there, searched).cpu().numpy()
        return found if self.mates is None else keep_mates(found, self.mates, wanted)

    @torch.no_grad()
    def march(self, posed: Posed, rays: Rays, precision: torch.dtype) -> tuple[Rendered, int]:
        """Render the first posed head front to back in blocks of samples, without gradients.

        A ray ends when less than END of the light behind it would still pass; memory does not grow with the image.
        Returns N rays and the number of field evaluations.
        """
        if self.hierarchical:
            return self._march_dense(posed, rays, precision)
        terms = self.field.vertex_terms(self.source(posed.condition).values, precision).flatten(0, 1)
        vertices, device = posed.vertices_m[0], terms.device
        count_rays = len(rays.origins_m)
        colour, opacity, depth = torch.ones(count_rays, 3), torch.zeros(count_rays), torch.zeros(count_rays)
        grid, evaluations = self._pruned(posed, terms, precision)
        for start in range(0, count_rays, RAY_CHUNK):
            chunk = Rays(rays.origins_m[start : start + RAY_CHUNK], rays.directions[start : start + RAY_CHUNK])
            found, count, met = shell.intervals(grid, chunk.origins_m, chunk.directions)
            samples = shell.sample(found, count, self.step_m, self.max_samples, None, met)
            light, shade, middle = (
                np.ones(len(count), np.float32),
                np.zeros((len(count), 3), np.float32),
                np.zeros(len(count), np.float32),
            )
            for block in range(0, self.max_samples, SLOT_BLOCK):
                chosen = np.nonzero((samples.slot >= block) & (samples.slot < block + SLOT_BLOCK) & (light[samples.ray] > END))[0]
                if not len(chosen):
                    break
                ray, distance = samples.ray[chosen], samples.distance_m[chosen]
                directions = chunk.directions[ray]
                points = chunk.origins_m[ray] + distance[:, None] * directions
                index = torch.from_numpy(self._nearest(posed, 0, points)).to(device)
                density, tint = self._evaluate(
                    torch.from_numpy(points).to(device),
                    torch.from_numpy(directions).to(device),
                    vertices,
                    index,
                    terms,
                    precision,
                )
                present, place = np.unique(ray, return_inverse=True)
                part, weight = composite(
                    density * torch.from_numpy(samples.step_m[chosen]).to(device)
                    + CLOSED * torch.from_numpy(samples.closed[chosen]).to(device),
                    tint,
                    torch.from_numpy(distance).to(device),
                    torch.from_numpy(place).to(device),
                    torch.from_numpy(samples.slot[chosen] - block).to(device),
                    len(present),
                    0.0,
                )
                shade[present] += light[present, None] * part.colour.cpu().numpy()
                middle[present] += light[present] * (part.depth * part.opacity).cpu().numpy()
                light[present] *= 1 - part.opacity.cpu().numpy()
                evaluations += len(chosen)
            here = slice(start, start + len(count))
            opacity[here] = torch.from_numpy(1 - light)
            colour[here] = torch.from_numpy(shade + light[:, None])
            depth[here] = torch.from_numpy(middle / np.where(light < 1, 1 - light, 1))
        return Rendered(colour, opacity, depth), evaluations

    def _march_dense(self, posed: Posed, rays: Rays, precision: torch.dtype) -> tuple[Rendered, int]:
        """The same for hierarchical samples: every ray in full, some at a time."""
        features, parts, evaluations = self.source(posed.condition), [], 0
        for start in range(0, max(len(rays.origins_m), 1), DENSE_CHUNK):
            some = Rays(*(array[start : start + DENSE_CHUNK] for array in rays))
            outcome = self.render(posed, [some], precision, features=features)
            parts.append(outcome.renders[-1])
            evaluations += outcome.evaluations
        return Rendered(*(torch.cat(column).cpu() for column in zip(*parts, strict=True))), evaluations

    def _pruned(self, posed: Posed, terms: Tensor, precision: torch.dtype) -> tuple[shell.Grid, int]:
        """The first head's shell without the voxels whose surroundings the field leaves empty: one evaluation a voxel.

        A voxel stays when any of its 27 neighbours, itself included, has an optical depth of VOID at its centre.
        """
        grid, device = posed.grids[0], terms.device
        place = np.argwhere(grid.labels == shell.SHELL)
        points = ((place + 0.5) * shell.VOXEL_M + grid.origin).astype(np.float32)
        index = torch.from_numpy(self._nearest(posed, 0, points)).to(device)
        points = torch.from_numpy(points).to(device)
        density = self._evaluate(points, torch.zeros_like(points), posed.vertices_m[0], index, terms, precision)[0]
        full = np.zeros(grid.labels.shape, bool)
        full[tuple(place.T)] = (density * shell.VOXEL_M > VOID).cpu().numpy()
        keep = ndimage.binary_dilation(full, np.ones((3, 3, 3), bool)) | (grid.labels == shell.CORE)
        return shell.Grid(grid.origin, np.where(keep, grid.labels, shell.EMPTY)), len(place)

    def _evaluate(
        self, points: Tensor, directions: Tensor, vertices: Tensor, index: Tensor, terms: Tensor, precision: torch.dtype
    ) -> tuple[Tensor, Tensor]:
        """The field in pieces that stay in the processor's cache."""
        pieces = zip(points.split(FIELD_CHUNK), directions.split(FIELD_CHUNK), index.split(FIELD_CHUNK), strict=True)
        results = [self.field(p, d, vertices, i, terms, precision) for p, d, i in pieces]
        return torch.cat([r[0] for r in results]), torch.cat([r[1] for r in results])
