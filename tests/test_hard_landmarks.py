"""Hard cases 2 to 5 and 15 to 17 of research/fitting.md: landmarks that are wrong, missing or somebody else's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fitting import camera, stages, tracking
from fitting.rig import posed
from tests import hard_scenes
from tests.hard_scenes import NOISE, SIZE, apart_deg, apart_mm, below, fit_scene, moved, scene, seen


def test_case_2_landmarks_that_follow_the_gaze() -> None:
    """All landmarks move with the gaze, 3 px beside the eyes and 1 px far from them: rotation error below 0.5 degrees.

    Measured (on top of 1 px noise): median 0.31, p95 0.57; the same without the coupling 0.27 and 0.42.
    """
    made, clean = hard_scenes.baseline("talk")
    coupled = fit_scene(seen(made.truth, replace(NOISE, gaze_near_px=3.0, gaze_far_px=1.0)), hard_scenes.calibrated())
    below(np.median(coupled.rotation), 0.5, "rotation error, median")
    below(np.percentile(coupled.rotation, 95), 0.8, "rotation error, p95")
    below(np.median(apart_deg(coupled, clean)), 0.5, "rotation moved by the gaze")


@pytest.fixture(scope="module")
def sweep() -> hard_scenes.Scene:
    """A yaw sweep from -90 to 90 degrees."""
    truth = hard_scenes.baseline("profile")[0].truth
    turn = np.zeros((90, 3))
    turn[:, 1] = np.radians(np.linspace(-90, 90, 90))
    return seen(moved(truth, rotation=turn, neck=np.zeros_like(turn)))


def test_case_3_profile(sweep: hard_scenes.Scene) -> None:
    """Yaw -90 to 90: no frame lost to 75 degrees; rotation within 2 degrees to 60, within 5 to 80."""
    result = fit_scene(sweep, hard_scenes.calibrated())
    yaw = np.abs(np.linspace(-90, 90, 90))
    error = result.rotation
    assert result.fitted.usable[yaw <= 75].all()
    below(error[yaw <= 60].max(), 2.0, "rotation to 60 degrees")
    below(error[yaw <= 80].max(), 5.0, "rotation to 80 degrees")


def test_case_3_guesses_on_the_far_side(sweep: hard_scenes.Scene) -> None:
    """Landmarks on the far side wrong by 30 px: the pose changes by less than 1 degree.

    Measured: 0.5 to 45 degrees of yaw, 1.0 to 60, 1.8 to 90 (before the visibility gate of `stages` 2.2, 2.8, 3.3): the
    guesses begin where a landmark still faces the camera a little, at a cosine of 0.1.
    """
    clean = fit_scene(sweep, hard_scenes.calibrated())
    guessed = fit_scene(seen(sweep.truth, replace(NOISE, far_side_px=30.0)), hard_scenes.calibrated())
    yaw, change = np.abs(np.linspace(-90, 90, 90)), apart_deg(guessed, clean)
    below(change[yaw <= 45].max(), 1.0, "to 45 degrees")
    below(change[yaw <= 60].max(), 1.4, "to 60 degrees")
    below(change[yaw <= 90].max(), 2.5, "to 90 degrees")
    assert guessed.fitted.usable[yaw <= 75].all()


@pytest.mark.parametrize("gap", [1, 5, 30])
def test_case_4_missing_detections(gap: int) -> None:
    """Frames without a face: still in the track and flagged; a gap of 5 is drawn within 2 mm; after 30 a fresh start."""
    made, whole = hard_scenes.baseline()
    lost = np.arange(20, 20 + gap)
    result = fit_scene(seen(made.truth, replace(NOISE, lost=tuple(lost))), hard_scenes.calibrated())
    assert len(result.fitted.state) == 90 and np.isfinite(result.arrays["translation"]).all()
    np.testing.assert_array_equal(np.flatnonzero(~result.fitted.usable), lost)
    assert result.fitted.reinit[20 + gap] == (gap >= stages.LONG_GAP)
    below(apart_mm(result, whole)[20 + gap :].max(), 1.0, "after the gap, mm")
    if gap <= 5:
        below(apart_mm(result, whole)[lost].max(), 2.0, "in the gap, mm")


@pytest.mark.parametrize(("share", "factor"), [(0.1, 1.5), (0.3, 3.0)])
def test_case_5_outliers(share: float, factor: float) -> None:
    """A tenth of the points wrong by up to 50 px: less than 1.5 times the clean error; three tenths: less than 3 times."""
    made, clean = hard_scenes.baseline()
    result = fit_scene(seen(made.truth, replace(NOISE, outlier_share=share)), hard_scenes.calibrated())
    below(np.percentile(result.rotation, 95) / np.percentile(clean.rotation, 95), factor, "rotation error over clean (p95)")
    below(np.median(result.rotation) / np.median(clean.rotation), factor, "rotation error over clean (median)")


def test_case_15_another_face_steals_the_detector() -> None:
    """The detector jumps to a nearer stranger for ten frames: both switches are flagged, the other frames stay as they were.

    The stranger's frames themselves stay usable: measured, the subject's face fits them to 3.1 % of the inter-ocular distance
    (1.0 % its own), and `tracking._usable` asks for 5 %.
    """
    made, clean = hard_scenes.baseline()
    stranger = scene("slow", 90, seed=7, distance_m=0.4)
    aside = stranger.truth.motion.translation + [0.08, 0, 0]
    stranger = seen(moved(stranger.truth, translation=aside))
    rows = np.arange(30, 40)
    result = fit_scene(hard_scenes.changed(made, rows, stranger.track.points[rows, :, :2]), hard_scenes.calibrated())
    others = np.setdiff1d(made.frames, rows)
    assert result.fitted.cut[[30, 40]].all() and result.fitted.cut.sum() == 2
    below(apart_mm(result, clean)[others].max(), 2.0, "frames of the subject, mm")
    assert result.fitted.reinit[30]
    below(
        3.0, np.median(result.fitted.error_px[rows]) / np.median(result.fitted.error_px), "error over the clip's (lower bound 3)"
    )


def test_case_16_face_leaves_the_frame() -> None:
    """The face slides out within 20 frames and returns: flagged, clamped landmarks pull nothing, found again within 2 frames."""
    made, _ = hard_scenes.baseline()
    count = 90
    slide = np.interp(np.arange(count), [25, 45, 55, 75], [0.0, 0.35, 0.35, 0.0])
    truth = moved(made.truth, translation=made.truth.motion.translation + slide[:, None] * [1, 0, 0])
    free = seen(truth)
    clamped = np.clip(free.track.points[..., :2], 0, np.array(SIZE[::-1]) - 1)
    outside = (free.track.points[..., 0] > SIZE[1]).mean(1)
    result = fit_scene(hard_scenes.changed(free, slice(None), clamped), hard_scenes.calibrated())
    assert not result.fitted.usable[outside > 0.6].any()
    partly = (outside > 0.05) & (outside < 0.4)
    error = result.rotation
    assert partly.sum() >= 4
    below(error[partly].max(), 3.0, "rotation with up to 40 % outside")
    back = np.flatnonzero((outside < 0.4) & (np.arange(count) > 50))
    assert result.fitted.usable[back].all()
    below(error[back[1] :].max(), 3.0, "rotation from the second frame after the return")


def test_case_17_occluder_drags_landmarks() -> None:
    """A quarter of the face's landmarks dragged by 30 px: the others' fitted places move by less than 0.5 px.

    Measured: median 0.05, p95 0.19 (before `Tracker.foresee` 2.0 and 7).  A drag of 15 px (a tenth of the inter-ocular distance)
    is not told from an expression: 0.9 px and 3 degrees.
    """
    made, clean = hard_scenes.baseline()
    template = hard_scenes.MODEL.surface.base
    dragged = np.zeros(478, bool)
    ids = hard_scenes.MODEL.ids
    corner = np.argsort(template[:, 0] + template[:, 1])[-len(ids) // 4 :]
    dragged[ids[corner]] = True
    rows = np.arange(30, 60)
    points = made.track.points[rows, :, :2] + dragged[:, None] * np.array([30.0, 0.0])
    result = fit_scene(hard_scenes.changed(made, rows, points), hard_scenes.calibrated())
    moved_px = np.linalg.norm(_fitted_px(result) - _fitted_px(clean), axis=-1)[rows][:, ~dragged[ids]]
    below(np.percentile(moved_px, 95), 0.5, "the other landmarks, px (p95)")
    assert result.fitted.usable.all()


def _fitted_px(result: hard_scenes.Result) -> np.ndarray:
    """Projections [T, L, 2] of the fitted landmarks."""
    state = result.fitted.state
    surface = state.fold(hard_scenes.MODEL).surface
    points = np.stack([posed(surface, state.pose(k)).points for k in range(len(state))])
    return camera.project(points, state.focal_px, result.arrays["centre_px"])


def test_no_face_at_all_is_an_error() -> None:
    """Case 23, landmarks: NaN or infinite points are flagged frames; a clip of nothing else is an error with a reason."""
    made, _ = hard_scenes.baseline()
    bad = made.track.points[..., :2].copy()
    bad[10, 5], bad[11, 7] = np.nan, np.inf
    flagged = hard_scenes.changed(made, slice(None), bad)
    assert np.flatnonzero(~flagged.observed.found).tolist() == [10, 11]
    assert np.isfinite(flagged.observed.points).all()
    nothing = hard_scenes.changed(made, slice(None), np.full_like(bad, np.nan))
    with pytest.raises(tracking.LostFace, match="a face is found in 0 of"):
        fit_scene(nothing)
    with pytest.raises(ValueError, match="no face"):
        hard_scenes.tracker(nothing).block(np.arange(10))


def test_case_12_pnp_on_degenerate_points() -> None:
    """Points on a line, in one place, within 5 px, mirrored (behind the camera) or too few: a plain pose, never NaN."""
    made, _ = hard_scenes.baseline()
    random = np.random.default_rng(0)
    points = np.repeat(made.observed.points[:1], 5, 0)
    points[0, :, 1] = 240.0
    points[1] = 77.0
    points[2] = 200 + random.uniform(0, 5, points[2].shape)
    points[3] = 2 * hard_scenes.SIZE[0] / 2 - points[3]  # as of a face behind the camera
    observed = replace(made.observed, points=points, scale_px=np.full(5, 130.0), inside=made.observed.inside[:5].copy())
    observed.inside[4] = np.isin(np.arange(points.shape[1]), np.flatnonzero(observed.inside[4])[:4])
    state = stages.pnp(hard_scenes.MODEL, observed, np.arange(5), hard_scenes.calibrated().state)
    assert np.isfinite(state.rotation).all() and np.isfinite(state.translation).all()
    assert (state.translation[:, 2] > 0).all() and (state.rotation[:, 2, 2] > 0).all()


def test_case_12_pnp_picks_the_facing_solution() -> None:
    """1000 random poses with yaw up to 80 degrees: the facing solution in all of them."""
    random = np.random.default_rng(1)
    angle = np.radians(random.uniform([-30, -80, -40], [30, 80, 40], (1000, 3)))
    turn = (
        camera.exp_rotation(angle * [1, 0, 0]) @ camera.exp_rotation(angle * [0, 1, 0]) @ camera.exp_rotation(angle * [0, 0, 1])
    )
    base, focal = hard_scenes.MODEL.surface.base, 624.0
    head = np.einsum("tij,lj->tli", turn, base) + random.uniform([-0.05, -0.05, 0.35], [0.05, 0.05, 1.0], (1000, 3))[:, None]
    pixel = camera.project(head, focal, np.array([240.0, 240.0])) + random.normal(size=(1000, len(base), 2))
    observed = hard_scenes.baseline()[0].observed
    observed = replace(observed, points=pixel, scale_px=np.full(1000, 130.0), inside=np.ones(pixel.shape[:2], bool))
    state = stages.pnp(
        hard_scenes.MODEL, observed, np.arange(1000), replace(hard_scenes.neutral_state(), log_focal=np.log(focal))
    )
    error = hard_scenes.rotation_degrees(state.rotation, turn)
    print("worst", error.max(), "above 10:", (error > 10).sum())
    assert (error < 20).all()
