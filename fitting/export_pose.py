"""A track in FLAME's own terms: what the export formats share.  Numpy float64.

The model file's axes are x to the subject's left, y up, z towards the viewer of a frontal face; a head baked from it has the
project's axes (y down, z forward) about the same origin (`fitting.flame`).  The half turn about x between them turns axis-angle
vectors like points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fitting.head_model import HeadModel

FLIP = np.diag([1.0, -1.0, -1.0])  # the project's axes <-> FLAME's, which are OpenGL's as well
SHAPES, EXPRESSIONS = 300, 100  # coefficients that every FLAME program reads
POSES = ("expression", "rotation", "neck", "jaw", "eyes", "translation")  # one row a frame in a track


@dataclass(frozen=True)
class FlamePose:
    """What a FLAME program needs of a track; T frames."""

    shape: np.ndarray  # [300] standard deviations, zero beyond the fitted ones
    expression: np.ndarray  # [T, 100], eyelid coefficients dropped, zero beyond the fitted ones
    neck: np.ndarray  # [T, 3] rad, axis-angle, FLAME's axes
    jaw: np.ndarray  # [T, 3] rad, joint 2 of the model file
    eyes: np.ndarray  # [T, 2, 3] rad, joints 3 and 4 of the model file: the left and the right eye, in most files in this order
    rotation: np.ndarray  # [T, 3, 3] of the head in camera axes (OpenCV), identity when frontal
    offset: np.ndarray  # [T, 3] m: a head point x of a straight neck lies at `rotation x + offset`
    root: np.ndarray  # [T, 3] m, FLAME's root joint in the project's axes: it moves with shape and expression


def eyelids(head: HeadModel) -> np.ndarray:
    """Which expression coefficients [E] bool are the project's own eyelid ones, unknown to FLAME."""
    return np.array([name.startswith("eyelid") for name in head.expression_names], bool)


def refusal(head: HeadModel) -> str | None:
    """Why a head model's codes must not be written as FLAME codes: one sentence, None where they may."""
    if head.name == "anny":
        return (
            "its codes are of another basis than FLAME's and would be a garbled face in a FLAME program; "
            "set head.model: flame (with your own FLAME file) and run snakemake again"
        )
    if len(head.pose_basis) != 36:
        return f"it has {len(head.pose_basis)} pose correctives and FLAME has 36; delete it and run snakemake again"
    if len(head.shape_basis) > SHAPES or (~eyelids(head)).sum() > EXPRESSIONS:
        return f"it has more than FLAME's {SHAPES} shape and {EXPRESSIONS} expression coefficients"
    return None


def without_eyelids(head: HeadModel, track: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The track [as read from track.npz] with eyelid coefficients zero: what FLAME's own basis can say."""
    return dict(track) | {"expression": np.where(eyelids(head), 0.0, track["expression"])}


def vertices(head: HeadModel, track: Mapping[str, np.ndarray], rows: np.ndarray | slice) -> np.ndarray:
    """The project's own posed vertices [n, V, 3] m, camera axes, of some rows of a track."""
    return head.forward(_tensor(head, track["shape"]), *(_tensor(head, track[name][rows]) for name in POSES)).numpy()


def of_track(head: HeadModel, track: Mapping[str, np.ndarray]) -> FlamePose:
    """A track in FLAME's terms.

    Args:
        head: a head model that `refusal` lets pass, best in float64.
        track: arrays of track.npz (design note 3).
    """
    lid = eyelids(head)
    shape, expression = np.asarray(track["shape"], np.float64), np.asarray(track["expression"], np.float64)
    beta, psi = _tensor(head, shape), _tensor(head, np.where(lid, 0.0, expression))
    turn, move = _tensor(head, track["rotation"]), _tensor(head, track["translation"])
    jaw, eyes = _file_order(head, np.asarray(track["jaw"], np.float64), np.asarray(track["eyes"], np.float64))
    rotation, offset = head.rigid(beta, turn, torch.zeros_like(turn), move, psi)
    return FlamePose(
        shape=np.pad(shape, (0, SHAPES - len(shape))),
        expression=np.pad(expression[:, ~lid], ((0, 0), (0, EXPRESSIONS - (~lid).sum()))),
        neck=np.asarray(track["neck"], np.float64) @ FLIP,
        jaw=jaw @ FLIP,
        eyes=eyes @ FLIP,
        rotation=rotation.numpy(),
        offset=offset.numpy(),
        root=head.joints_of(beta, psi)[:, 0].numpy(),
    )


def own(head: HeadModel, pose: FlamePose) -> dict[str, np.ndarray]:
    """The way back: neck, jaw and eyes of a pose in FLAME's terms as a track holds them."""
    joints = np.concatenate([pose.jaw[:, None], pose.eyes], 1)[:, head.source_joints.numpy()[2:] - 2]
    return {"neck": pose.neck @ FLIP, "jaw": joints[:, 0] @ FLIP, "eyes": joints[:, 1:] @ FLIP}


def _file_order(head: HeadModel, jaw: np.ndarray, eyes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations of the model file's joints 2 [T, 3] and 3, 4 [T, 2, 3], which other programs take for jaw and eyes."""
    joints = np.concatenate([jaw[:, None], eyes], 1)[:, np.argsort(head.source_joints.numpy()[2:])]
    return joints[:, 0], joints[:, 1:]


def _tensor(head: HeadModel, values: np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(values), dtype=head.template.dtype)
