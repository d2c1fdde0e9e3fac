"""Rendering without gradients: one posed head, many rays, no more work than the picture needs.

In the shell samples go where the field's density at the centres of the voxels that the picture sees says that light ends; see
`avatar.guide`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from avatar import guide, sampling, shell
from avatar.volume import CLOSED, Rays, Rendered, composite

if TYPE_CHECKING:
    from avatar.radiance import Posed, RadianceAvatar

RAY_CHUNK = 16384
DENSE_CHUNK = 512  # rays at a time where whole rays are sampled
FIELD_CHUNK = 1 << 16  # samples at a time on other devices; on a CPU the field makes its own blocks
END = 0.004  # light behind a ray's end: one level of 8 bits
GUIDED = 2 / 3  # of the samples that training spreads over the shell


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
        density, evaluations = marcher.seen(rays)
        parts = []
        for some in chunks(rays, RAY_CHUNK):
            rendered, count = marcher.render(density, some)
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

    def render(self, density: np.ndarray, rays: Rays) -> tuple[Rendered, int]:
        """N rays inside the shell, and the number of field evaluations; density: from `guide.seen_density`.

        A ray that has light left where its samples stop goes on through the rest of the shell.
        """
        grid, step_m = self.posed.grids[0], self.avatar.step_m
        samples, stops = guide.guided(grid, density, rays, step_m, self.most, END)
        front = composited(samples, *self.at(rays, samples), len(rays.origins_m))[0]
        left = np.flatnonzero(np.isfinite(stops) & (1 - front.opacity.cpu().numpy() > END))
        if not len(left):
            return front, len(samples.ray)
        on, stops = Rays(rays.origins_m[left], rays.directions[left]), stops[left].astype(np.float32)
        rest = sampling.in_shell(
            grid, on._replace(origins_m=on.origins_m + stops[:, None] * on.directions), step_m, self.most, None
        )
        rest = rest._replace(distance_m=rest.distance_m + stops[rest.ray])
        behind = composited(rest, *self.at(on, rest), len(left))[0]
        return joined(front, behind, torch.from_numpy(left).to(front.opacity.device)), len(samples.ray) + len(rest.ray)

    @property
    def most(self) -> int:
        """Samples on a ray: fewer than where they are spread over the whole shell."""
        return max(1, round(self.avatar.max_samples * GUIDED))

    def at(self, rays: Rays, samples: shell.Samples) -> tuple[Tensor, Tensor]:
        """Density and colour at samples of the rays."""
        directions = rays.directions[samples.ray]
        return self.evaluate(rays.origins_m[samples.ray] + samples.distance_m[:, None] * directions, directions)

    def evaluate(self, points_m: np.ndarray, directions: np.ndarray) -> tuple[Tensor, Tensor]:
        """The field at points [P, 3] seen along directions [P, 3]."""
        index = self.avatar.nearest(self.posed, 0, points_m)
        arrays = (torch.from_numpy(array).to(self.terms.device).split(FIELD_CHUNK) for array in (points_m, directions, index))
        pieces = [
            self.avatar.field(points, along, self.posed.vertices_m[0], neighbours, self.terms, self.precision)
            for points, along, neighbours in zip(*arrays, strict=True)
        ]
        return torch.cat([piece[0] for piece in pieces]), torch.cat([piece[1] for piece in pieces])

    def seen(self, rays: Rays) -> tuple[np.ndarray, int]:
        """The field's density at the voxels that the rays see, and the number of field evaluations."""
        return guide.seen_density(self.posed.grids[0], rays, self._density, END)

    def _density(self, points_m: np.ndarray) -> np.ndarray:
        return self.evaluate(points_m, np.zeros_like(points_m))[0].cpu().numpy()  # seen along no direction: it has no part in it


def composited(samples: shell.Samples, density: Tensor, colour: Tensor, rays: int) -> tuple[Rendered, Tensor]:
    """Rays of one head from the field's values at its samples, and the weight of each sample."""
    distance, step, ray, slot, closed = (torch.from_numpy(array).to(density.device) for array in samples)
    return composite(density * step + CLOSED * closed, colour, distance, ray, slot, rays)


def joined(front: Rendered, behind: Rendered, places: Tensor) -> Rendered:
    """Rays of which those at `places` [M] go on; behind: [M], seen from where the front ones end, on the same background of 1."""
    light = 1 - front.opacity[places]
    opacity = 1 - light * (1 - behind.opacity)
    depth = front.depth[places] * front.opacity[places] + light * behind.opacity * behind.depth
    parts = (
        front.colour[places] + light[:, None] * (behind.colour - 1),
        opacity,
        depth / torch.where(opacity > 0, opacity, torch.ones_like(opacity)),
    )
    return Rendered(*(whole.index_copy(0, places, part) for whole, part in zip(front, parts, strict=True)))
