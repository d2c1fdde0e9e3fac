"""The subject's page: complete, closed in itself, escaped; its player's video exact to the frame. `test_browser` opens it."""

import json
import re
from fractions import Fraction
from html.parser import HTMLParser
from pathlib import Path

import made_subject as made
import numpy as np
import pandas as pd
import pytest
from test_plot import curve

from avatar import baseline, evaluate, provenance
from avatar.config import BaselineConfig, EvaluateConfig
from avatar.report import page, page_scores, pictures, player, plot
from avatar.report.config import PageConfig, PlotConfig
from fitting.video import read_frames, write_video
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
    assert links.tags.count("video") == 2 and links.tags.count("canvas") == 4 and links.tags.count("noscript") == 1
    local = [address for address in links.addresses if not address.startswith(("#", "data:,"))]
    assert sorted(set(local)) == sorted(path.name for path in folder.iterdir() if path.name not in ("index.html", "card.jpg"))
    without_namespace = text.replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"https?://|url\(|@import|fetch\(|XMLHttpRequest|type=.module", without_namespace)
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
    found = [(rank, int(row["frame"])) for rank, row in page_scores.ranked(table)]
    assert found == [("worst 1", 12), ("worst 2", 14), ("worst 3", 15), ("median", 10), ("best", 11)]
    assert [int(row["frame"]) for _, row in page_scores.ranked(table.iloc[:1])] == [10]


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


def region_scores(predictor: bool, shift: float) -> dict:
    """Content of metrics.json with every region."""
    means = {"lpips": 0.1 + shift, "ssim": 0.9 - shift, "psnr": 25 - shift, "l1": 0.01 + shift, "iou": 0.9, "lpips_vgg": 0.3}
    regions = {f"{name}_{part}": mean for part in ("face", "mouth", "eyes") for name, mean in means.items() if name != "iou"}
    figures = {name: {"mean": mean, "std": 0.01, "n": 3} for name, mean in (means | regions).items()}
    return {"predictor": predictor, "metrics": figures, "ms_per_frame": 1.0, "scored_frames": 3, "training_seconds": None}


def test_score_tables_have_every_region_and_mark_the_best() -> None:
    metrics = {"nearest_frame": region_scores(True, 0.05), "fast": region_scores(False, 0.0)}
    head, parts = page_scores.tables(metrics)
    assert [row["variant"] for row in head["rows"]] == ["fast", "nearest_frame"]
    assert [group["title"] for group in parts["groups"]] == ["face hull", "mouth box", "eye boxes"]
    assert [len(group["titles"]) for group in parts["groups"]] == [5, 5, 5] and "LPIPS (VGG) ↓" in head["groups"][0]["titles"]
    assert [cell["best"] for cell in head["rows"][0]["cells"]] == [True] * 6 + [False] * 3
    assert [cell["start"] for cell in parts["rows"][0]["cells"]].index(True) == 5
    assert [cell["value"] for cell in head["rows"][0]["cells"][-3:]] == ["1.0", "not given", "3"]


def test_a_region_that_one_variant_lacks_is_said_and_one_that_all_lack_is_left_out() -> None:
    metrics = {"fast": region_scores(False, 0.0), "old": region_scores(False, 0.1)}
    for name in [name for name in metrics["old"]["metrics"] if name.endswith("mouth")]:
        del metrics["old"]["metrics"][name]
    for scores in metrics.values():
        scores["metrics"] = {name: value for name, value in scores["metrics"].items() if not name.endswith("eyes")}
    _, parts = page_scores.tables(metrics)
    assert [group["title"] for group in parts["groups"]] == ["face hull", "mouth box"]
    assert [cell["value"] for cell in parts["rows"][1]["cells"][5:]] == ["no mouth"] * 5
    assert [cell["best"] for cell in parts["rows"][0]["cells"]] == [True] * 5 + [False] * 5  # one figure is the best of nothing
    for scores in metrics.values():
        scores["metrics"] = {
            name: value for name, value in scores["metrics"].items() if "_face" not in name and "_mouth" not in name
        }
    assert len(page_scores.tables(metrics)) == 1


def test_tiles_keep_within_what_decoders_take() -> None:
    for count, size in ((1, (64, 72)), (4, (512, 500)), (9, (2048, 1500)), (30, (1080, 1920))):
        tiling = player.Tiling.of(count, size)
        whole = tiling.empty()
        assert max(whole.shape[:2]) <= player.LARGEST_PX and not any(side % 16 for side in whole.shape[:2])
        assert tiling.width / tiling.height == pytest.approx(size[1] / size[0], rel=0.02)
        corners = [tiling.corner(place) for place in range(count)]
        assert len(set(corners)) == count
        assert all(top + tiling.height <= whole.shape[0] and left + tiling.width <= whole.shape[1] for top, left in corners)
    assert (player.Tiling.of(4, (512, 500)).height, player.Tiling.of(4, (512, 500)).width) == (512, 500)


def test_frames_left_out_do_not_speed_the_player_up() -> None:
    assert player.rate([10, 11, 12], 30.0) == 30
    assert player.rate([0, 10, 20, 30], 25.0) == Fraction(5, 2)
    assert player.rate([7], 25.0) == 25


def test_the_players_video_shows_each_variants_own_frames(folder: Path, subject: dict) -> None:
    """Tile by tile against the arrays; a frame that a variant did not render is grey."""
    renders = {path.parents[1].name: np.load(path) for path in subject["renders"]}
    reports = {path.parents[1].name: json.loads(path.read_text()) for path in subject["reports"]}
    text = (folder / "index.html").read_text()
    data = json.loads(re.search(r'id="player-data">(.*?)</script>', text, re.S)[1])
    assert data["frames"] == made.TEST and [panel["name"] for panel in data["panels"]] == ["input", *VARIANTS]
    assert [panel["shown"] for panel in data["panels"]] == [True, True, False, False]
    shown = [frame.rgb().astype(float) for frame in read_frames(folder / "player.mp4")]
    assert len(shown) == len(made.TEST)
    inside = np.s_[4:-4, 4:-4]
    for place, picture in enumerate(shown):
        for panel in data["panels"][1:]:
            tile = picture[panel["top"] :, panel["left"] :][: data["height"], : data["width"]]
            truth = renders[panel["name"]][place, ..., :3].astype(float)
            assert np.abs(tile - truth)[inside].mean() < 12, (place, panel["name"])
    unscored = data["frames"].index(made.UNUSABLE)
    assert data["scores"]["demo"]["lpips"][unscored] is None and None not in data["scores"]["demo"]["lpips"][:unscored]
    reports["demo"] = reports["demo"] | {"frames": made.TEST[1:]}
    renders["demo"] = renders["demo"][1:]
    frames, alpha = np.load(subject["frames"]), np.load(subject["alpha"])
    tiling = player.Tiling.of(4, frames.shape[1:3])
    first = next(player.tiled(frames, alpha, renders, reports, tiling))
    top, left = tiling.corner(1)
    assert (first[top : top + tiling.height, left : left + tiling.width] == player.MISSING).all()


def test_a_render_time_that_is_not_known() -> None:
    figures = {name: {"mean": 0.5, "std": 0.0, "n": 1} for name in ("lpips", "ssim", "psnr", "l1", "iou")}
    said = {"predictor": False, "metrics": figures, "ms_per_frame": None, "training_seconds": 60.0, "scored_frames": 1}
    assert [tile["label"] for tile in page_scores.tiles({"demo": said})][3:] == ["training time", "test frames scored"]
    assert "not known" in str(page_scores.tables({"demo": said}))


def test_the_players_video_says_what_its_sources_say(folder: Path, subject: dict) -> None:
    said = provenance.read_comment(folder / "player.mp4")
    sources = [provenance.read_comment(path) for path in subject["videos"]]
    assert said and all(source in said for source in sources if source)
    assert any(sources)
