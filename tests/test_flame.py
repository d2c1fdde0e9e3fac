"""A FLAME-shaped file as a head model: equal to smplx, checked key by key, with charts, lids, mouth cavity and landmarks."""

import pickle
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse
import torch
from pipeline import Pipeline
from pydantic import ValidationError

from fitting import chart, correspondence, flame
from fitting import head as head_step
from fitting.config import HeadConfig
from fitting.detection import FaceFinder
from fitting.head_model import HeadModel
from tests import flame_file
from workflow import step

AXES = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return flame.bake(flame_file.checked(), 100, 50)


@pytest.fixture
def arrays() -> dict:
    return dict(flame_file.checked())


def to_double(head: HeadModel, folder: Path) -> HeadModel:
    head.save(folder / "head.npz")
    return HeadModel.load(folder / "head.npz", torch.float64)


# Equal to the reference


@pytest.mark.parametrize("order", ["left first", "right first"])
def test_equals_smplx(tmp_path, order):
    """smplx.FLAME on the same file, all parameters random, to 1e-6 m."""
    smplx = pytest.importorskip("smplx", reason="licensed for non-commercial research; make test installs it")
    content = flame_file.content() if order == "left first" else flame_file.other_eye_order()
    path = flame_file.write(tmp_path / "FLAME_NEUTRAL.pkl", content)
    embedding = {"lmk_face_idx": np.zeros(51, np.uint32), "lmk_b_coords": np.full((51, 3), 1 / 3)}
    (tmp_path / "flame_static_embedding.pkl").write_bytes(pickle.dumps(embedding))  # smplx reads it whatever it is asked
    reference = smplx.FLAME(str(tmp_path), num_betas=300, num_expression_coeffs=100, batch_size=3, dtype=torch.float64)
    ours = to_double(flame.bake(flame.read(path), 300, 100), tmp_path)
    generator = torch.Generator().manual_seed(1)
    draw = lambda *size: 0.5 * torch.randn(*size, generator=generator, dtype=torch.float64)  # noqa: E731
    shape, expression, translation = draw(300), draw(3, 100), draw(3, 3)
    rotation, neck, jaw, left, right = draw(5, 3, 3)
    first, second = (left, right) if order == "left first" else (right, left)
    theirs = reference(
        betas=shape.expand(3, -1), expression=expression, global_orient=rotation, neck_pose=neck, jaw_pose=jaw, leye_pose=first,
        reye_pose=second, transl=translation,
    ).vertices  # fmt: skip
    coefficients = torch.cat([expression, torch.zeros(3, 2, dtype=torch.float64)], 1)  # lids open
    turn = lambda vector: vector * AXES  # noqa: E731
    mine = ours.forward(
        shape, coefficients, turn(rotation), turn(neck), turn(jaw), torch.stack([turn(left), turn(right)], 1), turn(translation)
    )
    assert (mine * AXES - theirs).norm(dim=-1).max() < 1e-6


def test_every_kind_of_file_gives_the_same_model(head, tmp_path):
    content = flame_file.content()
    chumpy = flame_file.write(tmp_path / "chumpy.pkl", content, chumpy=("shapedirs", "v_template", "weights"))
    plain = tmp_path / "plain.npz"
    dense = {key: value.toarray() if scipy.sparse.issparse(value) else value for key, value in content.items()}
    np.savez(plain, **dense)
    for path in (chumpy, plain):
        assert flame.bake(flame.read(path), 100, 50).content_digest() == head.content_digest()


def test_counts_are_those_of_flame(arrays):
    assert arrays["v_template"].shape == (5023, 3) and arrays["f"].shape == (9976, 3) and arrays["shapedirs"].shape[2] == 400
    assert np.bincount(chart.components(arrays["f"], 5023)).tolist() == [3931, 546, 546]
    assert sorted(len(loop) for loop in chart.boundary_loops(arrays["f"])) == [30, 32]
    assert arrays["kintree_table"][0].tolist() == [-1, 0, 1, 1, 1]


# What is refused


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("shapedirs", None, r"shapedirs: expected an array of shape \(5023, 3, any\), found nothing"),
        ("v_template", np.zeros((6890, 3)), r"v_template: expected an array of shape \(5023, 3\), found \(6890, 3\)"),
        ("weights", np.zeros((5023, 24)), r"weights: expected an array of shape \(5023, 5\), found \(5023, 24\)"),
        ("posedirs", np.zeros((5023, 3, 207)), r"posedirs: expected .*36\), found \(5023, 3, 207\)"),
        ("J_regressor", np.zeros((5, 5000)), r"J_regressor: expected an array of shape \(5, 5023\), found \(5, 5000\)"),
        ("weights", np.full((5023, 5), 0.3), "weights: expected rows that sum to 1, found one that is 0.5 off"),
        ("J_regressor", np.zeros((5, 5023)), "J_regressor: expected rows that sum to 1"),
        ("f", np.full((9976, 3), 5023, np.uint32), "f: expected vertex numbers below 5023, found up to 5023"),
        ("f", np.zeros((9976, 3)), "f: expected integers, found float64"),
        ("v_template", np.full((5023, 3), np.nan), "v_template: expected finite numbers, found 15069 that are not"),
        ("v_template", np.full((5023, 3), 1.5), "v_template: expected a head around the origin in m"),
        ("kintree_table", np.array([[-1, 0, 1, 2, 3], [0, 1, 2, 3, 4]]), r"kintree_table: .*found \(-1, 0, 1, 2, 3\)"),
        ("shapedirs", np.zeros((5023, 3, 300)), "shapedirs: expected more than 300 columns, found 300"),
    ],
)  # fmt: skip
def test_damaged_file_is_named_with_key_expected_and_found(tmp_path, key, value, message):
    content = {**flame_file.content(), "shapedirs": np.zeros((5023, 3, 301))}
    content[key] = value
    if value is None:
        del content[key]
    path = flame_file.write(tmp_path / "mine.pkl", content)
    with pytest.raises(ValueError, match=r"mine\.pkl: " + message):
        flame.read(path)


def test_npz_with_objects_is_refused(tmp_path):
    path = tmp_path / "mine.npz"
    np.savez(path, v_template=np.array([{}], object))
    with pytest.raises(ValueError, match=r"mine\.npz: refused"):
        flame.read(path)


def test_mesh_without_eyeballs_is_refused(arrays):
    arrays["f"] = arrays["f"][(arrays["f"] < 4477).all(1)]
    with pytest.raises(ValueError, match="expected skin and two eyeballs"):
        flame.bake(arrays, 20, 10)


def test_eyeballs_on_one_joint_are_refused(arrays):
    arrays["weights"] = arrays["weights"].copy()
    arrays["weights"][:, 3] += arrays["weights"][:, 4]
    arrays["weights"][:, 4] = 0
    with pytest.raises(ValueError, match=r"with a joint of its own, found them on joints \[3, 3\]"):
        flame.bake(arrays, 20, 10)


@pytest.mark.parametrize(
    ("name", "is_open", "version"),
    [
        ("generic_model.pkl", False, "2020"), ("FLAME_NEUTRAL.pkl", False, "2020"), ("flame2023.pkl", False, "2023"),
        ("flame2023_no_jaw.pkl", False, "2023 no_jaw"), ("flame2023_Open.pkl", False, "2023 Open"),
        ("model.pkl", True, "2023 Open"), ("model.pkl", False, "unknown"),
    ],
)  # fmt: skip
def test_version(name, is_open, version):
    assert flame.version_of(name, is_open) == version


# Config and rules


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"model": "flame"}, "FLAME is not shipped"),
        ({"model": "anny", "path": "x.pkl"}, "head.model=flame only"),
        ({"model": "anny", "masks": "x.pkl"}, "head.model=flame only"),
        ({"shape_components": 100, "samples": 150}, "at least twice"),
    ],
)
def test_config_names_the_mistake(config, message):
    with pytest.raises(ValidationError, match=message):
        HeadConfig(**config)


def test_plan_with_flame(tmp_path):
    """One sentence without the file; with it the head is its own output, and another content bakes again."""
    pipeline = Pipeline.create(tmp_path / "run", ("ann",))
    said = pipeline.run("-n", "--config", "head={model: flame}")
    assert said.code == 1 and "head.path" in said.last_line and "https://flame.is.tue.mpg.de" in said.last_line
    pipeline.append("config/config.yaml", "head: {model: flame, path: mine/generic_model.pkl}\n")
    said = pipeline.run("-n")
    assert said.code == 1 and "head.path: there is no file mine/generic_model.pkl" in said.last_line
    (pipeline.folder / "mine").mkdir()
    model = pipeline.folder / "mine" / "generic_model.pkl"
    model.write_text("one")
    target = "resources/heads/flame.npz"
    assert pipeline.run(target).code == 0
    assert (pipeline.folder / target).exists() and not pipeline.plan(target)
    model.touch()
    assert not pipeline.plan(target)
    pipeline.append("fitting/anny_head.py", "\nNEW = 1\n")  # the source that is not used
    assert not pipeline.plan(target)
    model.write_text("another")
    assert pipeline.plan(target) == {"head"}
    assert pipeline.run(target).code == 0
    pipeline.append("fitting/flame.py", "\nNEW = 1\n")
    assert pipeline.plan(target) == {"head"}


# The step


def job_with(folder: Path, name: str, **config) -> SimpleNamespace:
    """A job of the step `head` on a file of that name."""
    path = folder / name
    if not path.exists():
        flame_file.write(path)
    return SimpleNamespace(config=HeadConfig(model="flame", path=str(path), **config), input=SimpleNamespace(model=path))


@pytest.mark.parametrize(
    ("name", "jaw", "moves"),
    [("flame2023.pkl", None, True), ("flame2023_no_jaw.pkl", None, False), ("flame2023_no_jaw.pkl", True, True)],
)
def test_jaw_by_file_name_or_config(tmp_path, name, jaw, moves):
    head = head_step._flame(job_with(tmp_path, name, jaw=jaw, expression_components=10), flame, 10)
    assert bool(head.skinning_weights[:, 2].any()) == moves
    assert head.version.startswith("2023") and head.source.startswith("sha256 ") and len(head.source) == 7 + 64


def test_step_says_one_sentence_about_a_file_that_is_none(tmp_path):
    (tmp_path / "mine.pkl").write_bytes(b"no pickle")
    job = job_with(tmp_path, "mine.pkl")
    with pytest.raises(step.StepError, match=r"mine\.pkl: refused"):
        head_step.run(job)


# Landmarks


def test_detector_finds_the_face_and_pupils_lie_on_their_eyeballs(head, assets):
    with FaceFinder((assets / "face_landmarker.task").read_bytes(), video=False, max_faces=1) as finder:
        placed = correspondence.place(head, lambda image: next((face.points for face in finder.find(image)), None))
    assert placed.views == 21 and (placed.triangles >= 0).sum() > 350
    assert np.nanmedian(placed.spread_m) < 0.003
    corners = head.template.numpy()[head.triangles.numpy()[placed.triangles]]
    points = (corners * placed.barycentric[..., None]).sum(1)
    for landmark, joint, side in ((correspondence.RIGHT_IRIS, 4, -1), (correspondence.LEFT_IRIS, 3, 1)):
        on = head.triangles[placed.triangles[landmark]]
        assert (head.skinning_weights[on, joint] > 0.99).all() and points[landmark, 0] * side > 0.02
        ball = head.template[head.skinning_weights[:, joint] > 0.5]
        assert abs(points[landmark, 2] - float(ball[:, 2].min())) < 1e-3  # the front pole
    nose, chin = points[1], points[152]
    assert abs(nose[0]) < 0.003 and nose[2] < points[[33, 263], 2].min()
    assert points[33, 0] < 0 < points[263, 0]  # outer corners of the right and the left eye
    assert placed.triangles[152] < 0 or chin[1] > nose[1]


def test_users_embedding_wins_but_for_the_irises(head, tmp_path):
    placed = correspondence.Placement(np.full(478, 7), np.full((478, 3), 1 / 3), np.zeros(478), 21)
    index = np.array([4, 61, 468])
    path = tmp_path / "mediapipe_landmark_embedding.npz"
    given = {"landmark_indices": index, "lmk_face_idx": np.array([100, 200, 300], np.uint32), "lmk_b_coords": np.eye(3)}
    np.savez(path, **given)
    job = SimpleNamespace(input=SimpleNamespace(landmark_embedding=path))
    assert head_step._given_landmarks(job, flame, head, placed) == 2
    assert placed.triangles[[4, 61, 468, 5]].tolist() == [100, 200, 7, 7]
    np.testing.assert_array_equal(placed.barycentric[61], [0, 1, 0])
    np.savez(path, **{**given, "lmk_face_idx": np.array([100, 200, 9976])})
    with pytest.raises(step.StepError, match=r"mediapipe_landmark_embedding\.npz: a landmark or a triangle is out of range"):
        head_step._given_landmarks(job, flame, head, placed)
