"""The targets orbit, extrapolate, sheet, animate and half_data, asked of Snakemake itself; steps only write files."""

from __future__ import annotations

import pytest
from pipeline import Pipeline

CONFIG = "videos: videos\nvariants: {a: {preset: demo}, b: {preset: demo, render: {sample_factor: 4}}}\n"


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Pipeline:
    """Two subjects, one of them without a face; nothing made but the probes and what orbit needs."""
    made = Pipeline.create(tmp_path_factory.mktemp("uses") / "run", ("ann", "bob"))
    made.write_config(CONFIG + "animate: {wave: {file: wave.csv, fps: 12}}\n")
    (made.folder / "wave.csv").write_text("jawOpen\n0\n")
    made.set_fate(bob="reject")
    done = made.run("orbit")
    assert done.code == 0, done.text
    return made


def test_orbit_is_made_of_every_variant_and_nothing_else(pipeline: Pipeline) -> None:
    ran = pipeline.ran()
    assert ran.count("avatar.uses.orbit ann") == 2 and ran.count("avatar.train ann") == 2
    assert not [
        job for job in ran if job.split()[0] in ("avatar.render", "avatar.evaluate", "avatar.uses.sheet") or job.endswith("bob")
    ][1:]
    for name in ("orbit.mp4", "orbit.png", "orbit.json"):
        assert (pipeline.folder / "results/ann/b/orbit" / name).exists()


def test_other_targets_follow_from_the_same_avatars(pipeline: Pipeline) -> None:
    asked = pipeline.plan("orbit", "extrapolate", "sheet", "animate")
    wanted = {f"{rule} ann/{variant}" for rule in ("extrapolate_codes", "sheet_of", "animate_by") for variant in "ab"}
    assert asked - {"orbit", "extrapolate", "sheet", "animate"} == wanted
    text = pipeline.run("-n", "-p", "animate", "sheet").text
    assert '"sample_factor":4.0' in text and '"sample_factor":3.0' in text and "file=wave.csv" in text and '"fps":12.0' in text
    (pipeline.folder / "wave.csv").write_text("jawOpen\n0\n")  # the same content at another time
    done = pipeline.run("animate")
    assert done.code == 0, done.text
    assert pipeline.plan("animate") == set()
    (pipeline.folder / "wave.csv").write_text("jawOpen\n1\n")
    assert pipeline.plan("animate") == {"animate", "animate_by ann/a", "animate_by ann/b"}


def test_half_data_trains_every_variant_once_more(pipeline: Pipeline) -> None:
    asked = pipeline.plan("half_data")
    half = {f"{rule} ann/{variant}.half" for rule in ("train", "render", "evaluate") for variant in "ab"}
    full = {f"{rule} ann/{variant}" for rule in ("render", "evaluate") for variant in "ab"}
    assert asked - {"asset lpips_alexnet.ckpt", "fetch lpips_alexnet.ckpt"} == half | full | {"half_data", "split_half ann"}
    text = pipeline.run("-n", "-p", "half_data").text
    assert text.count("split=results/ann/split_half.json") == 2  # training alone: the test frames are the same
    assert '"variants": ["a", "a.half", "b", "b.half"]' in text
    table = next(line for line in text.splitlines() if "avatar.report.tabulate" in line and "half_data" in line)
    for variant in ("a", "a.half", "b", "b.half"):
        assert f" metrics=results/ann/{variant}/metrics/metrics.json" in table
        assert f" per_frames=results/ann/{variant}/metrics/per_frame.csv" in table
    assert "probes=results/bob/probe/probe.json" in table and "markdown=results/tables/half_data.md" in table
    assert not [job for job in pipeline.plan() if "half" in job]


def test_animate_without_a_file_says_what_to_do(pipeline: Pipeline) -> None:
    pipeline.write_config(CONFIG)
    refused = pipeline.run("-n", "animate")
    assert refused.code == 1 and "name a parameter file" in refused.text
