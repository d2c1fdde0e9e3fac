"""A field of one network drawn from uniform samples on whole rays: what the shell is compared with, on the same weights."""

from __future__ import annotations

import torch
from torch import Tensor

from avatar import sampling, shell
from avatar.marching import DENSE_CHUNK, Marcher, chunks, composited
from avatar.radiance import Posed, RadianceAvatar
from avatar.volume import Rays, Rendered


@torch.no_grad()
def march(
    avatar: RadianceAvatar, posed: Posed, rays: Rays, precision: torch.dtype, uniform: int, fine: int = 0
) -> tuple[Rendered, int]:
    """Rays of the first posed head: N rays and the number of field evaluations.

    uniform: samples in the middles of equal strata between the bounds of `sampling.bounds`.
    fine: more of them where those saw something, as the paper's second network has them; all are evaluated anew then, as two
        networks would: uniform + (uniform + fine) evaluations a ray.
    Rays end at a shell's core: it is part of what the field was trained with.
    """
    terms = avatar.field.vertex_terms(avatar.source(posed.condition).values, precision).flatten(0, 1)
    marcher, parts, evaluations = Marcher(avatar, posed, terms, precision), [], 0
    vertices = posed.vertices_m[0].cpu().numpy()
    for some in chunks(rays, DENSE_CHUNK):
        near, far = sampling.bounds(vertices, some.origins_m)
        samples = ended(posed, some, sampling.uniform(near, far, uniform, None))
        rendered, weight = seen(marcher, some, samples)
        evaluations += len(samples.ray)
        if fine:
            distance, weight = samples.distance_m.reshape(-1, uniform), weight.cpu().numpy().reshape(-1, uniform)
            samples = ended(posed, some, sampling.by_weight(near, far, distance, weight, fine, None))
            rendered, _ = seen(marcher, some, samples)
            evaluations += len(samples.ray)
        parts.append(rendered)
    return Rendered(*(torch.cat(column).cpu() for column in zip(*parts, strict=True))), evaluations


def ended(posed: Posed, rays: Rays, samples: shell.Samples) -> shell.Samples:
    """Samples that end at the core of a shell, where the avatar has one."""
    return sampling.ended(posed.grids[0], rays, samples) if posed.grids else samples


def seen(marcher: Marcher, rays: Rays, samples: shell.Samples) -> tuple[Rendered, Tensor]:
    """N rays, and the weight [P] of every sample, none left out."""
    density, colour = marcher.at(rays, samples)
    return composited(samples, density, colour, len(rays.origins_m))
