"""What the tracking benchmark compares, and on which clips. No torch: the workflow plans with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fitting.config import FitConfig, TermWeights

KINDS = ("still", "slow", "fast", "blink", "talk", "profile")
"""Kinds of the simulated clips; all are of `simulate`'s seed 0."""
HAIR = {"profile": "short"}
SIMULATED_FRAMES, REAL_FRAMES, SOLVER_FRAMES = 120, 200, 60
REAL_CLIPS = {"terms": 2, "iterations": 0, "solvers": 1}
GROUPS = {"terms": KINDS, "iterations": ("fast", "talk"), "solvers": ("slow", "talk")}
"""Settings are compared inside a group, on simulated clips of these kinds. Adam is slow, so solvers have SOLVER_FRAMES frames."""
REFERENCE = "all"
"""The default, which stands in the group of iterations too."""
PREFIX = "simulated."
"""No video of a user's can be a subject with a dot in its name."""


@dataclass(frozen=True)
class Setting:
    """One row of the table."""

    fit: FitConfig
    what: str
    """One phrase for the table."""
    group: str = "terms"
    """One of GROUPS."""
    real: bool = False
    """Whether it is measured on real clips too, where held-out landmarks tell something of it."""


def _without(*terms: str) -> FitConfig:
    return FitConfig(weights=TermWeights(**dict.fromkeys(terms, 0.0)))


def _alone(**choice: object) -> FitConfig:
    """A solver alone: the pixels' and the temporal stage are Gauss-Newton's whichever solver is chosen, so they are left out."""
    return FitConfig(**choice, weights=TermWeights(photometric=0, silhouette=0, temporal=0))


SETTINGS = {
    "all": Setting(FitConfig(), "all terms, iterations: 4 (the default)", real=True),
    **{
        f"iterations_{count}": Setting(FitConfig(iterations=count), f"all terms, iterations: {count}", "iterations")
        for count in (1, 2, 8)
    },
    "landmarks_only": Setting(
        _without("irises", "eyelids", "photometric", "silhouette", "priors", "temporal"), "landmarks, no other term", real=True
    ),
    "no_irises": Setting(_without("irises"), "without irises"),
    "no_eyelids": Setting(_without("eyelids"), "without eyelids"),
    "no_photometric": Setting(_without("photometric"), "without the photometric term", real=True),
    "no_silhouette": Setting(_without("silhouette"), "without the silhouette"),
    "no_priors": Setting(_without("priors"), "without the detector's scores as a prior"),
    "no_temporal": Setting(_without("temporal"), "without temporal terms", real=True),
    **{
        f"gauss_newton_{count}": Setting(_alone(iterations=count), f"Gauss-Newton, iterations: {count}", "solvers", True)
        for count in (1, 2, 4, 8)
    },
    **{
        f"adam_{count}": Setting(_alone(solver="adam", adam_steps=count), f"Adam, steps: {count}", "solvers", True)
        for count in (50, 150, 500)
    },
}


def clip_of(kind: str) -> str:
    """Name of the simulated clip of a kind, as rule `simulate` reads it: `profile_0_120_short`."""
    return f"{kind}_0_{SIMULATED_FRAMES}_{HAIR.get(kind, 'bald')}"


def planned(real: Sequence[str]) -> list[tuple[str, str]]:
    """Subject and setting of every row.

    Args:
        real: subjects of the user's own, of which each group takes the first REAL_CLIPS.
    """
    rows = []
    for name, setting in SETTINGS.items():
        own = real[: REAL_CLIPS[setting.group]] if setting.real else ()
        rows += [(subject, name) for subject in [*(PREFIX + clip_of(kind) for kind in GROUPS[setting.group]), *own]]
    return rows


def frames_of(subject: str, name: str) -> int:
    """Frames that a row takes at most."""
    if SETTINGS[name].group == "solvers":
        return SOLVER_FRAMES
    return SIMULATED_FRAMES if subject.startswith(PREFIX) else REAL_FRAMES
