"""play: the one-frame solver on landmarks with known truth, what it makes of garbage, and the one-euro filter."""

from __future__ import annotations

import numpy as np
import pytest

from avatar.play import smoothing
from avatar.play.rows import Row
from avatar.play.solver import CALIBRATE_ON, FaceSolver
from fitting import camera
from fitting.rig import posed
from tests.made_driver import FOCAL_PX, SIZE, landmarks_px, scores_of
from tests.small_face import true_head

SMILE = {"mouthSmileLeft": 0.7, "mouthSmileRight": 0.6, "jawOpen": 0.4, "browInnerUp": 0.5}
TURN = (0.1, -0.3, 0.05)


def degrees(pose, turn) -> float:
    apart = pose.rotation @ camera.exp_rotation(np.array(turn, float)).T
    return float(np.degrees(np.linalg.norm(camera.log_rotation(apart))))


def code(head, pose, name) -> float:
    return float(pose.expression[head.expression_names.index(name)])


def error_px(solver, pose, points) -> float:
    at = posed(solver.shared.fold(solver.model).surface, pose).points
    pixel = camera.project(at, FOCAL_PX, np.array(SIZE[::-1]) / 2)
    return float(np.sqrt(((pixel - points[solver.model.ids, :2]) ** 2).sum(1).mean()))


@pytest.mark.parametrize("warm", [False, True])
def test_a_known_face_is_found_cold_and_warm(warm: bool) -> None:
    head, gaze = true_head(), (0.1, -0.15)
    solver = FaceSolver(head, SIZE)
    if warm:
        for share in np.linspace(0, 0.8, 5):
            codes = {name: share * value for name, value in SMILE.items()}
            place = (0.01, -0.02 + 0.01 * share, 0.5)
            at = landmarks_px(head, codes, tuple(share * np.array(TURN)), tuple(share * np.array(gaze)), place)
            assert solver.solve(at, scores_of(codes)) is not None
    points = landmarks_px(head, SMILE, TURN, gaze)
    pose = solver.solve(points, scores_of(SMILE))
    assert degrees(pose, TURN) < 0.3
    assert error_px(solver, pose, points) < 0.5
    for name, value in SMILE.items():
        assert code(head, pose, name) == pytest.approx(value, abs=0.06)
    assert code(head, pose, "eyeBlinkLeft") == pytest.approx(0, abs=0.06)
    np.testing.assert_allclose(pose.gaze, [*gaze, *gaze], atol=0.03)


def test_landmarks_outweigh_wrong_scores() -> None:
    head, codes = true_head(), {"jawOpen": 0.8}
    pose = FaceSolver(head, SIZE).solve(landmarks_px(head, codes), scores_of({}))
    assert code(head, pose, "jawOpen") > 0.5


def test_a_wink_and_a_look_aside() -> None:
    head, codes = true_head(), {"eyeBlinkLeft": 1.0}
    solver = FaceSolver(head, SIZE)
    solver.solve(landmarks_px(head, {}), scores_of({}))
    pose = solver.solve(landmarks_px(head, codes), scores_of(codes))
    assert code(head, pose, "eyeBlinkLeft") > 0.8 and code(head, pose, "eyeBlinkRight") < 0.2


@pytest.mark.parametrize(
    "points",
    [
        None,
        np.full((478, 3), np.nan, np.float32),
        np.zeros((478, 3), np.float32),
        np.full((478, 3), 1e30, np.float32),
        np.full((478, 3), [320, 240, 0], np.float32),
    ],
    ids=["none", "nan", "corner", "far", "one point"],
)
def test_no_face_is_no_pose_and_the_next_face_is_found(points: np.ndarray | None) -> None:
    head = true_head()
    solver = FaceSolver(head, SIZE)
    good = landmarks_px(head, SMILE, TURN)
    assert solver.solve(good, scores_of(SMILE)) is not None
    with np.errstate(all="ignore"):
        assert solver.solve(points, scores_of({})) is None
    pose = solver.solve(good, scores_of(SMILE))
    assert degrees(pose, TURN) < 0.3 and error_px(solver, pose, good) < 0.5


@pytest.mark.parametrize("seed", range(4))
def test_noise_for_a_face_stays_finite(seed: int) -> None:
    head, random = true_head(), np.random.default_rng(seed)
    solver = FaceSolver(head, SIZE)
    for _ in range(3):
        points = np.concatenate([random.uniform(10, 460, (478, 2)), np.zeros((478, 1))], 1).astype(np.float32)
        pose = solver.solve(points, random.random(51).astype(np.float32))
        if pose is not None:
            parts = (pose.rotation, pose.translation, pose.expression, pose.gaze)
            assert all(np.isfinite(part).all() for part in parts) and pose.translation[2] > 0
    scores = np.full(51, np.nan, np.float32)
    pose = solver.solve(landmarks_px(head, {}), scores)
    assert pose is not None and np.isfinite(pose.expression).all()


def test_a_jump_is_followed() -> None:
    """A cut in the film: the frame before is no help."""
    head = true_head()
    solver = FaceSolver(head, SIZE)
    for _ in range(4):
        solver.solve(landmarks_px(head, {}, (0, 0.5, 0), place_m=(-0.08, 0.03, 0.6)), scores_of({}))
    turn, points = (0.0, -0.5, 0.2), landmarks_px(head, SMILE, (0.0, -0.5, 0.2), place_m=(-0.05, -0.02, 0.45))
    assert degrees(solver.solve(points, scores_of(SMILE)), turn) < 1.0


def test_calibration_learns_who_it_is() -> None:
    """Another identity than the mean head's: reprojection falls, and `forget` goes back."""
    head = true_head()
    shape = 1.2 * np.sin(np.arange(len(head.shape_basis)) * 2.1)
    solver, before, after = FaceSolver(head, SIZE), [], []
    for k in range(CALIBRATE_ON + 12):
        codes = {"jawOpen": 0.3 + 0.3 * np.sin(k / 4), "browInnerUp": 0.3 + 0.3 * np.cos(k / 5)}
        points = landmarks_px(head, codes, (0.1 * np.sin(k / 6), 0.35 * np.sin(k / 5), 0.0), shape=shape)
        known = solver.calibrated
        pose = solver.solve(points, scores_of(codes))
        if solver.calibrated == known:  # a pose from before the calibration does not fit what is known after it
            (after if known else before).append(error_px(solver, pose, points))
    assert solver.calibrated and np.median(after) < 0.4 * np.median(before)
    assert np.corrcoef(solver.shared.shape[:6], shape[:6])[0, 1] > 0.5
    solver.forget()
    assert not solver.calibrated and not solver.shared.shape.any()


def test_one_euro_is_its_formula_and_stands_still_where_nothing_moves() -> None:
    cutoff, speed = np.array([1.0, 3.0]), np.array([0.5, 2.0])
    euro, random, time = smoothing.OneEuro(cutoff, speed), np.random.default_rng(0), 0.0
    last = velocity = None
    for _ in range(40):
        value, step = random.normal(size=2), float(random.uniform(0.01, 0.1))
        time += step
        if last is None:
            expected, velocity = value, np.zeros(2)
        else:
            share = lambda hz: (2 * np.pi * hz * step) / (2 * np.pi * hz * step + 1)  # noqa: B023, E731
            rate = share(smoothing.SPEED_CUTOFF_HZ)
            velocity = rate * (value - last) / step + (1 - rate) * velocity
            amount = share(cutoff + speed * np.abs(velocity))
            expected = amount * value + (1 - amount) * last
        np.testing.assert_allclose(euro(value, time), expected, atol=1e-12)
        last = expected
    still = smoothing.OneEuro(cutoff, speed)
    assert all((still(np.ones(2), k / 30) == 1).all() for k in range(20))


def test_one_euro_calms_noise_and_follows_a_jump() -> None:
    random = np.random.default_rng(1)
    euro = smoothing.OneEuro(np.array([2.5]), np.array([8.0]))
    noise = 0.02 * random.normal(size=300)
    out = np.array([euro(np.array([value]), k / 30)[0] for k, value in enumerate(noise)])
    assert np.diff(out, 2).std() < 0.45 * np.diff(noise, 2).std()
    euro.reset()
    step = [euro(np.array([float(k >= 10)]), k / 30)[0] for k in range(16)]
    assert step[9] == 0 and step[11] > 0.7 and step[13] > 0.9  # 67 ms after the first frame of a blink


def test_one_euro_after_a_gap_and_at_the_same_time() -> None:
    euro = smoothing.OneEuro(np.array([0.1]), np.array([0.0]))
    euro(np.array([0.0]), 0.0)
    assert euro(np.array([5.0]), 0.0)[0] == 0  # twice the same time
    assert euro(np.array([5.0]), 0.03)[0] < 0.2
    assert euro(np.array([5.0]), 0.04 + smoothing.FORGET_S)[0] == 5


def test_a_row_goes_through_with_its_parts() -> None:
    smooth = smoothing.SmoothRow(3)
    row = Row(np.arange(3.0), np.full(3, 0.1), np.full(3, 9.0), np.full(3, 0.2), np.arange(6.0).reshape(2, 3), np.full(3, 0.5))
    for k in range(3):
        for given, got in zip(row, smooth(row, k / 30), strict=True):
            np.testing.assert_allclose(got, given)
    later = smooth(row._replace(neck=np.zeros(3), translation=np.ones(3)), 0.1)
    assert not later.neck.any() and (later.translation > 0.5).all() and (later.translation < 1).all()


@pytest.mark.parametrize("late", [0.0, 0.7, 2.0])
def test_lateness_is_measured(late: float) -> None:
    from avatar.play.timing import late_frames

    time = np.arange(200.0)
    wave = lambda at: np.sin(at / 9) + 0.4 * np.sin(at / 4)  # noqa: E731
    assert late_frames(list(wave(time)), list(wave(time - late))) == pytest.approx(late, abs=0.11)
