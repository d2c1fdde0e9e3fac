"""Textures to start from: the video's colours, projected onto every layer. One pass over a few frames, most of early convergence.

The shells are put where the frames agree (a plane sweep), the nearest of them opaque. The static texture is the mean;
the bases are the principal components of what remains frame by frame, without its coarse part, which the frame's map says
itself: closed eyes, wrinkles, lips. A basis of noise would take thousands of steps to become one of these.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy import ndimage

from avatar.dataset import Scene
from avatar.layered import outlines, shells
from avatar.layered.model import LayeredAvatar
from fitting.head_model import REGIONS

SEEN = 0.3  # opaque pixels that a texel's colour is a mean of, at least
OPAQUE = 0.98  # matte of a pixel whose colour is taken: at the rim it is mixed with what lies behind
INSIDE, WITHIN = 0.9, 0.5  # mean matte above which a place of a shell, and of the skin, is the head's in all views
SKIN, AIR = 2.5, -4.0  # logits of opacity: of a surface, and of what lies before it
MEDIAN = 9  # texels a side over which the surface's shell is the median
AGREEING = 4.0  # texels over which the frames' agreement on a colour is averaged
OUTSIDE = 2.0  # below what the matte's own mean says, beside the head
CLEARER = 0.6  # part of the skin's disagreement below which another shell is taken for the surface of the face
STANDS_OFF_M = 0.0045  # reach of the shells above which something stands off the mesh
COVERED_M = 0.004  # height of the surface from which what is seen there is not skin
STAYS = -0.16  # `fading` of a shell that fades to a third
LIMIT = 0.02  # colours are kept this far from 0 and 1: their logits are finite
DETAIL = 4  # the principal components are found at a texture's side over this
COARSE = 4.0  # texels of such a texture over which the coarse part is blurred
EXPRESSIVE, OTHERS = ("face", "eyeballs", "teeth", "tongue", "mouth_cavity"), 0.1  # hair moves too, but not with the face
COMMON = 0.1  # of the frames must see a texel that takes part


def logit(value: np.ndarray, limit: float) -> np.ndarray:
    """Inverse of the sigmoid, of values kept `limit` away from 0 and 1."""
    value = np.clip(value, limit, 1 - limit)
    return np.log(value / (1 - value))


class Sums:
    """Colours and mattes of many pixels by texel, for one layer of `side` texels a side."""

    def __init__(self, side: int) -> None:
        """Nothing yet."""
        self.side = side
        self.count, self.matte, self.weight = (np.zeros(side * side) for _ in range(3))
        self.colour, self.squared = np.zeros((side * side, 3)), np.zeros(side * side)

    def add(self, uv: np.ndarray, image: np.ndarray, matte: np.ndarray) -> None:
        """Pixels at uv [n, 2] with colours [n, 3] and mattes [n], both in [0, 1]."""
        column = np.clip((uv[:, 0] * self.side).astype(np.int64), 0, self.side - 1)
        texel = np.clip(((1 - uv[:, 1]) * self.side).astype(np.int64), 0, self.side - 1) * self.side + column
        weight = (matte > OPAQUE).astype(np.float64)
        self.count += np.bincount(texel, minlength=self.side**2)
        self.matte += np.bincount(texel, matte, self.side**2)
        self.weight += np.bincount(texel, weight, self.side**2)
        for channel in range(3):
            self.colour[:, channel] += np.bincount(texel, weight * image[:, channel], self.side**2)
        self.squared += np.bincount(texel, weight * np.square(image).sum(1), self.side**2)

    def disagreement(self) -> np.ndarray:
        """Variance of the colour over frames [side, side], averaged over the neighbourhood; infinite where nothing is seen."""
        square = np.square(self.colour).sum(1) / np.maximum(self.weight, 1e-6)
        spread, weight = (one.reshape(self.side, self.side) for one in (self.squared - square, self.weight))
        spread, weight = (ndimage.gaussian_filter(one, AGREEING) for one in (spread, weight))
        return np.where(weight > 1e-3, spread / np.maximum(weight, 1e-3), np.inf)

    def mean(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean colour [side, side, 3], the nearest texel's where none is known (grey without any), and which are known."""
        known = (self.weight > SEEN).reshape(self.side, self.side)
        mean = (self.colour / np.maximum(self.weight, 1e-6)[:, None]).reshape(self.side, self.side, 3)
        if not known.any():
            return np.full_like(mean, 0.5), known
        return mean[tuple(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))], known


def gathered(
    avatar: LayeredAvatar, scene: Scene, frames: np.ndarray, alpha: np.ndarray, chosen: Sequence[int], layers: Sequence[int]
) -> tuple[dict[int, Sums], dict[int, list[Sums]]]:
    """Sums of the given layers over the chosen frames; and for the skin and the inner parts those of each frame, DETAIL coarser.

    frames: [T, H, W, 3] uint8; alpha: [T, H, W] uint8.
    """
    count, side = avatar.textures.shape[:2]
    sums, small = {layer: Sums(side) for layer in layers}, max(1, side // DETAIL)
    singles: dict[int, list[Sums]] = {layer: [] for layer in (count - 3, count - 1) if layer in sums}
    for frame in chosen:
        posed = avatar.pose(*scene.heads([frame], "cpu"))
        fragments = avatar.fragments(posed, scene.view(frame, alpha.shape[1:]))
        matte, image = alpha[frame] / np.float32(255), frames[frame] / np.float32(255)
        for layer in layers:
            seen = fragments.inverse_depth[layer] > 0
            if layer == count - 1:  # what lies behind lids and lips is not what the pixel shows
                seen &= fragments.inverse_depth[layer] >= fragments.inverse_depth[count - 3]
            pixels = fragments.uv[layer][seen], image[seen], matte[seen]
            sums[layer].add(*pixels)
            if layer in singles:
                singles[layer].append(Sums(small))
                singles[layer][-1].add(*pixels)
    return sums, singles


def _nearest(avatar: LayeredAvatar, disagreement: np.ndarray) -> np.ndarray:
    """The shell [side, side] on whose colours frames agree best; disagreement: [n, side, side], the skin's among them.

    Over the face it is the skin's, unless another is CLEARER: what frames disagree on there is mostly what expressions change.
    """
    skin, side = len(avatar.textures) - 3, disagreement.shape[1]
    face = (avatar.head.region == REGIONS.index("face")).float().cpu().numpy()
    least = np.where(_map_of(avatar, face, "skin", side) > 0.5, CLEARER, 1.0)
    best = np.where(disagreement.min(0) < least * disagreement[skin], disagreement.argmin(0), skin)
    return ndimage.median_filter(best, MEDIAN)


def settle(avatar: LayeredAvatar, scene: Scene, frames: np.ndarray, alpha: np.ndarray, chosen: Sequence[int]) -> np.ndarray:
    """Move the shells to the surface of what stands off the skin, in place; returns the vertices [V] bool that it covers.

    Arrays as for `gathered`. The surface is where the outlines say, and off the scalp, where these are cut, where the frames
    agree best on each texel's colour: a plane sweep (Collins, 1996), shells as planes. Where it is not skin, the shells above it
    fade where they are seen edge on, as any does; those beneath fade little, for their edges are the head's outline.
    """
    shown = range(len(avatar.textures) - 2)
    sums = gathered(avatar, scene, frames, alpha, chosen, shown)[0]
    disagreement = np.stack([sums[layer].disagreement() for layer in shown])
    best = _nearest(avatar, disagreement)
    side, uv = avatar.textures.shape[1], avatar.corner_uv[avatar.drawn[0]].reshape(-1, 2)
    column, row = (np.clip((place * side).astype(int), 0, side - 1) for place in (uv[:, 0], 1 - uv[:, 1]))
    vertex = avatar.triangles[avatar.drawn[0]].ravel()
    offsets = avatar.offsets_m.cpu().numpy()
    known = np.isfinite(disagreement).any(0)[row, column] & (offsets[0][vertex] > STANDS_OFF_M)
    height = offsets[best[row, column], vertex]
    total, share = (np.bincount(vertex[known], weight, len(offsets[0])) for weight in (height[known], None))
    swept = np.where(share > 0, total / np.maximum(share, 1), np.nan)
    surface = outlines.surface(avatar.head, outlines.touched(scene, alpha, chosen), swept)
    known = offsets[0] > STANDS_OFF_M
    avatar.place_shells(np.where(known, surface, np.nan))
    covered = known & (np.nan_to_num(surface) > COVERED_M)
    first, side = shells.at_surface(len(avatar.textures)), avatar.fading.shape[1]
    with torch.no_grad():
        avatar.fading[first:, torch.from_numpy(_map_of(avatar, covered.astype(np.float32), "skin", side) > 0.5)] = STAYS
    return covered


def project(
    avatar: LayeredAvatar,
    scene: Scene,
    frames: np.ndarray,
    alpha: np.ndarray,
    chosen: Sequence[int],
    covered: np.ndarray | None = None,
) -> None:
    """Fill the textures from the chosen frames, in place. Arrays as for `gathered`; covered: [V] bool from `settle`."""
    layers, side = avatar.textures.shape[:2]
    sums, singles = gathered(avatar, scene, frames, alpha, chosen, range(layers))
    small = max(1, side // DETAIL)
    stands_off = _map_of(avatar, avatar.offsets_m[0].cpu().numpy(), "skin", side) > STANDS_OFF_M
    disagreement = np.stack([sums[layer].disagreement() for layer in range(layers - 1)])
    # Where something stands off, the surface is the shell on whose colours the frames agree best; else the skin.
    nearest = _nearest(avatar, disagreement)
    nearest = np.where(stands_off & np.isfinite(disagreement).any(0), nearest, layers - 3)
    if covered is not None and layers > 4:
        there = _map_of(avatar, covered.astype(np.float32), "skin", side) > 0.5
        nearest = np.where(there, np.clip(nearest, 1, shells.at_surface(layers)), nearest)
    region = avatar.head.region.cpu().numpy()
    expressive = np.where(np.isin(region, [REGIONS.index(name) for name in EXPRESSIVE]), 1.0, OTHERS)
    for layer in range(layers):
        surface = layer >= layers - 3  # just above the skin, beneath it, and the inner parts
        unseen = 1.0 if surface else 0.0  # where no frame looks the skin is closed, and nothing stands off it
        count = sums[layer].count
        inside = np.where(count > 0, sums[layer].matte / np.maximum(count, 1), unseen).reshape(side, side)
        base = np.where((layer >= nearest) | surface, SKIN, AIR)
        opacity = np.where(inside > (WITHIN if surface else INSIDE), base, np.minimum(base, logit(inside, 0.01) - OUTSIDE))
        avatar.textures[layer, ..., :3] = torch.from_numpy(logit(sums[layer].mean()[0], LIMIT).astype(np.float32))
        avatar.textures[layer, ..., 3] = torch.from_numpy(opacity.astype(np.float32))
    for layer, found in singles.items():
        part = "skin" if layer < layers - 1 else "inner"
        bases = components(found, avatar.bases, _map_of(avatar, expressive, part, small))
        large = torch.nn.functional.interpolate(torch.from_numpy(bases).permute(0, 3, 1, 2), (side, side), mode="bilinear")
        for other in range(layers - 1) if layer < layers - 1 else [layer]:
            for k in range(len(bases)):
                avatar.textures[other, ..., 4 + 4 * k : 7 + 4 * k] += large[k].permute(1, 2, 0)


def components(found: list[Sums], bases: int, importance: np.ndarray) -> np.ndarray:
    """Principal components [K, s, s, 3] float32 of logits of colour over frames, in standard deviations; fewer of few frames.

    importance: [s, s] of each texel's variance.
    """
    means = [one.mean() for one in found]
    colours, known = np.stack([logit(mean, LIMIT) for mean, _ in means]), np.stack([seen for _, seen in means])  # [T, s, s, 3]
    often = known.mean(0) > COMMON
    share = np.maximum(known.sum(0), 1)[..., None]
    residual = np.where(known[..., None], colours - (colours * known[..., None]).sum(0) / share, 0)
    weight = ndimage.gaussian_filter(known.astype(np.float64), (0, COARSE, COARSE))[..., None]
    coarse = ndimage.gaussian_filter(residual, (0, COARSE, COARSE, 0)) / np.maximum(weight, 1e-3)
    residual = np.where((known & often)[..., None], residual - coarse, 0)
    weighted = (residual * importance[..., None]).reshape(len(found), -1)
    _, left = np.linalg.eigh(weighted @ weighted.T)
    kept = left[:, ::-1][:, : min(bases, len(found))]  # [T, K]
    return (np.einsum("tk,tijc->kijc", kept, residual) / np.sqrt(len(found))).astype(np.float32)


def _map_of(avatar: LayeredAvatar, values: np.ndarray, part: str, side: int) -> np.ndarray:
    """Values [V] of vertices at the texels [side, side] of the `skin` or `inner` parts, by a frame's map's nearest texel."""
    small = avatar.read(torch.from_numpy(values).to(avatar.skin_barycentric)[:, None], part)[0].cpu().numpy()
    place = (np.arange(side) + 0.5) / side * len(small)
    return small[place.astype(int)[:, None], place.astype(int)]
