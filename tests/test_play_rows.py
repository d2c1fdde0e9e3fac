"""play: rows, sliders, and a driver's pose carried over to the subject."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar.play.carry import NEUTRAL_FRAMES, Carrier
from avatar.play.rows import Body, Row, as_motion, of_motion, rest_row
from avatar.play.sliders import GAZE, STATISTICAL, TURN, Panel, group_of, sliders_of, turn_matrix
from avatar.uses import retarget, sequence
from avatar.uses.motion import Motion
from fitting.camera import exp_rotation, log_rotation
from fitting.rig import Pose
from tests.landmarked import statistical_head
from tests.small_face import true_head


def motion_of(head, frames: int = 40, seed: int = 0) -> Motion:
    """A lively motion half a metre away."""
    random = np.random.default_rng(seed)
    codes = random.uniform(0, 0.6, (frames, len(head.expression_names)))
    turns = 0.2 * random.normal(size=(frames, 3))
    eyes = np.zeros((frames, 2, 3))
    eyes[..., :2] = 0.1 * random.normal(size=(frames, 1, 2))
    place = np.array([0.01, 0.02, 0.5]) + 0.01 * random.normal(size=(frames, 3))
    zero = np.zeros((frames, 3))
    return Motion(codes, turns, zero, 0 * turns, eyes, place, 30.0)


def shape_of(head) -> np.ndarray:
    return 0.5 * np.sin(np.arange(len(head.shape_basis)))


@pytest.fixture(scope="module")
def made() -> tuple:
    head = true_head()
    motion, shape = motion_of(head), shape_of(head)
    row, rest = rest_row(head, shape, motion)
    return head, shape, motion, row, rest, Panel.of(head, row, Body.of(head, shape), motion)


@pytest.mark.parametrize("head", [true_head(), statistical_head()], ids=["actions", "statistical"])
def test_face_centre_is_that_of_retarget(head) -> None:
    """Also where the root joint moves with shape and expression."""
    motion, shape = motion_of(head), shape_of(head)
    body, centres = Body.of(head, shape), retarget.face_centres(head, shape, motion)
    for place in (0, 7):
        row = of_motion(motion, place)
        np.testing.assert_allclose(body.face_centre(row), centres[place], atol=1e-6)
        moved = body.placed(row, np.array([0.1, 0.2, 0.7]))
        np.testing.assert_allclose(retarget.face_centres(head, shape, as_motion(moved))[0], [0.1, 0.2, 0.7], atol=1e-6)


def test_a_turn_is_about_the_skull_and_turns_the_vertices(made: tuple) -> None:
    head, shape, motion, *_ = made
    body, row, turn = Body.of(head, shape), of_motion(motion, 3), exp_rotation(np.array([0.3, -0.5, 0.2]))
    scenes = [
        sequence.scene_of(head, shape, sequence.Camera(1.0, np.zeros(2), (1, 1)), as_motion(one))
        for one in (row, body.turned(row, turn))
    ]
    first, second = (scene.vertices_m[0].double().numpy() @ scene.rotation[0].T + scene.offset_m[0] for scene in scenes)
    pivot = sequence.head_centre_m(scenes[0])[0]
    np.testing.assert_allclose(second, (first - pivot) @ turn.T + pivot, atol=2e-6)


def test_rest_is_straight_and_where_the_face_usually_is(made: tuple) -> None:
    head, shape, motion, row, rest, _ = made
    assert not row.rotation.any() and not row.neck.any()
    np.testing.assert_allclose(Body.of(head, shape).face_centre(row), rest.centre_m, atol=1e-9)
    np.testing.assert_allclose(rest.centre_m, np.median(retarget.face_centres(head, shape, motion), 0), atol=1e-9)
    np.testing.assert_array_equal(row.expression, rest.expression)


def test_every_code_has_a_slider_in_its_range(made: tuple) -> None:
    head, _, motion, row, _, panel = made
    found = {slider.name: slider for slider in panel.sliders.values()}
    assert set(found) == {*head.expression_names, *TURN, *GAZE}  # this jaw moves by actions alone
    for place, name in enumerate(head.expression_names):
        slider = found[name]
        assert (slider.low, slider.high) == (0, 1) and slider.low <= slider.rest <= slider.high
        low, high = np.percentile(motion.expression[:, place], [1, 99])
        assert slider.seen == pytest.approx((low, high))
    assert found["mouthSmileLeft"].twin == "mouthSmileRight" and found["jawOpen"].twin is None
    assert found["mouthSmileLeft"].label == "smile left" and found["mouthSmileLeft"].group == "Mouth"
    assert found["noseSneerLeft"].label == "nose sneer left" and found["mouthLeft"].twin == "mouthRight"
    groups = [slider.group for slider in panel.sliders.values()]
    assert groups == sorted(groups, key=groups.index) and groups[0] == "Head"  # a group is one piece


def test_a_statistical_head_has_ends_and_a_jaw() -> None:
    head = statistical_head()
    motion = motion_of(head)
    row, _ = rest_row(head, shape_of(head), motion)
    sliders = {slider.name: slider for slider in sliders_of(head, row, motion)}
    name = head.expression_names[0]
    assert (sliders[name].low, sliders[name].high) == (-STATISTICAL, STATISTICAL)
    assert group_of(name) == sliders[name].group == "Expression" and sliders["jaw_open"].high > 20
    panel = Panel.of(head, row, Body.of(head, shape_of(head)), motion)
    moved = panel.moved(row, panel.at_rest() | {"jaw_open": 20.0})
    assert moved.jaw[0] - row.jaw[0] == pytest.approx(np.radians(20))


def test_sliders_at_rest_move_nothing_and_add_to_a_motion(made: tuple) -> None:
    head, _, motion, row, _, panel = made
    for base in (row, of_motion(motion, 5)):
        for got, given in zip(panel.moved(base, panel.at_rest()), base, strict=True):
            np.testing.assert_allclose(got, given, atol=1e-9)
    place = head.expression_names.index("jawOpen")
    values = panel.at_rest() | {"jawOpen": 1.0, "gaze_right": 10.0, "gaze_up": 5.0}
    at_rest, playing = panel.moved(row, values), panel.moved(of_motion(motion, 5), values)
    assert at_rest.expression[place] == pytest.approx(1.0)  # the slider shows the code itself
    way = 1.0 - row.expression[place]
    assert playing.expression[place] == pytest.approx(motion.expression[5, place] + way)
    np.testing.assert_allclose(at_rest.eyes - row.eyes, np.radians([[-5, -10, 0]] * 2), atol=1e-12)
    doubled = panel.moved(of_motion(motion, 5), panel.at_rest(), 2.0)
    np.testing.assert_allclose(doubled.expression - row.expression, 2 * (motion.expression[5] - row.expression))


def test_turns_go_where_the_viewer_sees_them_go() -> None:
    nose, top = np.array([0, 0, -1.0]), np.array([0, -1.0, 0])
    assert (turn_matrix(20, 0, 0) @ nose)[0] > 0.3  # to the picture's right
    assert (turn_matrix(0, 20, 0) @ nose)[1] < -0.3  # up
    assert (turn_matrix(0, 0, 20) @ top)[0] > 0.3


@pytest.mark.parametrize(
    "values", [{"jawOpen": 1.01}, {"jawOpen": float("nan")}, {"turn_right": 1e9}, {"rm -rf": 0.0}, {"jawOpen": float("-inf")}]
)
def test_values_out_of_range_are_refused(made: tuple, values: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"goes from .* to|there is no slider"):
        made[5].checked(values)


def pose_of(head, codes: dict[str, float], turn=(0, 0, 0), place=(0.0, 0.0, 0.6), gaze=(0, 0)) -> Pose:
    expression = np.array([codes.get(name, 0.0) for name in head.expression_names])
    return Pose(exp_rotation(np.array(turn, float)), np.array(place), expression, np.array([*gaze, *gaze], float), np.zeros(3))


def test_a_driver_turns_and_moves_from_his_start(made: tuple) -> None:
    head, shape, _, row, rest, panel = made
    carrier = Carrier(head, panel.body, row, rest)
    begin = pose_of(head, {}, turn=(0.1, 0.4, 0))
    for _ in range(NEUTRAL_FRAMES):
        first = carrier.carried(begin)
    np.testing.assert_allclose(first.rotation, row.rotation, atol=1e-9)  # straight, however he sat
    np.testing.assert_allclose(panel.body.face_centre(first), rest.centre_m, atol=1e-9)
    turn = np.array([0.0, -0.3, 0.05])
    moved = carrier.carried(pose_of(head, {"jawOpen": 0.5}, turn=log_rotation(exp_rotation(turn) @ begin.rotation)))
    np.testing.assert_allclose(moved.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(moved.expression, pose_of(head, {"jawOpen": 0.5}).expression)  # copied until neutral is set
    # Nearer by a tenth: the subject's face is nearer by a tenth too, whatever focal length was assumed.
    driver = Body.of(head, np.zeros(len(head.shape_basis)))
    near = replace(begin, translation=0.9 * (begin.rotation @ driver.face_m + begin.translation) - begin.rotation @ driver.face_m)
    assert panel.body.face_centre(carrier.carried(near))[2] == pytest.approx(0.9 * rest.centre_m[2])


def test_set_neutral_makes_his_face_the_resting_one(made: tuple) -> None:
    head, _, _, row, rest, panel = made
    carrier = Carrier(head, panel.body, row, rest)
    assert not carrier.set_neutral()  # nobody has been seen yet
    raised = pose_of(head, {"browInnerUp": 0.4, "eyeBlinkLeft": 0.2}, turn=(0, 0.2, 0), gaze=(0.1, 0.05))
    for _ in range(NEUTRAL_FRAMES):
        carrier.carried(raised)
    assert carrier.set_neutral()
    at_rest = carrier.carried(raised)
    for name in ("expression", "jaw", "eyes", "rotation"):
        np.testing.assert_allclose(getattr(at_rest, name), getattr(row, name), atol=1e-9)
    shut = carrier.carried(pose_of(head, {"browInnerUp": 0.4, "eyeBlinkLeft": 1.0}, turn=(0, 0.2, 0)))
    assert shut.expression[head.expression_names.index("eyeBlinkLeft")] == pytest.approx(1.0)  # a shut eye is shut


def test_an_outlier_does_not_become_neutral(made: tuple) -> None:
    head, _, _, row, rest, panel = made
    carrier = Carrier(head, panel.body, row, rest)
    for k in range(NEUTRAL_FRAMES):
        carrier.carried(pose_of(head, {"jawOpen": 1.0 if k == 4 else 0.1}))
    carrier.set_neutral()
    place = head.expression_names.index("jawOpen")
    assert carrier.carried(pose_of(head, {"jawOpen": 0.1})).expression[place] == pytest.approx(row.expression[place])


def test_a_row_that_is_not_finite_is_refused() -> None:
    row = Row(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((2, 3)), np.array([0, 0, np.nan]))
    with pytest.raises(ValueError, match="translation of frame 0 is not finite"):
        as_motion(row)
