"""The plots, as matplotlib figures: numbers in, figure out. Lines are told apart by label, dash and marker, not colour alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

WIDTH_IN = 9.0
"""648 px in SVG: Snakemake's report crops what is wider than about 1000."""
COLOURS = ("#0b6bcb", "#c2410c", "#0f766e", "#7c3aed", "#a16207", "#be185d")  # 4.5:1 against white or better
DASHES = ("-", (0, (6, 2)), (0, (6, 2, 1.5, 2)), (0, (2, 1.5)))
MARKERS = ("o", "s", "^", "D", "v", "P")
PREDICTOR_COLOUR, PREDICTOR_DASHES = "#64748b", ((0, (1, 1.6)), (0, (4, 3)))
INK, FAINT = "#1e293b", "#e2e8f0"
STYLE = {
    "font.family": "DejaVu Sans", "font.size": 9, "axes.edgecolor": "#94a3b8", "axes.labelcolor": INK, "text.color": INK,
    "xtick.color": INK, "ytick.color": INK, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": FAINT, "axes.axisbelow": True, "axes.titlesize": 10, "axes.titlelocation": "left", "axes.titleweight": "bold",
    "svg.hashsalt": "avatar", "svg.fonttype": "path",
}  # fmt: skip
"""Put around figure making and saving with `matplotlib.rc_context`; the salt makes equal figures equal files."""
TITLES = {"lpips": "LPIPS (lower is better)", "ssim": "SSIM (higher is better)", "psnr": "PSNR, dB (higher is better)"}


def looks(names: Sequence[str], predictors: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour, dash and marker of each variant; predictors are grey."""
    found, trained = {}, [name for name in names if name not in predictors]
    for place, name in enumerate(trained):
        dash, marker = DASHES[place % len(DASHES)], MARKERS[place % len(MARKERS)]
        found[name] = {"color": COLOURS[place % len(COLOURS)], "linestyle": dash, "marker": marker, "linewidth": 1.8}
    for place, name in enumerate(name for name in names if name in predictors):
        dash = PREDICTOR_DASHES[place % 2]
        found[name] = {"color": PREDICTOR_COLOUR, "linestyle": dash, "marker": "x+"[place % 2], "linewidth": 1.2}
    return {name: found[name] for name in names}


def label_ends(axes: Axes, ends: Mapping[str, float], style: Mapping[str, dict[str, Any]]) -> None:
    """Write each line's name right of the axes at the height of its last value, pushed apart where they would overlap.

    Args:
        axes: with its final limits.
        ends: last y value of each line, data units.
        style: from `looks`.
    """
    if not ends:
        return
    to_axes = axes.transData + axes.transAxes.inverted()
    wanted = {name: float(to_axes.transform((axes.get_xlim()[1], y))[1]) for name, y in ends.items()}
    gap = 0.175 / axes.get_figure().get_size_inches()[1] / axes.get_position().height
    heights: list[float] = []
    ordered = sorted(wanted, key=wanted.get)
    for name in ordered:
        heights.append(max(wanted[name], heights[-1] + gap) if heights else wanted[name])
    over = max(0.0, heights[-1] - 1.02)  # a pile at the top moves down as a whole, lowest first giving way
    for place in reversed(range(len(heights))):
        ceiling = heights[place + 1] - gap if place + 1 < len(heights) else heights[place] - over
        heights[place] = min(heights[place], ceiling)
    for name, height in zip(ordered, heights, strict=True):
        look = style[name]
        leader = {"arrowstyle": "-", "color": look["color"], "linewidth": 0.8, "shrinkA": 1, "shrinkB": 0, "relpos": (0, 0.5)}
        text = axes.annotate(name, (1.0, wanted[name]), xytext=(1.03, height), xycoords="axes fraction", arrowprops=leader)
        text.set(va="center", color=look["color"], fontsize=8.5)


def _empty(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center")
    axes.set(xticks=[], yticks=[])


def training_figure(curves: Mapping[str, pd.DataFrame], subject: str) -> Figure:
    """Training loss over steps, and the PSNR on held-out probes over seconds.

    Args:
        curves: columns step, seconds, loss and probe_psnr (NaN where not measured) of each variant.
        subject: for the title.
    """
    figure = Figure((WIDTH_IN, 4.2))
    left, right = figure.subplots(1, 2)
    figure.subplots_adjust(0.08, 0.13, 0.88, 0.88, wspace=0.5)
    style = looks(list(curves), [])
    for axes, column, across in ((left, "loss", "step"), (right, "probe_psnr", "seconds")):
        ends = {}
        for name, curve in curves.items():
            known = curve[[across, column]].dropna() if column in curve else curve.iloc[:0]
            if known.empty:
                continue
            x, y = known[across].to_numpy(), known[column]
            look = {key: value for key, value in style[name].items() if key != "marker"}
            if column == "loss":
                axes.plot(x, y, color=look["color"], alpha=0.2, linewidth=0.6)
                y = y.rolling(max(1, len(y) // 30), min_periods=1, center=True).median()
                axes.plot(x, y, **look)
            else:
                axes.plot(x, y, **look, marker=style[name]["marker"], markersize=4)
            ends[name] = float(y.iloc[-1])
        if not ends:
            _empty(axes, "not measured")
            continue
        if column == "loss" and all(value > 0 for value in ends.values()):
            axes.set_yscale("log")
        axes.margins(x=0)
        figure.draw_without_rendering()
        label_ends(axes, ends, style)
    left.set(title=f"{subject}: training loss", xlabel="step", ylabel="loss (faint: each record; line: running median)")
    right.set(title="PSNR of probe frames", xlabel="training time, s", ylabel="PSNR, dB")
    return figure


def error_figure(tables: Mapping[str, pd.DataFrame], predictors: Sequence[str], subject: str) -> Figure:
    """LPIPS, PSNR and SSIM of each test frame, every variant and predictor.

    Args:
        tables: per_frame.csv of each variant.
        predictors: names among them that are trivial predictors.
        subject: for the title.
    """
    figure = Figure((WIDTH_IN, 7.2))
    rows = figure.subplots(3, 1, sharex=True)
    figure.subplots_adjust(0.09, 0.08, 0.82, 0.9, hspace=0.28)
    style = looks(list(tables), predictors)
    for axes, metric in zip(rows, ("lpips", "psnr", "ssim"), strict=True):
        ends = {}
        for name, table in tables.items():
            look = style[name] | {"marker": style[name]["marker"] if len(table) < 40 else None}
            axes.plot(table["frame"], table[metric], **look, markersize=3.5)
            ends[name] = float(table[metric].iloc[-1])
        axes.set_title(TITLES[metric])
        axes.set_ylabel({"psnr": "dB"}.get(metric, metric.upper()))
        axes.margins(x=0)
        figure.draw_without_rendering()
        label_ends(axes, ends, style)
    rows[-1].set_xlabel("frame of the clip (test tail)")
    figure.suptitle(f"{subject}: error of each test frame", x=0.09, y=0.975, ha="left", fontweight="bold", fontsize=12)
    return figure


def speed_figure(points: pd.DataFrame) -> Figure:
    """Speed against error over all subjects and variants; predictors are reference lines (mean over subjects).

    Args:
        points: one row a subject and variant: subject, variant, predictor, lpips, psnr, ms_per_frame, training_seconds (NaN
            where there was no training).
    """
    figure = Figure((WIDTH_IN, 7.4))
    panels = figure.subplots(2, 2, sharey="row", sharex="col")
    figure.subplots_adjust(0.09, 0.09, 0.86, 0.9, hspace=0.2, wspace=0.12)
    predictors = list(dict.fromkeys(points.variant[points.predictor]))
    trained = list(dict.fromkeys(points.variant[~points.predictor]))
    style = looks([*trained, *predictors], predictors)
    for row, metric in zip(panels, ("lpips", "psnr"), strict=True):
        means = {name: float(points[metric][points.variant == name].mean()) for name in predictors}
        for axes, across in zip(row, ("ms_per_frame", "training_seconds"), strict=True):
            for name in trained:
                _variant_points(axes, points[points.variant == name].dropna(subset=[across]), name, across, metric, style[name])
            known = points[across][~points.predictor].dropna()
            if len(known):
                axes.set_xscale("log")
                axes.set_xlim(known.min() / 1.6, known.max() * 1.6)
                axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                axes.xaxis.set_minor_formatter(NullFormatter())
            else:
                axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center")
            for name, mean in means.items():
                axes.axhline(mean, **{key: style[name][key] for key in ("color", "linestyle", "linewidth")})
            axes.margins(y=0.12)
        figure.draw_without_rendering()
        label_ends(row[1], means, style)
        row[0].set_ylabel(TITLES[metric])
    panels[1, 0].set_xlabel("render time, ms a frame (left is faster)")
    panels[1, 1].set_xlabel("training time, s (left is faster)")
    figure.suptitle("Speed against error", x=0.09, y=0.98, ha="left", fontweight="bold", fontsize=12)
    legend = "small marks: subjects, best and worst named; large mark: mean over subjects; grey lines: trivial predictors, mean"
    figure.text(0.09, 0.927, legend, fontsize=8.5, color="#475569")
    return figure


def _variant_points(axes: Axes, chosen: pd.DataFrame, name: str, across: str, metric: str, look: dict[str, Any]) -> None:
    """Subjects as small marks, best and worst with their names; their mean as a large one with the variant's name."""
    if chosen.empty:
        return
    axes.scatter(chosen[across], chosen[metric], s=18, color=look["color"], marker=look["marker"], alpha=0.55)
    ends = chosen.sort_values(metric).iloc[[0, -1]] if len(chosen) > 1 else chosen.iloc[:0]
    for (_, row), (drop, align) in zip(ends.iterrows(), ((-3, "top"), (3, "bottom")), strict=False):
        axes.annotate(row.subject, (row[across], row[metric]), xytext=(0, drop), textcoords="offset points", fontsize=7.5,
                      color="#475569", ha="center", va=align)  # fmt: skip
    # The geometric mean is the centre on a logarithmic axis.
    centre = (float(np.exp(np.log(chosen[across]).mean())), float(chosen[metric].mean()))
    axes.scatter(*centre, s=90, facecolor="white", edgecolor=look["color"], linewidth=2, marker=look["marker"], zorder=3)
    axes.annotate(name, centre, xytext=(10, 0), textcoords="offset points", color=look["color"], fontweight="bold", va="center",
                  bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.5})  # fmt: skip
