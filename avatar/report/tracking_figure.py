"""The plot of the tracking benchmark: error against ms a frame, one mark a setting, told apart by shape and fill, not colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from avatar.report.figures import INK, WIDTH_IN
from fitting.benchmark_settings import SETTINGS
from fitting.benchmark_table import Aggregate

PANELS = (
    ("rotation_deg", "rotation, deg (simulated clips)"),
    ("face_mm", "face, mm (simulated clips)"),
    ("heldout_percent", "held-out landmarks, % (real clips)"),
)
SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*", "8", "d")
FILLS = {"terms": INK, "iterations": "#b6c0cd", "solvers": "white"}
MARK = 7.5


def figure(sections: Mapping[str, Sequence[Aggregate]]) -> Figure:
    """Three panels and the key.

    Args:
        sections: settings by group; one without time or error has no mark in the panel.
    """
    out = Figure((WIDTH_IN, 7.6))
    panels = out.subplots(2, 2)
    out.subplots_adjust(0.08, 0.08, 0.98, 0.88, hspace=0.25, wspace=0.2)
    looks = looks_of(sections)
    for axes, (name, title) in zip(panels.flat, PANELS, strict=False):
        _panel(axes, sections, name, looks)
        axes.set_title(title)
        axes.set_xlabel("ms a frame (left is faster)")
    key = panels.flat[3]
    key.axis("off")
    if looks:
        key.legend(handles=list(looks.values()), loc="center left", frameon=False, fontsize=8, labelspacing=0.35)
    out.suptitle("Tracking: speed against error", x=0.08, y=0.98, ha="left", fontweight="bold", fontsize=12)
    legend = (
        "each fill is a group on clips of its own; compare inside a group (black: terms, grey: iterations, white: solvers alone)"
    )
    out.text(0.08, 0.93, legend, fontsize=8.5, color="#475569")
    return out


def looks_of(sections: Mapping[str, Sequence[Aggregate]]) -> dict[tuple[str, str], Line2D]:
    """The mark of each group and setting, with its phrase as label."""
    looks = {}
    for group, found in sections.items():
        for place, entry in enumerate(found):
            label = SETTINGS[entry.setting].what if entry.setting in SETTINGS else entry.setting
            shape = SHAPES[place % len(SHAPES)]
            looks[group, entry.setting] = Line2D(
                [], [], linestyle="", marker=shape, markersize=MARK, color=INK, markerfacecolor=FILLS[group], label=label
            )
    return looks


def _panel(axes: Axes, sections: Mapping[str, Sequence[Aggregate]], name: str, looks: Mapping[tuple[str, str], Line2D]) -> None:
    """One error against time, of the settings that have both."""
    times = []
    for group, found in sections.items():
        for entry in found:
            time, error = entry.values["ms_per_frame"], entry.values[name]
            if error is None or not time:
                continue
            look = looks[group, entry.setting]
            fill, shape = look.get_markerfacecolor(), look.get_marker()
            mark = axes.plot(
                time, error, linestyle="", marker=shape, markersize=MARK, color=INK, markerfacecolor=fill, alpha=0.85
            )
            mark[0].set_gid(f"{name}-{group}-{entry.setting}")
            times.append(time)
    if not times:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center")
        axes.set(xticks=[], yticks=[])
        return
    axes.set_xscale("log")
    axes.set_xlim(min(times) / 1.5, max(times) * 1.5)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.margins(y=0.12)
