"""Tables and plot of `snakemake speed_error` from made-up rows."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from made_speed_error import PRESETS, write_rows
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from toy_run import job

from avatar.report import figures
from avatar.speed_error import latex, plot, report, settings, table
from avatar.speed_error.report import Line, Results
from workflow.step import StepError

FAILED = "uv_256"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path]]:
    return write_rows(tmp_path_factory.mktemp("rows"), failed=FAILED)


@pytest.fixture(scope="module")
def made(inputs: dict[str, list[Path]], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The step's outputs as text."""
    folder = tmp_path_factory.mktemp("table")
    names = {"csv": "table.csv", "markdown": "table.md", "latex": "table.tex", "plot": "plot.svg", "report": "report.json"}
    outputs = {key: folder / name for key, name in names.items()}
    table.run(job(settings.table_config(PRESETS), inputs, outputs))
    return {key: path.read_text() for key, path in outputs.items()}


def test_every_row_is_in_every_table(made: dict[str, str], inputs: dict[str, list[Path]]) -> None:
    rows = pd.read_csv(pd.io.common.StringIO(made["csv"]))
    plans = settings.table_config(PRESETS).rows
    assert rows.row.tolist() == list(plans)
    failed = rows[rows.note.fillna("").str.startswith("training diverges")]
    assert failed.row.tolist() == ["uv_256"] and np.isnan(failed.psnr.item())
    for title in settings.GROUPS.values():
        assert f"## {title[0].upper()}{title[1:]}" in made["markdown"]
    for plan in plans.values():
        assert f"| {plan.what} |" in made["markdown"] and plan.what.replace("_", "\\_") in made["latex"]
    assert (
        "| 256 px | failed |" in made["markdown"] and "failed: side of the U-Net's maps, 256 px: training div" in made["markdown"]
    )
    assert "not run: preset paper: 400,000 steps" in made["markdown"]
    assert "1200 of 6000" in made["markdown"]
    lines = [line for line in made["markdown"].splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines if "dB to dense" in line}) == 1
    for title in ("training frames", "longer side, px (ours_d)", "vertices of the head model"):
        assert f"| {title} |" in made["markdown"]
    assert f"| 20000 | {report.number(2 + 200)} |" in made["markdown"]
    content = json.loads(made["report"])
    assert {"rows", "costs", "curves", "fronts", "claims"} <= set(content) and len(content["curves"]) == len(inputs["curves"]) - 1


def test_claims_are_differences_of_the_same_weights(made: dict[str, str]) -> None:
    full, small, paper = json.loads(made["report"])["claims"]
    assert full.startswith("256 px, 64 uniform against the shell, the same weights: -0.09 dB and +0.0009 LPIPS")
    assert "80.0 times fewer evaluations over all rays, 16.0 over the head's, 30.0 times less time (2000 ms)" in full
    assert small.startswith("128 px, 64 uniform, 8 frames") and paper.startswith("128 px, 256 uniform + 128 fine, 2 frames")
    assert all("dB between the two renders" in sentence for sentence in (full, small, paper))


def test_the_same_again_is_the_same(made: dict[str, str], inputs: dict[str, list[Path]], tmp_path: Path) -> None:
    outputs = {name: tmp_path / name for name in made}
    table.run(job(settings.table_config(PRESETS), inputs, outputs))
    assert (tmp_path / "plot").read_text() == made["plot"] and (tmp_path / "csv").read_text() == made["csv"]


def test_marks_of_the_plot(made: dict[str, str]) -> None:
    for metric in report.METRICS:
        assert (
            f'id="shell_8-{metric}-ms_per_frame"' in made["plot"] and f'id="kind_layers-{metric}-train_seconds"' in made["plot"]
        )
        assert f'id="kind_ours_d-{metric}-train_seconds"' in made["plot"] and f'id="shell_8-{metric}-train' not in made["plot"]
        assert f'id="dense_64-{metric}-train' not in made["plot"], "drawn from the same weights: no training of its own"
    assert "paper_128px-" not in made["plot"] and "uv_256-" not in made["plot"]


def test_a_missing_row_is_named(inputs: dict[str, list[Path]], tmp_path: Path) -> None:
    fewer = inputs | {"rows": [path for path in inputs["rows"] if path.stem != "end_0.1"]}
    outputs = {name: tmp_path / name for name in ("csv", "markdown", "latex", "plot", "report")}
    with pytest.raises(StepError, match=r"no row end_0\.1"):
        table.run(job(settings.table_config(PRESETS), fewer, outputs))


def test_nothing_measured_is_still_a_plot() -> None:
    lines = [Line("a", "shell", "8", {"failed": "why"})]
    with mpl.rc_context(figures.STYLE):
        made = plot.figure(Results("ann", lines, {}, {}), {})
    assert "not measured" in [text.get_text() for axes in made.axes for text in axes.texts]
    assert "failed: samples in the shell, 8: why" in report.markdown(Results("ann", lines, {}, {}))
    assert "tab:speed_error" in latex.document(Results("ann", lines, {}, {}))


@pytest.mark.parametrize("best", [min, max])
def test_front_is_what_nothing_beats(best) -> None:  # noqa: ANN001
    random = np.random.default_rng(3)
    points = [(str(n), *random.integers(0, 12, 2).tolist()) for n in range(60)]
    sign = 1 if best is min else -1
    beaten = lambda p, q: q[1] <= p[1] and sign * q[2] <= sign * p[2] and (q[1], q[2]) != (p[1], p[2])  # noqa: E731
    expected = {(p[1], p[2]) for p in points if not any(beaten(p, q) for q in points)}
    found = report.front(points, best)
    assert {(p[1], p[2]) for p in points if p[0] in found} == expected and len(found) == len(expected)
    assert report.front([], best) == []


def test_a_front_has_the_other_names_of_a_rendering() -> None:
    content = {"scores": {"psnr": 30.0, "lpips": 0.1, "lpips_mouth": 0.1}, "ms_per_frame": 5.0}
    worse = {"scores": {"psnr": 20.0, "lpips": 0.2, "lpips_mouth": 0.2}, "ms_per_frame": 6.0}
    lines = [Line("a", "shell", "24", content), Line("b", "uv", "64 px", content), Line("c", "end", "0", worse)]
    assert report.fronts(Results("ann", lines, {}, {}), "ms_per_frame")["psnr"] == ["a", "b"]


@pytest.mark.parametrize(("value", "text"), [(None, "not counted"), (0, "0"), (0.01234, "0.0123"), (1.5, "1.50"), (7721, "7721")])
def test_numbers_have_three_digits(value: float | None, text: str) -> None:
    assert report.number(value) == text


def test_distance_between_two_renders() -> None:
    first = np.zeros((2, 4, 4, 4), np.uint8)
    second = first.copy()
    second[..., :3] = 51  # a fifth of full scale
    assert table.between(first, second) == pytest.approx(-20 * np.log10(0.2)) and table.between(first, first) == 100


def test_labels_cover_no_label_and_no_mark() -> None:
    out = Figure((5, 4))
    FigureCanvasAgg(out)
    axes = out.add_subplot()
    random = np.random.default_rng(1)
    points = {f"point {n}": tuple(random.uniform(0.2, 0.8, 2)) for n in range(24)}
    axes.set(xlim=(0, 1), ylim=(0, 1))
    plot.place_labels(axes, points, {name: name for name in points}, dict.fromkeys(points, "k"))
    out.draw_without_rendering()
    boxes = [text.get_window_extent().padded(-1.5) for text in axes.texts]
    assert len(boxes) == 24 and not [pair for pair in itertools.combinations(boxes, 2) if pair[0].overlaps(pair[1])]
    marks = axes.transData.transform(list(points.values()))
    assert not [1 for box in boxes for x, y in marks if box.contains(x, y)]
    frame = axes.get_window_extent()
    assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 for box in boxes)
    assert plot.shared((0, 0, 2, 2), (1, 1, 3, 3)) == 1 and plot.shared((0, 0, 1, 1), (2, 0, 3, 1)) == 0
