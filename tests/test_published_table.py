"""What comes of a comparison: the table, the strip of pictures, the plan, and mistakes in the config."""

from __future__ import annotations

import json
from pathlib import Path

import made_subject as made
import numpy as np
import pandas as pd
import pytest
from made_comparison import CHOSEN, PANELS, SCORED, SIZE, make, placed, score, whole
from PIL import Image
from pipeline import Pipeline
from toy_run import job

from avatar.published import strip as published_strip
from avatar.published import table as published_table
from avatar.published.config import PublishedStripConfig, PublishedTableConfig
from avatar.report import tables
from avatar.settings import Settings
from workflow import settings
from workflow.step import StepError


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    return make(tmp_path)


# ---- table and strip


@pytest.fixture
def scored(files: dict[str, Path], tmp_path: Path) -> tuple[list[Path], list[Path]]:
    renders = np.full((len(made.TEST), made.HEIGHT, made.WIDTH, 4), 200, np.uint8)
    out = placed(files, tmp_path / "mean", renders, made.TEST)
    train = tmp_path / "train.json"
    train.write_text(json.dumps({"train_seconds": 600.0}))
    score(files, tmp_path, "Shifted", "published")
    score(files, tmp_path, "mean_frame", "predictor", **out)
    score(files, tmp_path, "my_demo", "avatar", **out, train=train)
    methods = ("Shifted", "mean_frame", "my_demo")
    return [[tmp_path / method / name for method in methods] for name in ("metrics.json", "per_frame.csv")]


def tabulated(scored: tuple[list[Path], list[Path]], folder: Path) -> dict[str, Path]:
    outputs = {"csv": folder / "table.csv", "markdown": folder / "table.md", "latex": folder / "table.tex"}
    published_table.run(job(PublishedTableConfig(), {"metrics": scored[0], "per_frames": scored[1]}, outputs))
    return outputs


def test_table(scored: tuple[list[Path], list[Path]], tmp_path: Path) -> None:
    outputs = tabulated(scored, tmp_path)
    table = pd.read_csv(outputs["csv"]).set_index("method")
    assert table.index.tolist() == ["my_demo", "mean_frame", "Shifted"]
    assert table.loc["Shifted", "psnr_mean"] == pytest.approx(pd.read_csv(scored[1][0])["psnr"].mean(), abs=1e-5)
    assert (table["scored_frames"] == len(SCORED)).all() and (table["excluded_frames"] == 4 - len(SCORED)).all()
    assert "other frames" in table.loc["Shifted", "trained"] and "first 16 frames" in table.loc["my_demo", "trained"]
    text = outputs["markdown"].read_text()
    row = next(line for line in text.splitlines() if line.startswith("| Shifted"))
    assert row.count("**") == 2 * 12 and f"| {len(SCORED)} of 4 |" in row  # best in head, face, mouth and eyes
    assert text.count("<ins>") == 2 * 12  # two methods of the same pixels share the second place
    assert "my_demo: 10 minutes of training" in text and "clothes and shoulders" in text
    latex = outputs["latex"].read_text()
    assert r"my\_demo" in latex and r"\textbf{" in latex and r"\underline{" in latex and r"\midrule" in latex
    assert latex.index("Trained here") < latex.index("Not trained") < latex.index("Published: trained on other frames")


def test_table_refuses_other_frames_and_says_where_a_region_is_missing(
    scored: tuple[list[Path], list[Path]], tmp_path: Path
) -> None:
    table = pd.read_csv(scored[1][2])
    table[[name for name in table if name.endswith("_eyes")]] = np.nan
    table.to_csv(scored[1][2], index=False)
    assert tables.NO_FACE in tabulated(scored, tmp_path)["markdown"].read_text()
    table.iloc[1:].to_csv(scored[1][2], index=False)
    with pytest.raises(StepError, match="other frames than in"):
        tabulated(scored, tmp_path)


def test_strip_shows_every_method_and_says_that_it_is_synthetic(files: dict[str, Path], tmp_path: Path) -> None:
    renders = np.full((len(made.TEST), made.HEIGHT, made.WIDTH, 4), 200, np.uint8)
    out = placed(files, tmp_path / "mean", renders, made.TEST)
    avatar = tmp_path / "avatar.pt"
    avatar.write_bytes(b"weights")
    config = PublishedStripConfig(panels=PANELS, variants=("demo",))
    outputs = {"picture": tmp_path / "strip.png"}
    published_strip.run(job(config, {"video": files["video"], "png": out["png"], "avatars": avatar}, outputs))
    picture = Image.open(outputs["picture"])
    assert "avatar sha256:" in picture.text["Comment"]
    pixels = np.asarray(picture)
    height = pixels.shape[0] // 4
    caption = height - SIZE[0]
    assert pixels.shape == (4 * height, 4 * SIZE[1] + 3 * 4, 3)
    number = CHOSEN[1]
    driving = pixels[height + caption : 2 * height, : SIZE[1]]
    assert np.array_equal(driving, whole(number)[:, : SIZE[1]])
    good = pixels[height + caption : 2 * height, 2 * (SIZE[1] + 4) :][:, : SIZE[1]]
    assert np.array_equal(good, whole(number)[:, SIZE[1] : 2 * SIZE[1]])


# ---- plan and config

PREPARED = "probe extract matte detect split fit trim"


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Pipeline:
    pipeline = Pipeline.create(tmp_path_factory.mktemp("published") / "run", ("ann",))
    named = "comparisons: {x: {video: clip.mp4, panels: [driving, A, B], test_frames: 7}}"
    pipeline.write_config(f"videos: videos\nvariants: {{demo: {{preset: demo}}}}\n{named}\n")
    (pipeline.folder / "clip.mp4").write_text("a comparison")
    return pipeline


def test_the_driving_panel_is_a_subject_of_its_own(pipeline: Pipeline) -> None:
    planned = pipeline.plan("compare_published")
    assert {f"{rule} published.x" for rule in PREPARED.split()} <= planned
    assert {"train published.x/demo", "published_render demo", "published_place mean_frame", "published_strip"} <= planned
    assert not any("ann" in job.split()[-1].split("/") for job in planned)
    printed = pipeline.run("-n", "-p", "compare_published").text
    assert printed.count("-m avatar.published.score") == 5  # one avatar, two predictors, two panels
    split = next(line for line in printed.splitlines() if "-m fitting.split" in line)
    assert '"test_frames":7' in split
    assert not any("published" in job for job in pipeline.plan())  # `all` asks for none of it


def test_comparisons_that_are_not_there(pipeline: Pipeline) -> None:
    clip = pipeline.folder / "clip.mp4"
    clip.rename(clip.with_suffix(".away"))
    result = pipeline.run("-n", "compare_published")
    clip.with_suffix(".away").rename(clip)
    assert result.code and "comparisons.x.video: there is no file clip.mp4" in result.text
    pipeline.write_config("videos: videos\n")
    result = pipeline.run("-n", "compare_published")
    assert result.code and "comparisons names no comparison video" in result.text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"strid": 3}, r"comparisons.x.strid is not a key; did you mean comparisons.x.stride"),
        ({"panels": ["driving", "A", "a"]}, "not told apart"),
        ({"panels": ["driving", "A/b"]}, "becomes a folder's name"),
        ({"driving": "Driving"}, "driving is Driving, but the panels are driving, A"),
        ({"panels": ["driving"]}, "at least 2 items"),
        ({"test_frames": 0}, "greater than or equal to 1"),
    ],
)
def test_config_mistakes_are_one_sentence(changes: dict[str, object], message: str) -> None:
    good = {"video": "clip.mp4", "panels": ["driving", "A"]}
    settings.validated(Settings, {"comparisons": {"x": good}}, "config")
    with pytest.raises(settings.SettingsError, match=message):
        settings.validated(Settings, {"comparisons": {"x": good | changes}}, "config")
    with pytest.raises(settings.SettingsError, match="'x y' must be of letters"):
        settings.validated(Settings, {"comparisons": {"x y": good}}, "config")
