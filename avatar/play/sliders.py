"""The sliders: which there are, how far they go, and what they do to a row. Arrays in, arrays out.

An expression slider shows the code itself, as a parameter file writes it; with a motion playing, its way from the resting face is
added to the motion. Turn, gaze and jaw are degrees from the rest, as the viewer sees them: to the right of the picture, and up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from avatar.play.rows import Body, Row
from avatar.uses.motion import Motion
from fitting.camera import exp_rotation
from fitting.head_model import HeadModel

STATISTICAL = 3.0  # standard deviations to either side, of a code without ends
SEEN = (1.0, 99.0)  # percentiles of the training frames between which a code counts as seen
TURN = {"turn_right": ("turn right", 75.0), "turn_up": ("raise", 40.0), "tilt_right": ("tilt right", 40.0)}
GAZE = {"gaze_right": ("look right", 35.0), "gaze_up": ("look up", 25.0)}
JAW = {"jaw_open": ("open", -3.0, 35.0)}
GROUPS = (
    ("jaw", "Jaw"),
    ("mouth", "Mouth"),
    ("eye", "Eyelids"),
    ("brow", "Brows"),
    ("cheek", "Cheeks and nose"),
    ("nose", "Cheeks and nose"),
)
OTHER = "Expression"


@dataclass(frozen=True)
class Slider:
    """One slider of the page."""

    name: str
    label: str
    group: str
    low: float
    high: float
    rest: float
    seen: tuple[float, float] | None = None
    """Between which values training saw it."""
    twin: str | None = None
    """The same action of the other side."""


def sliders_of(head: HeadModel, rest: Row, training: Motion) -> list[Slider]:
    """All sliders of a head model, in the order of the page.

    rest: where expression sliders begin; training: the motion that training saw.
    """
    found = [Slider(name, label, "Head", -most, most, 0.0) for name, (label, most) in TURN.items()]
    found += [Slider(name, label, "Gaze", -most, most, 0.0) for name, (label, most) in GAZE.items()]
    if bool((head.skinning_weights[:, 2] > 0).any()):
        found += [Slider(name, label, "Jaw", low, high, 0.0) for name, (label, low, high) in JAW.items()]
    names = set(head.expression_names)
    seen = np.percentile(training.expression, SEEN, axis=0)
    for place, name in enumerate(head.expression_names):
        low, high = float(head.expression_low[place]), float(head.expression_high[place])
        low, high = low if np.isfinite(low) else -STATISTICAL, high if np.isfinite(high) else STATISTICAL
        value = float(np.clip(rest.expression[place], low, high))
        between = tuple(np.clip(seen[:, place], low, high).tolist())
        found.append(Slider(name, _label(name), group_of(name), low, high, value, between, _twin(name, names)))
    order = list(dict.fromkeys(["Head", "Gaze", *(title for _, title in GROUPS), OTHER]))
    return sorted(found, key=lambda slider: order.index(slider.group))


def group_of(name: str) -> str:
    """The region's title of an expression code."""
    return next((title for stem, title in GROUPS if name.startswith(stem)), OTHER)


def _label(name: str) -> str:
    """`mouthSmileLeft` as `smile left`, for the group's title says the rest; other names as they are."""
    stem = next((stem for stem, _ in GROUPS if name.startswith(stem) and len(name) > len(stem)), "")
    words = "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in name[len(stem) :]).strip()
    return f"{stem} {words}" if stem in ("cheek", "nose") else words


def _twin(name: str, names: set[str]) -> str | None:
    for side, other in (("Left", "Right"), ("Right", "Left")):
        if name.endswith(side) and name.removesuffix(side) + other in names:
            return name.removesuffix(side) + other
    return None


@dataclass(frozen=True)
class Panel:
    """The sliders of one subject, and what they move."""

    sliders: dict[str, Slider]  # by name, in the order of the page
    names: tuple[str, ...]  # of the expression codes
    rest: Row
    body: Body

    @staticmethod
    def of(head: HeadModel, rest: Row, body: Body, training: Motion) -> Panel:
        """See `sliders_of`."""
        return Panel({slider.name: slider for slider in sliders_of(head, rest, training)}, head.expression_names, rest, body)

    def at_rest(self) -> dict[str, float]:
        """Every slider's value when nothing is moved."""
        return {name: slider.rest for name, slider in self.sliders.items()}

    def checked(self, values: Mapping[str, float]) -> dict[str, float]:
        """The values, all known, finite and in range; ValueError with one sentence else."""
        for name, value in values.items():
            if name not in self.sliders:
                raise ValueError(f"there is no slider {name[:60]!r}")
            slider = self.sliders[name]
            if not slider.low <= value <= slider.high:  # nor is NaN
                raise ValueError(f"{name} goes from {slider.low:g} to {slider.high:g}, found {value:g}")
        return dict(values)

    def moved(self, base: Row, values: Mapping[str, float], strength: float = 1.0) -> Row:
        """A row moved by the sliders.

        Args:
            base: what plays, or the rest where nothing does.
            values: every slider's value.
            strength: factor of expression and jaw beyond the rest, of the motion and the sliders alike; none is clipped.
        """
        rest, way = self.rest, {name: values[name] - slider.rest for name, slider in self.sliders.items()}
        expression = base.expression + np.array([way[name] for name in self.names]) - rest.expression
        jaw = base.jaw + np.array([np.radians(way.get("jaw_open", 0.0)), 0, 0]) - rest.jaw
        gaze = np.radians([-way["gaze_up"], -way["gaze_right"], 0.0])
        row = base._replace(
            expression=rest.expression + strength * expression, jaw=rest.jaw + strength * jaw, eyes=base.eyes + gaze
        )
        return self.body.turned(row, turn_matrix(*(way[name] for name in TURN)))


def turn_matrix(right_degrees: float, up_degrees: float, tilt_degrees: float) -> np.ndarray:
    """Turn [3, 3] in camera axes of a head that faces the camera; right and up are the viewer's."""
    pitch, yaw, roll = np.radians([-up_degrees, -right_degrees, tilt_degrees])  # the face looks along -z, y is down
    return exp_rotation(np.array([0, 0, roll])) @ exp_rotation(np.array([0, yaw, 0])) @ exp_rotation(np.array([pitch, 0, 0]))
