"""Wrinkles of simulated faces: none at rest, darker with their action, at their place, and nothing else changes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from fitting import synthetic, synthetic_paint
from fitting.synthetic_render import Renderer
from fitting.synthetic_wrinkles import BOTH, EACH, POINTS, Wrinkles, wrinkles
from tests.small_face import true_head
from tests.toy_head import toy_head

NAMES = true_head().expression_names
GESTURES = {
    "raised brows": {"browInnerUp": 0.6, "browOuterUpLeft": 0.6, "browOuterUpRight": 0.6},
    "lowered brows": {"browDownLeft": 0.4, "browDownRight": 0.4},
    "squint": {"eyeSquintLeft": 0.5, "eyeSquintRight": 0.5},
    "smile": {"mouthSmileLeft": 0.6, "mouthSmileRight": 0.6},
}


def code(actions: dict[str, float]) -> np.ndarray:
    values = np.zeros(len(NAMES))
    for name, value in actions.items():
        values[NAMES.index(name)] = value
    return values


def landmarks_m() -> np.ndarray:
    return true_head().landmarks(true_head().template).numpy()[:, :2]


@pytest.fixture(scope="module")
def folds() -> Wrinkles:
    return wrinkles(landmarks_m(), NAMES, synthetic_paint.MAP_LOW, synthetic_paint.MAP_STEP_M, synthetic_paint._map_size(), 3)


@pytest.fixture(scope="module")
def drawn() -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Each gesture on a mesh that does not move: picture with wrinkles, the same without, and the matte."""
    lens = synthetic.Camera.of((256, 256), 420.0)
    clip = synthetic.make(true_head(), "still", 1 + len(GESTURES), lens, 1)
    actions = np.stack([code({}), *map(code, GESTURES.values())])
    still = np.repeat(clip.vertices[:1], len(actions), 0)
    clip = dataclasses.replace(clip, vertices=still, motion=dataclasses.replace(clip.motion, expression=actions))
    clip.motion.translation[:] = clip.motion.translation[0]
    lined, plain = Renderer(clip, noise=0.0), Renderer(clip, noise=0.0, wrinkles=0.0)
    out = {}
    for row, name in enumerate(("rest", *GESTURES)):
        picture, alpha = lined.frame(row)
        smooth, same = plain.frame(row)
        assert np.array_equal(alpha, same)
        out[name] = picture.astype(int), smooth.astype(int), alpha
    return out


def test_every_action_is_the_head_models(folds: Wrinkles) -> None:
    assert len(folds.maps) == len(BOTH) + 2 * len(EACH) and folds.weights.shape == (len(folds.maps), len(NAMES))
    named = {name for fold in BOTH for name, _ in fold.actions}
    named |= {name.replace("*", side) for fold in EACH for name, _ in fold.actions for side in ("Left", "Right")}
    assert named <= set(NAMES)


def test_no_wrinkle_at_rest_and_deeper_with_the_action(folds: Wrinkles) -> None:
    assert not folds.darkness(code({})).any() and not folds.darkness(code({"jawOpen": 1.0, "eyeBlinkLeft": 1.0})).any()
    raised = [folds.darkness(code({"browInnerUp": value})) for value in (0.02, 0.1, 0.3, 0.6, 1.0)]
    assert 0 < raised[0].max() < 0.005  # grows as a square: a face that hardly moves has none
    assert all((low <= high).all() and low.max() < high.max() for low, high in zip(raised, raised[1:], strict=False))
    assert 0.4 < raised[-1].max() < 0.7
    assert folds.darkness(np.full(len(NAMES), 2.0)).max() <= 0.8  # doubled codes keep some light


def test_lines_are_where_the_muscles_are(folds: Wrinkles) -> None:
    y, x = np.mgrid[: folds.maps.shape[1], : folds.maps.shape[2]] * synthetic_paint.MAP_STEP_M
    x, y = x + synthetic_paint.MAP_LOW[0], y + synthetic_paint.MAP_LOW[1]
    points = landmarks_m()
    box = {}
    for name, actions in GESTURES.items():
        dark = folds.darkness(code(actions)) > 0.1
        box[name] = x[dark], y[dark]
    x_raised, y_raised = box["raised brows"]  # the outer ends come down with the brow
    assert y_raised[np.abs(x_raised) < 0.03].max() < points[list(POINTS["brow"]), 1].min() - 0.003
    assert np.abs(box["lowered brows"][0]).max() < 0.018
    assert np.abs(box["squint"][0]).min() > 0.01 and np.abs(box["squint"][1] - points[33, 1]).max() < 0.025
    between = points[[129, 61], 1] + [-0.008, 0.01]
    mouth = box["smile"][1][box["smile"][1] > 0.005]  # a smile has crow's feet as well
    assert between[0] < mouth.min() and mouth.max() < between[1]
    left = folds.darkness(code({"mouthSmileLeft": 0.6})) > 0.1
    assert x[left].min() > 0.01  # the subject's left is at positive x


def test_at_rest_the_picture_is_that_of_a_face_without_wrinkles(drawn: dict) -> None:
    assert np.array_equal(drawn["rest"][0], drawn["rest"][1])


@pytest.mark.parametrize("name", GESTURES)
def test_skin_gets_darker_and_nothing_else_changes(drawn: dict, name: str) -> None:
    lined, smooth, _ = drawn[name]
    assert np.array_equal(smooth, drawn["rest"][1])
    change = (lined - smooth).min(-1)
    assert (lined <= smooth).all() and change.min() < -15
    assert 0.0005 < (change < -2).mean() < 0.06  # lines, not a shade over the face


def test_subjects_differ_and_a_seed_decides(folds: Wrinkles) -> None:
    make = lambda seed: wrinkles(  # noqa: E731
        landmarks_m(), NAMES, synthetic_paint.MAP_LOW, synthetic_paint.MAP_STEP_M, synthetic_paint._map_size(), seed
    )
    assert np.array_equal(make(3).maps, folds.maps) and np.abs(make(4).maps - folds.maps).max() > 0.1


def test_a_head_without_landmarks_or_names_has_none() -> None:
    toy = toy_head()
    for names in (toy.expression_names, NAMES):
        nowhere = np.full((478, 2), np.nan)
        none = wrinkles(nowhere, names, np.zeros(2), 1e-3, (20, 30), 0)
        assert none.maps.shape == (0, 20, 30) and not none.darkness(np.ones(len(names))).any()
    assert not torch.isfinite(toy.landmarks(toy.template)).all()
    nameless = wrinkles(landmarks_m(), ("jawOpen",), np.zeros(2), 1e-3, (20, 30), 0)
    assert not len(nameless.maps)
