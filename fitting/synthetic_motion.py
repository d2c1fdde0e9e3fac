"""Trajectories of a simulated subject: head pose, gaze and facial actions over time, one kind of clip each.

Angles are amplitudes that people reach in front of a phone; a clip is decided by its kind, length, rate and seed alone.
T frames, E expression coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

KINDS = ("still", "slow", "fast", "jump", "profile", "blink", "talk")
JUMP_RAD = np.radians(40.0)
PROFILE_RAD = np.radians(80.0)
FAST_HZ, FAST_RAD = 1.6, np.radians(20.0)  # peak 200 degrees a second, a quick shake of the head
NECK_SHARE = 0.25  # part of the turn that the neck joint makes: a fit that keeps the neck straight cannot copy it
RESTING_GAZE_RAD = 0.18  # the gaze axis of the anny head passes high in the opening: this much lower, the eyes look at the camera
BLINK_CLOSED_FRAMES = 4
LIDS = ("eyeBlinkLeft", "eyeBlinkRight")
# Shapes of the mouth while talking: (action, weight) each; they follow each other at four to five a second.
VISEMES = (
    (("jawOpen", 0.45), ("mouthLowerDownLeft", 0.25), ("mouthLowerDownRight", 0.25)),  # a
    (("jawOpen", 0.2), ("mouthFunnel", 0.55)),  # o
    (("jawOpen", 0.08), ("mouthPucker", 0.65)),  # u
    (("jawOpen", 0.12), ("mouthStretchLeft", 0.4), ("mouthStretchRight", 0.4), ("mouthUpperUpLeft", 0.2)),  # e
    (("jawOpen", 0.05), ("mouthPressLeft", 0.35), ("mouthPressRight", 0.35), ("mouthRollLower", 0.2)),  # m, b, p
    (("jawOpen", 0.1), ("mouthRollLower", 0.4), ("mouthUpperUpLeft", 0.15), ("mouthUpperUpRight", 0.15)),  # f, v
    (),  # closed and at rest
)  # fmt: skip
# What a face does now and then: names moved together, largest amount, seconds over which it changes.
GESTURES = (
    (("mouthSmileLeft", "mouthSmileRight"), 0.7, 0.8),
    (("cheekSquintLeft", "cheekSquintRight"), 0.3, 0.8),
    (("browInnerUp", "browOuterUpLeft", "browOuterUpRight"), 0.6, 0.5),
    (("browDownLeft", "browDownRight"), 0.35, 0.6),
    (("jawOpen",), 0.3, 0.6),
    (("mouthPucker",), 0.3, 0.5),
    (("eyeSquintLeft", "eyeSquintRight"), 0.25, 0.7),
    (("mouthLeft",), 0.15, 0.7),
    (("noseSneerLeft", "noseSneerRight"), 0.15, 0.6),
)
LIVELINESS = {"still": 0.25, "slow": 1.0, "fast": 0.7, "jump": 0.8, "profile": 0.6, "blink": 0.35, "talk": 0.5}


@dataclass(frozen=True)
class Motion:
    """Parameters of every frame, conventions of `HeadModel.forward`."""

    expression: np.ndarray  # [T, E] in [0, 1]
    rotation: np.ndarray  # [T, 3] axis-angle rad, root
    neck: np.ndarray  # [T, 3] axis-angle rad
    eyes: np.ndarray  # [T, 2, 3] axis-angle rad, left then right
    translation: np.ndarray  # [T, 3] m
    bumps: np.ndarray  # [T, B] amounts in [-1, 1] of the bumps that no basis holds


def make(kind: str, frames: int, fps: float, names: tuple[str, ...], bumps: int, distance_m: float, seed: int) -> Motion:
    """Trajectory of one clip.

    Args:
        kind: one of KINDS; frames: T; fps: frames a second.
        names: the E action names; those that a kind moves but the model does not have are left out.
        bumps: B; distance_m: mean distance of the head from the camera.

    Raises:
        ValueError: the kind is unknown or there is no frame.
    """
    if kind not in KINDS:
        raise ValueError(f"there is no kind {kind!r} of clip; the kinds are {', '.join(KINDS)}")
    if frames < 1:
        raise ValueError(f"{frames} frames: a clip needs at least one")
    random = np.random.default_rng([seed, 1])
    time = np.arange(frames) / fps
    turn = _turn(kind, time, fps, random)
    expression = _expression(kind, frames, fps, names, random)
    amount = 0.002 if kind == "still" else 0.01
    sway = np.stack([amount * _wave(frames, fps, 1.5, random) for _ in range(3)], 1)
    sway[:, 2] *= 2.0
    gaze = np.stack([RESTING_GAZE_RAD + 0.1 * _saccades(frames, fps, random), 0.2 * _saccades(frames, fps, random)], 1)
    gaze -= 0.3 * turn[:, :2] * (np.abs(turn[:, :2]) < 0.6)  # eyes stay on the camera while the head turns a little
    eyes = np.zeros((frames, 2, 3))
    eyes[:, :, :2] = gaze.clip(-0.4, 0.4)[:, None]
    eyes[:, 0, 1] += 0.03  # both look at a point half a metre away, not at infinity
    eyes[:, 1, 1] -= 0.03
    return Motion(
        expression,
        (1 - NECK_SHARE) * turn,
        NECK_SHARE * turn,
        eyes,
        np.array([0.0, 0.015, distance_m]) + sway,
        np.stack([_wave(frames, fps, 0.8, random) for _ in range(bumps)], 1) if bumps else np.zeros((frames, 0)),
    )


def _turn(kind: str, time: np.ndarray, fps: float, random: np.random.Generator) -> np.ndarray:
    """Whole turn of the head [T, 3] rad: pitch, yaw, roll as one axis-angle vector."""
    frames = len(time)
    wave = np.stack([_wave(frames, fps, seconds, random) for seconds in (1.3, 1.0, 1.6)], 1)
    swing = lambda amplitude, period: amplitude * np.sin(2 * np.pi * time / period)  # noqa: E731
    if kind == "still":
        return np.radians([0.3, 0.4, 0.2]) * wave
    if kind == "fast":
        turn = np.radians([4.0, 0.0, 3.0]) * wave
        turn[:, 1] = swing(FAST_RAD, 1 / FAST_HZ)
        return turn
    if kind == "profile":
        turn = np.radians([4.0, 0.0, 2.0]) * wave
        turn[:, 1] = swing(PROFILE_RAD, max(time[-1], 1 / fps))  # one full sweep, to both sides
        return turn
    if kind == "jump":
        turn = np.radians([5.0, 6.0, 3.0]) * wave
        turn[:, 1] += JUMP_RAD * ((np.arange(frames) >= frames // 2) - 0.5)
        return turn
    amplitude = {"slow": (10.0, 25.0, 6.0), "blink": (3.0, 6.0, 2.0), "talk": (6.0, 12.0, 4.0)}[kind]
    turn = np.radians(amplitude) * wave
    if kind == "slow":
        turn[:, 1] = swing(np.radians(amplitude[1]), 3.0) + 0.15 * turn[:, 1]
    return turn


def _expression(kind: str, frames: int, fps: float, names: tuple[str, ...], random: np.random.Generator) -> np.ndarray:
    """Facial actions [T, E] in [0, 1]."""
    expression = np.zeros((frames, len(names)))

    def add(name: str, values: np.ndarray) -> None:
        if name in names:
            expression[:, names.index(name)] += values

    for group, most, seconds in GESTURES:
        together = _wave(frames, fps, seconds, random)
        for name in group:  # left and right differ a little, as in faces
            alone = 0.85 * together + 0.3 * _wave(frames, fps, seconds, random)
            add(name, LIVELINESS[kind] * most * alone.clip(0, 1))
    if kind == "talk":
        _talk(add, frames, fps, random)
    closed = blinks(kind, frames, fps, random)
    for side in ("Left", "Right"):
        add("eyeBlink" + side, closed)
        if "eyeSquint" + side in names:
            expression[:, names.index("eyeSquint" + side)] *= 1 - closed
    return expression.clip(0, 1)


def exaggerated(expression: np.ndarray, names: Sequence[str], factor: float) -> np.ndarray:
    """Expression [T, E] times `factor`, but for blinks: lids that meet cannot close any further."""
    return expression * np.where(np.isin(names, LIDS), 1.0, factor).astype(expression.dtype)


def blinks(kind: str, frames: int, fps: float, random: np.random.Generator) -> np.ndarray:
    """Closing of the lids [T] in [0, 1]: now and then, or as a train of blinks 4 frames closed for the kind `blink`."""
    closed = np.zeros(frames)
    profile = np.array([0.5, *[1.0] * BLINK_CLOSED_FRAMES, 0.6, 0.2]) if kind == "blink" else np.array([0.6, 1.0, 1.0, 0.6, 0.2])
    start = 8 if kind == "blink" else int(random.uniform(1.0, 2.5) * fps)
    while start < frames:
        part = profile[: frames - start]
        closed[start : start + len(part)] = np.maximum(closed[start : start + len(part)], part)
        start += int(random.uniform(0.6, 0.9) * fps) if kind == "blink" else int(random.uniform(2.0, 4.5) * fps)
    return closed


def _talk(add: object, frames: int, fps: float, random: np.random.Generator) -> None:
    """Visemes that follow each other, blended over about a tenth of a second."""
    chosen = np.zeros((frames, len(VISEMES)))
    start = 0
    while start < frames:
        length = max(1, int(random.uniform(0.16, 0.3) * fps))
        chosen[start : start + length, random.integers(len(VISEMES))] = random.uniform(0.7, 1.0)
        start += length
    chosen = gaussian_filter1d(chosen, 0.05 * fps, axis=0, mode="nearest")
    for column, viseme in enumerate(VISEMES):
        for name, weight in viseme:
            add(name, weight * chosen[:, column])


def _wave(frames: int, fps: float, seconds: float, random: np.random.Generator) -> np.ndarray:
    """Smooth random curve [T] of about unit size that changes over `seconds`; bounded by tanh."""
    pad = int(4 * seconds * fps) + 1  # so that the start is no different from the middle
    curve = gaussian_filter1d(random.normal(size=frames + 2 * pad), 0.4 * seconds * fps)
    return np.tanh(curve / (curve.std() + 1e-12))[pad : pad + frames]


def _saccades(frames: int, fps: float, random: np.random.Generator) -> np.ndarray:
    """Gaze [T] of about unit size: held for half a second to a second and a half, then moved within a frame or two."""
    curve = np.zeros(frames)
    start = 0
    while start < frames:
        length = int(random.uniform(0.5, 1.5) * fps) + 1
        curve[start : start + length] = random.uniform(-1, 1)
        start += length
    return gaussian_filter1d(curve, 0.7, mode="nearest")
