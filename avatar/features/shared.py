"""What several sources of vertex features share: units, the learned constant, one MLP on every vertex.

Letters: B posed heads, V vertices, C channels, D codes.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from avatar.field import HEAD_SIZE_M
from avatar.networks import MLP, encoded_size, positional_encoding
from fitting.head_model import HeadModel

DISPLACEMENT_UNIT_M = 0.01  # expressions move the skin by millimetres: inputs of about one
FEATURE_SCALE = 0.1  # root mean square of a source's features at the start (ours_d: 0.3 on the expressions of nerface.mp4)
# The constant's own learning rate, so to say: it is read by few rays and the network by all. Toy subject, 120 steps: 19.2 dB
# at 1, 24.9 dB at 10.
STATIC_GAIN = 10.0
JAW_CODES = 3  # a rotation vector
POSITION_BANDS = 10  # "on all coordinate inputs" (paper, supplement B)
POSITION_SIZE = encoded_size(3, POSITION_BANDS)


def code_count(head: HeadModel) -> int:
    """D: expression coefficients, then the jaw."""
    return head.expression_basis.shape[0] + JAW_CODES


def new_table(head: HeadModel, channels: int) -> nn.Parameter:
    """Learned values [V, channels], a constant of each vertex in units of `STATIC_GAIN`."""
    return nn.Parameter(torch.randn(head.vertex_count, channels) * FEATURE_SCALE / STATIC_GAIN)


def add_table(values: Tensor, table: Tensor | None) -> Tensor:
    """values: [..., V, C] plus the constant [V, C], if there is one."""
    return values if table is None else values + table * STATIC_GAIN


def encoded_position(neutral_m: Tensor) -> Tensor:
    """Where a vertex is on the neutral head, [V, 3] in metres -> [V, POSITION_SIZE]."""
    return positional_encoding(neutral_m / HEAD_SIZE_M, POSITION_BANDS)


class VertexMLP(nn.Module):
    """The same MLP on every vertex of every head: `depth` layers with ReLU, then a linear one.

    Its input is the concatenation of what depends on the vertex alone, on the head alone and on both. The first layer is
    applied to each part by itself, W [a, b, c] = W_a a + W_b b + W_c c, so that the large parts cost V and B rows, not B V.
    The last layer starts small: encoded inputs have a mean square of about 1/2, which ReLU layers of this start keep, so the
    outputs have about `FEATURE_SCALE`.
    """

    def __init__(self, sizes: tuple[int, int, int], width: int, depth: int, after: int) -> None:
        """sizes: channels per vertex, per head, per vertex and head (0: no such part); after: channels of the output."""
        super().__init__()
        self.sizes = sizes
        self.first = nn.Linear(sum(sizes), width)
        nn.init.kaiming_uniform_(self.first.weight, nonlinearity="relu")
        nn.init.zeros_(self.first.bias)
        self.hidden = MLP([width] * depth)  # one layer less than that
        self.out = nn.Linear(width, after)
        nn.init.normal_(self.out.weight, std=FEATURE_SCALE * (2 / width) ** 0.5)
        nn.init.zeros_(self.out.bias)

    def forward(self, vertex: Tensor, head: Tensor | None, both: Tensor | None) -> Tensor:
        """vertex: [V, sizes[0]]; head: [B, sizes[1]]; both: [B, V, sizes[2]]; None for zeros, but not for both of them.

        Returns [B, V, after].
        """
        weights = self.first.weight.split(self.sizes, 1)
        hidden = functional.linear(vertex, weights[0], self.first.bias)
        if head is not None:
            hidden = hidden + functional.linear(head, weights[1])[:, None]
        if both is not None:
            hidden = hidden + functional.linear(both, weights[2])
        return self.out(self.hidden(torch.relu_(hidden), hidden.dtype))
