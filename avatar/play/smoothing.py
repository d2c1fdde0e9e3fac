"""The one-euro filter (Casiez, Roussel and Vogel, CHI 2012): calm at rest, hardly late in motion."""

from __future__ import annotations

import numpy as np

from avatar.play.rows import Row

# Cut-off at rest (Hz), and Hz more per unit a second. On nerface.mp4, tracked frame by frame, they more than halve the jitter of
# the face where it is nearly still (rms second difference 1.26 -> 0.60 mm; the fit of the whole clip, which sees what comes,
# has 0.38), and are late by 13 ms in the jaw, 3 ms in a blink, 10 ms in yaw and 20 ms in place (`avatar.play.timing`).
CUTOFF_HZ = {"expression": 2.5, "rotation": 2.5, "jaw": 2.5, "eyes": 2.5, "translation": 2.5}
SPEED = {"expression": 8.0, "rotation": 24.0, "jaw": 24.0, "eyes": 24.0, "translation": 120.0}
SPEED_CUTOFF_HZ = 2.0  # of the speed itself
FORGET_S = 0.5  # after a gap this long the filter begins anew


class OneEuro:
    """Smooths a vector that comes at uneven times."""

    def __init__(self, cutoff_hz: np.ndarray, speed: np.ndarray) -> None:
        """cutoff_hz, speed: [D], see CUTOFF_HZ."""
        self._cutoff_hz, self._speed = np.asarray(cutoff_hz, np.float64), np.asarray(speed, np.float64)
        self.reset()

    def reset(self) -> None:
        """Forget what was."""
        self._last: np.ndarray | None = None
        self._velocity = np.zeros_like(self._cutoff_hz)
        self._time_s = 0.0

    def __call__(self, value: np.ndarray, time_s: float) -> np.ndarray:
        """The smoothed value [D] at a time that never goes back; the first one is returned as it is."""
        step = time_s - self._time_s
        if self._last is None or step > FORGET_S:
            self.reset()
            self._last, self._time_s = value.copy(), time_s
            return value.copy()
        if step <= 0:
            return self._last.copy()
        self._velocity += _share(SPEED_CUTOFF_HZ, step) * ((value - self._last) / step - self._velocity)
        cutoff = self._cutoff_hz + self._speed * np.abs(self._velocity)
        self._last = self._last + _share(cutoff, step) * (value - self._last)
        self._time_s = time_s
        return self._last.copy()


def _share(cutoff_hz: np.ndarray | float, step_s: float) -> np.ndarray | float:
    """How much of a new value is taken, of a low pass of first order."""
    return 1 / (1 + 1 / (2 * np.pi * np.asarray(cutoff_hz) * step_s))


class SmoothRow:
    """The filter over a row; the neck is held. Turns stay far below half a circle, so axis-angle vectors may be filtered."""

    def __init__(self, expressions: int) -> None:
        sizes = {"expression": expressions, "rotation": 3, "jaw": 3, "eyes": 6, "translation": 3}
        self._ends = np.cumsum(list(sizes.values()))[:-1]
        self._filter = OneEuro(
            *(np.repeat([table[name] for name in sizes], list(sizes.values())) for table in (CUTOFF_HZ, SPEED))
        )

    def reset(self) -> None:
        """Begin anew."""
        self._filter.reset()

    def __call__(self, row: Row, time_s: float) -> Row:
        """The smoothed row."""
        flat = np.concatenate([row.expression, row.rotation, row.jaw, row.eyes.ravel(), row.translation])
        expression, rotation, jaw, eyes, translation = np.split(self._filter(flat, time_s), self._ends)
        return Row(expression, rotation, row.neck, jaw, eyes.reshape(2, 3), translation)
