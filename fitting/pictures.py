"""The terms of the fit that read pixels: photometric samples and the silhouette of one frame, built around a pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from fitting import camera, hair, photometric, silhouette
from fitting.energy import Camera, Term
from fitting.photometric import Appearance, Samples
from fitting.rig import Pose, Rig, Surface, posed
from fitting.state import State

FINEST = len(photometric.LEVELS) - 1
HAIR_SHARE = 0.5  # samples of the scalp over those of the skin: half of a scalp is never seen


@dataclass(frozen=True)
class Strength:
    """How much the terms that read pixels count; 0 leaves one out."""

    photometric: float  # of one sample against one landmark of standard deviation 1: neighbouring samples err together
    hair: float  # the same of one sample of the hair
    photometric_robust: float  # Huber's threshold in standard deviations
    silhouette: float  # of one point of the rim
    silhouette_sigma: float  # of the matte's edge, in inter-ocular distances
    silhouette_robust: float


Extra = Callable[[State, int], tuple[tuple[Term, Surface], ...]]  # terms of one keyframe, with their unfolded surfaces


@dataclass(frozen=True)
class Patch:
    """Samples that are compared, by themselves as exposure goes: those of the skin, or of the hair."""

    samples: Samples
    appearance: Appearance
    strength: float


@dataclass(frozen=True)
class Seen:
    """How a patch is seen in one frame."""

    weight: np.ndarray  # [P] float32, 0 where hidden
    shade: np.ndarray  # [P] float32 light on each sample
    pixels: np.ndarray  # [P, 2] float32


@dataclass(frozen=True)
class Look:
    """How the patches and the mesh's outline are seen in one frame."""

    seen: tuple[Seen, ...]
    rim: silhouette.Rim | None  # the mesh's outline against the matte; None without the term
    edge: silhouette.Edge | None


class Pictures:
    """Frames and mattes of a clip with what was learned of them; makes terms.

    Photometric terms are there once `learn` has run, silhouette terms once `learn_skin` has.
    """

    def __init__(
        self, rig: Rig, frames: np.ndarray, alpha: np.ndarray, scale_px: np.ndarray, strength: Strength, samples: int
    ) -> None:
        """
        Args:
            frames: [T, H, W, 3] uint8; alpha: [T, H, W] uint8, the person; scale_px: [T] inter-ocular distance; samples: P.
        """
        self.rig, self.frames, self.alpha, self.scale_px, self.strength = rig, frames, alpha, scale_px, strength
        self.size = frames.shape[1:3]
        self.whole = rig.vertices()
        self.samples: Samples = photometric.choose_samples(rig, samples)
        self.patches: tuple[Patch, ...] = ()
        self.skin: silhouette.Skin | None = None
        self._folded: list[tuple[Surface, np.ndarray, Surface]] = []

    @property
    def appearance(self) -> Appearance | None:
        """What the skin looks like; None before `learn`."""
        return self.patches[0].appearance if self.patches else None

    def fold(self, surface: Surface, shape: np.ndarray) -> Surface:
        """A surface folded with one identity [S]; the last few are kept."""
        for one, known, folded in self._folded:
            if one is surface and np.array_equal(known, shape):
                return folded
        self._folded = [(surface, shape.copy(), surface.folded(shape)), *self._folded[:3]]
        return self._folded[0][2]

    def learn_skin(self, rows: Sequence[int], state: State, lens: Camera) -> None:
        """Colour of the skin, from the photometric samples of some frames (state of these rows)."""
        samples = self.fold(self.samples.surface, state.shape)
        pixels = []
        for k in range(len(rows)):
            at = posed(samples, state.pose(k))
            facing = photometric.weights_of(samples, state.pose(k), np.ones(len(at.points), bool)) > 0.2
            pixels.append(camera.project(at.points[facing], lens.focal_px, lens.centre_px))
        self.skin = silhouette.skin_of([self.frames[row] for row in rows], pixels)

    def learn(self, rows: Sequence[int], state: State, lens: Camera) -> None:
        """What skin and hair look like, from training keyframes (state of these rows)."""
        buffers = [self._buffer(state.pose(k), state.shape, lens) for k in range(len(rows))]
        values_of = partial(self._values, rows=rows, state=state, lens=lens, buffers=buffers)
        chosen = [(self.samples, self.strength.photometric)]
        scalp = hair.choose_samples(self.rig, round(HAIR_SHARE * len(self.samples.triangles)))
        if scalp is not None:
            values, weights = values_of(hair.swept(self.rig, scalp), levels=[FINEST])
            chosen.append((hair.settled(scalp, values[0], weights), self.strength.hair))
        patches = []
        for samples, strength in chosen:
            normal = self.fold(samples.surface, state.shape).normal
            turned = np.stack([normal @ turn.T for turn in state.rotation])
            appearance = photometric.learn(*values_of(samples, levels=range(FINEST + 1)), turned)
            patches.append(Patch(samples, appearance, strength))
        self.patches = tuple(patches)

    def _values(
        self,
        samples: Samples,
        levels: Sequence[int],
        rows: Sequence[int],
        state: State,
        lens: Camera,
        buffers: Sequence[tuple[np.ndarray, float]],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Grey values [levels, K, P] and weights [K, P] of samples in frames (state and depth of these rows)."""
        values, weights = np.zeros((len(levels), len(rows), len(samples.triangles))), []
        for k, row in enumerate(rows):
            pixel, weight = self._seen(samples, row, state.pose(k), state.shape, lens, buffers[k])
            for place, picture in enumerate(photometric.pyramid(self.frames[row], pixel, self.scale_px[row], levels)):
                value, inside = photometric.read(picture, pixel)
                values[place, k], weight = value[:, 0], weight * inside
            weights.append(weight)
        return values, np.stack(weights)

    def _buffer(self, pose: Pose, shape: np.ndarray, lens: Camera) -> tuple[np.ndarray, float]:
        """Depth of the head in one pose (see `photometric.depth_buffer`)."""
        return photometric.depth_buffer(self.fold(self.whole, shape), self.rig.triangles, pose, lens, self.size)

    def _seen(
        self, samples: Samples, row: int, pose: Pose, shape: np.ndarray, lens: Camera, buffer: tuple[np.ndarray, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [P, 2] and weights [P] of samples: nothing for hidden ones and where the blur mixes in the background."""
        surface = self.fold(samples.surface, shape)
        at = posed(surface, pose)
        pixel = camera.project(at.points, lens.focal_px, lens.centre_px)
        seen = photometric.visible(buffer, lens, at.points)
        seen &= photometric.inside(self.alpha[row], pixel, photometric.LEVELS[FINEST] * self.scale_px[row])
        return pixel, photometric.weights_of(surface, pose, seen)

    def silhouette_extra(self, rows: Sequence[int], state: State, centre_px: np.ndarray) -> Extra:
        """Extra terms of the joint calibration (see `fitting.calibrate.refine`): the rim is found around `state`, then held."""
        lens = state.lens(centre_px)
        edges = [silhouette.edge_of(self.alpha[row]) for row in rows]
        whole = self.fold(self.whole, state.shape)
        rims = [
            silhouette.rim_of(
                self.rig, whole, state.pose(k), lens, self.size, self.frames[row], edges[k], self.skin, self.scale_px[row]
            )
            for k, row in enumerate(rows)
        ]

        def extra(at: State, k: int) -> tuple[tuple[Term, Surface], ...]:
            if rims[k] is None:
                return ()
            sigma = self.strength.silhouette_sigma * self.scale_px[rows[k]]
            lens = at.lens(centre_px)
            term = silhouette.term_of(
                rims[k], edges[k], at.shape, sigma, self.strength.silhouette, lens, self.strength.silhouette_robust
            )
            return ((term, rims[k].surface),)

        return extra

    def look(self, row: int, pose: Pose, shape: np.ndarray, lens: Camera) -> Look:
        """Visibility and shading of the samples around a pose: worked out once a frame, they change slowly."""
        seen, rim, edge = [], None, None
        buffer = self._buffer(pose, shape, lens) if self.patches else None
        for patch in self.patches:
            pixel, weight = (part.astype(np.float32) for part in self._seen(patch.samples, row, pose, shape, lens, buffer))
            normal = self.fold(patch.samples.surface, shape).normal @ pose.rotation.T
            shade = np.clip(1 + photometric.harmonics(normal) @ patch.appearance.light, 0.3, None).astype(np.float32)
            seen.append(Seen(weight, shade, pixel))
        if self.strength.silhouette and self.skin is not None:
            edge, whole = silhouette.edge_of(self.alpha[row]), self.fold(self.whole, shape)
            rim = silhouette.rim_of(self.rig, whole, pose, lens, self.size, self.frames[row], edge, self.skin, self.scale_px[row])
        return Look(tuple(seen), rim, edge)

    def silhouette_terms(self, row: int, look: Look, shape: np.ndarray, lens: Camera) -> list[Term]:
        """The silhouette term of one frame, if it has one."""
        if look.rim is None:
            return []
        strength, sigma = self.strength, self.strength.silhouette_sigma * self.scale_px[row]
        term = silhouette.term_of(look.rim, look.edge, shape, sigma, strength.silhouette, lens, strength.silhouette_robust)
        return [term]

    def photometric_terms(self, row: int, look: Look, shape: np.ndarray, lens: Camera, levels: Sequence[int]) -> list[Term]:
        """The photometric terms of one frame, of each patch at some pyramid levels; none where they are off."""
        terms = []
        for patch, seen in zip(self.patches, look.seen, strict=True):
            surface = self.fold(patch.samples.surface, shape)
            pyramid = photometric.pyramid(self.frames[row], seen.pixels, self.scale_px[row], levels)
            for picture, level in zip(pyramid, levels, strict=True):
                colour = patch.appearance.albedo[level] * seen.shade
                told = picture, colour, seen.weight, patch.appearance.sigma[level], patch.strength, lens
                rows = partial(photometric.photometric_rows, *told, self.strength.photometric_robust)
                terms.append(Term(surface, rows))
        return terms
