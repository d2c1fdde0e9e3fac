"""Simulated truth: trajectories, identities, landmark faults one by one, and error measures with known answers."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fitting import synthetic, synthetic_errors, synthetic_motion
from fitting.head_model import HeadModel
from fitting.synthetic_landmarks import Faults, LandmarkTrack, landmark_track
from tests.toy_head import toy_head

NAMES = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight")
LENS = synthetic.Camera.of((256, 256))


@pytest.fixture(scope="module")
def head() -> HeadModel:
    """The toy head with 478 landmarks all over it, but for the last five, and the actions' names."""
    toy = dataclasses.replace(toy_head(rows=20, columns=30), expression_names=NAMES)
    random = np.random.default_rng(0)
    triangle = random.integers(0, len(toy.triangles), 478)
    triangle[-5:] = -1
    weight = random.dirichlet([2, 2, 2], 478).astype(np.float32)
    return dataclasses.replace(toy, landmark_triangles=torch.from_numpy(triangle), landmark_barycentric=torch.from_numpy(weight))


def clip_of(head: HeadModel, kind: str = "slow", frames: int = 60, seed: int = 1, **options: float) -> synthetic.Clip:
    return synthetic.make(head, kind, frames, LENS, seed, **options)


def detected(head: HeadModel, clip: synthetic.Clip, seed: int = 0, **faults: float) -> LandmarkTrack:
    return landmark_track(
        head, clip.vertices, clip.camera.project, Faults(**faults), clip.motion.expression, clip.motion.eyes, seed
    )


def turn_of(kind: str, frames: int = 150) -> tuple[np.ndarray, synthetic_motion.Motion]:
    """Whole turn [T, 3] in degrees and the motion."""
    motion = synthetic_motion.make(kind, frames, 30.0, NAMES, 2, 0.5, 3)
    return np.degrees(motion.rotation + motion.neck), motion


def test_each_kind_moves_as_its_name_says() -> None:
    speed = lambda turn: np.linalg.norm(np.diff(turn, axis=0), axis=1)  # noqa: E731
    assert np.abs(turn_of("still")[0]).max() < 1.0
    assert 180 < 30 * speed(turn_of("fast")[0]).max() < 280
    jump = speed(turn_of("jump")[0])
    assert jump.argmax() == 74 and 35 < jump.max() < 45 and np.delete(jump, 74).max() < 3
    yaw = turn_of("profile")[0][:, 1]
    assert yaw.max() > 79 and yaw.min() < -79
    assert 20 < np.abs(turn_of("slow")[0][:, 1]).max() < 35 and speed(turn_of("slow")[0]).max() < 3
    assert turn_of("talk")[1].expression[:, 0].std() > 2 * turn_of("still")[1].expression[:, 0].std()


def test_a_blink_train_is_closed_for_four_frames_each() -> None:
    closed = turn_of("blink")[1].expression[:, 1] == 1.0
    starts = np.flatnonzero(np.diff(closed.astype(int), prepend=0) == 1)
    ends = np.flatnonzero(np.diff(closed.astype(int), append=0) == -1)
    assert len(starts) >= 5 and set((ends - starts + 1).tolist()) == {4}


@pytest.mark.parametrize("kind", synthetic_motion.KINDS)
def test_motion_is_bounded_and_decided_by_its_seed(kind: str) -> None:
    one, again, other = (synthetic_motion.make(kind, 40, 30.0, NAMES, 2, 0.5, seed) for seed in (1, 1, 2))
    assert one.expression.min() >= 0 and one.expression.max() <= 1 and np.abs(one.bumps).max() <= 1
    assert np.abs(one.translation - [0, 0.015, 0.5]).max() < 0.03
    for item in dataclasses.fields(one):
        assert np.array_equal(getattr(one, item.name), getattr(again, item.name))
        assert np.isfinite(getattr(one, item.name)).all()
    assert not np.array_equal(one.translation, other.translation)


@pytest.mark.parametrize(("kind", "frames"), [("dance", 10), ("slow", 0)])
def test_what_cannot_be_simulated_is_refused(kind: str, frames: int) -> None:
    with pytest.raises(ValueError, match="kinds are|at least one"):
        synthetic_motion.make(kind, frames, 30.0, NAMES, 0, 0.5, 0)


def test_a_single_frame_is_a_clip(head: HeadModel) -> None:
    for kind in synthetic_motion.KINDS:
        assert np.isfinite(clip_of(head, kind, 1).vertices).all()


def test_no_basis_holds_the_identity(head: HeadModel) -> None:
    clip = clip_of(head)
    within = head.shaped(torch.from_numpy(clip.shape.astype(np.float32))).numpy()
    displacement = clip.neutral - within
    assert np.isclose(np.sqrt((displacement**2).sum(1).mean()), 7e-4, rtol=0.01)
    basis = head.shape_basis.numpy().reshape(len(head.shape_basis), -1).T
    left = displacement.ravel() - basis @ np.linalg.lstsq(basis, displacement.ravel(), rcond=None)[0]
    assert np.linalg.norm(left) > 0.9 * np.linalg.norm(displacement)
    assert np.abs(clip.shape).max() <= synthetic.SHAPE_LIMIT
    assert np.allclose(clip_of(head, displacement_m=0.0).neutral, within, atol=1e-7)


def test_vertices_are_everything_together(head: HeadModel) -> None:
    """Slow twin: neutral head, actions and bumps, neck about its joint, root about its own, translation; the jaw stays shut."""
    clip, row = clip_of(head, "talk"), 17
    motion, joints = clip.motion, clip.head.joints.numpy().astype(np.float64)
    code = np.concatenate([motion.expression[row], motion.bumps[row]])
    points = clip.neutral + np.einsum("e,evd->vd", code, clip.head.expression_basis.numpy())
    points = Rotation.from_rotvec(motion.neck[row]).apply(points - joints[1]) + joints[1]
    points = Rotation.from_rotvec(motion.rotation[row]).apply(points - joints[0]) + joints[0] + motion.translation[row]
    assert np.abs(clip.vertices[row] - points).max() < 1e-6
    assert np.abs(motion.bumps[row]).max() > 0.1


def test_camera_is_opencvs() -> None:
    lens = synthetic.Camera.of((480, 640), 700.0, -0.05)
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.2 + [0, 0, 0.8]
    matrix = np.array([[700, 0, 320], [0, 700, 240], [0, 0, 1.0]])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array([-0.05, 0, 0, 0]))[0][:, 0]
    assert np.abs(lens.project(points) - expected).max() < 1e-9


def test_truth_is_complete_and_plain(head: HeadModel) -> None:
    arrays = clip_of(head).arrays()
    assert all(array.dtype.kind in "fiU" for array in arrays.values())
    assert arrays["vertices"].shape == (60, head.vertex_count, 3) and arrays["vertices"].dtype == np.float32
    assert arrays["expression"].shape == (60, 3) and tuple(arrays["expression_names"]) == NAMES
    lens = synthetic.camera_of(arrays)
    assert lens.size == LENS.size and lens.focal_px == pytest.approx(1.3 * 256) and lens.k1 == 0


def test_landmarks_without_faults_are_exact(head: HeadModel) -> None:
    clip = clip_of(head)
    track = detected(head, clip)
    for landmark in (0, 100, 400):
        corner = clip.vertices[9, head.triangles[head.landmark_triangles[landmark]].numpy()].astype(np.float64)
        point = head.landmark_barycentric[landmark].numpy() @ corner
        assert np.abs(track.points[9, landmark, :2] - LENS.project(point)).max() < 1e-3
    assert np.isnan(track.exact[:, -5:]).all() and np.isfinite(track.points).all() and track.found.all()
    looks = [name for name in track.blendshape_names if name.startswith("eyeLook")]
    assert len(looks) == 8 and track.blendshapes.shape == (60, 11)
    assert np.allclose(track.blendshapes[:, :3], clip.motion.expression, atol=1e-6)
    down, up = (track.blendshapes[:, track.blendshape_names.index(name)] for name in ("eyeLookDownLeft", "eyeLookUpLeft"))
    assert (down > 0).any() and (down * up == 0).all()


def test_noise_has_the_size_and_memory_asked_for(head: HeadModel) -> None:
    clip = clip_of(head, frames=200)
    exact = detected(head, clip)
    white = (detected(head, clip, white_px=0.7).points - exact.points)[:, :-5, :2]
    slow = (detected(head, clip, slow_px=0.5).points - exact.points)[:, :-5, :2]
    assert white.std() == pytest.approx(0.7, rel=0.02) and slow.std() == pytest.approx(0.5, rel=0.03)
    memory = lambda noise: (noise[1:] * noise[:-1]).mean() / (noise**2).mean()  # noqa: E731
    assert abs(memory(white)) < 0.02 and memory(slow) == pytest.approx(0.9, abs=0.02)
    both = (detected(head, clip, white_px=0.7, slow_px=0.5).points - exact.points)[:, :-5, :2]
    assert np.allclose(both, white + slow, atol=1e-3)  # a fault does not change another's random numbers


def test_bias_lies_on_the_surface_and_turns_with_it(head: HeadModel) -> None:
    clip = clip_of(head, "still", frames=40)
    offset = (detected(head, clip, bias_m=1e-3).points - detected(head, clip).points)[:, :-5, :2]
    assert np.abs(offset - offset[:1]).max() < 0.1  # constant: the head hardly moves
    expected = 1e-3 * LENS.focal_px / 0.5
    seen_whole = np.sqrt((offset**2).sum(-1).mean())  # foreshortened over the sphere: between half and all of it
    assert 0.5 * expected < seen_whole < expected


def test_outliers_lost_frames_and_scores(head: HeadModel) -> None:
    clip = clip_of(head)
    exact = detected(head, clip)
    track = detected(head, clip, outlier_share=0.1, outlier_px=40.0, lost=(3, 4, 99), score_noise=0.05)
    away = np.abs(track.points - exact.points)[track.found][:, :-5, :2].max(-1)
    assert (away > 0.5).mean() == pytest.approx(0.1, abs=0.01) and away.max() <= 40.01
    assert np.flatnonzero(~track.found).tolist() == [3, 4] and np.isnan(track.points[3]).all()
    scores = track.blendshapes[track.found]
    assert scores.min() >= 0 and scores.max() <= 1 and np.abs(scores - exact.blendshapes[track.found]).std() > 0.01


def test_far_side_guesses_touch_the_far_side_only(head: HeadModel) -> None:
    clip = clip_of(head, "profile", frames=90)
    away = np.linalg.norm(detected(head, clip, far_side_px=30.0).points - detected(head, clip).points, axis=-1)[:, :-5]
    row = int(np.degrees(clip.motion.rotation + clip.motion.neck)[:, 1].argmax())
    corner = clip.vertices[row, head.triangles[head.landmark_triangles[:-5]].numpy()].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    cosine = -(normal * corner.mean(1)).sum(1) / np.linalg.norm(normal, axis=1) / np.linalg.norm(corner.mean(1), axis=1)
    assert away[row, cosine > 0.15].max() < 1e-3 and np.median(away[row, cosine < -0.3]) > 15


def test_landmarks_follow_the_gaze_as_far_as_asked(head: HeadModel) -> None:
    clip = clip_of(head)
    moved = (detected(head, clip, gaze_near_px=3.0, gaze_far_px=1.0).points - detected(head, clip).points)[:, :-5, :2]
    rest = head.landmarks(head.template).numpy()[:-5]
    away = np.linalg.norm(rest[:, None] - head.joints.numpy()[None, 3:], axis=-1).min(1)
    size = moved[..., 1].std(0)
    assert size[away < 0.03].mean() > 1.5 * size[away > 0.1].mean() > 0
    gaze = clip.motion.eyes[:, :, 0].mean(1)
    assert np.corrcoef(moved[..., 1].mean(1), gaze)[0, 1] > 0.999  # looking down moves them down


def fitted(head: HeadModel, clip: synthetic.Clip) -> tuple[HeadModel, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The perfect fit: the subject's own head and parameters; and the truth."""
    truth = clip.arrays()
    code = np.concatenate([truth["expression"], truth["bumps"]], 1)
    return clip.head, truth | {"expression": code}, truth


def test_a_perfect_fit_has_no_error(head: HeadModel) -> None:
    subject, track, truth = fitted(head, clip_of(head))
    errors = synthetic_errors.compare(subject, track, truth)
    for name, values in errors.frames.items():
        if "jitter" not in name and "aperture" not in name and "gaze" not in name:
            assert np.abs(values).max() < 2e-3, name
    assert errors.clip["scale"] == pytest.approx(1) and errors.clip["focal_percent"] == 0
    assert np.allclose(errors.frames["jitter_fit_mm"][1:-1], errors.frames["jitter_true_mm"][1:-1], atol=1e-3)
    assert set(errors.summary()["face_mm"]) == {"p50", "p95"}


def test_scale_about_the_camera_is_taken_out_and_reported(head: HeadModel) -> None:
    subject, track, truth = fitted(head, clip_of(head))
    truth = truth | {"vertices": truth["vertices"] * 1.1, "focal_px": truth["focal_px"] * 0.8}
    errors = synthetic_errors.compare(subject, track, truth, focal_scale=0.5)
    assert errors.clip["scale"] == pytest.approx(1.1, abs=1e-5) and errors.frames["face_mm"].max() < 2e-3
    assert errors.frames["face_raw_mm"].min() > 30 and errors.clip["focal_percent"] == pytest.approx(150, abs=1e-3)


def test_a_head_at_the_wrong_depth_is_still_the_right_head(head: HeadModel) -> None:
    subject, track, truth = fitted(head, clip_of(head))
    further = truth["vertices"] + np.float32([0, 0, 0.1])
    errors = synthetic_errors.compare(subject, track, truth | {"vertices": further})
    assert errors.frames["face_mm"].min() > 5 and errors.frames["face_alone_mm"].max() < 2e-3
    depth = truth["vertices"][..., 2].mean()
    assert np.median(errors.frames["depth_percent"]) == pytest.approx(-100 * 0.1 / (depth + 0.1), rel=0.05)
    larger = 1.05 * (truth["vertices"] - truth["vertices"].mean(1, keepdims=True)) + truth["vertices"].mean(1, keepdims=True)
    assert synthetic_errors.compare(subject, track, truth | {"vertices": larger}).clip["size"] == pytest.approx(1.05, abs=1e-5)


def test_rotations_constant_and_not(head: HeadModel) -> None:
    subject, track, truth = fitted(head, clip_of(head))
    size = 3.0 + np.tile([0.5, -0.5], 30)
    pose = Rotation.from_rotvec(truth["rotation"]) * Rotation.from_rotvec(truth["neck"])
    extra = pose * Rotation.from_rotvec(np.radians(size)[:, None] * np.array([0.6, 0.8, 0])) * pose.inv()  # in the head's axes
    middle = truth["vertices"].mean(1, keepdims=True)
    turned = np.einsum("tij,tvj->tvi", extra.as_matrix(), truth["vertices"] - middle) + middle
    errors = synthetic_errors.compare(subject, track, truth | {"vertices": turned})
    assert np.allclose(errors.frames["rotation_deg"], size, atol=0.01)
    assert np.allclose(errors.frames["rotation_less_constant_deg"], 0.5, atol=0.01)
    assert errors.clip["constant_rotation_deg"] == pytest.approx(3.0, abs=0.01)


def test_expression_and_jitter_of_known_size(head: HeadModel) -> None:
    subject, track, truth = fitted(head, clip_of(head))
    face = synthetic_errors._parts(subject)[0]
    missing = track | {"expression": track["expression"] * 0}
    expected = np.einsum("te,evd->tvd", track["expression"], subject.expression_basis.numpy()[:, face])
    errors = synthetic_errors.compare(subject, missing, truth)
    assert np.allclose(errors.frames["expression_mm"], 1e3 * np.sqrt((expected**2).sum(-1).mean(1)), rtol=0.35, atol=0.02)
    shaking = truth["vertices"] + 1e-3 * np.tile([1, -1], 30)[:, None, None] * np.array([1, 0, 0])
    jitter = synthetic_errors._jitter(shaking - truth["vertices"])
    assert np.allclose(jitter[1:-1], 4.0, rtol=1e-3) and np.isnan(jitter[[0, -1]]).all()


def test_lag_is_measured_in_frames() -> None:
    true = np.convolve(np.random.default_rng(0).normal(size=120), np.ones(5) / 5, "same")
    assert synthetic_errors.lag(np.roll(true, 2), true) == pytest.approx(2, abs=0.1)
    assert synthetic_errors.lag(np.roll(true, -1), true) == pytest.approx(-1, abs=0.1)
    assert np.isnan(synthetic_errors.lag(true * 0, true))


def test_another_clip_or_head_is_refused(head: HeadModel) -> None:
    subject, track, truth = fitted(head, clip_of(head))
    with pytest.raises(ValueError, match="60 frames"):
        synthetic_errors.compare(subject, track | {"rotation": track["rotation"][:-1]}, truth)
    rows = np.arange(0, 60, 2)
    part = {name: value[rows] if np.ndim(value) and len(value) == 60 else value for name, value in track.items()}
    assert synthetic_errors.compare(subject, part, truth, rows=rows).frames["face_mm"].max() < 2e-3
