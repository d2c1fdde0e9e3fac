"""The subject's page: complete, closed in itself, escaped, and readable in a real browser where there is one."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import made_subject as made
import numpy as np
import pandas as pd
import pytest
from test_plot import curve

from avatar import baseline, evaluate, page, pictures, plot
from avatar.config import BaselineConfig, EvaluateConfig, PageConfig, PlotConfig
from fitting.video import write_video
from workflow import step

VARIANTS = ("demo", "mean_frame", "nearest_frame")


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path | list[Path]]:
    """Inputs of the page, made by the steps themselves; the variant demo is the nearest frame renamed."""
    root = tmp_path_factory.mktemp("results") / "ann"
    files = made.make(root / "in")
    for variant in VARIANTS:
        config = {"predictor": "mean_frame" if variant == "mean_frame" else "nearest_frame"}
        inputs = {name: files[name] for name in ("head", "frames", "index", "alpha", "track", "split")}
        render = {"render": root / variant / "render" / "test.npy", "report": root / variant / "render" / "render.json"}
        step.main(
            baseline.run,
            BaselineConfig,
            made.arguments(config, inputs, render | {"video": root / variant / "render" / "test.mp4"}),
        )
        if variant == "demo":
            report = json.loads(render["report"].read_text())
            render["report"].write_text(json.dumps(report | {"predictor": False}))
            made_by = report["provenance"] | {"seconds": 61.5}
            (root / variant / "train.json").write_text(json.dumps({"train_seconds": 61.5, "steps": 2000, "provenance": made_by}))
            curve().to_csv(root / variant / "curve.tsv", sep="\t", index=False)
            render["train"] = root / variant / "train.json"
        scores = {name: files[name] for name in ("frames", "alpha", "landmarks", "track", "split", "lpips")} | render
        out = {"per_frame": root / variant / "metrics" / "per_frame.csv", "metrics": root / variant / "metrics" / "metrics.json"}
        step.main(evaluate.run, EvaluateConfig, made.arguments({}, scores, out))
    (root / "probe.json").write_text(
        json.dumps({"accepted": True, "reason": None, "file": "ann.mp4", "warnings": ["the face is <dark> & small"]})
    )
    fit = {
        "usable": 23,
        "reprojection": {"p50": 1.5},
        "decisions": {"neck": "fixed straight"},
        "not_determined": ["the skull under the hair"],
    }
    (root / "fit.json").write_text(json.dumps(fit))
    write_video(root / "overlay.mp4", [made.picture(frame)[0] for frame in range(4)], 25)
    listed = {
        "renders": "render/test.npy",
        "reports": "render/render.json",
        "videos": "render/test.mp4",
        "metrics": "metrics/metrics.json",
        "per_frames": "metrics/per_frame.csv",
    }
    lists = {name: [root / variant / file for variant in VARIANTS] for name, file in listed.items()}
    plots = {"curve": root / "plots" / "curve.svg", "error": root / "plots" / "error.svg"}
    drawn = {"curves": [root / "demo" / "curve.tsv"], "metrics": lists["metrics"], "per_frames": lists["per_frames"]}
    step.main(plot.run, PlotConfig, made.arguments({}, drawn, plots))
    single = {"probe": root / "probe.json", "fit": root / "fit.json", "overlay": root / "overlay.mp4"}
    return single | lists | {name: files[name] for name in ("frames", "index", "alpha")} | {
        "trains": [root / "demo" / "train.json"], "plots": list(plots.values())}  # fmt: skip


@pytest.fixture(scope="module")
def folder(subject: dict[str, Path | list[Path]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("page") / "page"
    step.main(page.run, PageConfig, made.arguments({}, subject, {"page": out}))
    return out


class Links(HTMLParser):
    """Every tag, and every address that the page names."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value for name, value in attributes if name in ("src", "href", "poster", "data") and value]


def test_every_file_is_there_and_nothing_comes_from_the_network(folder: Path) -> None:
    text = (folder / "index.html").read_text()
    links = Links()
    links.feed(text)
    assert links.tags.count("video") == 4 and "script" not in links.tags
    local = [address for address in links.addresses if not address.startswith(("#", "data:,"))]
    assert sorted(set(local)) == sorted(path.name for path in folder.iterdir() if path.name != "index.html")
    assert not re.search(r"https?://|url\(|@import", text)
    anchors = {address[1:] for address in links.addresses if address.startswith("#")}
    assert anchors and all(f'id="{anchor}"' in text for anchor in anchors)


def test_what_the_issue_lists_is_on_the_page(folder: Path) -> None:
    text = (folder / "index.html").read_text()
    needed_texts = ("the face is &lt;dark&gt; &amp; small", "the skull under the hair", "fixed straight", "worst 1", "best",
                    "mean_frame", "nearest_frame", "predictor", "snakemake results/ann/page", "test time fitting", "train demo",
                    "Rendered frames left out: 1", "prefers-color-scheme")  # fmt: skip
    for needed in needed_texts:
        assert needed in text, needed
    assert "<dark>" not in text and str(folder.parent) not in text


def test_numbers_are_those_of_the_metrics(folder: Path, subject: dict) -> None:
    text = (folder / "index.html").read_text()
    for path in subject["metrics"]:
        content = json.loads(path.read_text())
        assert f"{content['metrics']['lpips']['mean']:.3f}" in text and f"{content['metrics']['psnr']['mean']:.2f}" in text


def test_frames_are_ranked_by_lpips_each_once() -> None:
    table = pd.DataFrame({"frame": [10, 11, 12, 13, 14, 15], "lpips": [0.3, 0.1, 0.6, 0.2, 0.5, 0.4]})
    found = [(rank, int(row["frame"])) for rank, row in page.ranked(table)]
    assert found == [("worst 1", 12), ("worst 2", 14), ("worst 3", 15), ("median", 10), ("best", 11)]
    assert [int(row["frame"]) for _, row in page.ranked(table.iloc[:1])] == [10]


def test_error_map_and_strip() -> None:
    truth, render = np.full((5, 7, 3), 200, np.uint8), np.full((5, 7, 3), 200, np.uint8)
    render[0, 0] = 100
    shown = pictures.error_map(render, truth)
    assert shown[1:].sum() <= shown[1:].size * 4 and shown[0, 0].sum() > 500
    assert pictures.scored_strip(truth, np.full((5, 7), 255, np.uint8), render).shape == (5, 3 * 7 + 2 * pictures.GAP_PX, 3)


def test_no_scores_is_one_sentence(subject: dict, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    without = {
        name: value for name, value in subject.items() if name not in ("metrics", "per_frames", "renders", "videos", "reports")
    }
    with pytest.raises(SystemExit) as stopped:
        step.main(page.run, PageConfig, made.arguments({}, without, {"page": tmp_path / "page"}))
    assert stopped.value.code == 1 and "no scores" in caplog.text and not list(tmp_path.iterdir())


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium on this machine; `apt-get install chromium`")
@pytest.mark.parametrize("width", [1200, 500])
def test_a_browser_opens_it_without_a_console_message(folder: Path, tmp_path: Path, width: int) -> None:
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
             "--disable-component-update", "--disable-sync", f"--user-data-dir={tmp_path / 'profile'}", "--enable-logging=stderr",
             "--virtual-time-budget=3000", f"--window-size={width},1400", f"--screenshot={tmp_path / 'page.png'}"]  # fmt: skip
    done = subprocess.run(["chromium", *flags, f"file://{folder / 'index.html'}"], capture_output=True, text=True, timeout=60)
    assert (tmp_path / "page.png").stat().st_size > 10_000
    assert "CONSOLE" not in done.stderr
