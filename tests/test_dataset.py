"""Rays against the head model's own projection; what is refused; where rays are drawn; thickness from mattes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from exported import flame_like
from toy_head import toy_head, toy_images, toy_track

from avatar import coverage
from avatar.dataset import CELL, FEATURE_SHARE, Scene, cells_of, draw, on_white, shrink_any
from fitting.head_model import HeadModel

SIZE = 64


@pytest.fixture(scope="module")
def subject() -> tuple[HeadModel, dict[str, np.ndarray], Scene]:
    head = toy_head()
    track = toy_track(head, 5, SIZE)
    track["neck"] = track["rotation"][::-1].copy() * 0.3
    return head, track, Scene(head, track, range(5))


def test_rays_pass_through_the_vertices_that_project_to_their_pixels(subject: tuple) -> None:
    head, track, scene = subject
    values = {
        name: torch.from_numpy(track[name]) for name in ("shape", "expression", "rotation", "neck", "jaw", "eyes", "translation")
    }
    camera = head.forward(**values).numpy()  # [T, V, 3] camera axes
    for frame in (0, 3):
        pixels = camera[frame, :, :2] / camera[frame, :, 2:] * track["focal_px"] + track["centre_px"]
        np.testing.assert_allclose(scene.pixels_of(frame, scene.vertices_m[scene.place[frame]].numpy()), pixels, atol=2e-3)
        rays = scene.rays(frame, pixels[:, 0] - 0.5, pixels[:, 1] - 0.5)  # pixel centres at +0.5
        towards = scene.vertices_m[scene.place[frame]].numpy() - rays.origins_m
        np.testing.assert_allclose(towards / np.linalg.norm(towards, axis=1, keepdims=True), rays.directions, atol=2e-5)


def test_camera_follows_joints_that_the_expression_moves() -> None:
    """As FLAME's do: the rigid frame turns about a root joint of its own in each frame."""
    head = flame_like()
    track = toy_track(head, 3, SIZE)
    track["rotation"] = track["rotation"] + np.array([0.2, 0.5, 0.1])
    track["neck"] = -track["rotation"] * 0.3
    scene = Scene(head, track, range(3))
    names = ("shape", "expression", "rotation", "neck", "jaw", "eyes", "translation")
    camera = head.forward(*(torch.as_tensor(np.asarray(track[name], np.float64)) for name in names)).numpy()
    for frame in range(3):
        pixels = camera[frame, :, :2] / camera[frame, :, 2:] * track["focal_px"] + track["centre_px"]
        np.testing.assert_allclose(scene.pixels_of(frame, scene.vertices_m[frame].numpy()), pixels, atol=1e-3)


def test_displacement_ignores_eyes_neck_and_pose(subject: tuple) -> None:
    head, track, scene = subject
    changed = dict(track)
    random = np.random.default_rng(0)
    for name in ("rotation", "neck", "translation", "eyes"):
        changed[name] = track[name] + random.normal(size=track[name].shape).astype(np.float32) * 0.1
    assert torch.equal(Scene(head, changed, range(5)).displacement_m, scene.displacement_m)
    neutral = toy_track(head, 1, SIZE, motion=0.0)
    assert Scene(head, neutral, [0]).displacement_m.abs().max() < 1e-6


@pytest.mark.parametrize("name", ["expression", "rotation", "translation", "eyes"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_not_finite_is_refused_with_its_number(subject: tuple, name: str, value: float) -> None:
    head, track, _ = subject
    broken = track | {name: track[name].copy()}
    broken[name][3] = value
    with pytest.raises(ValueError, match=r"frame 3 is not finite"):
        Scene(head, broken, range(5))
    Scene(head, broken, [0, 1, 4])  # frames that are not used do not matter


def test_foreign_and_incomplete_tracks_are_refused(subject: tuple) -> None:
    head, track, _ = subject
    with pytest.raises(ValueError, match="belongs to head model other"):
        Scene(head, track | {"head_digest": np.array("other")}, [0])
    with pytest.raises(ValueError, match="lacks jaw"):
        Scene(head, {name: value for name, value in track.items() if name != "jaw"}, [0])
    with pytest.raises(ValueError, match="focal_px"):
        Scene(head, track | {"focal_px": np.float32(np.nan)}, [0])


def test_on_white() -> None:
    frame, alpha = np.array([[[0, 128, 255]], [[10, 20, 30]]], np.uint8), np.array([[255], [0]], np.uint8)
    np.testing.assert_allclose(on_white(frame, alpha), [[[0, 128 / 255, 1]], [[1, 1, 1]]], atol=1e-6)


def test_draw_stays_in_its_cells_and_in_the_image() -> None:
    hit = np.zeros((5, 6), bool)
    hit[4, 5] = hit[1, 2] = True
    near = hit.copy()
    near[4, 5] = False
    cells = cells_of(hit, near)
    columns, rows = draw(cells, 4000, (18, 22), np.random.default_rng(0))
    found = set(zip((columns // CELL).tolist(), (rows // CELL).tolist(), strict=True))
    assert found == {(5, 4), (2, 1)} and columns.max() == 21 and rows.max() == 17
    assert abs((columns // CELL == 2).mean() - 0.8) < 0.05  # beside the matte four times as often
    eye = np.zeros((5, 6), bool)
    eye[2, 2] = True
    both = cells_of(np.ones((5, 6), bool), np.ones((5, 6), bool), eye)
    chance = np.diff(both.cumulative, prepend=0)[(both.rows == 2 * CELL) & (both.columns == 2 * CELL)]
    assert chance == pytest.approx(FEATURE_SHARE)
    large = cells_of(np.ones((5, 6), bool), np.ones((5, 6), bool), ~eye)  # more than its share already: left as it is
    np.testing.assert_allclose(np.diff(large.cumulative, prepend=0), 1 / 30, rtol=1e-5)
    nothing = cells_of(np.zeros((5, 6), bool), near)
    assert len(draw(nothing, 10, (18, 22), np.random.default_rng(0))[0]) == 0


def test_shrink_any_keeps_the_odd_border() -> None:
    alpha = np.zeros((9, 10), np.uint8)
    alpha[8, 9] = 200
    small = shrink_any(alpha)
    assert small.shape == (3, 3) and small.sum() == 1 and small[2, 2]


def test_mattes_outside_the_mesh_make_the_shell_thicker_there(subject: tuple) -> None:
    head, track, scene = subject
    _, alpha = toy_images(head, track, SIZE, 1)
    base = coverage.base_thickness(np.zeros(head.vertex_count, np.int64), scene.neutral_m.numpy(), head.triangles.numpy())
    plain = coverage.measured_thickness(scene, alpha, [0, 1], base)
    assert plain.max() <= base.max()
    bigger = alpha.copy()
    for frame in (0, 1):  # hair: whatever lies up to 10 px above the head
        rows, columns = np.nonzero(alpha[frame] > 128)
        top = rows.min()
        bigger[frame][max(top - 10, 0) : top + 8, columns[rows < top + 8].min() : columns[rows < top + 8].max()] = 255
    hairy = coverage.measured_thickness(scene, bigger, [0, 1], base)
    up = scene.neutral_m[:, 1].numpy() < -0.09
    assert (
        hairy[up].max() > base.max() + 0.01
        and hairy[scene.neutral_m[:, 1].numpy() > 0].max() <= base.max()
        and hairy.max() <= coverage.LARGEST_M
    )


def test_overlap_of_mesh_and_matte(subject: tuple) -> None:
    head, track, scene = subject
    _, alpha = toy_images(head, track, SIZE, 1)
    assert coverage.overlap(scene, alpha[0], 0) > 0.8
    assert coverage.overlap(scene, np.roll(alpha[0], 40, 1), 0) < coverage.PREFLIGHT_OVERLAP
    assert coverage.overlap(scene, np.zeros_like(alpha[0]), 0) == 0
