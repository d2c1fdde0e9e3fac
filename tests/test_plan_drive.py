"""What Snakemake runs for `drive` and `identity_calibration`, with steps that only write small files."""

from __future__ import annotations

from pathlib import Path

import pytest
from pipeline import Pipeline

from avatar.uses.config import DriverConfig
from workflow.settings import SettingsError, check_drivers

CONFIG = """
videos: videos
variants: {a: {preset: demo}}
drivers:
  good: {video: other/good.mp4, subject: ann, use: pose}
  blind: {video: other/blind.mp4, subject: ann}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pipeline = Pipeline.create(tmp_path_factory.mktemp("drive") / "run", ("ann",))
    (pipeline.folder / "other").mkdir()
    for name in ("good", "blind"):
        (pipeline.folder / "other" / f"{name}.mp4").write_text(f"a video of {name}")
    pipeline.write_config(CONFIG)
    return pipeline.folder


def test_a_driver_is_tracked_and_never_trains_and_a_rejected_one_holds_back_no_other(folder: Path) -> None:
    pipeline = Pipeline(folder)
    pipeline.set_fate(**{"driver.blind": "reject"})
    result = pipeline.run("drive")
    assert result.code == 0, result.text
    assert "driver blind: left out, its video is rejected: no face in 62 % of the frames" in result.text
    ran = pipeline.ran()
    of_driver = {line.split()[0] for line in ran if line.endswith(" driver.good")}
    steps = {"fitting.probe", "fitting.extract", "fitting.matte", "fitting.detect", "avatar.uses.drive_split", "fitting.fit"}
    assert of_driver == steps
    assert [line for line in ran if line.endswith(" driver.blind")] == ["fitting.probe driver.blind"]
    assert [line for line in ran if line.startswith("avatar.uses.drive ")] == ["avatar.uses.drive ann"]
    assert (folder / "results/ann/a/drive/good/drive.mp4").exists() and "fitting.split ann" in ran
    text = (folder / "results/ann/a/drive/good/drive.json").read_text()
    assert r"\"use\":\"pose\"" in text and r"\"driver\":\"good\"" in text and r"\"sample_factor\":3.0" in text
    assert pipeline.plan("drive") <= {"drive"}
    uses = pipeline.run("-n", "uses")
    assert "driver blind: left out, its video is rejected" in uses.text and "rule orbit_around" in uses.text


def test_all_asks_for_no_driver(folder: Path) -> None:
    jobs = Pipeline(folder).plan()
    assert not any("driver." in name or name.startswith("drive") for name in jobs)


def test_no_drivers(folder: Path) -> None:
    pipeline = Pipeline(folder)
    pipeline.write_config("videos: videos\nvariants: {a: {preset: demo}}\n")
    result = pipeline.run("-n", "drive")
    assert result.code != 0 and "drivers is empty; name a driving video" in result.text
    assert {"identity_parts ann", "identity_calibration"} <= pipeline.plan("identity_calibration")
    pipeline.write_config("videos: videos\nfit: {focal_px: 700}\n")  # what parts are fitted with is what drivers are fitted with
    assert '"focal_px": 700.0' in pipeline.run("-n", "-p", "identity_calibration").text


def test_mistakes_in_the_config(tmp_path: Path) -> None:
    video = tmp_path / "second.mp4"
    video.write_text("a video")

    def check(name: str = "second", subject: str = "ann", path: Path = video) -> None:
        check_drivers({name: DriverConfig(video=str(path), subject=subject)}, ["ann", "bob"], "config.yaml")

    check()
    for keys, sentence in (
        ({"name": "a.b"}, "drivers.a.b: use letters"),
        ({"subject": "an"}, "drivers.second.subject: there is no subject an; did you mean ann?"),
        ({"subject": "xyz"}, "the subjects are ann, bob"),
        ({"path": tmp_path / "no.mp4"}, "drivers.second.video: there is no file"),
    ):
        with pytest.raises(SettingsError, match=sentence):
            check(**keys)
