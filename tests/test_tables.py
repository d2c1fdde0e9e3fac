"""The tables, continued: regions, a second network, reasons from logs, published renders."""

import csv
import json
from pathlib import Path

import pandas as pd
import pytest
from test_tabulate import cells_of, make, run, three_subjects, two_subjects

from avatar.report import tabulate


@pytest.fixture
def three(tmp_path: Path) -> dict[str, list[Path]]:
    return three_subjects(tmp_path)


@pytest.fixture
def two(tmp_path: Path) -> dict[str, list[Path]]:
    return two_subjects(tmp_path)


def log(root: Path, name: str, *lines: str) -> Path:
    """A step's log."""
    path = root / "logs" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


def test_regions_each_with_its_own_table(tmp_path: Path, two: dict[str, list[Path]]) -> None:
    text = make(tmp_path, two)
    titles = [line for line in text["regions_markdown"].splitlines() if ": LPIPS" in line]
    assert [title.split()[0] for title in titles] == ["Face", "Mouth", "Eyes"]
    assert [cells_of(text["regions_markdown"], place)[2][1] for place in range(3)] == [
        f"**{0.1 + shift / 100:.3f}** / **0.900** / **{26 - shift:.2f}**" for shift in (1, 2, 3)
    ]
    assert "inside face, mouth, eyes" in text["regions_latex"] and "inside face" not in text["latex"]
    assert text["regions_latex"].count(r"\multicolumn") == 3 and r"\textbf{0.120}" in text["regions_latex"]


def test_a_region_without_face_or_not_measured_is_said(tmp_path: Path, two: dict[str, list[Path]]) -> None:
    path = next(path for path in two["per_frames"] if "ann/demo" in str(path))
    table = pd.read_csv(path, dtype=str, keep_default_na=False)
    inside = [name for name in table if name.endswith(("_face", "_mouth"))]
    table.loc[2:, [name for name in inside if name.endswith("_face")]] = ""
    table[[name for name in inside if name.endswith("_mouth")]] = ""
    table["note"] = "no face landmarks"
    table[[name for name in table if not name.endswith("_eyes")]].to_csv(path, index=False)
    text = make(tmp_path, two)
    faces, mouths, eyes = (cells_of(text["regions_markdown"], place)[2][1] for place in range(3))
    assert (faces, mouths, eyes) == ("**0.110** / **0.900** / **25.00** (2 of 10 frames)", "no face", "not measured")
    row = next(row for row in csv.DictReader(text["csv"].splitlines()) if row["variant"] == "demo")
    assert row["psnr_mouth_n"] == "0" and "no face in any scored frame: psnr_mouth" in row["note"]
    assert "not measured: psnr_eyes" in row["note"]
    frame = next(csv.DictReader(text["per_frame"].splitlines()))
    assert "no face landmarks; not measured: psnr_eyes" in frame["note"]


def test_vgg_has_a_table_of_its_own_where_it_was_measured(tmp_path: Path, two: dict[str, list[Path]]) -> None:
    for path in two["per_frames"]:
        pd.read_csv(path, keep_default_na=False).assign(lpips_vgg=0.25).to_csv(path, index=False)
    text = make(tmp_path, two)
    assert "LPIPS (VGG16) ↓." in text["markdown"] and cells_of(text["markdown"], 1)[2][1] == "**0.250**"
    assert "LPIPS (VGG16)" in text["latex"]


def test_reasons_come_from_the_logs(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    killed = "12:00:01 avatar.render[eve] rendering: 9 of 12, 0.1 a second"
    three["logs"] = [
        log(tmp_path, "eve/demo/train.log", "12:00:00 avatar.train[eve] step 1", "12:00:01 avatar.train[eve] diverged at step 2"),
        log(tmp_path, "eve/nearest_frame/render.log", killed),
        log(tmp_path, "cem/fit.log", "12:00:01 fitting.fit[cem] failed; the traceback follows", "Traceback", "ValueError: x | y"),
    ]
    _, cells, text = run(tmp_path, three, subjects=["ann", "bob", "eve", "cem"])
    assert cells[4][1].endswith("eve/demo/train.log ends “diverged at step 2”") and cells[4][1].startswith("failed: ")
    assert cells[4][3].endswith("render.log ends “rendering: 9 of 12, 0.1 a second”")
    assert cells[5][0] == "cem" and cells[5][1].endswith(r"fit.log ends “ValueError: x \| y”")
    assert "1 subject failed (cem)" in text


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ((), "failed: see "),
        (("12:00:00 avatar.train[a] done in 3.1 s",), "its result is gone"),
        (("12:00:00 avatar.train[a] " + "x" * 1000,), "x…”"),
    ],
)
def test_words_of_a_log(tmp_path: Path, lines: tuple[str, ...], said: str) -> None:
    reason = tabulate.log_reason(log(tmp_path, "a/demo/train.log", *lines))
    assert said in reason and len(reason) < 600


def test_a_per_frame_file_that_is_gone_is_said(tmp_path: Path, two: dict[str, list[Path]]) -> None:
    """The means that metrics.json stores are not taken in its place."""
    two["per_frames"] = [path for path in two["per_frames"] if "ann/demo" not in str(path)]
    _, cells, _ = run(tmp_path, two)
    assert cells[2][1].endswith("ann/demo/metrics/per_frame.csv is gone; run snakemake again")


def test_published_renders_are_marked(tmp_path: Path, two: dict[str, list[Path]]) -> None:
    path = next(path for path in two["metrics"] if "ann/demo" in str(path))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"kind": "published"}))
    text = make(tmp_path, two)
    assert (
        "demo (published)" in text["markdown"] and "- published: published renders, trained on other frames" in text["markdown"]
    )
    assert r"demo$^\dagger$" in text["latex"] and "trained on other frames" in text["latex"]
