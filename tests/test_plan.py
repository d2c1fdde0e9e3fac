"""Which steps run again after a change: the whole table, asked of Snakemake itself on two subjects and two variants.

Variant `a` is of representation `ours_d`, `b` of one made up here, so that a change of one must leave the other alone.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Iterable
from pathlib import Path

import pytest
from pipeline import Pipeline

from workflow import digest

SUBJECTS = ("ann", "bob")
CONFIG = """
videos: videos
extract: {size: 256}
variants:
  a: {preset: demo}
  b: {preset: demo, train: {representation: other}}
"""
PREPARATION = ("fitting.probe", "fitting.extract", "fitting.matte", "fitting.detect", "fitting.split", "fitting.trim")
PREDICTORS = ("mean_frame", "nearest_frame")


def jobs(rules: str, subjects: Iterable[str] = SUBJECTS) -> set[str]:
    """`"matte fit"` -> one job a rule and subject."""
    return {f"{rule} {subject}" for rule in rules.split() for subject in subjects}


def variant_jobs(rules: str, variants: Iterable[str], subjects: Iterable[str] = SUBJECTS) -> set[str]:
    return {f"{rule} {subject}/{variant}" for rule in rules.split() for subject in subjects for variant in variants}


TABLES = {"tabulate", "plot_speed", "index"}
"""What is made of all subjects together."""
REPORTS = TABLES | jobs("plot page")


def avatars(variants: Iterable[str] = ("a", "b"), subjects: Iterable[str] = SUBJECTS) -> set[str]:
    """train, render, evaluate of some variants."""
    return variant_jobs("train render evaluate", variants, subjects)


def predictors(subjects: Iterable[str] = SUBJECTS) -> set[str]:
    return variant_jobs("baseline evaluate", PREDICTORS, subjects)


ONWARD = avatars() | predictors() | REPORTS
"""train onward: whatever reads the trimmed matte and the track."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which everything has been made."""
    pipeline = Pipeline.create(tmp_path_factory.mktemp("plan") / "run", SUBJECTS)
    pipeline.edit("avatar/config.py", 'Literal["ours_d"', 'Literal["other", "ours_d"')
    (pipeline.folder / "avatar/features/other.py").write_text("from avatar.features import other_parts\n")
    (pipeline.folder / "avatar/features/other_parts.py").write_text("size = 1\n")
    pipeline.write_config(CONFIG)
    result = pipeline.run()
    assert result.code == 0, result.text
    assert result.last_line == "2 of 2 subjects have an avatar"
    return pipeline.folder


@pytest.fixture
def pipeline(finished: Path, tmp_path: Path) -> Pipeline:
    """A copy of the finished folder, to be changed."""
    return Pipeline(Path(shutil.copytree(finished, tmp_path / "run", symlinks=True)))


def add_field(pipeline: Pipeline, model: str) -> None:
    """A new key with a default in a step's config."""
    path = next(path for path in pipeline.folder.glob("*/**/config.py") if f"class {model}(" in path.read_text())
    name, text = str(path.relative_to(pipeline.folder)), path.read_text()
    start = re.search(rf"^class {model}\(StepConfig\):\n(    \"\"\".*?\"\"\"\n)", text, re.M | re.S)
    pipeline.edit(name, start[0], start[0] + "    spare: int = 1\n")


def only_imported_by(step: str, others: Iterable[str]) -> str:
    """A library that one step imports and the others do not, as a file name; the step's own file where there is none."""
    elsewhere = {name for other in others for name in digest.closure(other)}
    own = [name for name in digest.closure(step) if name not in elsewhere and name != step]
    return f"{(own or [step])[0].replace('.', '/')}.py"


def test_nothing_changed(pipeline: Pipeline) -> None:
    assert pipeline.plan() == set()


def test_touching_videos_and_a_fresh_checkout(pipeline: Pipeline) -> None:
    now = time.time() + 5
    for name in ("videos", "avatar", "fitting", "workflow", "config", "profiles"):
        for path in (pipeline.folder / name).rglob("*"):
            os.utime(path, (now, now))
    os.utime(pipeline.folder / "Snakefile", (now, now))
    assert pipeline.plan() == set()


def test_comments_docstrings_and_formatting(pipeline: Pipeline) -> None:
    for name in ("fitting/extract.py", "fitting/detect.py", "fitting/camera.py", "avatar/train.py", "avatar/metrics.py"):
        pipeline.append(name, '\n\n# a new comment\n"""A string that nothing uses."""\n')
    assert pipeline.plan() == set()


def test_step_harness_help_text_and_device(pipeline: Pipeline) -> None:
    pipeline.append("workflow/step.py", "\nNEW = 1\n")
    pipeline.append("workflow/summary.py", "\nNEW = 1\n")
    pipeline.edit("fitting/config.py", "description=", "description='In other words. ' + ")
    pipeline.edit("avatar/config.py", "description=", "description='In other words. ' + ")
    assert pipeline.plan() == set()
    assert pipeline.plan("--config", "device=cuda:7") == set()
    assert pipeline.plan("--cores", "1") == set()


def test_new_field_concerns_its_own_step_only(pipeline: Pipeline) -> None:
    add_field(pipeline, "PageConfig")
    assert pipeline.plan() == jobs("page") | {"index"}


def test_extract(pipeline: Pipeline) -> None:
    everything = jobs("extract matte detect split fit trim") | ONWARD
    assert pipeline.plan("--config", "extract={size: 128}") == everything
    pipeline.append("fitting/extract.py", "\nNEW = 1\n")
    assert pipeline.plan() == everything


def test_head(pipeline: Pipeline) -> None:
    assert pipeline.plan("--config", "head={samples: 700}") == {"head"} | jobs("fit trim") | ONWARD


@pytest.mark.parametrize("step", ["matte", "detect", "split"])
def test_matte_detect_split(pipeline: Pipeline, step: str) -> None:
    add_field(pipeline, f"{step.capitalize()}Config")
    assert pipeline.plan() == jobs(f"{step} fit trim") | ONWARD
    pipeline.append(f"fitting/{step}.py", "\nNEW = 1\n")
    assert pipeline.plan() == jobs(f"{step} fit trim") | ONWARD


def test_library_that_only_fit_imports(pipeline: Pipeline) -> None:
    others = (*PREPARATION, "fitting.head", "avatar.train", "avatar.render", "avatar.baseline", "avatar.evaluate")
    pipeline.append(only_imported_by("fitting.fit", others), "\nNEW = 1\n")
    assert pipeline.plan() == jobs("fit trim") | ONWARD
    add_field(pipeline, "FitConfig")
    assert pipeline.plan() == jobs("fit trim") | ONWARD


def test_trim(pipeline: Pipeline) -> None:
    add_field(pipeline, "TrimConfig")
    assert pipeline.plan() == jobs("trim") | ONWARD
    pipeline.append("fitting/trim.py", "\nNEW = 1\n")
    assert pipeline.plan() == jobs("trim") | ONWARD


def test_train_keys_of_one_variant(pipeline: Pipeline) -> None:
    pipeline.edit("config/config.yaml", "representation: other", "representation: other, steps: 7")
    assert pipeline.plan() == avatars("b") | REPORTS


def test_losses(pipeline: Pipeline) -> None:
    pipeline.append("avatar/losses.py", "\nNEW = 1\n")
    assert pipeline.plan() == avatars() | REPORTS


def test_module_of_the_variants_own_representation(pipeline: Pipeline) -> None:
    pipeline.append("avatar/features/ours_d.py", "\nNEW = 1\n")
    assert pipeline.plan() == avatars("a") | REPORTS


def test_module_of_another_representation(pipeline: Pipeline) -> None:
    pipeline.append("avatar/features/other_parts.py", "\nNEW = 1\n")
    assert pipeline.plan() == avatars("b") | REPORTS


def test_metrics(pipeline: Pipeline) -> None:
    pipeline.append("avatar/metrics.py", "\nNEW = 1\n")
    assert pipeline.plan() == variant_jobs("evaluate", ("a", "b", *PREDICTORS)) | REPORTS


def test_plot(pipeline: Pipeline) -> None:
    add_field(pipeline, "PlotConfig")
    assert pipeline.plan() == jobs("plot page") | {"plot_speed", "index"}


def test_variant_added(pipeline: Pipeline) -> None:
    pipeline.append("config/config.yaml", "  c: {preset: demo, train: {steps: 9}}\n")
    assert pipeline.plan() == avatars("c") | REPORTS
    assert pipeline.run().last_line == "2 of 2 subjects have an avatar"
    assert pipeline.plan() == set()


def test_video_added(pipeline: Pipeline) -> None:
    pipeline.add_video("cem")
    pipeline.forget()
    result = pipeline.run()
    assert result.last_line == "3 of 3 subjects have an avatar"
    assert {line.split()[1] for line in pipeline.ran()} == {"cem", "all"}
    assert sorted(line for line in pipeline.ran() if line.endswith(" all")) == [
        "avatar.report.index_page all",
        "avatar.report.plot all",
        "avatar.report.tabulate all",
    ]


def test_video_removed(pipeline: Pipeline) -> None:
    (pipeline.folder / "videos" / "bob.mp4").unlink()
    assert pipeline.plan() == TABLES


def test_video_replaced(pipeline: Pipeline) -> None:
    """Same name, other content: that subject alone."""
    (pipeline.folder / "videos" / "bob.mp4").write_text("another video")
    pipeline.forget()
    assert pipeline.run().code == 0
    assert {line.split()[1] for line in pipeline.ran()} == {"bob", "all"}


def test_results_of_a_deleted_asset_stay(pipeline: Pipeline) -> None:
    (pipeline.folder / "resources" / "assets" / "lpips_alexnet.ckpt").unlink()
    assert pipeline.plan() == set()


def test_one_rejected_video_among_three(tmp_path: Path) -> None:
    pipeline = Pipeline.create(tmp_path / "run", ("ann", "bob", "cem"))
    pipeline.set_fate(bob="reject")
    result = pipeline.run()
    assert result.code == 0, result.text
    lines = result.text.strip().splitlines()
    assert lines[-2:] == ["bob: rejected: no face in 62 % of the frames", "2 of 3 subjects have an avatar"]
    assert not (pipeline.folder / "results/bob/frames").exists()
    assert (pipeline.folder / "results/tables/metrics.md").exists()
    command = (pipeline.folder / "results/tables/metrics.csv").read_text()
    assert "probes=results/bob/probe/probe.json" in command
    assert "results/bob/demo" not in command
    assert pipeline.plan() == set()


@pytest.mark.parametrize("step", ["fitting.probe", "fitting.fit"])
def test_one_crash_among_three(tmp_path: Path, step: str) -> None:
    pipeline = Pipeline.create(tmp_path / "run", ("ann", "bob", "cem"))
    pipeline.set_fate(bob=f"crash in {step}")
    result = pipeline.run()
    assert result.code != 0
    assert result.last_line == "2 of 3 subjects have an avatar"
    log = f"logs/bob/{step.partition('.')[2]}.log"
    assert f"see {log}" in result.text and "what exists: results/tables/available.md" in result.text
    assert f"logs={log}" in (pipeline.folder / "results/tables/available.md").read_text()
    for subject in ("ann", "cem"):
        assert (pipeline.folder / "results" / subject / "page" / "index.html").exists(), result.text
    pipeline.forget()
    available = pipeline.run("available")
    assert available.code == 0, available.text
    assert pipeline.ran() == ["avatar.report.tabulate all", "avatar.report.index_page all"]
    table = (pipeline.folder / "results/tables/available.csv").read_text()
    assert table.count("metrics=results/ann/") == table.count("metrics=results/cem/") == 3
    pipeline.set_fate()
    again = pipeline.run()
    assert again.code == 0, again.text
    assert again.last_line == "3 of 3 subjects have an avatar"


def test_interrupt_loses_nothing_that_was_made(tmp_path: Path) -> None:
    pipeline = Pipeline.create(tmp_path / "run", ("ann",))
    pipeline.set_fate(ann="sleep in avatar.train")
    assert pipeline.interrupt(until="avatar.train ann").code != 0
    pipeline.set_fate()
    pipeline.forget()
    result = pipeline.run()
    assert result.code == 0, result.text
    assert not [line for line in pipeline.ran() if line.startswith("fitting")]


def test_checkpoints_of_a_killed_training_are_there_when_it_runs_again(tmp_path: Path) -> None:
    """Snakemake clears the outputs of a job before it runs; the checkpoints are none of them."""
    pipeline = Pipeline.create(tmp_path / "run", ("ann",))
    pipeline.set_fate(ann="crash in avatar.train")
    assert pipeline.run().code != 0
    checkpoint = pipeline.folder / "results/ann/demo/checkpoints/last.pt"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_text("half-way")
    assert pipeline.run().code != 0
    assert checkpoint.read_text() == "half-way"
    pipeline.set_fate()
    assert pipeline.run().code == 0
    assert checkpoint.read_text() == "half-way"


def test_lint(tmp_path: Path) -> None:
    """One thing is left out on purpose: an environment per rule (one pinned environment serves all)."""
    pipeline = Pipeline.create(tmp_path / "run", ("ann",))
    result = pipeline.run("--lint", stub=False)
    assert "rule extract" in result.text
    assert set(re.findall(r"^    \* (.*):$", result.text, re.M)) == {"Specify a conda environment or container for each rule."}
