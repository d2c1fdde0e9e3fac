"""Depth and normals as pictures: a sphere whose normals are known, noise, edges, nothing to see, captions and scales."""

from __future__ import annotations

import cv2
import numpy as np

from avatar.uses import shading

FOCAL_PX, SIZE, RADIUS_M, DISTANCE_M = 300.0, (90, 100), 0.09, 0.6
CENTRE_PX = np.array([50.0, 45.0])


def sphere(noise_m: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth [H, W] m, opacity uint8 [H, W] and true normals [H, W, 3] of a sphere on the camera's axis."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    ray = np.stack([(columns - CENTRE_PX[0]) / FOCAL_PX, (rows - CENTRE_PX[1]) / FOCAL_PX, np.ones(SIZE)], -1)
    squared = (ray**2).sum(-1)
    inside = DISTANCE_M**2 - squared * (DISTANCE_M**2 - RADIUS_M**2)
    hit = inside > 0
    depth = np.where(hit, (DISTANCE_M - np.sqrt(np.maximum(inside, 0))) / squared, 0)
    normal = np.where(hit[..., None], (depth[..., None] * ray - [0, 0, DISTANCE_M]) / RADIUS_M, 0)
    depth = depth + hit * np.random.default_rng(0).normal(size=SIZE) * noise_m
    return depth.astype(np.float32), (255 * hit).astype(np.uint8), normal


def angles(found: np.ndarray, true: np.ndarray, opacity: np.ndarray) -> np.ndarray:
    """Degrees between normals, away from the rim, where the surface runs along the ray."""
    inner = cv2.erode(opacity, np.ones((9, 9), np.uint8)) > 0
    return np.degrees(np.arccos(np.clip((found * true).sum(-1)[inner], -1, 1)))


def test_normals_of_a_sphere_with_and_without_noise() -> None:
    depth, opacity, true = sphere()
    clean = angles(shading.normals(depth, opacity, FOCAL_PX, CENTRE_PX), true, opacity)
    assert np.median(clean) < 2 and clean.max() < 12
    depth, opacity, true = sphere(noise_m=0.001)
    noisy = angles(shading.normals(depth, opacity, FOCAL_PX, CENTRE_PX), true, opacity)
    assert np.median(noisy) < 8
    raw = depth.astype(np.float64)[..., None] * np.ones(3)  # what differences of raw depth would make of the same noise
    slope = np.abs(np.diff(raw[..., 0], axis=1)[cv2.erode(opacity, np.ones((9, 9)))[:, 1:] > 0]) / (DISTANCE_M / FOCAL_PX)
    assert np.degrees(np.arctan(np.median(slope))) > 20


def test_normals_are_unit_towards_the_camera_and_none_outside() -> None:
    depth, opacity, _ = sphere(noise_m=0.0005)
    normal = shading.normals(depth, opacity, FOCAL_PX, CENTRE_PX)
    seen = opacity > 0
    np.testing.assert_allclose(np.linalg.norm(normal[seen], axis=-1), 1, atol=1e-9)
    assert (normal[seen][:, 2] < 0).mean() > 0.99 and not normal[~seen].any()
    picture = shading.normal_picture(normal)
    assert (picture[~seen] == 255).all()
    left, right, top = picture[45, 25], picture[45, 75], picture[22, 50]
    assert right[0] > 170 > 90 > left[0] and top[1] > 170 and picture[45, 50, 2] > 250


def test_a_step_between_two_surfaces_stays_a_step() -> None:
    depth = np.full((40, 60), 0.5, np.float32)
    depth[:, 30:] = 0.55
    opacity = np.full(depth.shape, 255, np.uint8)
    smooth = shading.smooth_depth(
        depth + np.random.default_rng(0).normal(size=depth.shape).astype(np.float32) * 5e-4, opacity, 400.0
    )
    assert np.abs(smooth[:, :29] - 0.5).max() < 0.002 and np.abs(smooth[:, 31:] - 0.55).max() < 0.002


def test_nothing_to_see_is_white() -> None:
    depth, opacity = np.zeros((20, 24), np.float32), np.zeros((20, 24), np.uint8)
    assert (shading.normal_picture(shading.normals(depth, opacity, FOCAL_PX, CENTRE_PX)) == 255).all()
    assert shading.depth_range([depth], [opacity]) == (0.0, 1.0)
    assert (shading.depth_picture(depth, opacity, 0.0, 1.0) == 255).all()


def test_depth_picture_goes_from_near_to_far_and_shares_its_range() -> None:
    depth, opacity, _ = sphere()
    near, far = shading.depth_range([depth, depth + 0.1], [opacity, opacity])
    assert 0.5 < near < 0.53 and 0.65 < far < 0.72
    picture = shading.depth_picture(depth, opacity, near, far)
    light = picture.astype(int).sum(-1)
    assert light[45, 50] > light[45, 62] > light[45, 70] and (picture[opacity == 0] == 255).all()
    faint = opacity.copy()
    faint[45, 50] = 127
    assert (shading.depth_picture(depth, faint, near, far)[45, 50] == 255).all()
    one = np.full((4, 4), 0.5, np.float32)
    assert shading.depth_range([one], [np.full((4, 4), 255, np.uint8)])[1] > 0.5  # one depth alone: a range all the same


def test_captions_and_scales_add_lines_of_the_same_width() -> None:
    image = np.full((60, 80, 3), 120, np.uint8)
    for made in (shading.captioned(image, "a caption"), shading.captioned(image, "a caption " * 20)):
        assert made.shape[1] == 80 and made.shape[0] > 70 and (made[-60:] == image).all()
        assert made[:-60].min() < 140  # ink
    bar = shading.with_depth_bar(image, 0.3, 0.5)
    assert bar.shape[1] == 80 and (bar[:60] == image).all()
    assert len(np.unique(bar[60:].reshape(-1, 3), axis=0)) > 5
    assert shading.with_error_bar(image).shape == bar.shape
    narrow = shading.with_depth_bar(image[:, :20], 0.3, 0.5)
    assert narrow.shape == bar[:, :20].shape  # no room for the scale: no error


def test_grid_places_images_and_fills_with_white() -> None:
    small, large = np.zeros((10, 20, 3), np.uint8), np.full((30, 40, 3), 9, np.uint8)
    page = shading.grid([[small, large], [large]], gap_px=2)
    assert page.shape == (2 + 30 + 2 + 30 + 2, 2 + 40 + 2 + 40 + 2, 3)
    assert (page[2:12, 2:22] == 0).all() and (page[2:32, 44:84] == 9).all() and (page[34:64, 2:42] == 9).all()
    assert (page[12:32, 2:42] == 255).all() and (page[34:, 44:] == 255).all()
