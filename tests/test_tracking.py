"""The whole fit on arrays: made landmarks and painted pictures of a toy head with known truth."""

from dataclasses import replace

import numpy as np
import pytest

from fitting import camera, settings, tracking
from fitting.config import FitConfig
from fitting.pictures import Pictures
from fitting.rig import posed
from fitting.state import PER_FRAME
from tests.landmarked import CENTRE_PX, degrees_apart, detected, landmarked_head, model_of, picture, random_state

FRAMES, TRAIN = 32, 22
LOST = (12, 13)
CONFIG = FitConfig(keyframes=8, reinit_every=10, focal_px=420.0)


@pytest.fixture(scope="module", autouse=True)
def fewer_samples():
    """Enough for a toy."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(settings, "SAMPLES", 600)
        yield


@pytest.fixture(scope="module")
def made():
    """Clip and truth."""
    rig, model = model_of(landmarked_head())
    truth = random_state(model, FRAMES)
    turn = np.stack([0.1 * np.sin(np.arange(FRAMES) / 5), 0.5 * np.sin(np.arange(FRAMES) / 4), 0 * np.arange(FRAMES)], 1)
    truth = replace(truth, rotation=camera.exp_rotation(turn))
    observed = detected(model, truth, 1.0)
    found = ~np.isin(np.arange(FRAMES), LOST)
    observed = replace(observed, found=found, points=np.where(found[:, None, None], observed.points, 0.0))
    grey = (120, 120, 120)
    frames, alpha = zip(*(picture(rig, truth, k, background=grey, supersample=2) for k in range(FRAMES)), strict=True)
    rows = np.arange(FRAMES)
    clip = tracking.Clip(
        rig, model, observed, np.stack(frames), np.stack(alpha), rows / 30, rows[:TRAIN], rows[TRAIN:], float(np.log(420.0))
    )
    return clip, truth


@pytest.fixture(scope="module")
def fitted(made):
    return tracking.fit_clip(made[0], CONFIG)


def of_weights(**weights) -> FitConfig:
    return CONFIG.model_copy(update={"weights": CONFIG.weights.model_copy(update=weights)})


LANDMARKS_ONLY = of_weights(photometric=0.0, silhouette=0.0, temporal=0.0)


def vertices_px(clip, truth, state, rows):
    """Mean distance (px) of the front of the mesh from the truth."""
    front = clip.rig.template[:, 2] < -0.02
    out = []
    for k in rows:
        pixels = [
            camera.project(posed(clip.rig.vertices().folded(s.shape), s.pose(k)).points[front], s.focal_px, CENTRE_PX)
            for s in (state, truth)
        ]
        out.append(np.linalg.norm(pixels[0] - pixels[1], axis=1).mean())
    return np.array(out)


def same(first, second, rows):
    """The same poses of some rows, to the bit."""
    for name in PER_FRAME:
        np.testing.assert_array_equal(getattr(first.state, name)[rows], getattr(second.state, name)[rows], name)


def test_all_terms_together_find_the_truth(made, fitted):
    clip, truth = made
    assert len(fitted.state) == FRAMES and fitted.state.focal_px == pytest.approx(420, rel=0.01)
    assert np.median(degrees_apart(fitted.state.rotation, truth.rotation)) < 0.7
    assert np.median(vertices_px(clip, truth, fitted.state, np.arange(FRAMES))) < 0.8
    assert np.median(fitted.error_px[fitted.usable]) < 2.0
    assert np.isfinite(fitted.held_out_px).sum() >= 10
    assert np.isnan(fitted.held_out_px[fitted.calibration.keyframes]).all()  # never on frames that calibrated
    assert not fitted.cut.any() and np.isin(fitted.calibration.keyframes, clip.train).all()


def test_blocks_start_afresh_and_never_cross_the_split(made, fitted):
    assert np.flatnonzero(fitted.reinit).tolist() == [0, 10, 20, 22]
    assert fitted.usable.sum() == FRAMES - len(LOST) and not fitted.usable[list(LOST)].any()


def test_a_short_gap_is_drawn_across(made, fitted):
    clip, truth = made
    assert vertices_px(clip, truth, fitted.state, LOST).max() < 4
    held = tracking.fit_clip(clip, LANDMARKS_ONLY, held_out=False)
    assert vertices_px(clip, truth, held.state, LOST).max() > vertices_px(clip, truth, fitted.state, LOST).max()


def test_seconds_and_seams_are_reported(fitted):
    assert {"calibrate", "appearance", "track", "pixels", "bundle", "held_out"} <= set(fitted.seconds)
    assert all(value >= 0 for value in fitted.seconds.values())
    assert set(fitted.seams) == {"before", "after"} and set(fitted.seams["after"]) == set(fitted.seams["before"])
    assert fitted.seams["after"]["jump_mm"] < fitted.seams["before"]["jump_mm"]


def test_twice_the_same_to_the_bit(made, fitted):
    again = tracking.fit_clip(made[0], CONFIG)
    same(fitted, again, np.arange(FRAMES))
    for name in ("log_focal", "shape", "bias"):
        np.testing.assert_array_equal(getattr(fitted.state, name), getattr(again.state, name))
    np.testing.assert_array_equal(fitted.held_out_px, again.held_out_px)


def spoiled(clip, what):
    """The clip with its test frames made wrong."""
    late = np.isin(np.arange(FRAMES), clip.test)
    if what == "landmarks":
        points = np.where(late[:, None, None], clip.observed.points * 1.07 + 3, clip.observed.points)
        scores = np.where(late[:, None], 0.9, clip.observed.expression_mean)
        return replace(clip, observed=replace(clip.observed, points=points, expression_mean=scores))
    frames, alpha = clip.frames.copy(), clip.alpha.copy()
    frames[late] = np.random.default_rng(0).integers(0, 255, frames[late].shape)
    alpha[late] = 255 - alpha[late]
    return replace(clip, frames=frames, alpha=alpha)


@pytest.mark.parametrize("what", ["landmarks", "pictures"])
def test_test_frames_change_nothing_in_the_training_rows(made, fitted, what):
    clip = made[0]
    other = tracking.fit_clip(spoiled(clip, what), CONFIG, held_out=False)
    same(fitted, other, clip.train)
    for name in ("log_focal", "shape", "bias"):
        np.testing.assert_array_equal(getattr(fitted.state, name), getattr(other.state, name))
    np.testing.assert_array_equal(fitted.usable[clip.train], other.usable[clip.train])
    np.testing.assert_array_equal(fitted.pictures.appearance.albedo, other.pictures.appearance.albedo)
    changed = np.abs(fitted.state.translation - other.state.translation)[clip.test]
    assert changed.max() > 1e-6  # but the test rows do change


def test_training_pictures_alone_decide_the_light_and_the_skin(made):
    """What `Pictures` is asked to learn from are training frames."""
    clip, seen = made[0], []
    with pytest.MonkeyPatch.context() as patch:
        for name in ("learn", "learn_skin"):
            value = getattr(Pictures, name)
            patch.setattr(
                Pictures, name, lambda self, rows, *rest, value=value, **k: seen.append(rows) or value(self, rows, *rest, **k)
            )
        tracking.fit_clip(clip, CONFIG, held_out=False)
    assert len(seen) >= 2 and all(np.isin(rows, clip.train).all() for rows in seen)


def test_each_term_can_be_left_out(made):
    clip, truth = made
    plain = tracking.fit_clip(clip, LANDMARKS_ONLY, held_out=False)
    assert plain.pictures is None and not {"pixels", "appearance", "bundle"} & {k for k, v in plain.seconds.items() if v > 0}
    assert np.isnan(plain.held_out_px).all()
    for weights in ({"photometric": 0.0}, {"silhouette": 0.0}, {"temporal": 0.0}):
        other = tracking.fit_clip(clip, of_weights(**weights), held_out=False)
        assert np.median(vertices_px(clip, truth, other.state, np.arange(TRAIN))) < 1.2, weights


def test_pictures_bring_the_mesh_nearer(made):
    """With 3 px of landmark noise the pixels know better."""
    clip, truth = made
    noisy = replace(clip, observed=replace(detected(clip.model, truth, 4.0), found=clip.observed.found))
    errors = [
        np.median(vertices_px(clip, truth, tracking.fit_clip(noisy, config, held_out=False).state, clip.test))
        for config in (of_weights(photometric=0.0, silhouette=0.0), CONFIG)
    ]
    assert errors[1] < errors[0]


def test_adam_is_the_other_solver(made):
    clip, truth = made
    config = LANDMARKS_ONLY.model_copy(update={"solver": "adam", "adam_steps": 40})
    fitted = tracking.fit_clip(clip, config, held_out=False)
    assert np.median(vertices_px(clip, truth, fitted.state, np.arange(TRAIN))) < 6


def without_faces(clip, rows):
    found = clip.observed.found.copy()
    found[rows] = False
    return replace(clip, observed=replace(clip.observed, found=found))


def test_lost_faces_are_named(made):
    clip = made[0]
    with pytest.raises(tracking.LostFace, match="a face is found in 4 of 22 training frames; at least 5 are needed"):
        tracking.fit_clip(without_faces(clip, np.arange(4, FRAMES)), CONFIG)
    with pytest.raises(tracking.LostFace, match="the face is lost in all 10 test frames"):
        tracking.fit_clip(without_faces(clip, clip.test), LANDMARKS_ONLY)


def test_a_block_without_a_face_takes_the_nearest_pose(made):
    clip = made[0]
    fitted = tracking.fit_clip(without_faces(clip, np.arange(10, 20)), LANDMARKS_ONLY, held_out=False)
    assert not fitted.usable[10:20].any()
    np.testing.assert_array_equal(fitted.state.rotation[10:14], np.repeat(fitted.state.rotation[9:10], 4, 0))
    np.testing.assert_array_equal(fitted.state.rotation[16:20], np.repeat(fitted.state.rotation[20:21], 4, 0))


def test_wrong_frames_are_not_usable(made):
    """Landmarks that are no face: the frame is given up and its neighbour's pose kept."""
    clip = made[0]
    points = clip.observed.points.copy()
    points[8] = np.random.default_rng(0).uniform(20, 220, points[8].shape)
    fitted = tracking.fit_clip(replace(clip, observed=replace(clip.observed, points=points)), LANDMARKS_ONLY, held_out=False)
    assert np.flatnonzero(~fitted.usable).tolist() == [8, *LOST]
    assert fitted.error_px[8] > 20 and np.isfinite(fitted.state.rotation).all()


def test_the_test_tail_does_not_decide_which_training_frames_are_lost(made):
    """Limits come from the training frames' own median."""
    clip = replace(made[0], train=np.arange(10), test=np.arange(10, FRAMES))
    clip = replace(clip, observed=replace(clip.observed, found=np.ones(FRAMES, bool), scale_px=np.full(FRAMES, 75.0)))
    error = np.where(np.arange(FRAMES) < 10, 1.0, 3.0)
    error[5] = 1.0 * settings.LOST_OF_MEDIAN + 0.5
    assert error[5] > settings.LOST_OF_EYES * 75
    usable = tracking._usable(clip, error, clip.train, np.zeros(FRAMES, bool))
    assert np.flatnonzero(~usable).tolist() == [5]
