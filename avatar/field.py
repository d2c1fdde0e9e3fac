"""The k-NN inverse-distance field (paper, section 3.1, equation 1): MLP0 per neighbour, weighted sum, MLP1, MLP2."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from avatar import field_kernel
from avatar.networks import MLP, encoded_size, linear_in, positional_encoding

HEAD_SIZE_M = 0.15  # offsets are divided by it before encoding
NEAREST_M = 1e-8  # distances below the rounding of coordinates in metres count as this
ROWS = 512  # samples are padded to a multiple, for what `field_kernel.ROWS` says
DENSITY_LENGTH_M = 0.003  # a density of 1 is an optical depth of 1 over this length


def inverse_distance_weights(offsets_m: Tensor) -> Tensor:
    """w_j = (1 / d_j) / sum_k (1 / d_k) with d_j the length of offset j.

    offsets_m: [..., K, 3]. Returns [..., K], summing to 1.
    The pole is exact: a query on a vertex gets weight 1 there (shared among coincident ones), with a finite gradient.
    """
    distance = offsets_m.square().sum(-1).clamp_min(NEAREST_M**2).sqrt()
    ratio = distance.detach().amin(-1, keepdim=True) / distance  # the common factor cancels: no overflow at the pole
    return ratio / ratio.sum(-1, keepdim=True)


def padded(rows: Tensor) -> Tensor:
    """rows: [P, C] with the last one repeated until their number is a multiple of ROWS (a real one, so that it is finite)."""
    spare = -len(rows) % ROWS
    return torch.cat([rows, rows[-1:].expand(spare, -1)]) if spare and len(rows) else rows


class Field(nn.Module):
    """Density and colour at points, from their K nearest vertices and these vertices' features."""

    def __init__(
        self, channels: int, width: int, depth: int, colour_width: int, neighbours: int, bands: int, view_bands: int
    ) -> None:
        """channels: of a vertex feature; width, depth: of MLP0 and MLP1; colour_width: of MLP2; bands: octaves of encoding."""
        super().__init__()
        self.neighbours, self.bands, self.view_bands = neighbours, bands, view_bands
        self.encoded = encoded_size(3, bands)
        self.units = HEAD_SIZE_M, NEAREST_M
        first = nn.Linear(self.encoded + channels, width)  # split in two below: exact algebra, W [PE, z] = W_pe PE + W_z z
        nn.init.kaiming_uniform_(first.weight, nonlinearity="relu")
        self.from_offset = nn.Linear(self.encoded, width, bias=False)
        self.from_feature = nn.Linear(channels, width)
        self.from_offset.weight.data.copy_(first.weight[:, : self.encoded])
        self.from_feature.weight.data.copy_(first.weight[:, self.encoded :])
        nn.init.zeros_(self.from_feature.bias)
        self.mlp0 = MLP([width] * depth)
        self.mlp1 = MLP([width] * (depth + 1))
        self.density = nn.Linear(width, 1)
        self.mlp2 = MLP([width + encoded_size(3, view_bands), colour_width])
        self.colour = nn.Linear(colour_width, 3)

    def vertex_terms(self, features: Tensor, precision: torch.dtype) -> Tensor:
        """The part of MLP0's first layer that depends on the vertex alone, once a frame: [..., V, C] -> [..., V, width]."""
        return linear_in(precision, self.from_feature, features)

    def forward(
        self,
        points_m: Tensor,
        directions: Tensor,
        vertices_m: Tensor,
        index: Tensor,
        terms: Tensor,
        precision: torch.dtype = torch.float32,
    ) -> tuple[Tensor, Tensor]:
        """Evaluate the field.

        points_m: [P, 3]; directions: [P, 3], unit; vertices_m: [V, 3]; index: [P, K] into them; terms: [V, width].
        Encoding, weights, heads and outputs are float32 (or the points' own type); hidden layers run in `precision`.
        Returns density [P] per metre, >= 0, and colour [P, 3] in [0, 1].
        """
        if len(points_m) and field_kernel.fits(self, points_m, directions, vertices_m, terms):
            density, colour = field_kernel.evaluate(self, points_m, directions, vertices_m, index, terms, precision)
            return density / DENSITY_LENGTH_M, colour
        return self.plainly(points_m, directions, vertices_m, index, terms, precision)

    def plainly(
        self,
        points_m: Tensor,
        directions: Tensor,
        vertices_m: Tensor,
        index: Tensor,
        terms: Tensor,
        precision: torch.dtype = torch.float32,
    ) -> tuple[Tensor, Tensor]:
        """`forward` layer by layer: on any device, with gradients of everything."""
        count = len(points_m)
        points_m, directions, index = (padded(rows) for rows in (points_m, directions, index))
        offsets = vertices_m[index] - points_m[:, None]  # [P, K, 3]
        weights = inverse_distance_weights(offsets)
        encoded = positional_encoding(offsets / HEAD_SIZE_M, self.bands)
        hidden = linear_in(precision, self.from_offset, encoded) + functional.embedding(index, terms)
        hidden = self.mlp0(torch.relu_(hidden), precision)  # [P, K, width]
        mixed = (weights.to(hidden.dtype)[:, None] @ hidden)[:, 0]
        shared = self.mlp1(mixed, precision)
        density = functional.softplus(self.density(shared.to(points_m.dtype))[:, 0]) / DENSITY_LENGTH_M
        view = positional_encoding(directions, self.view_bands).to(precision)
        shade = self.mlp2(torch.cat([shared, view], -1), precision).to(points_m.dtype)
        return density[:count], torch.sigmoid(self.colour(shade))[:count]
