"""Cameras and viewpoints against the mesh's own projection; pictures with depth against the scene."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from toy_head import toy_head, toy_track
from toy_run import train_in, write_subject

from avatar import build, render
from avatar.dataset import Scene
from avatar.uses import motion, sequence
from avatar.uses.sequence import Camera
from fitting.camera import exp_rotation

HEAD = toy_head(24, 36)
TRACK = toy_track(HEAD, 8, 40)
CAMERA = Camera(float(TRACK["focal_px"]), TRACK["centre_px"], (40, 40))


@pytest.fixture(scope="module")
def avatar(tmp_path_factory: pytest.TempPathFactory) -> torch.nn.Module:
    folder = tmp_path_factory.mktemp("sequence")
    paths = write_subject(folder)
    stored = torch.load(train_in(folder, paths, steps=60)["avatar"], weights_only=True)
    return build.restore(stored, HEAD)


def scene(frames: list[int] | None = None, camera: Camera = CAMERA) -> Scene:
    return sequence.scene_of(HEAD, TRACK["shape"], camera, motion.of_track(TRACK, frames or [6, 7], 25.0))


def facing(count: int) -> Scene:
    """The head straight before the camera."""
    zeros = np.zeros((count, 3))
    where = np.tile([0, 0, 0.8], (count, 1))
    still = motion.Motion(np.zeros((count, 3)), zeros, zeros, zeros, np.zeros((count, 2, 3)), where, 25.0)
    found = sequence.scene_of(HEAD, TRACK["shape"], CAMERA, still)
    found.offset_m[:, :2] -= sequence.head_centre_m(found)[:, :2]
    return found


def vertices_of(scene: Scene, place: int) -> np.ndarray:
    """[V, 3] m in camera axes."""
    return scene.vertices_m[place].double().numpy() @ scene.rotation[place].T + scene.offset_m[place]


def test_the_same_frame_as_the_step_render_draws(avatar: torch.nn.Module) -> None:
    own, other = scene([6]), Scene(HEAD, TRACK, [6])
    picture = sequence.render(avatar, own, 0, (40, 40), torch.float32, "cpu")
    drawn, evaluations = render.render_frame(avatar, other, 6, (40, 40), torch.float32, "cpu")[:2]
    np.testing.assert_array_equal(picture.image, drawn)
    assert picture.evaluations == evaluations and picture.milliseconds > 0


def test_depth_lies_where_the_head_is(avatar: torch.nn.Module) -> None:
    own = scene([6])
    picture = next(sequence.render_all(avatar, own, [0], (40, 40), torch.float32, "cpu"))
    inside = picture.image[..., 3] > 200
    assert inside.sum() > 200 and picture.depth_m.dtype == np.float32
    assert (picture.depth_m[picture.image[..., 3] == 0] == 0).all()
    rows, columns = np.nonzero(inside)
    pixels = np.stack([columns, rows], 1) + 0.5
    points = np.c_[(pixels - CAMERA.centre_px) / CAMERA.focal_px, np.ones(len(pixels))] * picture.depth_m[inside][:, None]
    mesh = vertices_of(own, 0)
    front = mesh[mesh[:, 2] < np.median(mesh[:, 2])]
    away = np.linalg.norm(points[:, None] - front, axis=-1).min(1)
    assert np.median(away) < 0.012  # the shell's own thickness


def test_resized_and_cut_cameras_see_the_same_rays() -> None:
    point = np.array([0.03, -0.02, 0.8])

    def pixel(camera: Camera) -> np.ndarray:
        return point[:2] / point[2] * camera.focal_px + camera.centre_px

    half = Camera(100.0, np.array([21.0, 19.0]), (36, 40)).resized(20)
    assert half.size == (18, 20)
    np.testing.assert_allclose(pixel(half), pixel(Camera(100.0, np.array([21.0, 19.0]), (36, 40))) / 2)
    assert (same := half.resized(4000)).size == half.size and same.focal_px == half.focal_px  # never larger
    part = CAMERA.window({"x": 10, "y": 6, "width": 20, "height": 28}, (14, 10))
    np.testing.assert_allclose(pixel(part), (pixel(CAMERA) - [10, 6]) / 2)
    with pytest.raises(ValueError, match="unstretched"):
        CAMERA.window({"x": 0, "y": 0, "width": 20, "height": 20}, (14, 10))
    with pytest.raises(ValueError, match="at least one pixel"):
        CAMERA.resized(0)


def test_a_viewpoint_is_a_camera_that_moved() -> None:
    """The turned head in the fixed camera against the head in a camera that went around it."""
    yaw, pitch = 0.5, 0.3
    still, moved = facing(1), facing(1)
    pivot = sequence.head_centre_m(still)
    sequence.turn(moved, sequence.viewpoint(np.array([yaw]), np.array([pitch])), pivot)
    distance = pivot[0, 2]
    place = pivot[0] + distance * np.array([np.sin(yaw) * np.cos(pitch), -np.sin(pitch), -np.cos(yaw) * np.cos(pitch)])
    forward = (pivot[0] - place) / distance
    right = np.cross([0, 1.0, 0], forward)
    right /= np.linalg.norm(right)
    looks = np.stack([right, np.cross(forward, right), forward])
    np.testing.assert_allclose(vertices_of(moved, 0), (vertices_of(still, 0) - place) @ looks.T, atol=1e-9)


def test_camera_angles_are_the_views_asked_for() -> None:
    yaw, pitch = np.radians([-35, 0, 20, 0, 0]), np.radians([0, 0, 10, 15, -15])
    views = facing(5)
    sequence.turn(views, sequence.viewpoint(yaw, pitch), sequence.head_centre_m(views))
    np.testing.assert_allclose(sequence.camera_angles(views), [yaw, pitch], atol=1e-7)


def test_a_head_that_turns_to_its_left_is_seen_from_its_right() -> None:
    head = facing(1)
    head.rotation = exp_rotation(np.array([[0, -0.3, 0]])) @ head.rotation  # the face goes to the picture's right, its left
    yaw, pitch = sequence.camera_angles(head)
    assert yaw[0] < -0.25 and abs(pitch[0]) < 0.05


def test_framed_camera_shows_all_of_the_head_and_little_else() -> None:
    views = facing(3)
    turns = sequence.viewpoint(np.array([-0.6, 0, 0.6]), np.zeros(3))
    sequence.turn(views, turns, sequence.head_centre_m(views))
    camera = sequence.framed(views, 90, np.full(HEAD.vertex_count, 0.01))
    assert max(camera.size) == 90 and all(side % 2 == 0 for side in camera.size)
    kept = (HEAD.region != 3).numpy()
    pixels = np.concatenate([views.pixels_of(k, views.vertices_m[k][kept].double().numpy()) for k in range(3)])
    assert (pixels > 2).all() and (pixels < np.array(camera.size[::-1]) - 2).all()
    extent = pixels.max(0) - pixels.min(0)
    assert (extent > 0.75 * np.array(camera.size[::-1])).all()
    views.offset_m[:, 2] -= 2
    with pytest.raises(ValueError, match="behind the camera"):
        sequence.framed(views, 90, np.zeros(HEAD.vertex_count))


def test_a_motion_of_another_head_model_is_refused(avatar: torch.nn.Module) -> None:
    wrong = motion.of_track(TRACK | {"expression": np.zeros((8, 5), np.float32)}, [0], 25.0)
    with pytest.raises(ValueError, match="the motion has 5 expression codes, the head model toy 3"):
        sequence.scene_of(HEAD, TRACK["shape"], CAMERA, wrong)
    assert list(sequence.render_all(avatar, scene([6]), [], (8, 8), torch.float32, "cpu")) == []


def test_a_render_that_is_not_finite_names_its_frame(avatar: torch.nn.Module, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = avatar.march

    def broken(*arguments: object) -> tuple:
        rendered, count = whole(*arguments)
        return rendered._replace(colour=rendered.colour * torch.nan), count

    monkeypatch.setattr(avatar, "march", broken)
    with pytest.raises(ValueError, match="the render of frame 1 is not finite"):
        sequence.render(avatar, scene(), 1, (8, 8), torch.float32, "cpu")
