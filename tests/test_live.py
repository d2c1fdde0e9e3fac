"""Frames one at a time: the poser against the head model, normals, an avatar's own picture, buffers, threads and refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from toy_head import toy_head, toy_track

from avatar import build
from avatar.config import TrainConfig
from avatar.dataset import Scene
from avatar.layered import posing, threads
from avatar.live import Live
from avatar.uses.sequence import Camera
from fitting.head_model import HeadModel
from fitting.raster import vertex_normals

PARTS = ("expression", "rotation", "neck", "jaw", "eyes", "translation")
SIZE = 56


class Row(NamedTuple):
    """As `play` hands it over."""

    expression: np.ndarray
    rotation: np.ndarray
    neck: np.ndarray
    jaw: np.ndarray
    eyes: np.ndarray
    translation: np.ndarray


@pytest.fixture(scope="module")
def head() -> HeadModel:
    """With all that a head model may have: eyes that turn, neck, correctives, joints moved by expressions."""
    plain = toy_head(24, 36)
    random = np.random.default_rng(3)
    weights = plain.skinning_weights.numpy() + random.random((plain.vertex_count, 5)).astype(np.float32) * 0.2
    return replace(
        plain,
        skinning_weights=torch.from_numpy(weights / weights.sum(1, keepdims=True)),
        pose_basis=torch.from_numpy(random.normal(size=(36, plain.vertex_count, 3)).astype(np.float32) * 1e-3),
        joint_expression_basis=torch.from_numpy(random.normal(size=(3, 5, 3)).astype(np.float32) * 1e-3),
    )


@pytest.fixture(scope="module")
def track(head: HeadModel) -> dict[str, np.ndarray]:
    """Six frames with every joint turned, before a camera of 56 px."""
    random = np.random.default_rng(5)
    made = toy_track(head, 6, SIZE)
    turned = {name: random.normal(size=np.shape(made[name])) * 0.15 for name in ("neck", "jaw", "eyes")}
    return made | {name: value.astype(np.float32) for name, value in turned.items()} | {"head_digest": head.digest}


@pytest.fixture(scope="module")
def avatar(head: HeadModel) -> torch.nn.Module:
    """A layered avatar whose textures are noise."""
    torch.manual_seed(0)
    settings = build.settings_of(TrainConfig(representation="layers", layers=5, bases=2, texture_size=64, uv_size=64))
    made = build.build(settings, head)
    made.shape_shell(torch.full((head.vertex_count,), 0.01))
    made.textures.copy_(torch.randn(made.textures.shape))
    torch.nn.init.normal_(made.out.weight, std=0.1)
    return made.eval()


def row_of(track: dict[str, np.ndarray], frame: int) -> Row:
    return Row(**{name: track[name][frame] for name in PARTS})


def camera_of(track: dict[str, np.ndarray], size: tuple[int, int] = (SIZE, SIZE)) -> Camera:
    return Camera(float(track["focal_px"]), track["centre_px"].astype(np.float64), size)


def picture(avatar: torch.nn.Module, scene: Scene, frame: int, size: tuple[int, int] = (SIZE, SIZE)) -> np.ndarray:
    """By the avatar's own `picture`, [H, W, 3] in levels."""
    with torch.no_grad():
        rendered, _ = avatar.picture(avatar.pose(*scene.heads([frame], "cpu")), scene.view(frame, size), torch.float32)
    return rendered.colour.numpy().reshape(*size, 3) * 255


def test_the_poser_is_the_head_model(head: HeadModel, track: dict[str, np.ndarray]) -> None:
    scene, poser = Scene(head, track, range(6)), posing.Poser(head, track["shape"])
    for frame in range(6):
        posed = poser.pose(row_of(track, frame)._asdict())
        np.testing.assert_allclose(posed.vertices_m, scene.vertices_m[frame], atol=5e-7)
        np.testing.assert_allclose(posed.displacement_m, scene.displacement_m[frame], atol=5e-7)
        np.testing.assert_allclose(posed.codes, scene.codes[frame], atol=1e-7)
        np.testing.assert_allclose(posed.rotation, scene.rotation[frame], atol=1e-6)
        np.testing.assert_allclose(posed.offset_m, scene.offset_m[frame], atol=1e-6)
    assert np.abs(scene.displacement_m).max() > 1e-3  # something moved
    plain = toy_head(24, 36)
    bare = posing.Poser(plain, track["shape"]).pose(row_of(track, 2)._asdict())  # without correctives
    np.testing.assert_allclose(bare.vertices_m, Scene(plain, track | {"head_digest": plain.digest}, [2]).vertices_m[0], atol=5e-7)


def test_normals_layers_and_their_box(head: HeadModel) -> None:
    vertices, triangles = head.template.numpy(), head.triangles.numpy().astype(np.int32)
    odd = np.concatenate([triangles, [[0, 0, 1]], [[5, 6, 5]]]).astype(np.int32)
    found = posing.normals(vertices, odd)
    np.testing.assert_allclose(found, vertex_normals(vertices, odd), atol=1e-6)
    flat = np.concatenate([vertices, vertices[:3] + 1]).astype(np.float32)
    assert not posing.normals(flat, triangles)[-3:].any()  # vertices without triangles
    offsets = np.stack([np.full(len(vertices), 0.02), np.zeros(len(vertices))]).astype(np.float32)
    turn = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    places, points, box = posing.layers(vertices, found, offsets, turn, np.array([0, 0, 0.5]), 90.0, np.array([20.0, 30.0]))
    wanted = vertices + offsets[..., None] * found
    np.testing.assert_allclose(places, wanted, atol=1e-7)
    camera = wanted @ turn.T + [0, 0, 0.5]
    np.testing.assert_allclose(points[..., :2], camera[..., :2] / camera[..., 2:] * 90 + [20, 30], atol=1e-4)
    np.testing.assert_allclose(points[..., 2], camera[..., 2], atol=1e-6)
    np.testing.assert_allclose(box, [*points[..., :2].min((0, 1)), *points[..., :2].max((0, 1))], atol=1e-4)
    behind = posing.layers(vertices, found, offsets, turn, np.array([0, 0, -0.5]), 90.0, np.array([20.0, 30.0]))
    assert behind[2][0] > behind[2][2] and np.isfinite(behind[1]).all()


def test_a_layered_avatar_is_drawn_as_its_own_picture(head, avatar, track) -> None:  # noqa: ANN001
    scene, live = Scene(head, track, range(6)), Live(avatar, head, track["shape"], camera_of(track), torch.float32)
    for frame in (0, 5, 2):  # buffers of one frame serve the next
        image = live.frame(row_of(track, frame))
        wanted = picture(avatar, scene, frame)
        assert image.shape == (SIZE, SIZE, 3) and image.dtype == np.uint8 and wanted.std() > 10
        away = np.abs(image - wanted)
        assert np.quantile(away, 0.999) < 2.5 and away.mean() < 0.5  # textures of 8 bits; a pixel on an edge may differ
        assert set(live.milliseconds) == {"pose", "networks", "raster", "draw", "frame"}
        assert all(value > 0 for value in live.milliseconds.values())
    first = live.frame(dict(row_of(track, 0)._asdict()))
    kept = first.copy()
    live.frame(row_of(track, 5))
    assert (first == kept).all()  # the caller's own
    lower = Live(avatar, head, track["shape"], camera_of(track), torch.bfloat16).frame(row_of(track, 0))
    assert 0 < np.abs(lower.astype(int) - first).mean() < 3


def test_one_sample_a_pixel_is_nearly_the_same_picture(head, avatar, track) -> None:  # noqa: ANN001
    given = avatar, head, track["shape"], camera_of(track), torch.float32
    one, two = (Live(*given, samples=samples).frame(row_of(track, 1)).astype(float) for samples in (1, 2))
    assert 0 < np.abs(one - two).mean() < 0.25 * np.abs(two - 255).mean()  # of textures of noise


def test_threads_do_not_change_the_picture_nor_torch(head, avatar, track, monkeypatch) -> None:  # noqa: ANN001
    torches = torch.get_num_threads()
    live, images = Live(avatar, head, track["shape"], camera_of(track), torch.float32), []
    for count in (1, 2, 3):
        monkeypatch.setattr(threads, "count", lambda count=count: count)
        images.append(live.frame(row_of(track, 1)))
    assert all((image == images[0]).all() for image in images)
    assert torch.get_num_threads() == torches


@pytest.mark.parametrize("size", [(20, 90), (90, 20), (1, 1)])
def test_heads_beside_across_and_behind_the_picture(head, avatar, track, size: tuple[int, int]) -> None:  # noqa: ANN001
    scene = Scene(head, track, range(6))
    live = Live(avatar, head, track["shape"], camera_of(track, size), torch.float32)
    wanted = picture(avatar, scene, 3, size)
    assert np.quantile(np.abs(live.frame(row_of(track, 3)) - wanted), 0.99) < 2.5
    aside = row_of(track, 3)._replace(translation=np.array([5.0, 0, 0.6]))
    assert (live.frame(aside) == 255).all()
    assert (live.frame(aside._replace(translation=np.array([0, 0, -0.6]))) == 255).all()
    inside = live.frame(aside._replace(translation=np.zeros(3)))  # the camera in the head: odd, but no crash
    assert inside.shape == (*size, 3)


def test_any_other_avatar_by_its_own_picture(head: HeadModel, track: dict[str, np.ndarray]) -> None:
    torch.manual_seed(0)
    keys = {"mlp_width": 16, "colour_width": 16, "feature_channels": 8, "bands": 2, "max_samples": 4, "static_features": True}
    field = build.build(build.settings_of(TrainConfig(**keys)), head).eval()
    scene, size = Scene(head, track, range(6)), (12, 12)
    live = Live(field, head, track["shape"], camera_of(track, size), torch.float32)
    assert np.abs(live.frame(row_of(track, 1)) - picture(field, scene, 1, size)).max() < 1.5
    assert set(live.milliseconds) == {"pose", "draw", "frame"}


def test_rows_that_do_not_fit_are_refused(head, avatar, track) -> None:  # noqa: ANN001
    live, row = Live(avatar, head, track["shape"], camera_of(track)), row_of(track, 0)
    wrong: dict[str, Any] = {"expression": np.zeros(2), "eyes": np.zeros(3), "neck": np.full(3, np.nan), "jaw": [np.inf, 0, 0]}
    for name, value in wrong.items():
        with pytest.raises(ValueError, match=name):
            live.frame(row._replace(**{name: value}))
    part = row._asdict()
    del part["jaw"]
    with pytest.raises(ValueError, match="lack jaw"):
        live.frame(part)
    with pytest.raises(ValueError, match="lack rotation"):
        live.frame(object())
