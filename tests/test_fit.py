"""The fit and trim steps from files to files, on a made sequence with known truth."""

import json
import shutil

import numpy as np
import pytest
import torch

from fitting import camera, fit, settings, trim
from fitting.config import FitConfig, TrimConfig
from fitting.head_model import HeadModel
from tests.landmarked import CENTRE_PX, SIZE, detected, landmarked_head, model_of, picture, points_of, random_state
from tests.made_subject import arguments
from workflow import step

FRAMES, LOST = 32, slice(12, 15)
TRAIN = 22
REPORT = {
    "frames", "usable", "unusable_frames", "cuts", "reinitialised", "keyframes", "reprojection_percent_of_interocular",
    "heldout_percent_of_interocular", "interocular_px", "focal_px", "focal_relative_sd", "shape_largest_sigma", "yaw_degrees",
    "pitch_degrees", "jitter", "seams", "expression_spread", "decisions", "not_determined", "seconds_by_stage",
    "landmark_ms_per_frame", "track_ms_per_frame",
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def fewer_samples():
    """Enough for a toy."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(settings, "SAMPLES", 600)
        yield


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    """Input files of a clip whose face is lost for three frames, and the true state."""
    folder = tmp_path_factory.mktemp("subject")
    head = landmarked_head()
    head.save(folder / "head.npz")
    rig, model = model_of(head)
    truth = random_state(model, FRAMES)
    seen = detected(model, truth, 0.7)
    points = np.full((FRAMES, 478, 3), 50.0, np.float32)
    depth = points_of(model, truth)[..., 2]
    points[:, model.ids, :2] = seen.points
    points[:, model.ids, 2] = (depth - truth.translation[:, None, 2]) * truth.focal_px / 0.6
    found = np.ones(FRAMES, bool)
    found[LOST] = False
    points[LOST] = np.nan
    names = [f"score{k}" for k in range(48)] + ["bump0", "bump1", "bump2"]
    scores = np.zeros((FRAMES, 51), np.float32)
    scores[:, -3:] = truth.expression
    scores[LOST] = np.nan
    np.savez(folder / "landmarks.npz", points=points, found=found, blendshapes=scores, blendshape_names=np.array(names))
    frames, alpha = zip(*(picture(rig, truth, k, supersample=2) for k in range(FRAMES)), strict=True)
    np.save(folder / "frames.npy", np.stack(frames))
    np.save(folder / "alpha.npy", np.stack(alpha))
    crop = {"x": 0, "y": 0, "width": SIZE[1], "height": SIZE[0]}
    source = [int(2 * CENTRE_PX[1]), int(2 * CENTRE_PX[0])]
    time_s = [k / 30 for k in range(FRAMES)]
    index = {"fps": 30.0, "time_s": time_s, "crop": crop, "scale": 1.0, "size": list(SIZE), "source_size": source}
    (folder / "frames.json").write_text(json.dumps(index))
    (folder / "split.json").write_text(json.dumps({"train": list(range(TRAIN)), "test": list(range(TRAIN, FRAMES))}))
    return folder, truth


def inputs(folder):
    names = {
        "head": "head.npz",
        "frames": "frames.npy",
        "index": "frames.json",
        "landmarks": "landmarks.npz",
        "alpha": "alpha.npy",
    }
    return {name: folder / file for name, file in (names | {"split": "split.json"}).items()}


def run_fit(folder, out, given=None, config=None):
    outputs = {"track": out / "track.npz", "report": out / "fit.json", "overlay": out / "overlay.mp4"}
    step.main(fit.run, FitConfig, arguments(config or {"keyframes": 8, "focal_px": 420.0}, given or inputs(folder), outputs))
    with np.load(outputs["track"]) as file:
        return {name: file[name] for name in file.files}, json.loads(outputs["report"].read_text())


@pytest.fixture(scope="module")
def fitted(subject, tmp_path_factory):
    return run_fit(subject[0], tmp_path_factory.mktemp("fit"))


def test_contract(fitted):
    track, report = fitted
    per_frame = {"expression": (3,), "rotation": (3,), "neck": (3,), "jaw": (3,), "eyes": (2, 3), "translation": (3,)}
    per_frame |= {"reprojection_px": (), "heldout_px": (), "reinit": (), "usable": ()}
    expected = {"shape": (4,), "focal_px": (), "centre_px": (2,)} | {name: (FRAMES, *rest) for name, rest in per_frame.items()}
    assert {name: track[name].shape for name in expected} == expected
    reals = [name for name in expected if track[name].dtype.kind == "f"]
    assert all(track[name].dtype == np.float32 for name in reals)
    assert all(np.isfinite(track[name]).all() for name in reals if name != "heldout_px")
    assert np.flatnonzero(track["reinit"]).tolist() == [0, TRAIN]  # a block never crosses the split
    assert report["unusable_frames"] == [12, 13, 14] == np.flatnonzero(~track["usable"]).tolist()
    assert not track["neck"].any() and not track["eyes"][..., 2].any()


def test_report(fitted):
    _, report = fitted
    assert set(report) >= REPORT
    assert report["frames"] == FRAMES and report["usable"] == FRAMES - 3
    assert report["focal_px"] == pytest.approx(420, rel=0.01) and report["decisions"]["focal"] == "fixed: given in config"
    assert {"neck", "jaw joint", "gaze", "light", "expression"} <= set(report["decisions"])
    assert set(report["keyframes"]) <= set(range(TRAIN))
    errors = report["reprojection_percent_of_interocular"]
    assert 0 < errors["p50"] <= errors["p90"] <= errors["p99"] < 5
    assert {"calibrate", "track", "pixels", "bundle", "held_out", "overlay"} <= set(report["seconds_by_stage"])
    assert report["yaw_degrees"][0] < report["yaw_degrees"][1]
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_posing_the_head_model_from_the_file_lands_on_the_landmarks(subject, fitted):
    """The track's convention (root joint, axis-angle) is HeadModel's own: what trim, train and drive read."""
    folder, truth = subject
    track, _ = fitted
    head = HeadModel.load(folder / "head.npz")
    _, model = model_of(head)
    true = camera.project(points_of(model, truth), truth.focal_px, CENTRE_PX)
    away = []
    for row in np.flatnonzero(track["usable"]):
        points = head.landmarks(trim_vertices(head, track, row)).numpy()[model.ids]
        points = points + track["landmark_bias"] @ camera.exp_rotation(track["rotation"][row].astype(float)).T
        pixel = camera.project(points, float(track["focal_px"]), track["centre_px"])
        away.append(np.linalg.norm(pixel - true[row], axis=1).mean())
    assert np.median(away) < 1.2


def trim_vertices(head, track, row):
    return torch.from_numpy(trim.posed(head, track, row)).float()


def test_same_inputs_same_bytes(subject, fitted, tmp_path):
    again, _ = run_fit(subject[0], tmp_path)
    for name, value in fitted[0].items():
        np.testing.assert_array_equal(value, again[name])


def spoiled(folder, out):
    """Copies of the landmarks, frames and mattes whose test frames are wrong."""
    with np.load(folder / "landmarks.npz") as file:
        values = {name: file[name] for name in file.files}
    late = np.arange(FRAMES) >= TRAIN
    values["points"] = np.where(late[:, None, None], values["points"] * 1.05, values["points"])
    values["blendshapes"] = np.where(late[:, None], 1 - values["blendshapes"], values["blendshapes"])
    np.savez(out / "landmarks.npz", **values)
    for name in ("frames", "alpha"):
        pictures = np.load(folder / f"{name}.npy")
        pictures[late] = 255 - pictures[late]
        np.save(out / f"{name}.npy", pictures)
    return {"landmarks": out / "landmarks.npz", "frames": out / "frames.npy", "alpha": out / "alpha.npy"}


def test_test_frames_change_nothing_in_the_training_rows(subject, fitted, tmp_path):
    """Landmarks, scores, pictures and mattes of the test tail spoiled."""
    folder, _ = subject
    track, report = run_fit(folder, tmp_path / "fit", inputs(folder) | spoiled(folder, tmp_path))
    for name in ("shape", "focal_px", "landmark_bias"):
        np.testing.assert_array_equal(track[name], fitted[0][name])
    for name in ("expression", "rotation", "translation", "eyes", "jaw", "usable"):
        np.testing.assert_array_equal(track[name][:TRAIN], fitted[0][name][:TRAIN], name)
    assert np.abs(track["translation"] - fitted[0]["translation"])[TRAIN:].max() > 1e-4
    assert report["keyframes"] == fitted[1]["keyframes"]


def test_too_few_faces_is_one_sentence(subject, tmp_path, caplog):
    folder, _ = subject
    with np.load(folder / "landmarks.npz") as file:
        blind = {name: file[name] for name in file.files} | {"found": np.arange(FRAMES) < 3}
    np.savez(tmp_path / "landmarks.npz", **blind)
    with pytest.raises(SystemExit) as ended:
        run_fit(folder, tmp_path / "fit", inputs(folder) | {"landmarks": tmp_path / "landmarks.npz"})
    assert ended.value.code == 1
    assert "a face is found in 3 of 22 training frames; at least 5 are needed" in caplog.text
    assert "ann" in caplog.text and str(tmp_path / "landmarks.npz") in caplog.text
    assert not (tmp_path / "fit" / "track.npz").exists()


def test_landmarks_of_another_clip_are_refused(subject, tmp_path, caplog):
    folder, _ = subject
    with np.load(folder / "landmarks.npz") as file:
        short = {name: file[name] for name in file.files}
    for name in ("points", "found", "blendshapes"):
        short[name] = short[name][:-2]
    np.savez(tmp_path / "landmarks.npz", **short)
    with pytest.raises(SystemExit):
        run_fit(folder, tmp_path / "fit", inputs(folder) | {"landmarks": tmp_path / "landmarks.npz"})
    assert "landmarks.npz: 30 rows for 32 frames" in caplog.text


def test_a_head_model_that_is_none_is_named(subject, tmp_path, caplog):
    folder, _ = subject
    (tmp_path / "head.npz").write_bytes(b"no head")
    with pytest.raises(SystemExit):
        run_fit(folder, tmp_path / "fit", inputs(folder) | {"head": tmp_path / "head.npz"})
    assert "head.npz: not a baked head model" in caplog.text


def test_the_scale_of_the_frames_scales_the_focal_length(subject, tmp_path):
    """Frames at half the source's size: focal_px in config is the source's."""
    folder, _ = subject
    index = json.loads((folder / "frames.json").read_text())
    index |= {"scale": 0.5, "source_size": [2 * side for side in index["source_size"]]}
    shutil.copy(folder / "frames.json", tmp_path / "index.json")
    (tmp_path / "index.json").write_text(json.dumps(index))
    weights = {"photometric": 0.0, "silhouette": 0.0, "temporal": 0.0}
    config = {"keyframes": 8, "focal_px": 840.0, "weights": weights}
    track, report = run_fit(folder, tmp_path / "fit", inputs(folder) | {"index": tmp_path / "index.json"}, config)
    assert float(track["focal_px"]) == pytest.approx(420, rel=0.01)
    np.testing.assert_allclose(track["centre_px"], CENTRE_PX)
    assert report["decisions"]["light"].startswith("not modelled")


def test_trim_refuses_another_head_model(subject, fitted, tmp_path, caplog):
    folder, _ = subject
    track = fitted[0] | {"head_digest": np.array("another")}
    np.savez(tmp_path / "track.npz", **track)
    given = {name: path for name, path in inputs(folder).items() if name in ("head", "frames", "alpha")} | {
        "track": tmp_path / "track.npz"
    }
    outputs = {"alpha": tmp_path / "alpha.npy", "report": tmp_path / "trim.json"}
    with pytest.raises(SystemExit):
        step.main(trim.run, TrimConfig, arguments({}, given, outputs))
    assert "fitted with head model another" in caplog.text
    assert not outputs["alpha"].exists()
