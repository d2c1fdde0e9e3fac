"""The table: its layout, its best figures, and that no cell is empty without a reason."""

import csv
import json
from pathlib import Path

import made_subject as made
import pytest

from avatar import tabulate
from avatar.config import TabulateConfig
from workflow import step


def result(
    lpips: float, ssim: float, psnr: float, predictor: bool = False, excluded: int = 0, seconds: float | None = None
) -> dict:
    values = {"psnr": psnr, "ssim": ssim, "lpips": lpips, "l1": 0.02, "iou": 0.97, "psnr_face": psnr - 1, "lpips_face": lpips / 2}
    return {
        "predictor": predictor,
        "metrics": {name: {"mean": value, "std": 0.1, "n": 10} for name, value in values.items()},
        "test_frames": 10 + excluded,
        "scored_frames": 10,
        "excluded": {"count": excluded, "reason": "", "frames": []},
        "ms_per_frame": 80.0,
        "training_seconds": seconds,
        "protocol": {"background": "white", "resolution": "64x64", "frames": "10"},
    }


def write(root: Path, probes: dict[str, str | None], results: dict[str, dict[str, dict]]) -> dict[str, list[Path]]:
    """Files of several subjects: the reason of a rejection or None by subject, and metrics by subject and variant."""
    paths: dict[str, list[Path]] = {"probes": [], "metrics": []}
    for subject, reason in probes.items():
        paths["probes"].append(root / subject / "probe" / "probe.json")
        paths["probes"][-1].parent.mkdir(parents=True, exist_ok=True)
        paths["probes"][-1].write_text(json.dumps({"accepted": reason is None, "reason": reason}))
    for subject, variants in results.items():
        for variant, content in variants.items():
            paths["metrics"].append(root / subject / variant / "metrics" / "metrics.json")
            paths["metrics"][-1].parent.mkdir(parents=True, exist_ok=True)
            paths["metrics"][-1].write_text(json.dumps(content))
    return paths


def run(tmp_path: Path, inputs: dict[str, list[Path]], **config: list[str]) -> tuple[list[dict[str, str]], list[list[str]], str]:
    """csv rows, cells of the first Markdown table, the whole Markdown."""
    out = {"csv": tmp_path / "tables" / "metrics.csv", "markdown": tmp_path / "tables" / "metrics.md"}
    step.main(tabulate.run, TabulateConfig, made.arguments(config, inputs, out))
    text = out["markdown"].read_text()
    first = text.split("\n\n")[1].splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in first]
    with open(out["csv"], newline="") as file:
        return list(csv.DictReader(file)), cells, text


@pytest.fixture
def three(tmp_path: Path) -> dict[str, list[Path]]:
    """One whole subject, one rejected, one of which a variant is missing."""
    ann = {
        "mean_frame": result(0.35, 0.83, 18.5, True),
        "nearest_frame": result(0.12, 0.86, 20.8, True),
        "demo": result(0.091, 0.8604, 25.456, seconds=612.4),
    }
    eve = {"mean_frame": result(0.3, 0.9, 21.0, True, excluded=2)}
    return write(
        tmp_path,
        {"ann": None, "bob": "bob.mp4: no face in any of 48 sampled frames; film one face", "eve": None},
        {"ann": ann, "eve": eve},
    )


def test_layout_of_table_1(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    _, cells, text = run(tmp_path, three)
    assert cells[0] == ["subject", "demo", "mean_frame (predictor)", "nearest_frame (predictor)", "test frames"]
    assert cells[2] == ["ann", "**0.091** / **0.860** / **25.46**", "0.350 / 0.830 / 18.50", "0.120 / **0.860** / 20.80", "10"]
    assert "LPIPS / SSIM / PSNR" in text and "- background: white" in text and "80.0 ms / 612 s" in text


def test_one_row_for_every_subject(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    rows, cells, _ = run(tmp_path, three)
    assert [line[0] for line in cells[2:]] == ["ann", "bob", "eve"]
    assert cells[3][1] == "rejected: bob.mp4: no face in any of 48 sampled frames; film one face" and cells[3][-1] == "0"
    assert cells[4] == [
        "eve",
        "failed: see logs/eve/demo/",
        "0.300 / 0.900 / 21.00",
        "failed: see logs/eve/nearest_frame/",
        "10 of 12",
    ]
    assert all(cell for line in cells for cell in line)
    status = {(row["subject"], row["variant"]): row["status"] for row in rows}
    assert status[("bob", "")] == "rejected" and status[("eve", "demo")] == "failed" and status[("ann", "demo")] == "ok"


def test_csv_has_every_aggregate_and_no_empty_field_without_a_note(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    rows, _, _ = run(tmp_path, three)
    demo = next(row for row in rows if (row["subject"], row["variant"]) == ("ann", "demo"))
    assert float(demo["psnr_mean"]) == 25.456 and float(demo["training_seconds"]) == 612.4 and demo["psnr_n"] == "10"
    for name in ("psnr", "ssim", "lpips", "l1", "iou", "psnr_face", "lpips_face"):
        assert demo[f"{name}_mean"] and demo[f"{name}_std"]
    for row in rows:
        assert row["note"] or all(value for name, value in row.items() if name != "note"), row


def test_expected_subjects_and_variants_are_rows_and_columns(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    rows, cells, _ = run(tmp_path, three, subjects=["zoe", "ann"], variants=["large", "demo"])
    assert cells[0][1:3] == ["large", "demo"] and [line[0] for line in cells[2:]] == ["zoe", "ann", "bob", "eve"]
    assert cells[2][1] == "failed: see logs/zoe/" and cells[3][1] == "failed: see logs/ann/large/"
    assert {row["status"] for row in rows if row["subject"] == "zoe"} == {"failed"}


def test_only_rejected_subjects(tmp_path: Path) -> None:
    _, cells, _ = run(tmp_path, write(tmp_path, {"bob": "too short | dark"}, {}))
    assert cells[0] == ["subject", "result", "test frames"]
    assert "rejected: too short \\" in cells[2][1]


def test_nothing_at_all_is_one_sentence(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SystemExit):
        run(tmp_path, {})
    assert "nothing to tabulate" in caplog.text
