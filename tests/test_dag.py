"""The whole pipeline with its real steps on a tiny clip: three videos, of which one is no video."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import time
import zipfile
from pathlib import Path

import av
import pytest
from pipeline import Pipeline

FRAMES = 32
SMALL = "rays: 64, frames_per_step: 1, feature_channels: 4, mlp_width: 16, mlp_depth: 1, colour_width: 8, max_samples: 4"
CONFIG = f"""
videos: videos
device: cpu
extract: {{size: 96, max_frames: {FRAMES}}}
head: {{renders: 60}}
variants:
  tiny: {{preset: demo, train: {{steps: 8, {SMALL}}}, render: {{max_frames: 3}}}}
"""
SUBJECT = "Zoë_1"


def shorten(source: Path, target: Path, frames: int) -> None:
    """The first frames of a video, with the same pictures."""
    with av.open(str(source)) as reader, av.open(str(target), "w") as writer:
        video = reader.streams.video[0]
        stream = writer.add_stream("libx264", rate=video.average_rate, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = video.width, video.height, "yuv420p"
        for index, frame in enumerate(reader.decode(video)):
            if index == frames:
                break
            writer.mux(stream.encode(av.VideoFrame.from_ndarray(frame.to_ndarray(format="rgb24"), format="rgb24")))
        writer.mux(stream.encode(None))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, assets: Path) -> Pipeline:
    """A folder in which everything has been made by a bare `snakemake`."""
    pipeline = Pipeline.create(tmp_path_factory.mktemp("dag") / "run")
    (pipeline.folder / "resources").mkdir()
    shutil.copytree(assets, pipeline.folder / "resources" / "assets")
    pipeline.write_config(CONFIG)
    shorten(assets / "carphone.mp4", pipeline.folder / "videos" / "Zoë 1.mp4", FRAMES)
    (pipeline.folder / "videos" / "notes.mp4").write_text("these are not the frames you are looking for")
    result = pipeline.run(stub=False)
    assert result.code == 0, result.text
    assert result.last_line == "1 of 2 subjects have an avatar"
    assert re.search(r"^notes: rejected: .*notes\.mp4", result.text, re.M), result.text
    return pipeline


def test_every_output_is_there(finished: Pipeline) -> None:
    subject = finished.folder / "results" / SUBJECT
    for name in ("fit/overlay.mp4", "tiny/avatar.pt", "tiny/render/test.mp4", "plots/training.svg", "page/index.html"):
        assert (subject / name).stat().st_size > 0, name
    assert not list(finished.folder.rglob(".partial-*"))
    assert not (finished.folder / "results" / "notes" / "frames").exists()


def test_table_has_a_row_for_every_subject(finished: Pipeline) -> None:
    tables = finished.folder / "results" / "tables"
    with open(tables / "metrics.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["subject"] for row in rows} == {SUBJECT, "notes"}
    assert {row["variant"] for row in rows if row["subject"] == SUBJECT} == {"tiny", "mean_frame", "nearest_frame"}
    text = (tables / "metrics.md").read_text(encoding="utf-8")
    assert "notes.mp4" in text
    assert "mean_frame" in text or "mean frame" in text


def test_scores_are_finite_and_on_the_same_frames(finished: Pipeline) -> None:
    frames = set()
    for variant in ("tiny", "mean_frame", "nearest_frame"):
        folder = finished.folder / "results" / SUBJECT / variant
        frames.add(tuple(json.loads((folder / "render" / "render.json").read_text())["frames"]))
        assert json.loads((folder / "metrics" / "metrics.json").read_text())["scored_frames"] > 0
    assert len(frames) == 1
    assert len(frames.pop()) == 3


def test_nothing_to_do_afterwards(finished: Pipeline) -> None:
    assert finished.plan() == set()


def test_report(finished: Pipeline) -> None:
    result = finished.run("--report", "report.zip", stub=False)
    assert result.code == 0, result.text
    names = zipfile.ZipFile(finished.folder / "report.zip").namelist()
    assert any(name.endswith("overlay.mp4") for name in names)


def test_training_interrupted_half_way_resumes_at_its_step(finished: Pipeline) -> None:
    """Ctrl-C while it trains: the next run goes on from the checkpoint and ends at the same step."""
    target, steps = f"results/{SUBJECT}/longer/avatar.pt", 120
    finished.append("config/config.yaml", f"  longer: {{preset: demo, train: {{steps: {steps}, {SMALL}}}}}\n")
    folder, log = finished.folder / "results" / SUBJECT / "longer", finished.folder / "logs" / SUBJECT / "longer" / "train.log"
    with subprocess.Popen(
        finished.command(target, "--cores", "1", stub=False), cwd=finished.folder, env=finished.environment(),
        start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ) as process:  # fmt: skip
        end = time.monotonic() + 120
        while not (log.exists() and "loss" in log.read_text()) and process.poll() is None and time.monotonic() < end:
            time.sleep(0.02)
        assert process.poll() is None, "the training ended before it could be interrupted"
        os.killpg(process.pid, signal.SIGINT)
    assert process.returncode != 0
    assert not (folder / "avatar.pt").exists()
    assert (folder / "checkpoints" / "last.pt").exists()
    result = finished.run(target, "--cores", "1", stub=False)
    assert result.code == 0, result.text
    begun = re.search(r"continuing at step (\d+) of (\d+)", log.read_text())
    assert begun, log.read_text()
    assert 0 < int(begun[1]) < int(begun[2]) == steps
    curve = [int(row.split("\t")[0]) for row in (folder / "curve.tsv").read_text().splitlines()[1:]]
    assert curve == sorted(set(curve))
    assert curve[0] <= int(begun[1]) < curve[-1] == steps
