"""The ablation's table, claims and plot, from made-up rows."""

from __future__ import annotations

import csv
import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import SimpleNamespace

import pytest
from test_latex import check

from avatar.ablation import report as ablation_report
from avatar.ablation import settings as ablation_settings
from avatar.ablation import table as ablation_table
from avatar.ablation.config import AblationTableConfig
from avatar.ablation.report import Results
from workflow import step

SUBJECT = ablation_settings.SUBJECT
ENDS = {"csv": "csv", "markdown": "md", "latex": "tex", "plot": "svg"}
SVG = "{http://www.w3.org/2000/svg}"
LPIPS = {"static": 0.16, "codes": 0.17, "codes_mlp": 0.155, "ours_c": 0.14, "ours_d": 0.145, "displacement_mlp": 0.15}


def row(lpips: float, doubled: float | None = None) -> dict:
    """A row as the step writes it."""
    scores = {"test": {"lpips": lpips, "ssim": 0.9, "psnr": 30 - 10 * lpips, "frames": 24}}
    if doubled is not None:
        scores["doubled"] = {"lpips": doubled, "ssim": 0.8, "psnr": 25.0, "frames": 24}
    budget = {"steps": 2000, "train_seconds": 180.0, "skipped_steps": 0, "training_frames": 267, "load": 1.5}
    return budget | {"scores": scores}


def made() -> dict[tuple[str, str, int], dict]:
    """Three seeds 0.001 apart on the simulated subject; one on a real one, where everything is upside down."""
    rows = {}
    for name, lpips in LPIPS.items():
        for seed in (0, 1, 2):
            rows[SUBJECT, name, seed] = row(lpips + 0.001 * seed, 2 * lpips)
        rows["ann", name, 0] = row(0.3 - lpips)
    for seed in (0, 1, 2):
        rows[SUBJECT, "ours_c_half", seed] = row(0.20 + 0.001 * seed)
        rows[SUBJECT, "ours_d_half", seed] = row(0.16 + 0.001 * seed)
        rows[SUBJECT, "ours_d_table", seed] = row(0.12)
        rows[SUBJECT, "ours_d_table_half", seed] = row(0.13)
        rows[SUBJECT, "ours_d_table_warp", seed] = row(0.142)
        rows[SUBJECT, "ours_d_table_true", seed] = row(0.09)
    return rows


def results(rows: dict[tuple[str, str, int], dict]) -> Results:
    return Results([row | dict(zip(("subject", "cell", "seed"), key, strict=True)) for key, row in rows.items()])


def collect(folder: Path, rows: dict[tuple[str, str, int], dict]) -> SimpleNamespace:
    """Run the step on made-up rows; its outputs."""
    paths = []
    for (subject, cell, seed), content in rows.items():
        paths.append(folder / "rows" / subject / cell / f"{seed}.json")
        paths[-1].parent.mkdir(parents=True, exist_ok=True)
        paths[-1].write_text(json.dumps(content))
    output = SimpleNamespace(**{name: folder / f"t.{end}" for name, end in ENDS.items()})
    log = SimpleNamespace(info=lambda *_: None)
    ablation_table.run(step.Job(AblationTableConfig(), SimpleNamespace(rows=paths), output, output, "all", 1, "cpu", "", log))
    return output


def test_mean_spread_and_losses() -> None:
    found = results(made())
    figure = found.figure(SUBJECT, "ours_c", "lpips")
    assert (figure.mean, figure.spread, figure.seeds) == (pytest.approx(0.141), pytest.approx(0.001), 3)
    assert figure.text(4) == "0.1410 ± 0.0010" and found.figure("ann", "ours_c", "lpips").text(3) == "0.160"
    loss = found.loss(SUBJECT, "ours_c", "half")  # seed by seed: what seeds share drops out
    assert (loss.mean, loss.spread) == (pytest.approx(0.06), pytest.approx(0, abs=1e-9))
    assert found.loss(SUBJECT, "ours_d", "doubled").mean == pytest.approx(0.29 - 0.146)
    assert found.loss("ann", "ours_d", "doubled") is None and found.figure("ann", "ours_d_table_true", "lpips") is None
    assert found.subjects == [SUBJECT, "ann"]


def test_claims_are_computed() -> None:
    beats, half, doubled = ablation_report.claims(results(made()), False)
    assert "held on 1 of 2 subjects" in beats
    assert "the worse of the two is Ours-D 0.1460 ± 0.0010, the best other 3DMM Codes MLP 0.1560 ± 0.0010;" in beats
    assert half.endswith("held (talk_0_360_bald (simulated): D +0.0150 ± 0.0000, C +0.0600 ± 0.0000).")
    assert "did not hold" in doubled and "D +0.1440 ± 0.0010, C +0.1390 ± 0.0010" in doubled
    rows = made()
    rows[SUBJECT, "ours_d", 2] = row(0.19)
    assert "the worse of the two is Ours-D 0.1603 ± 0.0225" in ablation_report.claims(results(rows), False)[0]
    assert "within the spread over seeds" in ablation_report.claims(results(rows), False)[0]
    assert ablation_report.claims(results({("ann", "static", 0): row(0.1)}), False)[0].endswith("not measured.")


def test_markdown_has_the_papers_layout(tmp_path: Path) -> None:
    text = collect(tmp_path, made()).markdown.read_text()
    title = "| subject | Static features | 3DMM Codes | 3DMM Codes MLP | Ours-C | Ours-D | Displacement MLP |"
    assert text.count(title) == 8  # three metrics and doubled codes, twice
    line = "| talk_0_360_bald (simulated) | 0.1610 ± 0.0010 | 0.1710 ± 0.0010 | 0.1560 ± 0.0010 | **0.1410 ± 0.0010** | "
    assert line + "<ins>0.1460 ± 0.0010</ins> |" in text and "| ann | <ins>0.1400</ins> | **0.1300** |" in text
    assert "| ann | not run | not run | not run | not run |" in text.split("first half")[1]
    constant = text.split("## On a learned constant")[1]
    none = "not run | not run"
    assert f"| <ins>0.1610 ± 0.0010</ins> | 0.1710 ± 0.0010 | {none} | **0.1200 ± 0.0000** | not run |" in constant
    assert "not measured." in constant and "| 0.1300 ± 0.0000 | 0.0100 ± 0.0000 |" in constant
    assert "true head and parameters | 0.0900 ± 0.0000 |" in text and "2000 steps of 256 rays" in text
    assert "180 s each in the median" in text and "nan" not in text.lower()


def test_latex_has_the_papers_layout(tmp_path: Path) -> None:
    rows = made() | {("Zoë_2", name, 0): row(lpips) for name, lpips in LPIPS.items()}
    rows |= {("Zoë_2", "ours_c_half", 0): row(0.1300), ("Zoë_2", "ours_d_half", 0): row(0.1450)}
    source = collect(tmp_path, rows).latex.read_text()
    check(source)
    assert source.count(r"\begin{table") == 2 and source.count(r"\multicolumn") == 6
    lines = source.split(r"\begin{table")[1].splitlines()
    assert r" & \textit{talk\_0\_360\_bald (simulated)} & \textit{Zoë\_2} & \textit{ann} \\" in lines
    spread = r" {\scriptsize $\pm$ 0.0010}"
    assert rf"Ours-C & \textbf{{0.1410}}{spread} & \textbf{{0.1400}} & 0.1600 \\" in lines
    assert rf"Ours-D & \underline{{0.1460}}{spread} & \underline{{0.1450}} & 0.1550 \\" in lines
    place = lines.index(rf"Ours-C & 0.2010{spread} & 0.1300 & not run \\")
    assert lines[place - 2].startswith(r"\multicolumn{4}{c}{\footnotesize \textit{First $50\%$ Training Data}}")
    worse, better = r"\textcolor{red}{+0.0600}", r"\textcolor[rgb]{0,0.5,0}{-0.0100}"
    assert lines[place + 1] == rf" & {worse} & {better} & no comparison \\"
    assert r"unknown\textsuperscript" in source and "no true pictures of doubled codes" in source


def test_failed_and_missing_cells_are_said(tmp_path: Path) -> None:
    rows = made() | {(SUBJECT, "codes", 1): {"load": 1.0, "failed": "training diverges at step 3"}}
    text = collect(tmp_path, rows).markdown.read_text()
    assert f"- {SUBJECT}, codes, seed 1: training diverges at step 3" in text
    assert "0.1710 ± 0.0010" in text  # the other two seeds
    rows |= {("ann", "codes", 0): {"load": 1.0, "failed": "out of 100% luck"}}
    found = collect(tmp_path / "two", rows)
    assert "| ann | **0.1400** | failed, see below |" in found.markdown.read_text()
    source = found.latex.read_text()
    assert r"& failed\textsuperscript{1} \\" in source
    assert r"\textsuperscript{1}\,out of 100\% luck" in source
    check(source)
    alone = collect(tmp_path / "one", {("ann", "static", 0): {"load": 1.0, "failed": "dark"}})
    assert "Not measured." in alone.markdown.read_text() and r"\begin" not in alone.latex.read_text()
    ElementTree.parse(alone.plot)


def test_csv_and_plot(tmp_path: Path) -> None:
    output = collect(tmp_path, made())
    with open(output.csv, newline="") as file:
        found = {(line["subject"], line["cell"], int(line["seed"])): line for line in csv.DictReader(file)}
    assert set(found) == set(made()) and float(found[SUBJECT, "ours_d", 1]["test_lpips"]) == pytest.approx(0.146)
    assert found["ann", "ours_d", 0]["doubled_lpips"] == "" and found["ann", "ours_d", 0]["steps"] == "2000"
    marks = {item.get("id") for item in ElementTree.parse(output.plot).getroot().iter(f"{SVG}g")}
    assert {f"{SUBJECT}-ours_d-doubled", f"{SUBJECT}-ours_d_table_true-test", "ann-static-test"} <= marks
    assert "ann-static-doubled" not in marks


def test_a_score_that_is_not_a_number_is_named(tmp_path: Path) -> None:
    with pytest.raises(step.StepError, match=r"0\.json: lpips of the test frames is nan"):
        collect(tmp_path, {("ann", "codes", 0): row(float("nan"))})


def test_a_damaged_row_is_named(tmp_path: Path) -> None:
    with pytest.raises(step.StepError, match=r"0\.json: scores is missing"):
        collect(tmp_path, {("ann", "codes", 0): {"load": 1.0}})
