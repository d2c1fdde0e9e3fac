"""The terms of the fit that read pixels: photometric samples and the silhouette of one frame, built around a pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fitting import camera, photometric, silhouette
from fitting.energy import Camera, Term
from fitting.photometric import Appearance, Samples
from fitting.rig import Pose, Rig, Surface, posed
from fitting.state import State

FINEST = len(photometric.LEVELS) - 1


@dataclass(frozen=True)
class Strength:
    """How much the terms that read pixels count; 0 leaves one out."""

    photometric: float  # of one sample against one landmark of standard deviation 1: neighbouring samples err together
    photometric_robust: float  # Huber's threshold in standard deviations
    photometric_rigid: float  # strength, relative to that, of what a rigid motion of all samples explains
    silhouette: float  # of one point of the rim
    silhouette_sigma: float  # of the matte's edge, in inter-ocular distances
    silhouette_robust: float


Extra = Callable[[State, int], tuple[tuple[Term, Surface], ...]]  # terms of one keyframe, with their unfolded surfaces


@dataclass(frozen=True)
class Look:
    """How the samples and the mesh's outline are seen in one frame; None for a term that is off."""

    weight: np.ndarray | None  # [P] float32, 0 where hidden
    shade: np.ndarray | None  # [P] float32 light on each sample
    pixels: np.ndarray | None  # [P, 2] float32
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
        self.appearance: Appearance | None = None
        self.skin: silhouette.Skin | None = None
        self._folded: tuple[np.ndarray, Surface, Surface] | None = None

    def fold(self, shape: np.ndarray) -> tuple[Surface, Surface]:
        """All vertices and the samples, folded with one identity [S] (kept until another one is asked for)."""
        if self._folded is None or not np.array_equal(self._folded[0], shape):
            self._folded = (shape.copy(), self.whole.folded(shape), self.samples.surface.folded(shape))
        return self._folded[1:]

    def learn_skin(self, rows: Sequence[int], state: State, lens: Camera) -> None:
        """Colour of the skin, from the photometric samples of some frames (state of these rows)."""
        _, samples = self.fold(state.shape)
        pixels = []
        for k in range(len(rows)):
            at = posed(samples, state.pose(k))
            facing = photometric.weights_of(samples, state.pose(k), np.ones(len(at.points), bool)) > 0.2
            pixels.append(camera.project(at.points[facing], lens.focal_px, lens.centre_px))
        self.skin = silhouette.skin_of([self.frames[row] for row in rows], pixels)

    def learn(self, rows: Sequence[int], state: State, lens: Camera) -> Appearance:
        """Albedo and light from training keyframes (state of these rows)."""
        _, samples = self.fold(state.shape)
        pyramids, pixels, weights, normals = [], [], [], []
        for k, row in enumerate(rows):
            pixel, weight = self._seen(row, state.pose(k), state.shape, lens)
            pixels.append(pixel)
            pyramids.append(photometric.pyramid(self.frames[row], pixel, self.scale_px[row], range(FINEST + 1)))
            weights.append(weight)
            normals.append(samples.normal @ state.rotation[k].T)
        self.appearance = photometric.learn(pyramids, np.stack(pixels), np.stack(weights), np.stack(normals))
        return self.appearance

    def _seen(self, row: int, pose: Pose, shape: np.ndarray, lens: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [P, 2] and weights [P] of the samples: nothing for hidden ones and where the blur mixes in the background."""
        whole, samples = self.fold(shape)
        at = posed(samples, pose)
        seen = photometric.visible(whole, self.rig.triangles, pose, lens, self.size, at.points)
        pixel = camera.project(at.points, lens.focal_px, lens.centre_px)
        seen &= photometric.inside(self.alpha[row], pixel, photometric.LEVELS[FINEST] * self.scale_px[row])
        return pixel, photometric.weights_of(samples, pose, seen)

    def silhouette_extra(self, rows: Sequence[int], state: State, centre_px: np.ndarray) -> Extra:
        """Extra terms of the joint calibration (see `fitting.calibrate.refine`): the rim is found around `state`, then held."""
        lens = state.lens(centre_px)
        edges = [silhouette.edge_of(self.alpha[row]) for row in rows]
        whole, _ = self.fold(state.shape)
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
        weight = shade = pixel = rim = edge = None
        if self.appearance is not None:
            pixel, weight = (values.astype(np.float32) for values in self._seen(row, pose, shape, lens))
            normal = self.fold(shape)[1].normal @ pose.rotation.T
            shade = np.clip(1 + photometric.harmonics(normal) @ self.appearance.light, 0.3, None).astype(np.float32)
        if self.strength.silhouette and self.skin is not None:
            edge, whole = silhouette.edge_of(self.alpha[row]), self.fold(shape)[0]
            rim = silhouette.rim_of(self.rig, whole, pose, lens, self.size, self.frames[row], edge, self.skin, self.scale_px[row])
        return Look(weight, shade, pixel, rim, edge)

    def silhouette_terms(self, row: int, look: Look, shape: np.ndarray, lens: Camera) -> list[Term]:
        """The silhouette term of one frame, if it has one."""
        if look.rim is None:
            return []
        strength, sigma = self.strength, self.strength.silhouette_sigma * self.scale_px[row]
        term = silhouette.term_of(look.rim, look.edge, shape, sigma, strength.silhouette, lens, strength.silhouette_robust)
        return [term]

    def photometric_terms(self, row: int, look: Look, shape: np.ndarray, lens: Camera, levels: Sequence[int]) -> list[Term]:
        """The photometric term of one frame at some pyramid levels; none where it is off."""
        if self.appearance is None:
            return []
        _, samples = self.fold(shape)
        pyramid = photometric.pyramid(self.frames[row], look.pixels, self.scale_px[row], levels)
        strength, appearance = self.strength, self.appearance
        amount, rigid = strength.photometric, strength.photometric_rigid

        def one(picture: photometric.Level, level: int) -> Term:
            colour, sigma = appearance.albedo[level] * look.shade, appearance.sigma[level]
            robust = strength.photometric_robust
            return Term(
                samples,
                lambda at: photometric.photometric_rows(picture, colour, look.weight, sigma, amount, lens, robust, at, rigid),
            )

        return [one(picture, level) for picture, level in zip(pyramid, levels, strict=True)]
