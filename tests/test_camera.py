"""Rotations at and near zero and pi; projection against OpenCV."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting import camera


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 9.9e-5, 1.01e-4, 0.3, 2.0, np.pi - 1e-6])
def test_exp_and_log_against_scipy(angle):
    axis = np.array([0.36, -0.48, 0.8])
    matrix = camera.exp_rotation(axis * angle)
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(axis * angle).as_matrix(), atol=1e-13)
    np.testing.assert_allclose(camera.log_rotation(matrix), axis * angle, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 3.0])
def test_left_jacobian_against_differences(angle):
    vector = np.array([0.6, 0.0, -0.8]) * angle
    step = 1e-6
    for axis in range(3):
        moved = vector.copy()
        moved[axis] += step
        change = camera.log_rotation(camera.exp_rotation(moved) @ camera.exp_rotation(vector).T) / step
        np.testing.assert_allclose(camera.left_jacobian(vector)[:, axis], change, atol=2e-6)


def test_projection_equals_opencv():
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.1 + [0, 0, 0.7]
    vector, offset = np.array([0.1, -0.2, 0.05]), np.array([0.02, 0.01, 0.1])
    matrix = np.array([[500.0, 0, 130], [0, 500, 120], [0, 0, 1]])
    expected = cv2.projectPoints(points, vector, offset, matrix, None)[0][:, 0]
    ours = camera.project(points @ camera.exp_rotation(vector).T + offset, 500.0, np.array([130.0, 120.0]))
    np.testing.assert_allclose(ours, expected, atol=1e-9)


def test_projection_jacobian_against_differences():
    point, step = np.array([0.05, -0.03, 0.6]), 1e-7
    for axis in range(3):
        moved = point.copy()
        moved[axis] += step
        change = (camera.project(moved, 400.0, np.zeros(2)) - camera.project(point, 400.0, np.zeros(2))) / step
        np.testing.assert_allclose(camera.project_jacobian(point, 400.0)[:, axis], change, rtol=1e-4, atol=1e-3)
