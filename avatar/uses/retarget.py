"""One head's motion carried over to another fit of a head: another session's camera, place and rest. Arrays in, arrays out.

Codes of two fits of one person differ where the fits divide the same face differently into identity and expression: what one
takes for identity the other's codes must make good (`same_face`). Measured on nerface.mp4, whose last 150 frames were fitted on
their own and carried over to the whole clip's fit, in rms of the face against that fit's own codes: 0.60 mm so, 0.79 mm for codes
copied as they are, 1.95 mm for codes taken from rest to rest, since no two sessions rest alike. Gaze and turn are copied (0.6
degrees; 4.0 from rest to rest). Places are the driver's about its own middle, in head sizes, about the subject's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from avatar.uses.identity import aligned, vertices_of
from avatar.uses.motion import Motion
from fitting.camera import exp_rotation
from fitting.head_model import HeadModel

Use = Literal["both", "pose", "expression"]
FACING = 0.5  # part of the frames, those that face the camera most, in which a rest is looked for
CALM = 0.1  # part of these, the calmest, that are it
FEWEST = 5
# Quantile of an action over time that counts as not acting. Rests of disjoint thirds of five shared clips differ by 1.0 mm rms of
# the face with it, by 1.3 with the lower quartile, by 2.0 with the median: who talks with raised brows rests without.
FLOOR = 0.05
DOUBT_M2 = 1e-6  # of `same_face`: squared displacement per vertex and unit of code below which a code is left alone
STEEPEST = 2.0  # how much a code may be stretched on its way: noise is stretched with it
BLOCK = 1000  # frames compared with all others at once


@dataclass(frozen=True)
class Rest:
    """Where one fitted head is when it does nothing."""

    frames: tuple[int, ...]  # places in the motion that the resting face is the median of
    expression: np.ndarray  # [E] of the resting face
    jaw: np.ndarray  # [3] rad
    eyes: np.ndarray  # [2, 3] rad, median over all frames
    centre_m: np.ndarray  # [3] middle of the face in camera axes, median over all frames
    rotation: np.ndarray  # [3] of the frame with the most usual turn
    size_m: float  # root mean square radius of the neutral face


def face_centres(head: HeadModel, shape: np.ndarray, motion: Motion) -> np.ndarray:
    """Middle of the neutral face [T, 3] in camera axes, wherever the head is turned to; shape [S]."""
    identity = torch.from_numpy(np.asarray(shape)).to(head.template.dtype)
    names = ("rotation", "neck", "translation", "expression")
    values = [torch.from_numpy(np.asarray(getattr(motion, name))).to(head.template.dtype) for name in names]
    matrix, offset = head.rigid(identity, *values)
    middle = head.shaped(identity)[torch.from_numpy(vertices_of(head))].mean(0)
    return (matrix @ middle + offset).double().numpy()


def face_size_m(head: HeadModel, shape: np.ndarray) -> float:
    """Root mean square radius of the neutral face of one identity [S]."""
    points = head.shaped(torch.from_numpy(np.asarray(shape)).to(head.template.dtype)).double().numpy()[vertices_of(head)]
    return float(np.sqrt(np.mean(((points - points.mean(0)) ** 2).sum(-1))))


def rest_of(head: HeadModel, shape: np.ndarray, motion: Motion) -> Rest:
    """A head's rest over a motion of usable frames; shape [S].

    The resting face is the median code over keyframes: of the half of the frames that face the camera most, for there the codes
    are known best, the calmest tenth. Calm is small displacement of the face's vertices from each action's own floor, a low
    quantile over time: an action only adds, and what never stops is no action but a fit's way to explain this face. Codes of a
    statistical basis go both ways; their floor is the median. Eyes rest nowhere: their rest is the median over all frames.

    Raises ValueError without a frame.
    """
    if not len(motion):
        raise ValueError("there is no usable frame to take a resting face from")
    centres = face_centres(head, shape, motion)
    ahead = exp_rotation(motion.rotation)[:, :, 2]  # the face looks along -z, the camera lies at the origin
    facing = np.einsum("ti,ti->t", ahead, centres) / np.linalg.norm(centres, axis=1)
    seen = np.argsort(-facing, kind="stable")[: max(min(FEWEST, len(motion)), round(FACING * len(motion)))]
    codes = motion.expression[seen]
    bounded = np.isfinite(head.expression_low.numpy()) & np.isfinite(head.expression_high.numpy())
    floor = np.where(bounded, np.quantile(codes, FLOOR, 0), np.median(codes, 0))
    basis = head.expression_basis.numpy()[:, vertices_of(head)].reshape(len(floor), -1).astype(np.float64)
    activity = np.linalg.norm((codes - floor) @ basis, axis=1)
    calm = np.sort(seen[np.argsort(activity, kind="stable")[: max(min(FEWEST, len(seen)), round(CALM * len(seen)))]])
    return Rest(
        tuple(int(frame) for frame in calm),
        np.median(motion.expression[calm], 0),
        np.median(motion.jaw[calm], 0),
        np.median(motion.eyes, 0),
        np.median(centres, 0),
        motion.rotation[_most_usual(motion.rotation)],
        face_size_m(head, shape),
    )


def _most_usual(rotation: np.ndarray) -> int:
    """The frame whose turn [T, 3] is nearest to all others' in the sum."""
    matrices = exp_rotation(rotation).reshape(len(rotation), 9)
    blocks = (matrices[start : start + BLOCK] for start in range(0, len(matrices), BLOCK))
    angles = [np.arccos(np.clip((block @ matrices.T - 1) / 2, -1, 1)).sum(1) for block in blocks]
    return int(np.concatenate(angles).argmin())


def carried(codes: np.ndarray, source: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Codes [T, E] from one rest [E] to another, so that a range's ends stay its ends: a shut eye is shut.

    Above the rest a code goes over as its part of the way to the upper end, below as its part of the way to the lower one; the
    way below is never stretched, that above at most STEEPEST times. Codes without ends are shifted. Equal rests change nothing,
    and codes inside their range stay inside.
    """
    away = codes - source
    with np.errstate(invalid="ignore", divide="ignore"):
        up, down = (high - target) / (high - source), (target - low) / (source - low)
    up = np.where(np.isfinite(up), np.clip(up, 0, STEEPEST), 1.0)
    down = np.where(np.isfinite(down), np.clip(down, 0, 1), 1.0)
    return target + away * np.where(away > 0, up, down)


def same_face(head: HeadModel, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Codes [E] with which the head of shape target [S] has the neutral face of shape source [S], as well as codes can say it.

    Least squares over the face's vertices, place, turn and size left free, small codes preferred (DOUBT_M2). Only of one person:
    another's face would be made of expressions. Zero for equal shapes.
    """
    chosen = vertices_of(head)
    basis, template = (values.numpy().astype(np.float64) for values in (head.shape_basis[:, chosen], head.template[chosen]))
    here, there = (template + np.einsum("s,svd->vd", shape, basis) for shape in (target, source))
    here, there = here - here.mean(0), there - there.mean(0)
    there = aligned(there, here) * np.sqrt((here**2).sum() / (there**2).sum())
    moves = head.expression_basis[:, chosen].numpy().astype(np.float64).reshape(len(head.expression_names), -1)
    free = [here, *np.cross(here, np.eye(3)[:, None]), *np.broadcast_to(np.eye(3)[:, None], (3, *here.shape))]
    columns = np.concatenate([moves, np.stack(free).reshape(7, -1)]).T
    ridge = np.concatenate([np.full(len(moves), DOUBT_M2 * len(here)), np.full(7, 1e-12)])
    normal = columns.T @ columns + np.diag(ridge)
    return np.linalg.solve(normal, columns.T @ (there - here).ravel())[: len(moves)]


def transferred(
    head: HeadModel,
    shape: np.ndarray,
    motion: Motion,
    source: Rest,
    target: Rest,
    centres_m: np.ndarray,
    use: Use = "both",
    offset: np.ndarray | None = None,
) -> Motion:
    """A driver's motion as the subject would make it.

    shape: [S] the subject's; source, target: rests of the driver and of the subject; centres_m: [T, 3] the driver's
    `face_centres`. use: `pose` keeps the subject's resting face, `expression` the subject's most usual pose.
    offset: [E] of `same_face`, by which the code of the driver's resting face is another in the subject; None: the same.
    """
    count = len(motion)
    if use == "pose":
        rest = {name: np.repeat(getattr(target, name)[None], count, 0) for name in ("expression", "jaw", "eyes")}
        return _placed(head, shape, replace(motion, **rest), places(centres_m, source, target))
    low, high = (limit.numpy().astype(np.float64) for limit in (head.expression_low, head.expression_high))
    if offset is not None and offset.any():
        there = source.expression + offset
        there = np.where(offset > 0, np.minimum(there, np.maximum(high, source.expression)), there)
        there = np.where(offset < 0, np.maximum(there, np.minimum(low, source.expression)), there)
        motion = replace(motion, expression=carried(motion.expression, source.expression, there, low, high))
    if use == "expression":
        still = np.repeat(target.rotation[None], count, 0)
        motion = replace(motion, rotation=still, neck=np.zeros_like(still))
        return _placed(head, shape, motion, np.repeat(target.centre_m[None], count, 0))
    return _placed(head, shape, motion, places(centres_m, source, target))


def places(centres_m: np.ndarray, source: Rest, target: Rest) -> np.ndarray:
    """Where the subject's face is [T, 3] m when the driver's is at centres_m [T, 3].

    Sideways and up and down by as many face sizes as the driver: x' = x_s + (s_s / s_d) (x - x_d), y alike. To the front by the
    same ratio: z' = z_s z / z_d, so that the face grows in the picture as the driver's does, whatever focal length the driver's
    fit took (an error of it stretches all of z alike). Index s is the subject's rest, d the driver's; equal rests change nothing.
    """
    scale = target.size_m / source.size_m
    across = target.centre_m[:2] + scale * (centres_m[:, :2] - source.centre_m[:2])
    return np.concatenate([across, target.centre_m[2] * centres_m[:, 2:] / source.centre_m[2]], 1)


def _placed(head: HeadModel, shape: np.ndarray, motion: Motion, centres_m: np.ndarray) -> Motion:
    """The motion translated so that the face's middle goes through centres_m [T, 3]."""
    at_origin = face_centres(head, shape, replace(motion, translation=np.zeros_like(motion.translation)))
    return replace(motion, translation=centres_m - at_origin)


def bridged(motion: Motion, usable: Sequence[bool] | np.ndarray) -> Motion:
    """Every frame that is not usable takes the pose of the nearest one that is: what is smoothed afterwards reads no lost face.

    Raises ValueError where none is.
    """
    good = np.flatnonzero(usable)
    if not len(good):
        raise ValueError("none of the frames is usable")
    nearest = good[np.searchsorted((good[1:] + good[:-1]) / 2, np.arange(len(motion)))]  # of two equally near ones the earlier
    return motion.take(nearest.tolist())
