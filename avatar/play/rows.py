"""One frame's parameters, and how they are put together: rest, turn, place. Arrays in, arrays out.

A row is one frame of fit/track.npz: rotations are axis-angle in rad and turn about the root joint, places are metres in camera
axes (x right, y down, z forward).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from avatar.uses import retarget
from avatar.uses.identity import vertices_of
from avatar.uses.motion import PARTS, Motion
from fitting.camera import exp_rotation, log_rotation
from fitting.head_model import REGIONS, HeadModel


class Row(NamedTuple):
    """Parameters of one frame."""

    expression: np.ndarray  # [E]
    rotation: np.ndarray  # [3] axis-angle, rad
    neck: np.ndarray  # [3]
    jaw: np.ndarray  # [3]
    eyes: np.ndarray  # [2, 3] left, right
    translation: np.ndarray  # [3] m


def of_motion(motion: Motion, place: int) -> Row:
    """One frame of a motion."""
    return Row(**{name: getattr(motion, name)[place] for name in PARTS})


def as_motion(row: Row, fps: float = 1.0) -> Motion:
    """A motion of one frame; ValueError where it is not finite."""
    return Motion(**{name: np.asarray(getattr(row, name), np.float64)[None] for name in PARTS}, fps=fps)


@dataclass(frozen=True)
class Body:
    """Where two points of one identity's head go: the middle of the face, and the middle of the skull about which it turns."""

    face_m: np.ndarray  # [3] of the neutral head, head frame
    skull_m: np.ndarray  # [3]
    root_m: np.ndarray  # [3] root joint
    root_basis: np.ndarray  # [E, 3] m, how expressions move it

    @staticmethod
    def of(head: HeadModel, shape: np.ndarray) -> Body:
        """The points of one identity; shape: [S]."""
        identity = torch.from_numpy(np.asarray(shape)).to(head.template.dtype)
        points = head.shaped(identity).double().numpy()
        region = head.region.numpy()
        box = points[np.isin(region, [REGIONS.index("face"), REGIONS.index("scalp")])]
        box = box if len(box) else points
        basis = head.joint_expression_basis.double().numpy()[:, 0]
        root = head.joints_of(identity).double().numpy()[0]
        return Body(points[vertices_of(head)].mean(0), (box.min(0) + box.max(0)) / 2, root, basis)

    def _at(self, point_m: np.ndarray, row: Row) -> np.ndarray:
        root = self.root_m + row.expression @ self.root_basis
        return exp_rotation(np.asarray(row.rotation, np.float64)) @ (point_m - root) + root + row.translation

    def face_centre(self, row: Row) -> np.ndarray:
        """Middle of the face [3] in camera axes, the neck straight (`retarget.face_centres` of one frame)."""
        return self._at(self.face_m, row)

    def placed(self, row: Row, centre_m: np.ndarray) -> Row:
        """The row with the middle of its face at centre_m [3]."""
        return row._replace(translation=row.translation + (centre_m - self.face_centre(row)))

    def turned(self, row: Row, turn: np.ndarray) -> Row:
        """The row turned by a matrix [3, 3] in camera axes about the middle of the skull."""
        root, pivot = self.root_m + row.expression @ self.root_basis, self._at(self.skull_m, row)
        rotation = log_rotation(turn @ exp_rotation(np.asarray(row.rotation, np.float64)))
        return row._replace(rotation=rotation, translation=turn @ (root + row.translation - pivot) + pivot - root)


def rest_row(head: HeadModel, shape: np.ndarray, motion: Motion) -> tuple[Row, retarget.Rest]:
    """The head held straight with its resting face, where it usually is, and the rest it comes from.

    motion: usable frames, those of the training part. Raises ValueError without a frame.
    """
    rest, zero = retarget.rest_of(head, shape, motion), np.zeros(3)
    row = Row(rest.expression, zero, zero, rest.jaw, rest.eyes, np.zeros(3))
    return Body.of(head, shape).placed(row, rest.centre_m), rest
