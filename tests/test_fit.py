"""The fit and trim steps from files to files, on a made sequence with known truth."""

import json

import numpy as np
import pytest

from fitting import camera, energy, fit, trim
from fitting.config import FitConfig, TrimConfig
from fitting.head_model import HeadModel
from fitting.landmark_model import LandmarkModel
from tests.landmarked import CENTRE_PX, SIZE, detected, landmarked_head, random_state
from tests.made_subject import arguments
from workflow import step

FRAMES, LOST = 48, slice(20, 23)


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    """Input files of a clip whose face is lost for three frames, and the true state."""
    folder = tmp_path_factory.mktemp("subject")
    head = landmarked_head()
    head.save(folder / "head.npz")
    model = LandmarkModel.of(head)
    truth = random_state(model, FRAMES)
    seen = detected(model, truth, 0.7)
    points = np.full((FRAMES, 478, 3), 50.0, np.float32)
    local = energy.head_points(model, truth)
    depth = (np.einsum("bij,blj->bli", truth.rotation, local) + truth.translation[:, None])[..., 2]
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
    np.save(folder / "frames.npy", np.random.default_rng(0).integers(0, 255, (FRAMES, *SIZE, 3), np.uint8))
    np.save(folder / "alpha.npy", np.full((FRAMES, *SIZE), 255, np.uint8))
    crop = {"x": 0, "y": 0, "width": SIZE[1], "height": SIZE[0]}
    source = [int(2 * CENTRE_PX[1]), int(2 * CENTRE_PX[0])]
    index = {"fps": 30.0, "time_s": list(range(FRAMES)), "crop": crop, "scale": 1.0, "size": list(SIZE), "source_size": source}
    (folder / "frames.json").write_text(json.dumps(index))
    (folder / "split.json").write_text(json.dumps({"train": list(range(36)), "test": list(range(36, FRAMES))}))
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
    step.main(fit.run, FitConfig, arguments(config or {"keyframes": 15, "focal_px": 420.0}, given or inputs(folder), outputs))
    with np.load(outputs["track"]) as file:
        return {name: file[name] for name in file.files}, json.loads(outputs["report"].read_text())


@pytest.fixture(scope="module")
def fitted(subject, tmp_path_factory):
    return run_fit(subject[0], tmp_path_factory.mktemp("fit"))


def test_contract(fitted):
    track, report = fitted
    per_frame = {"expression": (3,), "rotation": (3,), "neck": (3,), "jaw": (3,), "eyes": (2, 3), "translation": (3,)}
    per_frame |= {"reprojection_px": (), "reinit": (), "usable": ()}
    expected = {"shape": (4,), "focal_px": (), "centre_px": (2,)} | {name: (FRAMES, *rest) for name, rest in per_frame.items()}
    assert {name: track[name].shape for name in expected} == expected
    assert all(np.isfinite(track[name]).all() for name in expected if track[name].dtype.kind == "f")
    assert np.flatnonzero(track["reinit"]).tolist() == [0, 36]  # a block never crosses the split
    assert report["decisions"]["focal"] == "fixed: given in config"
    assert report["unusable_frames"] == [20, 21, 22] == np.flatnonzero(~track["usable"]).tolist()


def test_posing_the_head_model_from_the_file_lands_on_the_landmarks(subject, fitted):
    """The track's convention (root joint, axis-angle) is HeadModel's own: what trim, train and drive read."""
    folder, truth = subject
    track, _ = fitted
    head = HeadModel.load(folder / "head.npz")
    model = LandmarkModel.of(head)
    rows = np.flatnonzero(track["usable"])
    away = []
    for row in rows:
        points = head.landmarks(trim_vertices(head, track, row)).numpy()[model.ids]
        points = points + track["landmark_bias"] @ camera.exp_rotation(track["rotation"][row].astype(float)).T
        skin = ~np.isin(np.arange(len(model.ids)), model.pupil)  # the toy's pupils are not skinned to its eyes
        pixel = camera.project(points, float(track["focal_px"]), track["centre_px"])
        true = (
            np.einsum("ij,lj->li", truth.rotation[row], energy.head_points(model, truth.frame([row]))[0]) + truth.translation[row]
        )
        away.append(np.linalg.norm(pixel - camera.project(true, truth.focal_px, CENTRE_PX), axis=1)[skin].mean())
    assert np.median(away) < 1.2


def trim_vertices(head, track, row):
    import torch

    return torch.from_numpy(trim.posed(head, track, row)).float()


def test_same_inputs_same_bytes(subject, fitted, tmp_path):
    again, _ = run_fit(subject[0], tmp_path)
    for name, value in fitted[0].items():
        np.testing.assert_array_equal(value, again[name])


def test_test_frames_do_not_reach_the_shared_unknowns(subject, fitted, tmp_path):
    folder, _ = subject
    with np.load(folder / "landmarks.npz") as file:
        spoiled = {name: file[name] for name in file.files}
    spoiled["points"] = np.where(np.arange(FRAMES)[:, None, None] >= 36, spoiled["points"] * 1.05, spoiled["points"])
    np.savez(tmp_path / "landmarks.npz", **spoiled)
    track, _ = run_fit(folder, tmp_path / "fit", inputs(folder) | {"landmarks": tmp_path / "landmarks.npz"})
    for name in ("shape", "focal_px", "landmark_bias"):
        np.testing.assert_array_equal(track[name], fitted[0][name])
    np.testing.assert_array_equal(track["expression"][:36], fitted[0]["expression"][:36])


def test_too_few_faces_is_one_sentence(subject, tmp_path, caplog):
    folder, _ = subject
    with np.load(folder / "landmarks.npz") as file:
        blind = {name: file[name] for name in file.files} | {"found": np.arange(FRAMES) < 3}
    np.savez(tmp_path / "landmarks.npz", **blind)
    with pytest.raises(SystemExit) as ended:
        run_fit(folder, tmp_path / "fit", inputs(folder) | {"landmarks": tmp_path / "landmarks.npz"})
    assert ended.value.code == 1
    assert "a face is found in 3 of 36 training frames; at least 5 are needed" in caplog.text


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
