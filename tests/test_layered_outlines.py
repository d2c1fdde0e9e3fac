"""Heights of hair from the mattes' outlines: against an ellipsoid that is larger than the mesh, and hard mattes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from toy_head import toy_head, toy_images, toy_track

from avatar import build
from avatar.config import TrainConfig
from avatar.dataset import Scene
from avatar.layered import initial, outlines, shells
from avatar.layered.model import LayeredAvatar
from fitting.head_model import REGIONS, HeadModel
from fitting.raster import vertex_normals

SIZE, COUNT, HEIGHT_M = 128, 8, 0.009
Made = tuple[HeadModel, Scene, np.ndarray, np.ndarray]


def toy_track_of(head: HeadModel) -> dict[str, np.ndarray]:
    """It nods and turns, without expression."""
    track = toy_track(head, COUNT, SIZE)
    turns = [np.linspace(-0.3, 0.3, COUNT), np.linspace(-0.35, 0.35, COUNT), np.zeros(COUNT)]
    track["rotation"] = np.stack(turns, 1).astype(np.float32)
    track["expression"] *= 0
    return track


@pytest.fixture(scope="module")
def made() -> Made:
    """A turning toy head, and pictures and mattes of one that is HEIGHT_M larger all around."""
    head = toy_head(24, 36)
    track = toy_track_of(head)
    normals = vertex_normals(head.template.double().numpy(), head.triangles.numpy())
    larger = replace(head, template=head.template + HEIGHT_M * torch.from_numpy(normals).float())
    return head, Scene(head, track, range(COUNT)), *toy_images(larger, track, SIZE)


def scalp(head: HeadModel) -> np.ndarray:
    return (head.region == REGIONS.index("scalp")).numpy()


def test_an_outline_goes_around_the_largest_part() -> None:
    alpha = np.zeros((100, 120), np.uint8)
    cv2.circle(alpha, (60, 50), 30, 255, -1)
    alpha[5:9, 5:9], alpha[20, 100] = 255, 255
    pixels = outlines.outline(alpha)
    assert pixels.shape[1] == 2 and 50 < len(pixels) <= outlines.RAYS
    np.testing.assert_allclose(np.linalg.norm(pixels - [60, 50], axis=1), 30, atol=1.5)


@pytest.mark.parametrize("value", [0, 255])
def test_a_matte_without_an_outline_has_none(value: int) -> None:
    assert outlines.outline(np.full((40, 50), value, np.uint8)).shape == (0, 2)


def test_rays_that_touch_tell_how_far_the_surface_is(made: Made) -> None:
    head, scene, _, alpha = made
    found = outlines.touched(scene, alpha, range(COUNT))
    known = np.isfinite(found)
    assert found.shape == (head.vertex_count,) and 0.1 < known[scalp(head)].mean() < 1
    assert abs(np.median(found[known]) - HEIGHT_M) < 0.002  # a pixel is 3 mm here
    assert np.quantile(np.abs(found[known] - HEIGHT_M), 0.9) < 0.004


def test_a_head_that_fills_its_matte_has_nothing_on_it(made: Made) -> None:
    _, scene, _, alpha = made
    nothing = outlines.touched(scene, np.zeros_like(alpha), range(COUNT))
    assert np.isnan(nothing).all()
    inside = np.stack([cv2.erode(one, np.ones((9, 9))) for one in alpha])  # rays that meet the mesh
    found = outlines.touched(scene, inside, range(COUNT))
    assert np.isfinite(found).any() and not found[np.isfinite(found)].any()


def test_a_cut_beside_the_face_tells_nothing(made: Made) -> None:
    """Long hair is cut off at the mouth's level: that edge is no outline of the head."""
    head, scene, _, alpha = made
    wide = alpha.copy()
    wide[:, 60:80] = np.where(wide[:, 60:80].any(2)[..., None], 255, wide[:, 60:80])
    found = outlines.touched(scene, wide, range(COUNT))
    assert np.isnan(found[~scalp(head)]).all()


def test_the_surface_is_drawn_on_between_outlines_and_keeps_to_the_sweep_on_the_face(made: Made) -> None:
    head, scene, _, alpha = made
    touched = outlines.touched(scene, alpha, range(COUNT))
    found = outlines.surface(head, touched, np.where(scalp(head), 0.03, HEIGHT_M))
    assert found.shape == (head.vertex_count,) and found.min() >= 0
    assert abs(np.median(found[scalp(head)]) - HEIGHT_M) < 0.002  # and not the sweep's 30 mm
    unseen = np.full(head.vertex_count, np.nan)
    swept = outlines.surface(head, unseen, np.full(head.vertex_count, 0.02))
    np.testing.assert_allclose(swept, 0.02, rtol=1e-3)  # with no outline at all the sweep decides
    assert np.isnan(outlines.surface(head, unseen, unseen)).all()


def begun(made: Made, layers: int) -> tuple[LayeredAvatar, np.ndarray]:
    """An avatar with projected textures, and which vertices are covered."""
    head, *seen = made
    torch.manual_seed(0)
    keys = {"representation": "layers", "layers": layers, "bases": 2, "texture_size": 128, "uv_size": 64}
    avatar = build.build(build.settings_of(TrainConfig(**keys)), head)
    avatar.shape_shell(torch.full((head.vertex_count,), 0.018))
    covered = initial.settle(avatar, *seen, range(COUNT))
    initial.project(avatar, *seen, range(COUNT), covered)
    return avatar, covered


@pytest.mark.parametrize("layers", range(3, 17))
def test_the_shell_at_the_surface_is_the_first_that_is_not_above_it(layers: int) -> None:
    heights, number = shells.near(layers), shells.at_surface(layers)
    assert len(heights) == max(layers - 4, 0) and (np.diff(heights) < 0).all()
    assert number == layers - 3 if layers < 5 else (heights[: number - 1] > 0).all() and heights[number - 1] <= 0


@pytest.mark.parametrize("layers", [5, 6, 12])
def test_any_number_of_layers_starts_without_a_hull_around_the_hair(made: Made, layers: int) -> None:
    avatar, _ = begun(made, layers)
    scene, alpha = made[1], made[3]
    posed = avatar.pose(*scene.heads([3], "cpu"))
    drawn = avatar.picture(posed, scene.view(3, (SIZE, SIZE)), torch.float32)[0].opacity.numpy().reshape(SIZE, SIZE)
    grown = cv2.dilate(alpha[3], np.ones((5, 5))) > 0  # two pixels are 6 mm
    assert (drawn[~grown] > 0.5).mean() < 0.008


def test_a_bald_head_is_not_covered(made: Made) -> None:
    head, scene, *_ = made
    avatar, covered = begun((head, scene, *toy_images(head, toy_track_of(head), SIZE)), 8)
    over = initial._map_of(avatar, scalp(head).astype(np.float32), "skin", avatar.fading.shape[1]) > 0.5
    assert over.any() and not covered[scalp(head)].any() and not avatar.fading.detach().numpy()[:, over].any()


def test_the_start_stands_where_the_outlines_say_and_its_rim_stays(made: Made) -> None:
    head, scene, _, alpha = made
    avatar, covered = begun(made, 8)
    middle = scalp(head) & (head.template[:, 1] < -0.08).numpy()
    number = shells.at_surface(8)
    expected = HEIGHT_M + shells.near(8)[number - 1]
    assert covered[middle].all() and abs(np.median(avatar.offsets_m[number, middle].numpy()) - expected) < 0.0012
    stays = avatar.fading.detach() == initial.STAYS
    assert not stays[:number].any() and stays[number:].any((1, 2)).all()
    view = scene.view(0, (SIZE, SIZE))
    with torch.no_grad():
        drawn = avatar.picture(avatar.pose(*scene.heads([0], "cpu")), view, torch.float32)[0].opacity.numpy().reshape(SIZE, SIZE)
        avatar.fading[...] = 0
        faded = avatar.picture(avatar.pose(*scene.heads([0], "cpu")), view, torch.float32)[0].opacity.numpy().reshape(SIZE, SIZE)
    wrong = [np.abs(one - alpha[0] / 255)[:50].mean() for one in (drawn, faded)]  # the upper part: hair
    assert wrong[0] < 0.75 * wrong[1]
