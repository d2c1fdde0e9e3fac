"""Error against render time and against training time, as one matplotlib figure. Numbers in, figure out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from avatar.report import figures
from avatar.speed_error.report import METRICS, Line, Results, front
from avatar.speed_error.settings import GROUPS, REFERENCES

PLOTTED = [name for name in GROUPS if name != "small"]
LOOKS = {
    name: {"color": color, "marker": marker}
    for name, color, marker in zip(PLOTTED, (*figures.COLOURS, figures.INK), ("s", "o", "v", "D", "P", "*", "^"), strict=True)
}
TRAINED = ("representation", "preset", "uv", "neighbourhood", "dense")
"""Groups with trainings of their own, the one that names a training first; the other groups draw the same weights."""
SERIES = ("shell", "end")
"""Groups whose rows are one thing turned up: a line joins them."""
SIZE_IN = (11.0, 17.0)
LABEL_PT = 7.0
DIRECTIONS = ((1, 0), (1, 1), (1, -1), (0, 1), (0, -1), (-1, 0), (-1, 1), (-1, -1))
DISTANCES_PT = (5, 10, 16, 23, 31, 40, 50)
NEAR_PT = 8  # a label farther than this from its mark has a line to it
LEVELS_PT = 3.5  # half of the side of a mark


def figure(results: Results, curves: Mapping[str, pd.DataFrame]) -> Figure:
    """Three metrics down, render time and training time across, and below them every training's probe.

    curves: columns step, seconds, probe_psnr of each training.
    """
    out = Figure(SIZE_IN)
    FigureCanvasAgg(out)  # measures the labels
    place = {"left": 0.07, "right": 0.98, "top": 0.905, "bottom": 0.04, "hspace": 0.24, "wspace": 0.14}
    grid = out.add_gridspec(4, 2, **place, height_ratios=(1, 1, 1, 0.85))
    columns = (("ms_per_frame", results.drawn(), "render time, ms a frame (left is faster)"),
               ("train_seconds", trained(results), "training time, s (left is faster)"))  # fmt: skip
    for row, metric in enumerate(METRICS):
        for column, (cost, lines, label) in enumerate(columns):
            axes = out.add_subplot(grid[row, column])
            panel(axes, lines, cost, metric, by_training=column == 1)
            axes.set_xlabel(label)
    below = out.add_subplot(grid[3, :])
    below.set_position([0.07, 0.04, 0.75, below.get_position().height])
    progress(below, curves)
    header(out, results)
    return out


def header(out: Figure, results: Results) -> None:
    """Title, what the marks are, and the groups."""
    lines = results.drawn()
    sizes = next((line.content["size"] for line in lines if "size" in line.content), None)
    of = f"{len(lines[0].content.get('frames', []))} test frames of {sizes[1]}x{sizes[0]} px; " if sizes else ""
    out.suptitle(f"{results.subject}: speed against error", x=0.07, y=0.985, ha="left", fontweight="bold", fontsize=13)
    words = f"{of}a mark is a row of the table; grey line: the rows that no other beats in error and time"
    out.text(0.07, 0.961, words, fontsize=9, color="#475569")
    shown = {line.group for line in results.lines}
    handles = [
        Line2D([], [], linestyle="none", markersize=6, label=GROUPS[group], **look)
        for group, look in LOOKS.items()
        if group in shown
    ]
    out.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.062, 0.957), ncols=4, frameon=False, fontsize=8.5)


def trained(results: Results) -> list[Line]:
    """One row a training, by the name that says most, drawn as it is drawn by default."""
    found: dict[str, Line] = {}
    for group in TRAINED:
        for line in results.lines:
            if line.group == group and line.name not in REFERENCES and not line.failed:
                found.setdefault(line.training, line)
    return list(found.values())


def panel(axes: Axes, lines: Sequence[Line], cost: str, metric: str, by_training: bool) -> None:
    """One metric against one cost, on a logarithmic axis of the cost."""
    title, _, best = METRICS[metric]
    axes.set_title(f"{title} ({'higher' if best is max else 'lower'} is better)")
    known = [line for line in lines if line.figure(cost) and line.figure(metric) is not None]
    if not known:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center")
        return
    axes.set_xscale("log")
    points = {line.name: (line.figure(cost), line.figure(metric)) for line in known}
    chosen = front([(name, *point) for name, point in points.items()], best)
    axes.plot(*np.array([points[name] for name in chosen]).T, color="#cbd5e1", linewidth=5, solid_capstyle="round", zorder=1)
    for group in SERIES if not by_training else ():
        series = [points[line.name] for line in known if line.group == group]
        axes.plot(*np.array(series or [(np.nan, np.nan)]).T, color=LOOKS[group]["color"], linewidth=0.7, alpha=0.6, zorder=2)
    for line in known:
        marks = axes.scatter(*points[line.name], s=30, linewidth=0, zorder=3, **LOOKS[line.group])
        marks.set_gid(f"{line.name}-{metric}-{cost}")
    decades(axes, [point[0] for point in points.values()])
    axes.margins(y=0.13)
    texts = {line.name: named(line) for line in known}
    place_labels(axes, points, texts, {line.name: LOOKS[line.group]["color"] for line in known})


def named(line: Line) -> str:
    """What stands beside a mark."""
    if line.group == "preset" and line.of_steps:
        return f"{line.what}, {line.steps} steps"
    return line.what


def decades(axes: Axes, values: Sequence[float]) -> None:
    """Ticks at 1, 2 and 5 of each decade as plain numbers."""
    axes.set_xlim(min(values) / 1.5, max(values) * 1.9)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def place_labels(
    axes: Axes, points: Mapping[str, tuple[float, float]], texts: Mapping[str, str], colours: Mapping[str, str]
) -> None:
    """Write each text beside its mark where it covers no other text, no mark and no border, as near as that allows.

    points: data units, by name. Where every place is taken the least covered one is used.
    """
    out = axes.get_figure()
    out.draw_without_rendering()
    renderer, scale = out.canvas.get_renderer(), out.dpi / 72
    frame = axes.get_window_extent(renderer)
    pixels = {name: np.asarray(axes.transData.transform(point)) for name, point in points.items()}
    half = LEVELS_PT * scale
    taken = [(x - half, y - half, x + half, y + half) for x, y in pixels.values()]
    for name in sorted(points, key=lambda key: -pixels[key][1]):
        text = axes.text(0, 0, texts[name], fontsize=LABEL_PT, color=colours[name], zorder=4)
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])
        extent = text.get_window_extent(renderer)
        width, height = extent.width, extent.height * 0.9
        places = []
        for rank, distance in enumerate(DISTANCES_PT):
            for direction in DIRECTIONS:
                x, y = pixels[name] + np.array(direction) * distance * scale
                left = x - width * (0.5 - direction[0] / 2)
                box = (left, y - height / 2, left + width, y + height / 2)
                out_of_frame = box[0] < frame.x0 or box[2] > frame.x1 or box[1] < frame.y0 or box[3] > frame.y1
                places.append((sum(shared(box, other) for other in taken) + 1e6 * out_of_frame, rank, box, distance))
        _, _, box, distance = min(places, key=lambda place: place[:2])
        taken.append(box)
        centre = axes.transData.inverted().transform(((box[0] + box[2]) / 2, (box[1] + box[3]) / 2))
        text.set(position=centre, ha="center", va="center")
        if distance > NEAR_PT:
            near = np.clip(pixels[name], (box[0], box[1]), (box[2], box[3]))
            ends = axes.transData.inverted().transform(np.stack([pixels[name], near]))
            axes.plot(*ends.T, color=colours[name], linewidth=0.5, alpha=0.6, zorder=2)


def shared(first: Sequence[float], second: Sequence[float]) -> float:
    """Area that two boxes (left, bottom, right, top) share."""
    width = min(first[2], second[2]) - max(first[0], second[0])
    height = min(first[3], second[3]) - max(first[1], second[1])
    return max(width, 0.0) * max(height, 0.0)


def progress(axes: Axes, curves: Mapping[str, pd.DataFrame]) -> None:
    """The probe's PSNR of every training over its seconds."""
    axes.set(title="PSNR on held-out training frames while training", xlabel="training time, s", ylabel="dB")
    style, ends = figures.looks(list(curves), []), {}
    for name, curve in curves.items():
        points = curve[["seconds", "probe_psnr"]].dropna()
        if len(points):
            axes.plot(points.seconds, points.probe_psnr, **style[name] | {"linewidth": 1.3}, markersize=3)
            ends[name] = float(points.probe_psnr.iloc[-1])
    if not ends:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center")
        return
    axes.set_xscale("log")
    decades(axes, [value for name in ends for value in curves[name].seconds])
    for name, end in ends.items():  # from the line's end to its name
        axes.hlines(end, curves[name].seconds.max(), axes.get_xlim()[1], style[name]["color"], ":", linewidth=0.6)
    axes.get_figure().draw_without_rendering()
    figures.label_ends(axes, ends, style)
