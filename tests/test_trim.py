"""Cutting the matte: what must stay, what must go, whichever way the head leans."""

import cv2
import numpy as np
import pytest

from fitting.trim import down_axis, head_and_neck

SIZE = (200, 180)


def person(lean_deg=0.0):
    """Matte of head, neck and shoulders; mesh of head and neck; face points; all turned by lean_deg about the neck."""
    alpha, mesh = np.zeros(SIZE, np.uint8), np.zeros(SIZE, np.uint8)
    cv2.ellipse(alpha, (90, 70), (42, 52), 0, 0, 360, 255, -1)  # hair stands off the mesh
    cv2.ellipse(mesh, (90, 72), (34, 44), 0, 0, 360, 255, -1)
    cv2.rectangle(alpha, (70, 100), (110, 160), 255, -1)
    cv2.rectangle(mesh, (74, 100), (106, 135), 255, -1)
    cv2.rectangle(alpha, (10, 140), (170, 199), 255, -1)  # shoulders
    turn = cv2.getRotationMatrix2D((90.0, 150.0), lean_deg, 1.0)
    warp = lambda image: cv2.warpAffine(image, turn, SIZE[::-1])  # noqa: E731
    angle = np.radians(lean_deg)
    down = np.array([np.sin(angle), np.cos(angle)])
    chin = turn @ [90, 116, 1]
    return warp(alpha), warp(mesh) > 127, np.array([chin]), down, turn


@pytest.mark.parametrize("lean", [0.0, 20.0, -25.0])
def test_keeps_hair_and_neck_and_drops_shoulders(lean):
    alpha, mesh, face, down, turn = person(lean)
    trimmed = head_and_neck(alpha, mesh, face, down, 8.0, 2.0, 20.0)
    at = lambda x, y: trimmed[tuple(np.round(turn @ [x, y, 1]).astype(int)[::-1])]  # noqa: E731
    assert at(90, 22) == 255 and at(51, 70) == 255  # hair outside the mesh
    assert at(90, 130) == 255 and at(72, 128) == 255  # neck, and skin beside the mesh's neck
    assert at(30, 150) == 0 and at(150, 150) == 0 and at(90, 145) == 0  # clothes
    assert (trimmed <= alpha).all()


def test_a_shoulder_raised_to_the_chin_goes():
    alpha, mesh, face, down, _ = person()
    cv2.rectangle(alpha, (10, 112), (55, 140), 255, -1)
    trimmed = head_and_neck(alpha, mesh, face, down, 8.0, 2.0, 20.0)
    assert trimmed[118:, :50].max() == 0


def test_a_strand_apart_from_the_head_stays():
    """A tuft's strands are islands of the matte beside the mesh: above the mouth nothing was cut from them."""
    alpha, mesh, face, down, _ = person()
    alpha[5:9, 100:130], alpha[60:64, 140:160] = 255, 255
    trimmed = head_and_neck(alpha, mesh, face, down, 8.0, 2.0, 20.0)
    assert (trimmed[:90] == alpha[:90]).all()


def test_soft_edges_stay_soft():
    alpha, mesh, face, down, _ = person()
    alpha[18:22, 80:100] = 90
    assert (head_and_neck(alpha, mesh, face, down, 8.0, 2.0, 20.0)[18:22, 80:100] == 90).all()


def test_no_mesh_in_the_picture_gives_an_empty_matte():
    alpha, mesh, face, down, _ = person()
    assert head_and_neck(alpha, mesh & False, face, down, 8.0, 2.0, 20.0).max() == 0


def test_empty_matte_stays_empty():
    alpha, mesh, face, down, _ = person()
    assert head_and_neck(alpha * 0, mesh, face, down, 8.0, 2.0, 20.0).max() == 0


def test_down_axis_of_a_head_seen_from_above_is_still_defined():
    assert down_axis(np.array([np.pi / 2, 0.0, 0.0])).tolist() == [0.0, 1.0]
    np.testing.assert_allclose(down_axis(np.array([0.0, 0.0, 0.3])), [-np.sin(0.3), np.cos(0.3)], atol=1e-12)
