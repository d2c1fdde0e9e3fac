"""The plots: what they show is in the figure, labels do not overlap, and any number of subjects or variants is drawn."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import made_subject as made
import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from test_tabulate import result, write

from avatar.report import figures, plot
from avatar.report.config import PlotConfig
from workflow import step


def curve(seed: int = 0) -> pd.DataFrame:
    steps = np.arange(0, 2000, 10)
    noise = np.random.default_rng(seed).normal(0, 0.05, len(steps))
    psnr = np.where(steps % 500 == 0, 15 + 3 * np.log1p(steps / 100), np.nan)
    return pd.DataFrame(
        {"step": steps, "seconds": steps * 0.2, "loss": np.exp(-steps / 900 + noise), "loss_rgb": 0.1, "probe_psnr": psnr}
    )


def per_frame(level: float) -> pd.DataFrame:
    frames = np.arange(354, 504)
    wave = 0.02 * np.sin(frames / 9)
    return pd.DataFrame(
        {"frame": frames, "psnr": 20 + 50 * level + 50 * wave, "ssim": 0.9 + wave / 2, "lpips": 0.2 - level / 2 + wave}
    )


def files(root: Path) -> dict[str, list[Path]]:
    """Inputs of the subject's plots: two variants and two predictors."""
    levels = {"demo": 0.1, "large": 0.15, "mean_frame": 0.0, "nearest_frame": 0.05}
    paths = write(root, {"ann": None}, {"ann": {name: result(0.1, 0.9, 25, "frame" in name) for name in levels}})
    curves, tables = [], []
    for seed, (name, level) in enumerate(levels.items()):
        tables.append(root / "ann" / name / "metrics" / "per_frame.csv")
        per_frame(level).to_csv(tables[-1], index=False)
        if "frame" not in name:
            curves.append(root / "ann" / name / "curve.tsv")
            curve(seed).to_csv(curves[-1], index=False, sep="\t")
    return {"metrics": paths["metrics"], "curves": curves, "per_frames": tables}


def svg_size(path: Path) -> tuple[float, float]:
    root = ElementTree.parse(path).getroot()
    assert root.tag.endswith("svg")
    return tuple(float(re.fullmatch(r"([\d.]+)pt", root.get(side)).group(1)) * 4 / 3 for side in ("width", "height"))


def texts(figure: Figure) -> list[str]:
    return [item.get_text() for item in figure.findobj(mpl.text.Text)]


def test_the_step_draws_both_plots_the_same_way_twice(tmp_path: Path) -> None:
    inputs = files(tmp_path)
    out = {"curve": tmp_path / "plots" / "curve.svg", "error": tmp_path / "plots" / "error.svg"}
    drawn = []
    for _ in range(2):
        step.main(plot.run, PlotConfig, made.arguments({}, inputs, out))
        drawn.append([path.read_bytes() for path in out.values()])
        assert all(max(svg_size(path)) < 1000 for path in out.values())
    assert drawn[0] == drawn[1]


@pytest.mark.parametrize("subjects", [1, 7])
def test_the_step_draws_speed_against_error(tmp_path: Path, subjects: int) -> None:
    results = {}
    for place in range(subjects):
        demo = result(0.08 + 0.01 * place, 0.9, 27.0 - place, seconds=300.0 + 20 * place)
        results[f"subject{place}"] = {"mean_frame": result(0.35, 0.8, 18, True), "demo": demo}
    paths = write(tmp_path, dict.fromkeys(results), results)
    out = {"speed": tmp_path / "speed_error.svg"}
    step.main(plot.run, PlotConfig, made.arguments({}, {"metrics": paths["metrics"]}, out, subject="all"))
    assert max(svg_size(out["speed"])) < 1000


def test_no_accepted_subject_still_draws(tmp_path: Path) -> None:
    out = {"speed": tmp_path / "speed_error.svg"}
    step.main(plot.run, PlotConfig, made.arguments({}, {}, out, subject="all"))
    assert out["speed"].exists()


def test_every_line_is_named_and_axes_have_units() -> None:
    tables = {"demo": per_frame(0.1), "mean_frame": per_frame(0.1)}
    figure = figures.error_figure(tables, ["mean_frame"], "ann")
    words = texts(figure)
    assert words.count("demo") == words.count("mean_frame") == 3 and "dB" in words
    demo, mean = figure.axes[0].lines
    np.testing.assert_array_equal(demo.get_ydata(), tables["demo"]["lpips"])
    assert demo.get_linestyle() != mean.get_linestyle() and demo.get_color() != mean.get_color()
    words = texts(figures.training_figure({"demo": curve()}, "ann"))
    assert "training time, s" in words and "PSNR, dB" in words and words.count("demo") == 2


def test_labels_of_close_lines_are_pushed_apart() -> None:
    names = [f"variant{place}" for place in range(6)]
    figure = figures.error_figure({name: per_frame(0.1 + 1e-4 * place) for place, name in enumerate(names)}, [], "ann")
    figure.draw_without_rendering()
    for axes in figure.axes:
        labels = [item for item in axes.texts if item.get_text() in names]
        boxes = sorted((mpl.text.Text.get_window_extent(item) for item in labels), key=lambda box: box.y0)
        assert len(boxes) == 6
        assert all(upper.y0 - lower.y1 > -3 for lower, upper in zip(boxes, boxes[1:], strict=False))
        assert max(box.x1 for box in boxes) < figure.bbox.width


def test_training_without_probes_or_without_variants() -> None:
    bare = curve()[["step", "seconds", "loss"]]
    assert "not measured" in texts(figures.training_figure({"demo": bare}, "ann"))
    assert texts(figures.training_figure({}, "ann")).count("not measured") == 2


def test_a_damaged_table_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    inputs = files(tmp_path)
    out = {"curve": tmp_path / "curve.svg", "error": tmp_path / "error.svg"}
    for content, message in (
        ("", "not readable"),
        ("step\tseconds\n1\t2\n", "column loss is missing"),
        ("step\tseconds\tloss\n", "no rows"),
    ):
        inputs["curves"][0].write_text(content)
        with pytest.raises(SystemExit):
            step.main(plot.run, PlotConfig, made.arguments({}, inputs, out))
        assert message in caplog.text and "demo/curve.tsv" in caplog.text
