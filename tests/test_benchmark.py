"""The tracking benchmark: the cut of a clip, the table and the plot of made-up rows, and when it is planned."""

from __future__ import annotations

import csv
import json
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pipeline import Pipeline

from avatar.report import compare
from avatar.report.config import CompareConfig
from avatar.settings import Settings
from fitting import benchmark, benchmark_settings, benchmark_table
from fitting.config import BenchmarkConfig, SimulateConfig
from fitting.tracking import Clip
from workflow import settings, step

SLOW, TALK = (benchmark_settings.PREFIX + benchmark_settings.clip_of(kind) for kind in ("slow", "talk"))
SVG = "{http://www.w3.org/2000/svg}"


def row(subject: str, ms: float, rotation: float | None = None, heldout: float | None = None) -> dict:
    """A row as the step writes it; without rotation, one without truth."""
    found = {
        "subject": subject, "simulated": subject.startswith(benchmark_settings.PREFIX), "frames": 120, "ms_per_frame": ms,
        "ms_by_stage": {"track": ms, "photometric": 0.0, "bundle": 0.0}, "once_s": 5.0, "usable_percent": 100.0,
        "heldout_percent": heldout, "jitter": {"vertices_mm": 0.5, "rotation_degrees": 0.1}, "load": 1.5,
        "provenance": {"seconds": 60.0},
    }  # fmt: skip
    if rotation is not None:
        errors = {name: {"p50": rotation + place, "p95": 9.0} for place, name in enumerate(benchmark_table.TRUTH)}
        found["errors"] = errors | {"gaze_deg": {"p50": None, "p95": None}, "aperture_lag_frames": None}
    return found


def collect(folder: Path, rows: dict[tuple[str, str], dict]) -> step.Job:
    """Run the step on made-up rows by subject and setting."""
    paths = []
    for (subject, setting), content in rows.items():
        paths.append(folder / "rows" / subject / f"{setting}.json")
        paths[-1].parent.mkdir(parents=True, exist_ok=True)
        paths[-1].write_text(json.dumps(content))
    output = SimpleNamespace(csv=folder / "t.csv", markdown=folder / "t.md", plot=folder / "t.svg")
    log = SimpleNamespace(info=lambda *_: None)
    job = step.Job(CompareConfig(), SimpleNamespace(rows=paths), output, output, "all", 1, "cpu", "", log)
    compare.run(job)
    return job


ROWS = {
    (SLOW, "all"): row(SLOW, 40.0, 1.0),
    (TALK, "all"): row(TALK, 60.0, 3.0),
    ("ann", "all"): row("ann", 500.0, heldout=1.25),
    (SLOW, "no_irises"): row(SLOW, 41.0, 2.0),
    (SLOW, "adam_500"): row(SLOW, 400.0, 7.0),
    (TALK, "adam_500"): {"subject": TALK, "simulated": True, "frames": 60, "failed": "the face is lost"},
}


def cells(text: str, setting: str) -> dict[str, str]:
    """A setting's line of the Markdown by title."""
    lines = text.splitlines()
    place = next(number for number, line in enumerate(lines) if line.startswith(f"| {setting} |"))
    head = next(line for line in reversed(lines[:place]) if line.startswith("| setting |"))
    split = lambda line: [cell.strip() for cell in line.strip("|").split("|")]  # noqa: E731
    return dict(zip(split(head), split(lines[place]), strict=True))


def test_markdown_has_medians_over_clips(tmp_path: Path) -> None:
    text = collect(tmp_path, ROWS).output.markdown.read_text()
    default = cells(text, "all")
    assert default["ms a frame"] == "50.0", "real clips are of other lengths: the simulated ones are timed"
    assert default["rotation, deg"] == "2.00" and default["face, mm"] == "4.00"
    assert default["held-out, %"] == "1.25"
    assert cells(text, "no_irises")["held-out, %"] == benchmark_table.NONE
    assert cells(text, "adam_500")["rotation, deg"] == "7.00"
    assert "- adam_500, talk: no track: the face is lost" in text
    assert "6 fits took 5.0 minutes, one after the other" in text and "load of the machine 1.5" in text
    assert default["clips"] == "2 + 1 real" and cells(text, "adam_500")["clips"] == "1"
    assert text.index("| no_irises") < text.index("Solvers alone") < text.index("| adam_500")
    assert "| slow | 120 | 40.0 |" in text and "| ann | 120 | 500.0 |" in text


def test_csv_has_a_row_a_fit(tmp_path: Path) -> None:
    with open(collect(tmp_path, ROWS).output.csv, newline="") as file:
        found = {(line["subject"], line["setting"]): line for line in csv.DictReader(file)}
    assert set(found) == set(ROWS)
    assert float(found[SLOW, "all"]["rotation_deg_p50"]) == 1 and found[SLOW, "all"]["gaze_deg_p50"] == ""
    assert found["ann", "all"]["rotation_deg_p50"] == "" and float(found["ann", "all"]["heldout_percent"]) == 1.25
    assert found[TALK, "adam_500"]["note"] == "the face is lost" and found[TALK, "adam_500"]["ms_per_frame"] == ""


def test_plot_is_svg_with_a_mark_a_setting(tmp_path: Path) -> None:
    root = ElementTree.parse(collect(tmp_path, ROWS).output.plot).getroot()
    assert root.tag == f"{SVG}svg"
    marks = {item.get("id") for item in root.iter(f"{SVG}g")}
    assert {f"rotation_deg-{name}" for name in ("terms-all", "terms-no_irises", "solvers-adam_500")} <= marks
    assert "heldout_percent-terms-all" in marks and "heldout_percent-terms-no_irises" not in marks


def test_every_setting_has_a_look_of_its_own() -> None:
    from avatar.report import tracking_figure

    rows = [row(subject, 40.0, 1.0) | {"setting": name} for subject, name in benchmark_settings.planned([])]
    found = tracking_figure.looks_of(benchmark_table.sections(rows))
    assert len({(look.get_marker(), look.get_markerfacecolor()) for look in found.values()}) == len(found)
    assert {name for _, name in found} == set(benchmark_settings.SETTINGS)


def test_iterations_stand_beside_the_default_on_the_same_clips() -> None:
    rows = [row(SLOW, 40.0, 1.0) | {"setting": "all"}, row(TALK, 60.0, 3.0) | {"setting": "all"}]
    rows.append(row(TALK, 50.0, 4.0) | {"setting": "iterations_2"})
    default, other = benchmark_table.sections(rows)["iterations"]
    assert (default.setting, default.simulated, default.values["rotation_deg"]) == ("all", 1, 3.0)
    assert (other.setting, other.values["ms_per_frame"]) == ("iterations_2", 50.0)
    assert benchmark_table.sections(rows)["terms"][0].values["rotation_deg"] == 2.0


def test_without_any_truth(tmp_path: Path) -> None:
    """As with a FLAME head, whose vertices are not those of the simulated clips."""
    job = collect(tmp_path, {(SLOW, "all"): row(SLOW, 40.0), ("ann", "all"): row("ann", 50.0, heldout=1.0)})
    text = job.output.markdown.read_text()
    assert "rotation, deg" not in text.split("Each clip")[0] and "no truth" in text
    ElementTree.parse(job.output.plot)


def test_nothing_fitted(tmp_path: Path) -> None:
    failed = {"subject": SLOW, "simulated": True, "frames": 60, "failed": "lost"}
    ElementTree.parse(collect(tmp_path, {(SLOW, "all"): failed}).output.plot)


def test_a_damaged_row_is_named(tmp_path: Path) -> None:
    with pytest.raises(step.StepError, match=r"all\.json: simulated is missing"):
        collect(tmp_path, {(SLOW, "all"): {"subject": SLOW}})


def test_median() -> None:
    assert benchmark_table.median([3.0, None, 1.0]) == 2.0
    assert benchmark_table.median([None]) is None


@dataclass(frozen=True)
class Seen:
    """In the place of Observed: one array a frame, and the centre."""

    found: np.ndarray
    centre_px: np.ndarray


def made_clip(train: np.ndarray, test: np.ndarray, frames: int = 100) -> Clip:
    numbers = np.arange(frames)
    seen = Seen(numbers * 2, np.zeros(2))
    return Clip(None, None, seen, numbers[:, None], numbers[:, None], numbers / 30, train, test, 0.0)


def test_cut_keeps_both_parts_about_the_split() -> None:
    clip, rows = benchmark.cut(made_clip(np.arange(75), np.arange(75, 100)), 40)
    assert rows.tolist() == list(range(45, 85))
    assert clip.train.tolist() == list(range(30)) and clip.test.tolist() == list(range(30, 40))
    assert clip.frames[:, 0].tolist() == rows.tolist() and clip.observed.found.tolist() == (2 * rows).tolist()
    assert len(clip.observed.centre_px) == 2 and clip.time_s[0] == 1.5


def test_cut_of_a_short_clip_takes_all() -> None:
    clip, rows = benchmark.cut(made_clip(np.arange(60), np.arange(80, 100)), 200)
    assert rows.tolist() == [*range(60), *range(80, 100)]  # frames of neither part are left out
    assert clip.test.tolist() == list(range(60, 80))


def test_settings() -> None:
    names = benchmark_settings.SETTINGS
    assert {names[f"iterations_{count}"].fit.iterations for count in (1, 2, 8)} | {names["all"].fit.iterations} == {1, 2, 4, 8}
    assert {names[f"adam_{count}"].fit.adam_steps for count in (50, 150, 500)} == {50, 150, 500}
    rows = benchmark_settings.planned(["ann", "bob", "cem"])
    assert len(rows) == len(set(rows)) and {subject for subject, name in rows if name == "adam_50"} == {SLOW, TALK, "ann"}
    assert benchmark_settings.frames_of(SLOW, "adam_500") == 60 and benchmark_settings.frames_of("ann", "all") == 200


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Pipeline:
    return Pipeline.create(tmp_path_factory.mktemp("benchmark") / "run", ("ann", "bob", "cem"))


def test_planned_only_when_asked_for(pipeline: Pipeline) -> None:
    def of_benchmark(jobs: set[str]) -> list[str]:
        return [job for job in jobs if "simulat" in job or "benchmark" in job]

    assert of_benchmark(pipeline.plan()) == []
    assert "tracking_benchmark" in pipeline.plan("tracking_benchmark")


def test_runs_and_is_then_done(pipeline: Pipeline) -> None:
    pipeline.set_fate(ann="reject")
    result = pipeline.run("tracking_benchmark")
    assert result.code == 0, result.text
    ran = pipeline.ran()
    assert len([line for line in ran if line.startswith("fitting.benchmark ")]) == len(benchmark_settings.planned(["bob"]))
    assert "fitting.benchmark bob" in ran and "fitting.benchmark ann" not in ran and "fitting.probe cem" not in ran
    assert not [line for line in ran if line.startswith(("fitting.fit", "avatar.train"))]
    assert pipeline.plan("tracking_benchmark") == set()
    made = json.loads((pipeline.folder / f"results/tracking_benchmark/rows/{SLOW}/adam_50.json").read_text())
    config = BenchmarkConfig.model_validate_json(made[made.index("--config") + 1])
    assert config == BenchmarkConfig(fit=benchmark_settings.SETTINGS["adam_50"].fit, frames=60, simulated=True)
    assert made[made.index("--threads") + 1] == "1" and "truth=simulated/truth/slow_0_120_bald.npz" in made
    made = json.loads((pipeline.folder / "simulated/videos/profile_0_120_short.mp4").read_text())
    config = SimulateConfig.model_validate_json(made[made.index("--config") + 1])
    assert (config.kind, config.seed, config.frames, config.hair) == ("profile", 0, 120, "short")
    for name in (f"rows/{SLOW}/adam_50.json", "tracking.md"):  # as after an interruption
        (pipeline.folder / "results/tracking_benchmark" / name).unlink()
    pipeline.forget()
    assert pipeline.run("tracking_benchmark").code == 0
    assert pipeline.ran() == [f"fitting.benchmark {SLOW}", "avatar.report.compare tracking_benchmark"]


def test_its_folder_is_no_subject(tmp_path: Path) -> None:
    (tmp_path / "tracking_benchmark.mp4").touch()
    with pytest.raises(settings.SettingsError, match="cannot be used for a subject"):
        settings.discover(tmp_path)


def test_simulated_clips_cannot_be_a_users() -> None:
    assert settings.subject_name(SLOW) != SLOW


def test_simulated_videos_follow_the_config(pipeline: Pipeline) -> None:
    text = pipeline.run("-n", "-p", "simulated/videos/blink_3.mp4", "--config", "simulate={frames: 50}").text
    assert '"frames":50' in text and '"kind":"blink"' in text and '"seed":3' in text
    with pytest.raises(settings.SettingsError, match="simulate.kind is not a key"):
        settings.validated(Settings, {"simulate": {"kind": "slow"}}, "config.yaml")
