"""The step `export`: its folder, its report of what is lost, and what it refuses."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from exported import FRAMES, SIZE, flame_like, moving
from pipeline import Pipeline

from fitting import export, export_pose
from fitting.config import ExportConfig
from fitting.head_model import HeadModel
from workflow import step


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return flame_like()


@pytest.fixture
def track(head: HeadModel) -> dict[str, np.ndarray]:
    return moving(head)


def make_job(tmp_path: Path, head: HeadModel, track: dict, monkeypatch: pytest.MonkeyPatch, pictures: str = "all") -> step.Job:
    """A job of the step on small made-up files."""
    monkeypatch.setattr(export, "load_head", lambda path, dtype: head)
    random, folder = np.random.default_rng(0), tmp_path / "in"
    (tmp_path / "out" / "nha").mkdir(parents=True)
    folder.mkdir()
    np.savez(folder / "track.npz", **track | {"head_digest": np.array(head.digest)})
    np.save(folder / "frames.npy", random.integers(0, 255, (FRAMES, *SIZE, 3), np.uint8))
    np.save(folder / "alpha.npy", random.integers(0, 255, (FRAMES, *SIZE), np.uint8))
    (folder / "split.json").write_text(json.dumps({"train": list(range(6)), "test": [7, 8]}))
    (folder / "frames.json").write_text(json.dumps({"source_frame": list(range(10, 10 + FRAMES))}))
    names = {"track": "track.npz", "frames": "frames.npy", "alpha": "alpha.npy", "split": "split.json", "index": "frames.json"}
    inputs = SimpleNamespace(head=Path("head.npz"), **{key: folder / name for key, name in names.items()})
    out = tmp_path / "out"
    outputs = SimpleNamespace(nha=out / "nha" / "tracked.npz", vhap=out / "vhap", report=out / "export.json")
    config = ExportConfig(pictures=pictures)
    return step.Job(config, inputs, outputs, outputs, "ann", 1, "cpu", "", logging.getLogger("test"))


def test_step_writes_the_folder_and_says_what_is_lost(
    tmp_path: Path, head: HeadModel, track: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    track["expression"][1, 4] = 1.0  # an eyelid
    track["jaw"][4, 1] = 0.1
    job = make_job(tmp_path, head, track, monkeypatch)
    export.run(job)
    report = json.loads(job.output.report.read_text())
    assert report["nha"]["lost"]["eyelids"]["frames"] == report["vhap"]["lost"]["eyelids"]["frames"] == 1
    lid = 1000 * head.expression_basis[4].norm(dim=-1).max()
    assert report["vhap"]["lost"]["eyelids"]["max_mm"] == pytest.approx(float(lid), rel=0.3)  # this lid moves joints
    assert report["nha"]["lost"]["jaw"]["frames"] == 1 and report["nha"]["lost"]["jaw"]["max_mm"] > 1
    assert report["nha"]["lost"]["neck"] == {"frames": 0, "max_mm": 0.0, "mean_mm": 0.0}
    assert report["head"]["digest"] == head.digest and report["head"]["version"] == "2020" and report["licence_note"]
    assert report["nha"]["codes"]["same"] and not report["vhap"]["codes"]["same"]
    for checked in (report["nha"]["verified"]["file"], *report["vhap"]["verified"].values()):
        assert checked["vertices_max_mm"] < 0.001
    folder = job.output.vhap
    database = {part: json.loads((folder / f"transforms_{part}.json").read_text()) for part in ("train", "val", "test")}
    rows = {part: [frame["timestep_index_original"] for frame in content["frames"]] for part, content in database.items()}
    assert rows == {"train": [0, 1, 3, 4, 5], "val": [], "test": [7, 8]}  # 2 is not usable, 6 in neither part
    complete = json.loads((folder / "transforms.json").read_text())
    assert complete["timestep_indices"] == list(range(7)) and complete["camera_indices"] == [0]
    frame = complete["frames"][-1]
    assert frame["timestep_index"] == 6 and frame["timestep_id"] == "00018"
    assert {"backup", "backup_flame"} <= {path.stem.removeprefix("transforms_") for path in folder.glob("transforms_*.json")}
    picture = cv2.imread(str(folder / frame["file_path"]))
    mask = cv2.imread(str(folder / frame["fg_mask_path"]), cv2.IMREAD_GRAYSCALE)
    assert picture.shape[:2] == mask.shape == (frame["h"], frame["w"]) == tuple(report["vhap"]["picture_size"])
    top, left = report["vhap"]["padding_top_left_px"]
    alpha = np.load(job.input.alpha)[8]
    np.testing.assert_array_equal(mask[top : top + 60, left : left + 48], alpha)
    expected = np.load(job.input.frames)[8] * (alpha[..., None] / 255) + 255 - alpha[..., None]
    assert np.abs(picture[top : top + 60, left : left + 48, ::-1] - expected).max() <= 0.51
    assert (picture[: top or -1, : left or -1] == 255).all()
    with np.load(folder / frame["flame_param_path"]) as params:
        assert {name: params[name].shape for name in params.files} == {
            "translation": (1, 3), "rotation": (1, 3), "neck_pose": (1, 3), "jaw_pose": (1, 3), "eyes_pose": (1, 6),
            "shape": (300,), "expr": (1, 100), "static_offset": (1, 5143, 3),
        }  # fmt: skip
    with np.load(folder / "canonical_flame_param.npz") as params:
        np.testing.assert_allclose(params["jaw_pose"], [[0.3, 0, 0]], rtol=1e-6)
        assert not any(params[name].any() for name in ("translation", "rotation", "neck_pose", "eyes_pose", "expr"))


def test_pictures_of_one_split(tmp_path: Path, head: HeadModel, track: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    job = make_job(tmp_path, head, track, monkeypatch, pictures="test")
    export.run(job)
    assert len(list((job.output.vhap / "images").iterdir())) == 2
    assert json.loads((job.output.vhap / "transforms_train.json").read_text())["frames"] == []


def test_anny_head_is_refused(tmp_path: Path, track: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    job = make_job(tmp_path, flame_like("anny"), track, monkeypatch)
    with pytest.raises(step.StepError, match=r"head\.npz.*another basis.*head\.model: flame"):
        export.run(job)
    assert not job.output.nha.exists()


def test_a_head_without_correctives_is_refused(head: HeadModel) -> None:
    assert export_pose.refusal(head) is None
    assert "0 pose correctives" in export_pose.refusal(replace(head, pose_basis=head.pose_basis[:0]))


def test_track_of_another_head_is_refused(tmp_path: Path, head: HeadModel, track: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    job = make_job(tmp_path, head, track, monkeypatch)
    np.savez(job.input.track, **track | {"head_digest": np.array("other")})
    with pytest.raises(step.StepError, match="fit again"):
        export.run(job)


def test_tampering_between_writing_and_reading_fails_the_step(
    tmp_path: Path, head: HeadModel, track: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = make_job(tmp_path, head, track, monkeypatch)
    right = export._read
    monkeypatch.setattr(export, "_read", lambda path: (file := right(path)) | {"expr": file["expr"] + 1})
    with pytest.raises(step.StepError, match="coefficients beyond"):
        export.run(job)
    shutil.rmtree(job.output.vhap)
    monkeypatch.setattr(export, "_read", lambda path: (file := right(path)) | {"rotation": -file["rotation"]})
    with pytest.raises(step.StepError, match="fault of the export"):
        export.run(job)


def test_rule_is_run_only_when_asked_for(tmp_path: Path) -> None:
    pipeline = Pipeline.create(tmp_path / "run", ("ann", "bob"))
    for target in ("export_all", "results/ann/export/export.json"):
        refused = pipeline.run("-n", target)
        assert refused.code == 1 and "the default head (head.model: anny) cannot be written as FLAME codes" in refused.text
    assert pipeline.plan() and not pipeline.ran()
    (pipeline.folder / "generic_model.pkl").write_text("a file of FLAME")
    pipeline.append("config/config.yaml", "head: {model: flame, path: generic_model.pkl}\n")
    asked = pipeline.plan("results/ann/export/export.json")
    assert {"export ann", "fit ann", "trim ann"} <= asked
    assert not [job for job in asked if "bob" in job or job.startswith("train")]
    assert pipeline.plan("export_all") >= {"export_all", "probe ann", "probe bob"}
    assert not [job for job in pipeline.plan() if job.startswith("export")]
    text = pipeline.run("-n", "-p", "results/ann/export/export.json", "--config", "export={pictures: test}").text
    assert '"pictures":"test"' in text
