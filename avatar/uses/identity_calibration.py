"""Step `identity_calibration`: how far fitted heads lie apart, of one person and of two, and the limit between them.

Input: head, rows (of `identity_parts`, one a clip). Output: report (json), markdown, plot (svg). Each clip counts as a person of
its own; parts of one clip share light, lens and day, so what is said of one person is optimistic.
"""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from avatar.report import figures
from avatar.report.results import many
from avatar.uses import identity
from avatar.uses.config import IdentityCalibrationConfig
from fitting.files import load_head
from workflow import step

OPTIMISTIC = (
    "Pairs of one person are disjoint parts of one clip, with the same light, lens and day: two sessions lie further apart. "
    "Every clip is taken for a person of its own."
)
WORDS = {
    "codes": "shape codes, rms difference (standard deviations)",
    "face_mm": "neutral face, rms distance after similarity alignment (mm)",
    "head_mm": "neutral face, scalp and ears, rms distance after similarity alignment (mm)",
}


def facts(found: identity.Separation) -> dict[str, Any]:
    """One distance in numbers."""
    limit = found.threshold
    return {
        "pairs_of_one_person": len(found.same),
        "pairs_of_two_people": len(found.different),
        "area_under_roc": round(found.area, 4),
        "nearest_two_over_farthest_one": round(found.gap, 3),
        "limit": round(limit, 4),
        "one_person_refused": round(found.refused(limit), 4),
        "two_people_missed": round(found.missed(limit), 4),
        "one_person": np.sort(found.same).round(4).tolist(),
        "two_people": np.sort(found.different).round(4).tolist(),
    }


def markdown(separations: dict[str, identity.Separation], people: dict[str, int]) -> str:
    """The table of distances."""
    lines = [
        "| distance | area under ROC | one person: median, largest | two people: smallest, median | limit | refused | missed |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, found in separations.items():
        limit = found.threshold
        cells = (
            WORDS[name] + (" (used)" if name == identity.CHOSEN else ""),
            f"{found.area:.3f}",
            f"{np.median(found.same):.2f}, {found.same.max():.2f}",
            f"{found.different.min():.2f}, {np.median(found.different):.2f}",
            f"{limit:.2f}",
            f"{int((found.same >= limit).sum())} of {len(found.same)}",
            f"{int((found.different < limit).sum())} of {len(found.different)}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    clips = ", ".join(f"{name} ({parts})" for name, parts in people.items())
    return "\n".join([*lines, "", f"Clips (parts that could be fitted): {clips}. {OPTIMISTIC}", ""])


def figure(separations: dict[str, identity.Separation]) -> Figure:
    """Distances of all pairs, one row of axes a kind of distance, with the limit."""
    drawn = Figure(figsize=(figures.WIDTH_IN, 1.5 * len(separations)), layout="constrained")
    axes = drawn.subplots(len(separations), 1, squeeze=False)[:, 0]
    for ax, (name, found) in zip(axes, separations.items(), strict=True):
        for height, values, kind in ((1, found.same, "one person"), (0, found.different, "two people")):
            spread = height + 0.6 * (np.arange(len(values)) % 7 / 6 - 0.5)
            ax.plot(np.sort(values), spread, figures.MARKERS[height], color=figures.COLOURS[height], markersize=3.5)
            ax.text(1.01, height, kind, transform=ax.get_yaxis_transform(), va="center", color=figures.COLOURS[height])
        ax.axvline(found.threshold, color=figures.INK, linestyle="--", linewidth=1)
        ax.set(yticks=[], ylim=(-0.6, 1.6), xlabel=WORDS[name], xlim=(0, None))
        ax.set_title(f"limit {found.threshold:.2f}, area under ROC {found.area:.3f}")
    return drawn


def run(job: step.Job) -> None:
    """Compare all parts of all clips."""
    head = load_head(job.input.head)
    people: dict[str, list[np.ndarray]] = {}
    for path in many(job.input, "rows"):
        row = step.read_json(path)
        if row["head_digest"] != head.digest:
            raise step.StepError(f"{path}: belongs to head model {row['head_digest']}, found {head.digest}; delete it, run again")
        people[row["subject"]] = [np.array(part["shape"]) for part in row["parts"]]
    try:
        separations = {name: identity.separation(head, list(people.values()), by) for name, by in identity.DISTANCES.items()}
    except ValueError as error:
        raise step.StepError(f"results/identity: {error}; put more videos into the folder") from error
    counts = {name: len(parts) for name, parts in people.items()}
    job.output.markdown.write_text(markdown(separations, counts), encoding="utf-8")
    with mpl.rc_context(figures.STYLE):
        figure(separations).savefig(job.output.plot, format="svg", metadata={"Date": None, "Creator": None})
    content = {"head_digest": head.digest, "parts": counts, "used": identity.CHOSEN, "note": OPTIMISTIC}
    job.write_json(job.output.report, content | {"distances": {name: facts(found) for name, found in separations.items()}})
    job.log.info("%s", ", ".join(f"{name}: {found.area:.3f}" for name, found in separations.items()))


if __name__ == "__main__":
    step.main(run, IdentityCalibrationConfig)
