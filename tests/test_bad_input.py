"""Mistakes of the user at the level of the workflow: one sentence each, no traceback, and nothing already made is lost."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from pipeline import REPOSITORY, Pipeline, Result

from avatar.config import RenderConfig, TrainConfig
from avatar.settings import Settings
from workflow import settings


@pytest.fixture
def pipeline(tmp_path: Path) -> Pipeline:
    return Pipeline.create(tmp_path / "run")


def sentence(result: Result) -> str:
    """The one line that is said, beside Snakemake's own about profile and config; the run failed, without a traceback."""
    own = ("Using workflow specific profile", "Config file config/config.yaml is extended")
    lines = [line for line in result.text.splitlines() if line.strip() and not line.startswith(own)]
    assert result.code == 1, result.text
    assert len(lines) == 1, result.text
    return lines[0]


def test_missing_folder(pipeline: Pipeline) -> None:
    said = sentence(pipeline.run("--config", "videos=elsewhere"))
    assert said.startswith("elsewhere: there is no such folder; put one video a subject there")


def test_empty_folder(pipeline: Pipeline) -> None:
    (pipeline.folder / "videos" / "notes.txt").write_text("not a video")
    (pipeline.folder / "videos" / "._ann.mov").write_text("what a Mac leaves behind")
    said = sentence(pipeline.run())
    assert "videos: there is no video in this folder" in said
    assert "snakemake --config videos=FOLDER" in said


def test_two_files_with_one_stem(pipeline: Pipeline) -> None:
    pipeline.add_video("ann", ".mp4")
    pipeline.add_video("ann", ".MOV")
    assert sentence(pipeline.run()) == (
        "videos/ann.MOV and videos/ann.mp4 would both be the subject ann; rename or remove one of them"
    )


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        ("extract={sise: 256}", "config/config.yaml or --config: extract.sise is not a key; did you mean extract.size?"),
        ("variants={demo: {train: {stps: 3}}}", "variants.demo.train.stps is not a key; did you mean variants.demo.train.steps?"),
        ("assets={face_landmarker: x}", "assets.face_landmarker is not known; did you mean face_landmarker.task?"),
    ],
)
def test_config_of_a_run(pipeline: Pipeline, argument: str, expected: str) -> None:
    pipeline.add_video("ann")
    assert expected in sentence(pipeline.run("-n", "--config", argument))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("extrct: {size: 256}", "config: extrct is not a key; did you mean extract?"),
        ("extract: {zzz: 1}", "extract.zzz is not a key; the keys there are "),
        ("extract: {size: 100000}", "extract.size is 100000, but input should be less than or equal to 2048"),
        ("extract: {size: big}", "extract.size is big, but input should be a valid integer"),
        ("extract: {size: 1, max_frames: 1}", "extract.size is 1, but input should be greater than or equal to 64; extract.max"),
        ("variants: {demo: {train: {steps: -3}}}", "variants.demo.train.steps is -3, but"),
        ("variants: {demo: {prset: fast}}", "variants.demo.prset is not a key; did you mean variants.demo.preset?"),
        (
            "variants: {demo: {preset: quick}}",
            "config/presets: there is no preset 'quick'; the presets are balanced, demo, fast, layers, paper",
        ),
        ("variants: {fit: {preset: demo}}", "variants.fit: this name is taken"),
        ("variants: {export: {preset: demo}}", "variants.export: this name is taken"),
        ("variants: {mean_frame: {preset: demo}}", "variants.mean_frame: this name is taken"),
        ("variants: {a/b: {preset: demo}}", "variants.a/b: use letters, digits, _ and - only"),
        ("variants: {}", "variants is empty; name at least one"),
    ],
)
def test_config(text: str, expected: str) -> None:
    raw = yaml.safe_load(text)
    models = {"train": TrainConfig, "render": RenderConfig}
    with pytest.raises(settings.SettingsError) as error:
        found = settings.validated(Settings, raw, "config")
        settings.resolve_variants(found.variants, REPOSITORY / "config" / "presets", models, "config")
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_preset_with_a_key_of_data_preparation(pipeline: Pipeline) -> None:
    pipeline.add_video("ann")
    (pipeline.folder / "config" / "presets" / "demo.yaml").write_text("extract: {size: 64}\n")
    assert "demo.yaml: extract is not a key; a preset holds train and render only" in sentence(pipeline.run("-n"))


def test_preset_with_a_misspelt_key_names_the_file(pipeline: Pipeline) -> None:
    pipeline.add_video("ann")
    (pipeline.folder / "config" / "presets" / "demo.yaml").write_text("train: {seeed: 1}\n")
    said = sentence(pipeline.run("-n"))
    assert "presets/demo.yaml: train.seeed is not a key; did you mean train.seed?" in said


def test_names_with_spaces_quotes_and_letters_of_any_script(pipeline: Pipeline) -> None:
    names = ("Zoë März 2", "李雷", "it's (me) & $HOME")
    for name in names:
        pipeline.add_video(name)
    result = pipeline.run()
    assert result.code == 0, result.text
    assert result.last_line == "3 of 3 subjects have an avatar"
    made = {path.parent.name for path in (pipeline.folder / "results").glob("*/page")}
    assert made == {"Zoë_März_2", "李雷", "it_s_me_HOME"}
    command = json.loads((pipeline.folder / "results" / "Zoë_März_2" / "frames" / "frames.json").read_text())
    assert "video=videos/Zoë März 2.mp4" in command
    assert pipeline.plan() == set()


def test_a_name_of_the_pipeline_itself(pipeline: Pipeline) -> None:
    pipeline.add_video("tables")
    assert "videos/tables.mp4: this name cannot be used for a subject" in sentence(pipeline.run())


def test_decomposed_and_composed_letters_are_one_subject(tmp_path: Path) -> None:
    assert settings.subject_name("Zoe\u0308") == settings.subject_name("Zoë") == "Zoë"


def test_no_subject_looks_like_an_option() -> None:
    assert [settings.subject_name(stem) for stem in ("-x", "- ann", "_-1-", "---")] == ["x", "ann", "1-", ""]


def test_a_mistake_in_the_config_leaves_what_is_made(pipeline: Pipeline) -> None:
    pipeline.add_video("ann")
    assert pipeline.run().code == 0
    before = sorted((pipeline.folder / "results").rglob("*"))
    sentence(pipeline.run("--config", "extract={size: 1}"))
    assert sorted((pipeline.folder / "results").rglob("*")) == before
    assert pipeline.plan() == set()


def test_planning_imports_no_heavy_package(pipeline: Pipeline) -> None:
    """Every cluster job parses the Snakefile again."""
    pipeline.add_video("ann")
    report = "import atexit, sys; atexit.register(lambda: print('IMPORTED', *sys.modules)); "
    code = report + "from snakemake.cli import main; main(['-n'])"
    done = subprocess.run([sys.executable, "-c", code], cwd=pipeline.folder, capture_output=True, text=True, check=True)
    imported = set(done.stdout.rpartition("IMPORTED")[2].split())
    assert "avatar.config" in imported
    assert not imported & {"torch", "cv2", "mediapipe", "numba", "scipy", "anny", "fitting.head_model"}


def test_no_variant_can_take_a_folder_that_a_rule_writes() -> None:
    written = set()
    for path in (REPOSITORY / "workflow" / "rules").glob("*.smk"):
        written |= set(re.findall(r"results/\{subject\}/([a-z_]+)/", path.read_text()))
    assert {"fit", "export"} <= written <= settings.RESERVED_VARIANTS
