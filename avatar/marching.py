"""Rendering without gradients: one posed head, many rays, no more work than the picture needs.

In the shell half of a ray's samples are spread over it, front to back until next to no light passes; the other half goes where
these saw something. Before that the shell loses the voxels that the field leaves empty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from avatar import sampling, shell
from avatar.volume import CLOSED, Rays, Rendered, composite

if TYPE_CHECKING:
    from avatar.radiance import Posed, RadianceAvatar

RAY_CHUNK = 16384
DENSE_CHUNK = 512  # rays at a time where whole rays are sampled
SLOT_BLOCK = 4
FIELD_CHUNK = 4096  # samples that stay in the processor's cache
END = 0.004  # light behind a ray's end: one level of 8 bits
VOID = 0.01  # optical depth across a voxel below which its surroundings are skipped


@torch.no_grad()
def march(avatar: RadianceAvatar, posed: Posed, rays: Rays, precision: torch.dtype) -> tuple[Rendered, int]:
    """Render the first posed head; memory does not grow with the image. Returns N rays and the number of field evaluations."""
    features = avatar.source(posed.condition)
    if avatar.hierarchical:
        parts, evaluations = [], 0
        for some in chunks(rays, DENSE_CHUNK):
            outcome = avatar.render(posed, [some], precision, features=features)
            parts.append(outcome.renders[-1])
            evaluations += outcome.evaluations
    else:
        terms = avatar.field.vertex_terms(features.values, precision).flatten(0, 1)
        marcher = Marcher(avatar, posed, terms, precision)
        grid, evaluations = marcher.pruned()
        parts = []
        for some in chunks(rays, RAY_CHUNK):
            rendered, count = marcher.render(grid, some)
            parts.append(rendered)
            evaluations += count
    return Rendered(*(torch.cat(column).cpu() for column in zip(*parts, strict=True))), evaluations


def chunks(rays: Rays, size: int) -> list[Rays]:
    """Rays some at a time; one empty chunk of none."""
    starts = range(0, max(len(rays.origins_m), 1), size)
    return [Rays(*(array[start : start + size] for array in rays)) for start in starts]


@dataclass
class Marcher:
    """What stays the same for all rays of a picture."""

    avatar: RadianceAvatar
    posed: Posed
    terms: Tensor  # [V, width], see `Field.vertex_terms`
    precision: torch.dtype

    def render(self, grid: shell.Grid, rays: Rays) -> tuple[Rendered, int]:
        """N rays inside the shell, and the number of field evaluations."""
        found, count, met = shell.intervals(grid, rays.origins_m, rays.directions)
        step, most = 2 * self.avatar.step_m, max(1, self.avatar.max_samples // 2)
        coarse = shell.sample(found, count, step, most, None, met)
        density, colour, evaluations = self.front_to_back(rays, coarse)
        _, weight = composited(coarse, density, colour, len(count))
        samples, old = sampling.refine(found, count, coarse, weight.cpu().numpy(), met)
        new = np.flatnonzero(old < 0)
        density, colour = density[old], colour[old]  # those of new samples come now
        density[new], colour[new] = self.at(rays, samples, new)
        return composited(samples, density, colour, len(count))[0], evaluations + len(new)

    def front_to_back(self, rays: Rays, samples: shell.Samples) -> tuple[Tensor, Tensor, int]:
        """Density [P] and colour [P, 3], both 0 where less than END of the light arrives, and how many samples that left."""
        density = torch.zeros(len(samples.ray), device=self.terms.device)
        colour = density.new_zeros(len(samples.ray), 3)
        depth, evaluations = np.zeros(len(rays.origins_m)), 0  # optical depth in front
        for block in range(0, int(samples.slot.max(initial=-1)) + 1, SLOT_BLOCK):
            within = (samples.slot >= block) & (samples.slot < block + SLOT_BLOCK)
            chosen = np.flatnonzero(within & (np.exp(-depth[samples.ray]) > END))
            density[chosen], colour[chosen] = self.at(rays, samples, chosen)
            np.add.at(depth, samples.ray[chosen], density[chosen].cpu().numpy() * samples.step_m[chosen])
            evaluations += len(chosen)
        return density, colour, evaluations

    def at(self, rays: Rays, samples: shell.Samples, chosen: np.ndarray) -> tuple[Tensor, Tensor]:
        """Density and colour at some samples of the rays."""
        directions = rays.directions[samples.ray[chosen]]
        return self.evaluate(rays.origins_m[samples.ray[chosen]] + samples.distance_m[chosen, None] * directions, directions)

    def evaluate(self, points_m: np.ndarray, directions: np.ndarray) -> tuple[Tensor, Tensor]:
        """The field at points [P, 3] seen along directions [P, 3]."""
        index = self.avatar.nearest(self.posed, 0, points_m)
        arrays = (torch.from_numpy(array).to(self.terms.device).split(FIELD_CHUNK) for array in (points_m, directions, index))
        pieces = [
            self.avatar.field(points, along, self.posed.vertices_m[0], neighbours, self.terms, self.precision)
            for points, along, neighbours in zip(*arrays, strict=True)
        ]
        return torch.cat([piece[0] for piece in pieces]), torch.cat([piece[1] for piece in pieces])

    def pruned(self) -> tuple[shell.Grid, int]:
        """The head's shell without the voxels whose surroundings the field leaves empty: one evaluation a voxel.

        A voxel stays when any of its 27 neighbours, itself included, has an optical depth of VOID at its centre.
        """
        grid = self.posed.grids[0]
        place = np.argwhere(grid.labels == shell.SHELL)
        points = ((place + 0.5) * shell.VOXEL_M + grid.origin).astype(np.float32)
        density = self.evaluate(points, np.zeros_like(points))[0]
        full = np.zeros(grid.labels.shape, bool)
        full[tuple(place.T)] = (density * shell.VOXEL_M > VOID).cpu().numpy()
        keep = ndimage.binary_dilation(full, np.ones((3, 3, 3), bool)) | (grid.labels == shell.CORE)
        return shell.Grid(grid.origin, np.where(keep, grid.labels, shell.EMPTY)), len(place)


def composited(samples: shell.Samples, density: Tensor, colour: Tensor, rays: int) -> tuple[Rendered, Tensor]:
    """Rays of one head from the field's values at its samples, and the weight of each sample."""
    distance, step, ray, slot, closed = (torch.from_numpy(array).to(density.device) for array in samples)
    return composite(density * step + CLOSED * closed, colour, distance, ray, slot, rays)
