"""How a head moves over time, apart from whose head it is: what drives an avatar. Arrays in, arrays out.

A motion comes from a track, or from any other program (`avatar.uses.parameters`); codes may be scaled and all of it smoothed.
Rotations are averaged as matrices, never as axis-angle vectors, which jump by a turn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from fitting.camera import exp_rotation, log_rotation

PARTS = ("expression", "rotation", "neck", "jaw", "eyes", "translation")
TURNS = ("rotation", "neck", "jaw", "eyes")


@dataclass(frozen=True)
class Motion:
    """T frames of a head's parameters, in the units of fit/track.npz."""

    expression: np.ndarray  # [T, E]
    rotation: np.ndarray  # [T, 3] axis-angle, rad
    neck: np.ndarray  # [T, 3]
    jaw: np.ndarray  # [T, 3]
    eyes: np.ndarray  # [T, 2, 3], left then right
    translation: np.ndarray  # [T, 3] m
    fps: float

    def __post_init__(self) -> None:
        count = len(self.expression)
        tails = {"rotation": (3,), "neck": (3,), "jaw": (3,), "eyes": (2, 3), "translation": (3,)}
        for name in PARTS:
            array = getattr(self, name)
            expected = (count, *tails.get(name, array.shape[1:]))
            if array.shape != expected or array.ndim < 2:
                raise ValueError(f"{name} of a motion must have shape {expected}, found {array.shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} of frame {int(np.argwhere(~np.isfinite(array))[0][0])} is not finite")
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f"frames a second must be above 0, found {self.fps}")

    def __len__(self) -> int:
        return len(self.expression)

    def take(self, places: Sequence[int], fps: float | None = None) -> Motion:
        """The frames at `places`, in that order; fps: of the result, where it is another."""
        chosen = {name: getattr(self, name)[list(places)] for name in PARTS}
        return Motion(**chosen, fps=self.fps if fps is None else fps)


def of_track(track: Mapping[str, np.ndarray], frames: Sequence[int], fps: float) -> Motion:
    """The motion of a track's frames.

    track: the arrays of fit/track.npz. Raises ValueError naming a missing array or the first frame that is not finite.
    """
    if missing := [name for name in PARTS if name not in track]:
        raise ValueError(f"the track lacks {', '.join(missing)}")
    return Motion(**{name: np.asarray(track[name])[list(frames)].astype(np.float64) for name in PARTS}, fps=fps)


def scaled(motion: Motion, factor: float) -> Motion:
    """Expression codes and jaw times `factor` (paper, section 4.5: twice the code of a test frame).

    The zero code stays where it is, and none is clipped: going beyond what was seen is the point.
    """
    return replace(motion, expression=motion.expression * factor, jaw=motion.jaw * factor)  # `factor` times the angle


def smoothed(motion: Motion, seconds: float) -> Motion:
    """All parameters low-passed over time by a Gaussian of standard deviation `seconds`, ends held; 0 leaves the motion as it is.

    Frames must follow each other in time. Rotations are the chordal mean: the rotation nearest to the weighted mean matrix.
    Raises ValueError for a negative or infinite time.
    """
    if not (np.isfinite(seconds) and seconds >= 0):
        raise ValueError(f"a motion is smoothed over 0 seconds or more, found {seconds}")
    sigma = seconds * motion.fps
    if sigma == 0 or len(motion) == 1:
        return motion

    def low(values: np.ndarray) -> np.ndarray:
        return gaussian_filter1d(values, sigma, axis=0, mode="nearest", truncate=4.0)

    plain = {name: low(getattr(motion, name)) for name in PARTS if name not in TURNS}
    turned = {name: log_rotation(nearest_rotation(low(exp_rotation(getattr(motion, name))))) for name in TURNS}
    return replace(motion, **plain, **turned)


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotations [..., 3, 3] nearest to matrices [..., 3, 3] in the Frobenius norm."""
    left, _, right = np.linalg.svd(matrix)
    sign = np.sign(np.linalg.det(left @ right))
    return np.concatenate([left[..., :2], left[..., 2:] * sign[..., None, None]], -1) @ right


def held(motion: Motion, place: int, count: int) -> Motion:
    """Frame `place` held for `count` frames."""
    return motion.take([place] * count)
