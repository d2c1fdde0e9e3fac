"""Exports: what other programs read back is the track; a wrong convention does not pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from exported import FRAMES, SIZE, flame_like, moving, nha_difference, nha_file, vhap_difference, vhap_file
from scipy.spatial.transform import Rotation

from fitting import export, export_nha, export_pose, export_vhap, verify_export
from fitting.camera import project
from fitting.head_model import HeadModel
from workflow import step


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return flame_like()


@pytest.fixture
def track(head: HeadModel) -> dict[str, np.ndarray]:
    return moving(head)


def test_nha_reads_back_the_track(head: HeadModel, track: dict) -> None:
    found = nha_difference(nha_file(head, track), head, track)
    assert found.frames == FRAMES
    assert found.vertex_mm < 0.001
    assert found.pixel_px < 0.001


def test_vhap_reads_back_the_track_but_for_whole_pixels_of_padding(head: HeadModel, track: dict) -> None:
    found = vhap_difference(vhap_file(head, track), head, track)
    assert found.vertex_mm < 0.001
    assert found.pixel_px < 0.25 * np.sqrt(2) + 0.001


def test_frontal_head_is_pi_about_y_in_nha_and_the_identity_in_vhap(head: HeadModel, track: dict) -> None:
    track["rotation"] = np.zeros_like(track["rotation"])
    np.testing.assert_allclose(nha_file(head, track)["rotation"], np.tile([0, np.pi, 0], (FRAMES, 1)), atol=1e-6)
    np.testing.assert_allclose(vhap_file(head, track)["rotation"], 0, atol=1e-7)


def test_nha_rotation_does_not_jump_where_the_head_passes_the_front(head: HeadModel, track: dict) -> None:
    track["rotation"] = np.stack([np.zeros(FRAMES), np.linspace(-0.1, 0.1, FRAMES), np.zeros(FRAMES)], 1)
    written = nha_file(head, track)["rotation"]
    assert np.abs(np.diff(written, axis=0)).max() < 0.05
    exact = Rotation.from_rotvec([0, np.pi, 0]) * Rotation.from_rotvec(track["rotation"] * [1, -1, -1])
    np.testing.assert_allclose((Rotation.from_rotvec(written) * exact.inv()).magnitude(), 0, atol=1e-6)


def test_nha_keys_and_shapes(head: HeadModel, track: dict) -> None:
    file = nha_file(head, track)
    n = FRAMES
    assert {name: value.shape for name, value in file.items()} == {
        "rotation": (n, 3), "translation": (n, 3), "neck_pose": (n, 3), "jaw_pose": (n, 3), "eyes_pose": (n, 6),
        "shape": (300,), "expr": (n, 100), "texture": (100,), "light": (n, 9, 3), "K": (3,), "RT": (3, 4),
        "frame": (n,), "view": (n,), "image_size": (2,), "n_processed": (),
    }  # fmt: skip
    assert {file[name].dtype for name in ("rotation", "translation", "jaw_pose", "shape", "expr", "light", "K")} == {
        np.dtype("f4")
    }
    assert file["frame"].tolist() == list(range(1, n + 1))
    assert set(file["view"]) == {"image_0000.png"}
    assert file["image_size"].tolist() == list(SIZE)
    np.testing.assert_allclose(file["K"], [151.7 / 60, 20.3 / 48, 1 - 37.1 / 60], rtol=1e-6)
    np.testing.assert_allclose(file["light"][:, 0], np.sqrt(4 * np.pi), rtol=1e-6)
    assert not file["light"][:, 1:].any()
    assert not file["shape"][4:].any() and not file["expr"][:, 4:].any() and file["expr"][:, :4].any()


def test_neutral_jaw_of_nha_is_not_zero(head: HeadModel, track: dict) -> None:
    track["jaw"] = np.zeros_like(track["jaw"])
    np.testing.assert_allclose(nha_file(head, track)["jaw_pose"], np.tile([np.arctanh(-55 / 65), 0, 0], (FRAMES, 1)), atol=1e-6)


def test_vhap_keys_and_shapes(head: HeadModel, track: dict) -> None:
    file, n = vhap_file(head, track), FRAMES
    assert {name: value.shape for name, value in file.items()} == {
        "rotation": (n, 3), "translation": (n, 3), "neck_pose": (n, 3), "jaw_pose": (n, 3), "eyes_pose": (n, 6),
        "shape": (300,), "expr": (n, 100), "timestep_id": (n,), "n_processed_frames": (), "focal_length": (1,), "lights": (9, 3),
        "tex_extra": (3, 2048, 2048), "static_offset": (1, 5143, 3), "image_size": (2,),
    }  # fmt: skip
    np.testing.assert_allclose(file["focal_length"], 151.7 / max(file["image_size"]), rtol=1e-6)


def test_limits_clip_to_one_percent_inside_and_touch_nothing_else(head: HeadModel, track: dict) -> None:
    track["jaw"][0], track["jaw"][1] = [1.3, 0.2, -0.2], [-0.5, 0, 0]
    track["eyes"][0, 1] = [2, -2, 0.5]
    pose = export_pose.of_track(head, track)
    inside = export_nha.limited(pose)
    np.testing.assert_allclose(np.degrees(inside.jaw[0]), [60 - 0.65, -0.098, 0.098])
    np.testing.assert_allclose(np.degrees(inside.jaw[1, 0]), -5 + 0.65)
    np.testing.assert_allclose(np.degrees(inside.eyes[0, 1]), [49, 49, -0.098])
    np.testing.assert_array_equal(inside.jaw[2:], pose.jaw[2:])
    np.testing.assert_array_equal(inside.neck, pose.neck)
    assert nha_difference(nha_file(head, track), head, track).vertex_mm > 1  # against what the track says
    assert nha_difference(nha_file(head, track), head, export._limited(head, track, pose)).vertex_mm < 0.001


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("rotation", lambda value: -value),
        ("rotation", lambda value: (Rotation.from_rotvec([0, np.pi, 0]) * Rotation.from_rotvec(value)).as_rotvec()),
        ("jaw_pose", lambda value: np.stack([np.radians(-5) + (np.tanh(value[:, 0]) + 1) / 2 * np.radians(65), *value.T[1:]], 1)),
        ("neck_pose", lambda value: value * [1, -1, 1]),
        ("eyes_pose", lambda value: value[:, [3, 4, 5, 0, 1, 2]]),
        ("translation", lambda value: value - [0, 0.09, 0]),
        ("translation", lambda value: value * [-1, -1, 1]),
        ("K", lambda value: value * [1, 1, 0] + [0, 0, 1 - value[2]]),
        ("expr", lambda value: value[:, ::-1]),
    ],
)
def test_nha_in_a_wrong_convention_does_not_pass(head: HeadModel, track: dict, name: str, change: Callable) -> None:
    file = nha_file(head, track)
    file[name] = change(file[name])
    with pytest.raises((step.StepError, ValueError)):
        export._verdict(Path("file.npz"), nha_difference(file, head, track))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("rotation", lambda value: value * [1, -1, -1]),
        ("jaw_pose", lambda value: -value),
        ("neck_pose", lambda value: value * [1, -1, -1]),
        ("eyes_pose", lambda value: value[:, [3, 4, 5, 0, 1, 2]]),
        ("translation", lambda value: value + [0, -0.09, 0]),
        ("translation", lambda value: value - [0, 0, 1]),
        ("focal_length", lambda value: value * 48 / 60),
    ],
)
def test_vhap_in_a_wrong_convention_does_not_pass(head: HeadModel, track: dict, name: str, change: Callable) -> None:
    file = vhap_file(head, track)
    file[name] = change(file[name])
    with pytest.raises(step.StepError, match="mm"):
        export._verdict(Path("file.npz"), vhap_difference(file, head, track), 0.36)


@pytest.mark.parametrize(("vertex_mm", "pixel_px"), [(0.011, 0.0), (0.0, 0.051), (float("nan"), 0.0), (0.0, float("nan"))])
def test_either_millimetres_or_pixels_suffice_to_fail(vertex_mm: float, pixel_px: float) -> None:
    assert export._verdict(Path("file.npz"), verify_export.Difference(0.009, 0.049, 3))["frames"] == 3
    with pytest.raises(step.StepError, match=r"file\.npz.*limits 0\.01 mm, 0\.05 px"):
        export._verdict(Path("file.npz"), verify_export.Difference(vertex_mm, pixel_px, 3))


def test_a_file_with_a_nan_does_not_pass(head: HeadModel, track: dict) -> None:
    file = nha_file(head, track)
    file["expr"][3, 0] = np.nan
    with pytest.raises(step.StepError):
        export._verdict(Path("file.npz"), nha_difference(file, head, track))


@pytest.mark.parametrize("centre", [(20.3, 37.1), (24.0, 30.0), (-3.4, 65.2), (47.9, 0.2)])
def test_canvas_puts_the_principal_point_in_the_middle(centre: tuple[float, float]) -> None:
    canvas = export_vhap.Canvas.around(SIZE, np.array(centre))
    off = canvas.centre_px(np.array(centre)) - [canvas.width / 2, canvas.height / 2]
    assert np.abs(off).max() <= 0.25 + 1e-9
    picture = np.arange(60 * 48 * 3, dtype=np.uint8).reshape(60, 48, 3)
    placed = canvas.place(picture, 7)
    assert placed.shape == (canvas.height, canvas.width, 3)
    np.testing.assert_array_equal(placed[canvas.top : canvas.top + 60, canvas.left : canvas.left + 48], picture)
    assert canvas.left == 0 or canvas.left + 48 == canvas.width


def test_folder_is_moved_with_its_camera(head: HeadModel, track: dict) -> None:
    file = vhap_file(head, track)
    centre = export_vhap.Canvas.around(SIZE, track["centre_px"]).centre_px(track["centre_px"])
    written = export_vhap.transforms(file, {"train": list(range(FRAMES)), "test": []}, 151.7, centre)
    params = [export_vhap.flame_param(file, row) for row in range(FRAMES)]
    np.testing.assert_allclose(np.mean([item["translation"] for item in params], 0), 0, atol=1e-6)
    matrix = np.array(written["transforms.json"]["frames"][0]["transform_matrix"])
    np.testing.assert_allclose(matrix[:3, 3], [0, 0, 1] - file["translation"].mean(0), atol=1e-6)
    frame, flame = written["transforms.json"]["frames"][5], verify_export.Flame.of(head)
    vertices = export_pose.vertices(head, track, np.array([5]))
    pixels = project(vertices, 151.7, centre)
    for centred, allowed in ((False, 0.001), (True, 0.36)):
        seen = verify_export.nerf_folder(params[5], flame, frame, centred)
        np.testing.assert_allclose(seen[0], vertices, atol=1e-6)
        np.testing.assert_allclose(seen[1], pixels, atol=allowed)
    unmoved = frame | {"transform_matrix": written["transforms_backup.json"]["frames"][5]["transform_matrix"]}
    assert np.abs(verify_export.nerf_folder(params[5], flame, unmoved)[0] - vertices).max() > 0.1


@pytest.fixture(scope="module")
def flame_shaped() -> tuple[HeadModel, verify_export.Flame]:
    """The FLAME-shaped file as the project bakes it, and as a FLAME program holds it: straight from the file's own keys."""
    loader, flame_file = pytest.importorskip("fitting.flame"), pytest.importorskip("flame_file")
    raw, shapes, expressions = flame_file.content(), 20, 15
    blend, regressor = raw["shapedirs"].transpose(2, 0, 1), np.asarray(raw["J_regressor"].todense())
    shape, expression = blend[:shapes], blend[300 : 300 + expressions]
    program = verify_export.Flame(
        template=raw["v_template"],
        shape_basis=shape,
        expression_basis=expression,
        pose_basis=raw["posedirs"].transpose(2, 0, 1),
        joints=regressor @ raw["v_template"],
        joint_shape_basis=regressor @ shape,
        joint_expression_basis=regressor @ expression,
        weights=raw["weights"],
    )
    arrays = {name: raw[name] for name in ("v_template", "shapedirs", "posedirs", "weights")}
    arrays |= {"f": raw["f"].astype(np.int64), "J_regressor": regressor}
    baked = loader.bake(arrays, shapes, expressions, version="2023")
    double = {item.name: getattr(baked, item.name) for item in fields(HeadModel)}
    double = {
        name: value.double() if torch.is_tensor(value) and value.is_floating_point() else value for name, value in double.items()
    }
    return HeadModel(**double), program


def test_a_baked_flame_file_is_the_file_again(flame_shaped: tuple[HeadModel, verify_export.Flame]) -> None:
    head, program = flame_shaped
    again = verify_export.Flame.of(head)
    for item in fields(verify_export.Flame):
        np.testing.assert_allclose(getattr(again, item.name), getattr(program, item.name), atol=2e-7, err_msg=item.name)


def test_exports_are_the_track_for_a_program_with_the_file_itself(flame_shaped: tuple[HeadModel, verify_export.Flame]) -> None:
    head, program = flame_shaped
    random = np.random.default_rng(8)
    track = moving(flame_like()) | {
        "shape": random.normal(size=20).astype(np.float32),
        "expression": np.pad(random.normal(size=(FRAMES, 15)), ((0, 0), (0, 2))).astype(np.float32),
    }
    rows = np.arange(FRAMES)
    vertices = export_pose.vertices(head, track, rows)
    for seen in (
        verify_export.nha(nha_file(head, track), program, rows),
        verify_export.vhap(vhap_file(head, track), program, rows),
    ):
        assert 1000 * np.linalg.norm(seen[0] - vertices, axis=-1).max() < 0.002
    closed = track | {"expression": track["expression"] + np.eye(17, dtype=np.float32)[15]}  # the left eyelid
    lost = export._loss(head, closed, export_pose.without_eyelids(head, closed), ["expression"])
    assert lost["frames"] == FRAMES and 2 < lost["max_mm"] < 30
