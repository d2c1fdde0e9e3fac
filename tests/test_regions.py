"""Face, mouth and eyes from landmarks: where they lie, what is left out and why, and crops that grow by context."""

import numpy as np
import pytest
from made_face import face

from avatar import regions
from avatar.regions import Box
from fitting import landmark_model

SIZE = (400, 300)


def test_landmarks_are_those_of_the_fit() -> None:
    assert set(regions.LIPS) < set(landmark_model.LIPS)
    assert set(regions.EYES["left"]) == set(landmark_model.EYES[:16])
    assert set(regions.EYES["right"]) == set(landmark_model.EYES[16:])
    assert tuple(regions.EYE_CORNERS.values()) == landmark_model.EYE_CORNERS


def test_where_regions_lie() -> None:
    points = face((150.0, 200.0), 200.0)
    found = regions.find(points, SIZE)
    length = np.ptp(points[:468, 1])
    assert regions.face_length(points[:, :2]) == pytest.approx(length, rel=0.01) and not found.notes
    (mouth,), margin = found.mouth, 0.06 * length
    lips = points[list(regions.LIPS)]
    assert mouth.left == pytest.approx(lips[:, 0].min() - margin, abs=1) and mouth.right == pytest.approx(
        lips[:, 0].max() + margin, abs=1
    )
    assert mouth.top == pytest.approx(lips[:, 1].min() - margin, abs=1) and mouth.bottom == pytest.approx(
        lips[:, 1].max() + margin, abs=1
    )
    assert len(found.eyes) == 2 and {box.right < 150 for box in found.eyes} == {True, False}
    y, x = np.nonzero(found.face)
    assert np.abs([x.mean() + 0.5 - 150, y.mean() + 0.5 - points[:468, 1].mean()]).max() < 2  # px: no half-pixel shift
    for box in (*found.mouth, *found.eyes):
        assert found.face[box.slices].mean() > 0.9


@pytest.mark.parametrize("yaw_degrees", [0, 30, -45, 75, -75])
def test_a_turned_head_keeps_its_length_and_loses_the_far_eye(yaw_degrees: float) -> None:
    points = face((150.0, 200.0), 200.0, yaw_degrees)
    found = regions.find(points, SIZE)
    assert regions.face_length(points[:, :2]) == pytest.approx(regions.face_length(face((150.0, 200.0), 200.0)[:, :2]), rel=0.03)
    if abs(yaw_degrees) < 50:
        assert len(found.eyes) == 2 and not found.notes
    else:  # turning to its left (positive) hides the subject's left eye
        assert len(found.eyes) == 1 and found.notes == (f"{'left' if yaw_degrees > 0 else 'right'} eye turned away: left out",)
    assert found.mouth and found.face is not None


def test_closed_lids_are_no_turned_eye() -> None:
    points = face((150.0, 200.0), 200.0)
    for ids in regions.EYES.values():
        points[list(ids), 1] = points[list(ids), 1].mean()
    found = regions.find(points, SIZE)
    assert len(found.eyes) == 2 and all(box.bottom - box.top >= 2 * 0.06 * 200 for box in found.eyes)


def test_nothing_to_find() -> None:
    for points in (None, np.full((478, 3), np.nan), np.full((478, 3), 7.0)):
        found = regions.find(points, SIZE)
        assert found.face is None and not found.mouth and not found.eyes and "no face" in found.notes[0]


def test_landmarks_out_of_the_picture() -> None:
    outside = regions.find(face((900.0, 200.0), 200.0), SIZE)
    assert outside.face is None and not outside.mouth and not outside.eyes and len(outside.notes) == 4
    chin = regions.find(face((150.0, 375.0), 200.0), SIZE)  # the mouth is below the last row
    assert not chin.mouth and len(chin.eyes) == 2 and chin.notes == ("mouth out of the picture: left out",)
    assert chin.face is not None and chin.face[-1].any()
    half = regions.find(face((150.0, 345.0), 200.0), SIZE)  # the mouth's box is cut by it
    (mouth,) = half.mouth
    assert mouth.bottom == 400 and mouth.top < 394


def test_every_region_has_a_pixel_that_ssim_sees() -> None:
    random = np.random.default_rng(3)
    for _ in range(200):
        points = face(random.uniform(-50, 350, 2), random.uniform(5, 300), random.uniform(-80, 80))
        found = regions.find(points, SIZE)
        inner = np.zeros(SIZE, bool)
        inner[5:-5, 5:-5] = True
        assert found.face is None or (found.face & inner).any()
        for box in (*found.mouth, *found.eyes):
            assert inner[box.slices].any()
            assert 0 <= box.top < box.bottom <= SIZE[0] and 0 <= box.left < box.right <= SIZE[1]


@pytest.mark.parametrize(
    ("box", "expected"),
    [
        (Box(100, 140, 100, 150), Box(100, 140, 100, 150)),  # large enough
        (Box(100, 110, 100, 150), Box(90, 121, 100, 150)),  # evenly to both sides
        (Box(0, 8, 290, 300), Box(0, 31, 269, 300)),  # shifted to stay inside
        (Box(395, 400, 0, 3), Box(369, 400, 0, 31)),
    ],
)
def test_small_boxes_grow_by_context(box: Box, expected: Box) -> None:
    assert regions.widened(box, 31, SIZE) == expected


def test_a_picture_smaller_than_the_least_crop_is_taken_whole() -> None:
    assert regions.widened(Box(3, 5, 3, 5), 31, (20, 40)) == Box(0, 20, 0, 31)
    mask = np.zeros((9, 9), bool)
    mask[2:4, 5:8] = True
    assert regions.around(mask) == Box(2, 4, 5, 8)
