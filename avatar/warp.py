"""Error-correction warp (paper, section 3.1 and supplement A and B.1): one small rigid motion a point and training frame.

It moves the points of training rays so that what the tracker missed does not blur the features; it is off in tests. The
network is the `SE3Field` of Nerfies' first release, which the supplement's sizes match layer for layer. Everything runs in the
type of the points, float32 or more: log singular values near 1 are the rounding of bfloat16. Letters: P points, C channels.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from avatar.field import HEAD_SIZE_M
from avatar.networks import encoded_size

JOIN_AT = 4  # the trunk's input joins again before this layer
LATENT_BOUND, OUTPUT_BOUND = 0.05, 1e-4  # uniform from 0 (Nerfies): the warp starts near the identity
SERIES_BELOW, SERIES_TERMS = 1.0, 9  # squared angle in rad^2; the first term left out is below 1e-19
LEAST_SINGULAR = 1e-6
ELASTIC_SCALE = 0.03  # Geman-McClure scale, in log singular values (Nerfies)
SWEEPS = 5  # of Jacobi rotations; on 20,000 matrices 4 reach float64's rounding, 3 reach float32's


def windowed_encoding(values: Tensor, bands: int, alpha: float) -> Tensor:
    """`layers.positional_encoding`, coarse to fine: band j is multiplied by (1 - cos(pi clip(alpha - j, 0, 1))) / 2.

    values: [..., C]; alpha: 0 passes the values alone, `bands` everything.
    Returns [..., C (1 + 2 bands)]: values, then all sines (band-major), then all cosines.
    """
    octave = torch.arange(bands, dtype=values.dtype, device=values.device)
    window = 0.5 - 0.5 * torch.cos(torch.pi * (alpha - octave).clamp(0, 1))
    angles = values[..., None, :] * 2.0 ** octave[:, None]
    waves = [(window[:, None] * wave(angles)).flatten(-2) for wave in (torch.sin, torch.cos)]
    return torch.cat([values, *waves], -1)


def encoding_tangents(encoded: Tensor, bands: int) -> Tensor:
    """Derivatives of `windowed_encoding` of 3 coordinates, from its own output: sines and cosines are each other's.

    encoded: [P, 3 (1 + 2 bands)]. Returns [3, P, 3 (1 + 2 bands)], by coordinate k first.
    """
    waves = encoded[:, 3:].view(len(encoded), 2, bands, 3)
    octaves = 2.0 ** torch.arange(bands, dtype=encoded.dtype, device=encoded.device)[:, None]
    slope = torch.cat([encoded.new_ones(len(encoded), 1, 3), octaves * waves[:, 1], -octaves * waves[:, 0]], 1)
    unit = torch.eye(3, dtype=encoded.dtype, device=encoded.device)
    return (slope * unit[:, None, None]).flatten(-2)  # a channel depends on one coordinate only


def third_stumpff(squared: Tensor) -> Tensor:
    """(x - sin x) / x^3 of squared = x^2: smooth, with right derivatives everywhere, 0 included."""
    series = torch.zeros_like(squared)
    small = squared.clamp_max(SERIES_BELOW)  # the branch not taken stays finite, its gradient too
    for term in range(SERIES_TERMS, -1, -1):  # 1/3! - x^2/5! + x^4/7! - ...
        series = (1 - small * series) / ((2 * term + 2) * (2 * term + 3))
    angle = squared.clamp_min(SERIES_BELOW).sqrt()
    return torch.where(squared < SERIES_BELOW, series, (angle - torch.sin(angle)) / angle**3)


def turn_factors(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin x / x, (1 - cos x) / x^2 and (x - sin x) / x^3 of squared = x^2, without a division by x at 0."""
    third, half = third_stumpff(squared), 1 - squared / 4 * third_stumpff(squared / 4)  # half = sin(x / 2) / (x / 2)
    return 1 - squared * third, half.square() / 2, third


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product of broadcasting [..., 3]."""
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


class WarpField(nn.Module):
    """q' = R (q + c) - c + t with R, c and t from the point and a learned latent of its frame (supplement A)."""

    def __init__(self, frames: int, latent_size: int = 64, width: int = 128, depth: int = 5, bands: int = 6) -> None:
        """frames: of training, a latent each; depth: of the trunk; bands: octaves of the encoding when its window is open."""
        super().__init__()
        self.bands = bands
        self.latents = nn.Parameter(torch.empty(frames, latent_size).uniform_(0, LATENT_BOUND))
        inputs = encoded_size(3, bands) + latent_size
        before = [inputs if i == 0 else width + inputs if i == JOIN_AT else width for i in range(depth)]
        self.trunk = nn.ModuleList(nn.Linear(size, width) for size in before)
        heads = ("rotation", "centre", "translation")
        self.hidden = nn.ModuleDict({name: nn.Linear(width, width) for name in heads})
        self.out = nn.ModuleDict({name: nn.Linear(width, 3) for name in heads})
        for layer in (*self.trunk, *self.hidden.values(), *self.out.values()):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
        for layer in self.out.values():
            nn.init.uniform_(layer.weight, 0, OUTPUT_BOUND)

    def forward(self, points_m: Tensor, frame: Tensor, window: float) -> Tensor:
        """Warped points [P, 3] in metres.

        points_m: [P, 3]; frame: [P] int64, the row of each point's latent; window: bands of the encoding that are open.
        Raises IndexError for a frame without a latent (on a CUDA device: its own assertion).
        """
        return self._warp(points_m, frame, window, False)[0]

    def with_jacobian(self, points_m: Tensor, frame: Tensor, window: float) -> tuple[Tensor, Tensor]:
        """Warped points [P, 3] in metres and the Jacobian [P, 3, 3], row i column k: metres of i per metre of k.

        Arguments as of `forward`. Both outputs are differentiable.
        """
        return self._warp(points_m, frame, window, True)

    def _warp(self, points_m: Tensor, frame: Tensor, window: float, jacobian: bool) -> tuple[Tensor, Tensor]:
        """Values [P, C] and, if wanted, three tangents of each carried along by hand, [3, P, C].

        Jacobian and its backward pass, 12,000 points on one thread: by hand 0.55 s, three reverse passes 0.63 s, `torch.func`
        with vmap 0.79 s, with three jvp 1.2 s; points alone 0.15 s. Latents come last and have no tangents.
        """
        points = points_m / HEAD_SIZE_M
        encoded = windowed_encoding(points, self.bands, window)
        slopes = encoding_tangents(encoded, self.bands) if jacobian else None
        inputs = torch.cat([encoded, functional.embedding(frame, self.latents)], -1)
        values, tangents = inputs, slopes
        for i, layer in enumerate(self.trunk):
            if i == JOIN_AT:
                values = torch.cat([values, inputs], -1)
                tangents = torch.cat([tangents, slopes], -1) if jacobian else None
            values, tangents = active(layer, values, tangents)
        parts, moves = [], []
        for name, hidden in self.hidden.items():
            inner, inner_tangents = active(hidden, values, tangents)
            parts.append(self.out[name](inner))
            moves.append(functional.linear(inner_tangents, self.out[name].weight) if jacobian else None)
        warped, columns = rigid(points, parts, moves if jacobian else None)
        return warped * HEAD_SIZE_M, columns.permute(1, 2, 0)


def active(layer: nn.Linear, values: Tensor, tangents: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """ReLU of a layer with its tangents, which may lack the input's last channels: those do not depend on the point.

    values: [P, C]; tangents: [3, P, at most C].
    """
    values = torch.relu_(layer(values))
    if tangents is not None:
        tangents = functional.linear(tangents, layer.weight[:, : tangents.shape[-1]]).mul_((values > 0).to(values.dtype))
    return values, tangents


def rigid(points: Tensor, parts: list[Tensor], moves: list[Tensor] | None) -> tuple[Tensor, Tensor]:
    """q' = R (q + c) - c + t, with R from the pure log-quaternion v: w = cos |v|, xyz = sin |v| v / |v|, a turn by 2 |v|.

    points: [P, 3]; parts: v, c, t, each [P, 3]; moves: derivatives of v, c, t by the point's coordinates, each [3, P, 3].
    Returns [P, 3] and the derivatives [3, P, 3] (empty without moves).
    """
    turn, (_, centre, shift) = 2 * parts[0], parts
    first, second, third = (factor[:, None] for factor in turn_factors(turn.square().sum(-1)))

    def rotated(vectors: Tensor) -> Tensor:
        inner = cross(turn, vectors)
        return vectors + first * inner + second * cross(turn, inner)

    arm = rotated(points + centre)
    warped = arm - centre + shift
    if moves is None:
        return warped, points.new_empty(3, 0, 3)
    turned, centre_moves, shift_moves = 2 * moves[0], *moves[1:]
    inner = cross(turn, turned)
    spin = turned + second * inner + third * cross(turn, inner)  # left Jacobian of the rotation group: d(R p) = spin x R p
    unit = torch.eye(3, dtype=points.dtype, device=points.device)[:, None]
    return warped, rotated(unit + centre_moves) - centre_moves + shift_moves + cross(spin, arm)


@torch.no_grad()
def right_singular_vectors(matrices: Tensor) -> Tensor:
    """V of the singular value decomposition, in no order, by one-sided Jacobi rotations (Hestenes).

    matrices: [P, 3, 3] with entries up to 1. Returns [P, 3, 3], vectors in columns.
    NaN passes through, for the training step to see and skip; LAPACK raises. `elastic` and its
    backward pass: 18 ms for 12,000, by `svdvals` 27 ms, and the worst singular value is off by 3e-7, not 3e-6.
    """
    unit = torch.eye(3, dtype=matrices.dtype, device=matrices.device).expand_as(matrices)
    columns = list(torch.cat([matrices, unit], 1).permute(2, 1, 0).contiguous())  # 3 of [6, P]: matrix above V
    tiny = torch.finfo(matrices.dtype).tiny
    for _ in range(SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            a, b = columns[p], columns[q]
            gap = (b[:3].square() - a[:3].square()).sum(0)
            overlap = 2 * (a[:3] * b[:3]).sum(0)
            tangent = torch.where(gap < 0, -overlap, overlap) / (gap.abs() + torch.hypot(gap, overlap)).clamp_min(tiny)
            cosine = torch.rsqrt(1 + tangent.square())
            sine = tangent * cosine
            columns[p], columns[q] = cosine * a - sine * b, sine * a + cosine * b
    vectors = torch.stack([column[3:] for column in columns], -1).transpose(0, 1)
    return vectors / torch.linalg.vector_norm(vectors, dim=1, keepdim=True)  # the rotations' rounding adds up


def elastic(jacobian: Tensor) -> Tensor:
    """Nerfies' elastic term, its ICCV form: 2 x / (x + 4) with x = sum_k log(max(s_k, 1e-6))^2 / c^2, s the singular values.

    jacobian: [P, 3, 3]. Returns [P] in [0, 2]: 0 for rotations and reflections. The caller takes the mean over
    one sample a ray, where half of its rendering weight is reached: Nerfies' reduction `median`.
    s_k = |J v_k| with v_k held constant: its gradient u_k v_k^T is that of s_k, and no difference of singular values is
    divided by, so that of a symmetric function of them is right where they are equal too.
    """
    size = jacobian.detach().abs().amax((-2, -1), keepdim=True).clamp_min(torch.finfo(jacobian.dtype).tiny)
    scaled = jacobian / size  # squares of huge entries do not overflow
    singular = size[:, 0] * torch.linalg.vector_norm(scaled @ right_singular_vectors(scaled), dim=-2)
    squared = singular.clamp_min(LEAST_SINGULAR).log().square().sum(-1) / ELASTIC_SCALE**2
    return 2 * squared / (squared + 4)


def magnitude(points_m: Tensor, warped_m: Tensor) -> Tensor:
    """Mean squared length of the moves, in squares of `HEAD_SIZE_M`, the warp's own unit; 0 for no points.

    points_m, warped_m: [P, 3]. The paper's unit is unknown; in metres its weight of 1e-2 would price a move of 5 mm at 2.5e-7.
    """
    return ((warped_m - points_m) / HEAD_SIZE_M).square().sum() / max(len(points_m), 1)
