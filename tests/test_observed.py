"""What the fit reads of the detector's output: placed points, scale, lids, scores by name."""

from dataclasses import replace

import numpy as np
import pytest

from fitting import observed
from fitting.landmark_model import EYE_CORNERS, IRIS_RINGS, LID_PAIRS, LandmarkModel
from fitting.rig import Rig
from tests.landmarked import CENTRE_PX, SIZE, detected, landmarked_head, model_of, random_state

NAMES = ("bump0", "bump1", "bump2")


@pytest.fixture(scope="module")
def model():
    return model_of(landmarked_head())[1]


def a_face(frames: int = 4, gap: float = 0.3) -> np.ndarray:
    """478 points inside the picture; eyes 60 px wide with lids this much of it apart."""
    points = np.random.default_rng(0).uniform(60, 180, (frames, 478, 3))
    for side, ring, (outer, inner), pairs in zip((1, -1), IRIS_RINGS, EYE_CORNERS, LID_PAIRS, strict=True):
        middle = np.array([120 + 45 * side, 100.0, 0.0])
        points[:, outer], points[:, inner] = middle + [30 * side, 0, 0], middle - [30 * side, 0, 0]
        for k, landmark in enumerate(ring):
            points[:, landmark] = middle + [k - 2, 0, 0]
        for k, (upper, lower) in enumerate(pairs):
            points[:, upper], points[:, lower] = middle + [9 * (k - 1), -30 * gap, 0], middle + [9 * (k - 1), 30 * gap, 0]
    return points


def look(model, points, found=None, scores=None, names=NAMES, size=SIZE):
    found = np.ones(len(points), bool) if found is None else found
    scores = np.zeros((len(points), len(names))) if scores is None else scores
    return observed.observe(model, points, found, scores, list(names), NAMES, CENTRE_PX, size)


def test_shapes_scale_and_irises(model):
    seen = look(model, a_face())
    assert seen.points.shape == (4, len(model.ids), 2) and seen.found.all() and seen.inside.all()
    np.testing.assert_allclose(seen.scale_px, 150.0)  # between the outer corners
    np.testing.assert_allclose(seen.points[0, model.pupil], [[165.0, 100.0], [75.0, 100.0]])  # mean of the ring, not its first


def test_the_scale_does_not_shrink_with_yaw(model):
    points = a_face()
    middle = points[:, [33, 263]].mean(1, keepdims=True)
    turn = np.array([[np.cos(0.9), 0, np.sin(0.9)], [0, 1, 0], [-np.sin(0.9), 0, np.cos(0.9)]])
    np.testing.assert_allclose(look(model, (points - middle) @ turn.T + middle).scale_px, 150.0)


@pytest.mark.parametrize(("gap", "expected"), [(0.05, 0.0), (0.07, 0.0), (0.105, 0.5), (0.14, 1.0), (0.4, 1.0)])
def test_lids_open_and_shut(model, gap, expected):
    np.testing.assert_allclose(look(model, a_face(gap=gap)).open_eyes, expected, atol=1e-9)


def test_an_iris_behind_a_lid_counts_nothing_and_its_gaze_is_held(model):
    points = a_face()
    points[:, [pair[1] for pair in LID_PAIRS[0]]] = points[:, [pair[0] for pair in LID_PAIRS[0]]]  # the left eye shuts
    seen = look(model, points)
    np.testing.assert_allclose(seen.open_eyes, [[0, 1]] * 4)
    held = np.arange(4.0)
    frame = seen.frame(model, 0, held)
    assert frame.weight[model.pupil].tolist() == [0.0, 1.0] and np.delete(frame.weight, model.pupil).all()
    np.testing.assert_array_equal(frame.gaze_mean, held)
    np.testing.assert_array_equal(seen.frame(model, 0).gaze_mean, np.zeros(4))


def test_making_a_frame_leaves_the_clip_alone(model):
    seen = replace(look(model, a_face()), open_eyes=np.zeros((4, 2)))
    before = seen.inside.copy()
    keep = np.arange(len(model.ids)) % 2 == 0
    frame = seen.frame(model, 1, None, keep)
    np.testing.assert_array_equal(seen.inside, before)
    assert not frame.weight[~keep].any() and not seen.frame(model, 1).weight[model.pupil].any()


def test_scores_by_name_never_by_place(model):
    scores = np.random.default_rng(1).random((4, 4))
    seen = look(model, a_face(), scores=scores, names=("bump2", "another", "bump0", "more"))
    np.testing.assert_allclose(seen.expression_mean, np.stack([scores[:, 2], 0 * scores[:, 0], scores[:, 0]], 1))
    scores[1, 2] = np.nan
    seen = look(model, a_face(), scores=scores, names=("bump2", "another", "bump0", "more"))
    assert np.isfinite(seen.expression_mean).all() and seen.expression_mean[1, 0] == 0


def test_frames_that_are_no_face(model):
    points = a_face(6)
    points[1] = np.nan
    points[2, 40, 1] = np.inf
    points[3, [33, 263]] = points[3, [33, 33]] + [[0, 0, 0], [1, 0, 0]]  # the eyes one pixel apart
    points[4] += [SIZE[1] - 90, 0, 0]  # more than half of it out of the picture
    found = np.ones(6, bool)
    found[5] = False
    seen = look(model, points, found)
    assert seen.found.tolist() == [True, False, False, False, False, False]
    for name in ("points", "scale_px", "expression_mean", "open_eyes"):
        assert np.isfinite(getattr(seen, name)).all(), name
    assert (seen.scale_px > 0).all() and not seen.frame(model, 1).weight.any()


def test_points_outside_the_picture_count_nothing(model):
    points = a_face()
    outside = int(model.ids[7])
    points[0, outside, :2] = [-3.0, 50.0]
    points[1, outside, :2] = [100.0, SIZE[0] + 0.5]
    points[2, outside, :2] = [SIZE[1] - 0.5, 50.0]
    seen = look(model, points)
    assert seen.inside[:, 7].tolist() == [False, False, False, True] and seen.inside.sum() == 4 * len(model.ids) - 3


def test_the_input_is_not_changed(model):
    points = a_face()
    before = points.copy()
    look(model, points)
    np.testing.assert_array_equal(points, before)


def test_landmarks_without_a_place_are_left_out_and_needed_ones_are_named():
    head = landmarked_head()
    rig, triangles = Rig(head), head.landmark_triangles.numpy().copy()
    weights = head.landmark_barycentric.numpy()
    triangles[[0, 1, 400]] = -1
    model = LandmarkModel.of(rig, triangles, weights)
    assert len(model.ids) == 475 and not np.isin([0, 1, 400], model.ids).any()
    np.testing.assert_array_equal(model.ids[model.pupil], [473, 468])
    np.testing.assert_array_equal(model.ids[model.lids], LID_PAIRS)
    triangles[386] = -1
    with pytest.raises(ValueError, match=r"no place for the landmarks \[.*386.*\]"):
        LandmarkModel.of(rig, triangles, weights)


def test_the_made_detector_agrees(model):
    """tests.landmarked.detected builds what observe would."""
    truth = random_state(model, 3)
    seen = detected(model, truth, 0.0)
    points = np.zeros((3, 478, 3))
    points[:, model.ids, :2] = seen.points
    again = look(model, points, np.ones(3, bool))
    plain = np.setdiff1d(np.arange(len(model.ids)), model.pupil)
    np.testing.assert_allclose(again.points[:, plain], seen.points[:, plain])
    np.testing.assert_allclose(again.open_eyes, 1.0)
