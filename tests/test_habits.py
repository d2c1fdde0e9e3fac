"""The detector's habits, learned from a made detector whose slide over the surface is known."""

import dataclasses

import numpy as np
import pytest
import torch

from fitting import camera, habits
from fitting.landmark_model import LandmarkModel
from fitting.rig import Rig, posed, view_direction
from tests.landmarked import landmarked_head

RENDERS = 120


@pytest.fixture(scope="module")
def head():
    return landmarked_head()


class SlidingDetector:
    """Reports each landmark a known way off its place: more for a first identity coefficient, more for a turned head."""

    def __init__(self, head, seed=0):
        self.rig = Rig(head)
        self.triangles, self.weights = head.landmark_triangles.numpy(), head.landmark_barycentric.numpy().astype(float)
        self.points = self.rig.surface(self.triangles, self.weights)
        self.random = np.random.default_rng(seed)  # the same draws as `learn` makes, one head behind another
        self.constant, self.broad, self.turned = 0.002, 0.0015, 0.004

    def __call__(self, image):
        shape, pose, focal_px = habits._random_head(self.rig, self.random)
        self.random.uniform(0.6, 1.15), self.random.uniform(0.2, 0.9)
        at = posed(self.points.folded(shape), pose)
        away = np.array([self.constant + self.broad * shape[0], self.turned * view_direction(pose)[0], 0.0])
        pixel = camera.project(at.points + pose.rotation @ away, focal_px, habits.CENTRE_PX)
        return np.concatenate([pixel, np.zeros((len(pixel), 1))], 1)


def test_a_known_slide_is_found(head):
    found = habits.learn(head, SlidingDetector(head), RENDERS)
    skin = np.setdiff1d(np.arange(468), [])
    slide = found.slide[skin]
    assert found.slide.shape == (478, 3, 1 + len(head.shape_basis) + 2) and found.renders == RENDERS
    assert np.median(slide[:, 0, 0]) == pytest.approx(0.002, abs=4e-4)
    assert np.median(slide[:, 0, 1]) == pytest.approx(0.0015, abs=4e-4)
    assert np.median(slide[:, 1, -2]) == pytest.approx(0.004, abs=1e-3)
    assert found.after_mm <= 1e3 * habits.LEAST_SIGMA_M < 0.25 * found.before_mm


def test_irises_keep_their_place(head):
    found = habits.learn(head, SlidingDetector(head), 60)
    assert not found.slide[468:].any() and np.isnan(found.sigma_m[468:]).all()


def test_a_landmark_that_is_never_seen_keeps_the_spread_of_its_group(head):
    """Its weight is zero in every render: no figure may come out of that, least of all a zero or NaN in the fit."""
    triangles = head.landmark_triangles.clone()
    corner = head.template[head.triangles].mean(1)
    triangles[10] = int(corner[:, 2].argmax())  # the back of the head
    hidden = dataclasses.replace(head, landmark_triangles=triangles)
    found = habits.learn(hidden, SlidingDetector(hidden), 60)
    assert np.isnan(found.sigma_m[10]) and np.isfinite(found.slide).all()
    whole = dataclasses.replace(
        hidden, landmark_slide=torch.from_numpy(found.slide), landmark_sigma=torch.from_numpy(found.sigma_m)
    )
    names = ("landmark_triangles", "landmark_barycentric", "landmark_slide", "landmark_sigma")
    model = LandmarkModel.of(Rig(whole), *(getattr(whole, name).numpy() for name in names))
    assert np.isfinite(model.group_sigma).all() and (model.group_sigma > 0.1).all()
    assert model.surface.view_basis.shape == (len(model.ids), 3, 2)


def test_a_detector_that_sees_nothing_is_an_error(head):
    with pytest.raises(ValueError, match="found the face in 0 of 20 renders"):
        habits.learn(head, lambda image: None, 20)


def test_an_unbaked_slide_is_zero(head):
    assert not head.landmark_slide.any() and torch.isnan(head.landmark_sigma).all()
