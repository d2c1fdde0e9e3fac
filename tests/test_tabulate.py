"""The tables: figures from per-frame files alone, their layout, their best figures, and no cell empty without a reason."""

import csv
import json
from pathlib import Path

import made_subject as made
import pandas as pd
import pytest

from avatar.report import tables, tabulate
from avatar.report.config import TabulateConfig
from workflow import step

OUTPUTS = {
    "csv": "metrics.csv",
    "per_frame": "per_frame.csv",
    "markdown": "metrics.md",
    "latex": "metrics.tex",
    "regions_markdown": "regions.md",
    "regions_latex": "regions.tex",
}
FRAMES = 10


def result(
    lpips: float, ssim: float, psnr: float, predictor: bool = False, excluded: int = 0, seconds: float | None = None
) -> dict:
    values = {"psnr": psnr, "ssim": ssim, "lpips": lpips, "l1": 0.02, "iou": 0.97, "psnr_face": psnr - 1, "lpips_face": lpips / 2}
    return {
        "predictor": predictor,
        "metrics": {name: {"mean": value, "std": 0.1, "n": FRAMES} for name, value in values.items()},
        "test_frames": FRAMES + excluded,
        "scored_frames": FRAMES,
        "excluded": {"count": excluded, "reason": "", "frames": []},
        "ms_per_frame": 80.0,
        "training_seconds": seconds,
        "protocol": {"background": "white", "resolution": "64x64", "frames": "10"},
    }


def frames_of(content: dict, regions: bool = False) -> pd.DataFrame:
    """Ten frames around the means of `result`, half of them 0.1 % above and half below; an old file has no mouth and no eyes."""
    means = {name: value["mean"] for name, value in content["metrics"].items()}
    if regions:
        for region, shift in (("face", 1.0), ("mouth", 2.0), ("eyes", 3.0)):
            means |= {f"psnr_{region}": means["psnr"] - shift, f"ssim_{region}": means["ssim"], f"l1_{region}": 0.03}
            means[f"lpips_{region}"] = means["lpips"] + shift / 100
    wave = [1.001, 0.999] * (FRAMES // 2)
    table = pd.DataFrame({"frame": range(100, 100 + FRAMES)})
    for name in sorted(means, key=tables.COLUMNS.index):
        table[name] = [means[name] * factor for factor in wave]
    return table.assign(note="")


def write(
    root: Path, probes: dict[str, str | None], results: dict[str, dict[str, dict]], regions: bool = False
) -> dict[str, list[Path]]:
    """Files of several subjects: the reason of a rejection or None by subject, and metrics by subject and variant."""
    paths: dict[str, list[Path]] = {"probes": [], "metrics": [], "per_frames": []}
    for subject, reason in probes.items():
        paths["probes"].append(root / subject / "probe" / "probe.json")
        paths["probes"][-1].parent.mkdir(parents=True, exist_ok=True)
        paths["probes"][-1].write_text(json.dumps({"accepted": reason is None, "reason": reason}))
    for subject, variants in results.items():
        for variant, content in variants.items():
            folder = root / subject / variant / "metrics"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "metrics.json").write_text(json.dumps(content))
            frames_of(content, regions).to_csv(folder / "per_frame.csv", index=False, float_format="%.6f")
            paths["metrics"].append(folder / "metrics.json")
            paths["per_frames"].append(folder / "per_frame.csv")
    return paths


def make(tmp_path: Path, inputs: dict[str, list[Path]], **config: list[str]) -> dict[str, str]:
    """Text of each output."""
    out = {name: tmp_path / "tables" / file for name, file in OUTPUTS.items()}
    step.main(tabulate.run, TabulateConfig, made.arguments(config, inputs, out))
    return {name: path.read_text() for name, path in out.items()}


def cells_of(text: str, table: int = 0) -> list[list[str]]:
    """Cells of a Markdown table, header and ruler first."""
    found = [part for part in text.split("\n\n") if part.startswith("|")][table]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in found.splitlines()]


def run(tmp_path: Path, inputs: dict[str, list[Path]], **config: list[str]) -> tuple[list[dict[str, str]], list[list[str]], str]:
    """csv rows, cells of the first Markdown table, the whole Markdown."""
    text = make(tmp_path, inputs, **config)
    return list(csv.DictReader(text["csv"].splitlines())), cells_of(text["markdown"]), text["markdown"]


def three_subjects(root: Path) -> dict[str, list[Path]]:
    """One whole subject, one rejected, one of which a variant is missing."""
    ann = {
        "mean_frame": result(0.35, 0.83, 18.5, True),
        "nearest_frame": result(0.12, 0.8602, 20.8, True),
        "demo": result(0.091, 0.8604, 25.456, seconds=612.4),
    }
    eve = {"mean_frame": result(0.3, 0.9, 21.0, True, excluded=2)}
    return write(
        root,
        {"ann": None, "bob": "bob.mp4: no face in any of 48 sampled frames; film one face", "eve": None},
        {"ann": ann, "eve": eve},
    )


def two_subjects(root: Path) -> dict[str, list[Path]]:
    """Two whole subjects, with regions."""
    ann = {"demo": result(0.1, 0.9, 26.0, seconds=600.0), "mean_frame": result(0.3, 0.8, 20.0, True)}
    eve = {"demo": result(0.2, 0.8, 24.0, seconds=600.0), "mean_frame": result(0.4, 0.7, 21.0, True)}
    return write(root, {"ann": None, "eve": None}, {"ann": ann, "eve": eve}, regions=True)


@pytest.fixture
def three(tmp_path: Path) -> dict[str, list[Path]]:
    return three_subjects(tmp_path)


@pytest.fixture
def two(tmp_path: Path) -> dict[str, list[Path]]:
    return two_subjects(tmp_path)


def test_layout_of_table_1(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    _, cells, text = run(tmp_path, three)
    assert cells[0] == ["subject", "demo", "mean_frame (predictor)", "nearest_frame (predictor)", "test frames"]
    nearest = "<ins>0.120</ins> / **0.860** / <ins>20.80</ins>"  # 0.8602 and 0.8604 read alike: both are best
    assert cells[2] == ["ann", "**0.091** / **0.860** / **25.46**", "0.350 / <ins>0.830</ins> / 18.50", nearest, "10"]
    assert text.startswith("LPIPS ↓ / SSIM ↑ / PSNR ↑ (dB), mean over the scored test frames")
    assert "- background: white" in text and "80.0 ms / 612 s" in text and "80.0 ms / not trained" in text


def test_one_row_for_every_subject(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    rows, cells, text = run(tmp_path, three)
    assert [line[0] for line in cells[2:]] == ["ann", "bob", "eve"]
    assert cells[3][1] == "rejected: bob.mp4: no face in any of 48 sampled frames; film one face" and cells[3][-1] == "0"
    failed = ["not made yet", "not made yet"]
    assert cells[4] == ["eve", failed[0], "0.300 / 0.900 / 21.00", failed[1], "10 of 12"]
    assert all(cell for line in cells for cell in line)
    status = {(row["subject"], row["variant"]): row["status"] for row in rows}
    assert status[("bob", "")] == "rejected" and status[("eve", "demo")] == "not made" and status[("ann", "demo")] == "ok"
    said = "1 subject rejected (bob); 2 variants without scores (eve/demo, eve/nearest_frame), of 3 subjects"
    assert said in text


def test_csv_has_every_aggregate_and_no_empty_field_without_a_note(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    rows, _, _ = run(tmp_path, three)
    demo = next(row for row in rows if (row["subject"], row["variant"]) == ("ann", "demo"))
    assert float(demo["psnr_mean"]) == 25.456 and float(demo["training_seconds"]) == 612.4 and demo["psnr_n"] == "10"
    assert float(demo["psnr_std"]) == pytest.approx(0.025456, abs=1e-6)  # of the frames, whatever metrics.json says
    for name in ("psnr", "ssim", "lpips", "l1", "iou", "psnr_face", "lpips_face"):
        assert demo[f"{name}_mean"] and demo[f"{name}_std"]
    assert demo["protocol"].startswith("background: white; resolution: 64x64")
    for row in rows:
        assert row["note"] or all(value for name, value in row.items() if name != "note"), row


def test_tables_follow_the_per_frame_files_and_not_the_stored_means(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    before = make(tmp_path, three)
    for path in three["metrics"]:
        content = json.loads(path.read_text())
        content["metrics"] = {name: {"mean": 0.5, "std": 9.0, "n": 3} for name in content["metrics"]}
        if "nearest" in str(path):
            del content["metrics"]
        path.write_text(json.dumps(content))
    assert make(tmp_path, three) == before
    path = next(path for path in three["per_frames"] if "ann/demo" in str(path))
    table = pd.read_csv(path, keep_default_na=False)
    table["psnr"] += 1.0
    table[:8].to_csv(path, index=False)
    rows, cells, _ = run(tmp_path, three)
    assert cells[2][1] == "**0.091** / **0.860** / **26.46**" and cells[2][-1] == "10, 8"
    demo = next(row for row in rows if (row["subject"], row["variant"]) == ("ann", "demo"))
    assert (demo["psnr_n"], demo["scored_frames"], demo["test_frames"]) == ("8", "8", "8")
    assert "ann: its variants were scored on different frames" in make(tmp_path, three)["markdown"]


def test_per_frame_files_alone_are_enough(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    rows, cells, text = run(tmp_path, {"per_frames": three["per_frames"]})
    assert cells[2][0] == "ann" and "0.091" in " ".join(cells[2]) and "not known / not given" in text
    assert "no metrics.json beside" in text and all(row["note"] for row in rows)


def test_all_frames_in_one_long_file(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    rows = list(csv.DictReader(make(tmp_path, three)["per_frame"].splitlines()))
    assert len(rows) == 4 * FRAMES and list(rows[0])[:4] == ["subject", "variant", "frame", "psnr"]
    frames = [row["frame"] for row in rows if (row["subject"], row["variant"]) == ("eve", "mean_frame")]
    assert frames == [str(frame) for frame in range(100, 110)]


def test_mean_over_subjects_that_have_every_variant(tmp_path: Path, two: dict[str, list[Path]]) -> None:
    text = make(tmp_path, two)
    assert cells_of(text["markdown"])[-1] == [
        "mean of 2 subjects", "**0.150** / **0.850** / **25.00**",
        "<ins>0.350</ins> / <ins>0.750</ins> / <ins>20.50</ins>", "2 of 2 subjects",
    ]  # fmt: skip
    assert "Mean of 2" in text["latex"]
    lacking = {name: [path for path in paths if "eve/demo" not in str(path)] for name, paths in two.items()}
    text = make(tmp_path, lacking)
    assert "mean of" not in text["markdown"] and "No mean over subjects" in text["markdown"] and "Mean of" not in text["latex"]
    one = {name: [path for path in paths if "eve" not in str(path)] for name, paths in two.items()}
    assert "mean over subjects" not in make(tmp_path, one)["markdown"].lower()


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("psnr", "nan", "frame 103 has psnr = nan"),
        ("lpips", "", "frame 103 has lpips = nothing"),
        ("ssim_face", "inf", "frame 103 has ssim_face = inf"),
        ("psnr_mouth", "", "frame 103 has psnr_mouth = nothing"),  # and no note that says why
        ("frame", "104", "each once"),
        ("frame", "x", "each once"),
    ],
)
def test_no_score_that_is_not_a_number(
    tmp_path: Path, two: dict[str, list[Path]], caplog: pytest.LogCaptureFixture, column: str, value: str, said: str
) -> None:
    table = pd.read_csv(two["per_frames"][0], dtype=str, keep_default_na=False)
    table.loc[3, column] = value
    table.to_csv(two["per_frames"][0], index=False)
    with pytest.raises(SystemExit):
        run(tmp_path, two)
    assert said in caplog.text and str(two["per_frames"][0]) in caplog.text
    assert not list((tmp_path / "tables").iterdir())


def test_a_cost_that_is_not_a_number(tmp_path: Path, two: dict[str, list[Path]], caplog: pytest.LogCaptureFixture) -> None:
    two["metrics"][0].write_text(json.dumps(json.loads(two["metrics"][0].read_text()) | {"ms_per_frame": float("nan")}))
    with pytest.raises(SystemExit):
        run(tmp_path, two)
    assert "ms_per_frame is nan" in caplog.text


def test_expected_subjects_and_variants_are_rows_and_columns(tmp_path: Path, three: dict[str, list[Path]]) -> None:
    rows, cells, _ = run(tmp_path, three, subjects=["zoe", "ann"], variants=["large", "demo"])
    assert cells[0][1:3] == ["large", "demo"] and [line[0] for line in cells[2:]] == ["zoe", "ann", "bob", "eve"]
    assert cells[2][1] == cells[3][1] == "not made yet"
    assert {row["status"] for row in rows if row["subject"] == "zoe"} == {"not made"}


def test_only_rejected_subjects(tmp_path: Path) -> None:
    text = make(tmp_path, write(tmp_path, {"bob": "too short | dark"}, {}))
    cells = cells_of(text["markdown"])
    assert cells[0] == ["subject", "result", "test frames"]
    assert "rejected: too short \\" in cells[2][1]
    assert "rejected: too short" in text["latex"] and "rejected: too short" in text["regions_latex"]


def test_nothing_at_all_is_one_sentence(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SystemExit):
        run(tmp_path, {})
    assert "nothing to tabulate" in caplog.text
