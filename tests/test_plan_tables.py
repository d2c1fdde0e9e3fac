"""Tables are made from per-frame files: deleting them, or what they are made from, plans no training and no rendering."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from pipeline import Pipeline

SUBJECTS = ("ann", "bob")
CONFIG = "videos: videos\nvariants:\n  demo: {preset: demo}\n"
TABLES = ("metrics.csv", "per_frame.csv", "metrics.md", "metrics.tex", "regions.md", "regions.tex")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Pipeline:
    """A folder in which everything has been made but bob's training, which crashed."""
    pipeline = Pipeline.create(tmp_path_factory.mktemp("plan") / "run", SUBJECTS)
    pipeline.write_config(CONFIG)
    pipeline.set_fate(bob="crash in avatar.train")
    assert pipeline.run().code != 0
    return pipeline


@pytest.fixture(scope="module")
def whole(finished: Pipeline, tmp_path_factory: pytest.TempPathFactory) -> Pipeline:
    """A copy in which bob's training has succeeded."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    pipeline = Pipeline(Path(shutil.copytree(finished.folder, folder, symlinks=True)))
    pipeline.set_fate()
    result = pipeline.run()
    assert result.code == 0, result.text
    return pipeline


def test_available_hands_over_what_exists_and_the_log_of_what_does_not(finished: Pipeline) -> None:
    available = finished.run("available")
    assert available.code == 0, available.text
    text = (finished.folder / "results/tables/available.csv").read_text()
    for variant in ("demo", "mean_frame", "nearest_frame"):
        assert f"per_frames=results/ann/{variant}/metrics/per_frame.csv" in text
    assert "per_frames=results/bob/mean_frame/metrics/per_frame.csv" in text and "results/bob/demo/metrics" not in text
    assert text.count("logs=") == 1 and "logs=logs/bob/demo/train.log" in text
    tables = finished.folder / "results/tables"
    for name in ("per_frame.csv", "regions.md", "regions.tex"):
        assert (tables / f"available_{name}").exists()
    assert (tables / "available.md").exists() and (tables / "available.tex").exists()
    assert not (tables / "metrics.csv").exists()


def test_another_per_frame_file_means_other_tables(whole: Pipeline) -> None:
    path = whole.folder / "results/ann/demo/metrics/per_frame.csv"
    path.write_text(path.read_text() + "\n")
    assert whole.plan("results/tables/metrics.tex") == {"tabulate"}


def test_deleting_tables_makes_tables_and_nothing_that_takes_long(whole: Pipeline) -> None:
    tables = whole.folder / "results/tables"
    assert all((tables / name).exists() for name in TABLES)
    shutil.rmtree(tables)
    assert whole.plan("results/tables/metrics.csv") == {"tabulate"}
    rules = {job.split()[0] for job in whole.plan()}
    assert "tabulate" in rules and not rules & {"probe", "extract", "matte", "detect", "split", "fit", "trim"}
    assert not rules & {"train", "baseline", "render", "evaluate"}
