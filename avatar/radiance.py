"""The radiance-field avatar: a source of vertex features, the k-NN field and volume rendering inside the shell.

What a representation offers (the same for every one): `pose` a head once a frame, then `render` rays of the posed head to
colour, opacity and depth. Everything is in the neck-normalised head frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor, nn

from avatar import shell
from avatar.field import Field
from avatar.neighbours import nearest_by_blocks, nearest_by_tree, tree_of
from avatar.volume import Rays, Rendered, composite

RAY_CHUNK = 16384
SLOT_BLOCK = 4
FIELD_CHUNK = 4096
CLOSED = 20.0  # optical depth where a ray ends at the core: the head is opaque, white never shines through it
END = 0.004  # light behind a ray's end: one level of 8 bits
VOID = 0.01  # optical depth across a voxel below which its surroundings are skipped


@dataclass
class Posed:
    """Work done once for B posed heads, without gradients."""

    vertices_m: Tensor  # [B, V, 3] with eye pose
    displacement_m: Tensor  # [B, V, 3] without eye pose
    grids: list[shell.Grid]
    trees: list[cKDTree]


class RadianceAvatar(nn.Module):
    """Features at vertices -> field -> rays."""

    def __init__(self, source: nn.Module, settings: dict, vertex_count: int) -> None:
        """source: displacement [B, V, 3] -> features [B, V, C]; settings: see `avatar.build.settings_of`."""
        super().__init__()
        self.source = source
        self.field = Field(
            settings["feature_channels"],
            settings["mlp_width"],
            settings["mlp_depth"],
            settings["colour_width"],
            settings["neighbours"],
            settings["bands"],
            settings["view_bands"],
        )
        self.step_m, self.max_samples = settings["sample_step_m"], settings["max_samples"]
        self.register_buffer("thickness_m", torch.zeros(vertex_count))
        self.register_buffer("core_m", torch.zeros(0, 3))

    def shape_shell(self, thickness_m: Tensor, core_m: Tensor) -> None:
        """Set the shell's thickness [V] and the core's points [Q, 3]; both are part of the weights file."""
        self.thickness_m, self.core_m = thickness_m.to(self.thickness_m), core_m.to(self.core_m)

    def grid(self, vertices_m: np.ndarray) -> shell.Grid:
        """The shell of one posed head, vertices [V, 3]."""
        return shell.occupancy(vertices_m, self.thickness_m.cpu().numpy(), self.core_m.cpu().numpy())

    def pose(self, vertices_m: Tensor, displacement_m: Tensor, grids: list[shell.Grid] | None = None) -> Posed:
        """vertices_m, displacement_m: [B, V, 3]; grids: kept from an earlier call."""
        arrays = vertices_m.detach().cpu().numpy()
        grids = [self.grid(array) for array in arrays] if grids is None else grids
        return Posed(vertices_m, displacement_m, grids, [tree_of(array) for array in arrays])

    def terms(self, posed: Posed, precision: torch.dtype) -> Tensor:
        """Per-vertex part of the field for all heads: [B * V, width]."""
        return self.field.vertex_terms(self.source(posed.displacement_m), precision).flatten(0, 1)

    def render(
        self, posed: Posed, rays: list[Rays], precision: torch.dtype, jitter: list[np.ndarray] | None = None
    ) -> tuple[Rendered, int]:
        """All rays of all posed heads in one pass with gradients.

        rays: one entry a head; jitter: [N, max_samples] a head, see `shell.sample`.
        Returns N rays in order and the number of field evaluations.
        """
        terms = self.terms(posed, precision)
        device = terms.device
        parts, offset = [], 0
        for head, bundle in enumerate(rays):
            found, count, met = shell.intervals(posed.grids[head], bundle.origins_m, bundle.directions)
            offsets = None if jitter is None else jitter[head]
            samples = shell.sample(found, count, self.step_m, self.max_samples, offsets, met)
            points = bundle.origins_m[samples.ray] + samples.distance_m[:, None] * bundle.directions[samples.ray]
            index = self._nearest(posed, head, points) + head * posed.vertices_m.shape[1]
            parts.append(
                (
                    points,
                    bundle.directions[samples.ray],
                    samples.distance_m,
                    samples.step_m,
                    samples.ray + offset,
                    samples.slot,
                    samples.closed,
                    index,
                )
            )
            offset += len(bundle.origins_m)
        points, directions, distance, step, ray, slot, closed, index = (
            torch.from_numpy(np.concatenate(column)).to(device) for column in zip(*parts, strict=True)
        )
        density, colour = self.field(points, directions, posed.vertices_m.flatten(0, 1), index, terms, precision)
        rendered, _ = composite(density * step + CLOSED * closed, colour, distance, ray, slot, offset)
        return rendered, len(points)

    def _nearest(self, posed: Posed, head: int, points: np.ndarray) -> np.ndarray:
        if posed.vertices_m.device.type == "cpu":
            return nearest_by_tree(posed.trees[head], points, self.field.neighbours, torch.get_num_threads())
        found = nearest_by_blocks(
            posed.vertices_m[head], torch.from_numpy(points).to(posed.vertices_m.device), self.field.neighbours
        )
        return found.cpu().numpy()

    @torch.no_grad()
    def march(self, posed: Posed, rays: Rays, precision: torch.dtype) -> tuple[Rendered, int]:
        """Render the first posed head front to back in blocks of samples, without gradients.

        A ray ends when less than END of the light behind it would still pass; memory does not grow with the image.
        Returns N rays and the number of field evaluations.
        """
        terms = self.terms(posed, precision)
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
