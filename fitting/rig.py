"""The head model as the fit uses it: float64 numpy, a few hundred surface points at a time, with analytic derivatives.

Whatever the fit compares with the video (landmarks, photometric samples, points of the contour) is a set of points on the mesh,
so one small linear model serves all of them.  The neck stays straight here (see `fitting.fit_report` for the reason).

Letters: P points, S shape, E expression coefficients, M residual rows, d unknowns of one frame.  Unknowns, in this order:
    rotation (3, left-multiplicative: R <- exp(w) R), translation (3, m), expression (E), gaze (4: left pitch, left yaw, right
    pitch, right yaw, rad), jaw (3, axis-angle, rad; held where the model's jaw joint moves nothing).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from fitting import camera
from fitting.head_model import HeadModel

POSE, GAZE, JAW = 6, 4, 3
JOINTED = (2, 3, 4)  # jaw, left eye, right eye: rows of HeadModel.joints that the fit turns


@dataclass(frozen=True)
class Pose:
    """Unknowns of one frame."""

    rotation: np.ndarray  # [3, 3]
    translation: np.ndarray  # [3] m
    expression: np.ndarray  # [E]
    gaze: np.ndarray  # [4] rad
    jaw: np.ndarray  # [3] rad

    def moved(self, step: np.ndarray) -> Pose:
        """After a step [d]."""
        count = len(self.expression)
        return Pose(
            camera.exp_rotation(step[:3]) @ self.rotation,
            self.translation + step[3:POSE],
            self.expression + step[POSE : POSE + count],
            self.gaze + step[POSE + count : POSE + count + GAZE],
            self.jaw + step[POSE + count + GAZE :],
        )

    @property
    def vectors(self) -> np.ndarray:
        """Axis-angle vectors [3, 3] of jaw, left eye and right eye; an eye does not roll."""
        return np.array([self.jaw, [*self.gaze[:2], 0.0], [*self.gaze[2:], 0.0]])


@dataclass(frozen=True)
class Surface:
    """Fixed points on the mesh; `folded` chooses the identity."""

    base: np.ndarray  # [P, 3] m, head frame
    shape_basis: np.ndarray  # [P, 3, S] m
    expression_basis: np.ndarray  # [P, 3, E] m
    normal: np.ndarray  # [P, 3] outward, of the template
    skin: np.ndarray  # [P, 3] weights on jaw, left eye, right eye; the rest moves with the head
    pose_basis: np.ndarray  # [P, 3, 27 or 0] correctives of jaw, left eye, right eye
    joints: np.ndarray  # [3, 3] jaw, left eye, right eye
    joint_shape_basis: np.ndarray  # [3, 3, S]
    joint_expression_basis: np.ndarray  # [3, 3, E]
    view_basis: np.ndarray | None = None  # [P, 3, 2] m, points that slide with the view direction (detected landmarks)

    def folded(self, shape: np.ndarray, bias: np.ndarray | float = 0.0) -> Surface:
        """The same points of one identity [S], moved by a constant bias [P, 3] m."""
        return replace(
            self, base=self.base + self.shape_basis @ shape + bias, joints=self.joints + self.joint_shape_basis @ shape
        )


@dataclass(frozen=True)
class Posed:
    """A folded surface in one pose."""

    surface: Surface
    pose: Pose
    head: np.ndarray  # [P, 3] m, head frame
    points: np.ndarray  # [P, 3] m, camera axes
    moving: np.ndarray  # rows of points that hang from a joint
    blend: np.ndarray  # [len(moving), 3, 3] derivative of a moving head point with respect to its rest place
    arms: np.ndarray  # [3, len(moving), 3] weighted arms about jaw, left eye, right eye, after turning


class Rig:
    """All vertices in float64; makes surfaces."""

    def __init__(self, head: HeadModel) -> None:
        as_array = lambda tensor: tensor.cpu().numpy().astype(np.float64)  # noqa: E731
        self.template = as_array(head.template)  # [V, 3]
        self.shape_basis = np.ascontiguousarray(np.moveaxis(as_array(head.shape_basis), 0, -1))  # [V, 3, S]
        self.expression_basis = np.ascontiguousarray(np.moveaxis(as_array(head.expression_basis), 0, -1))  # [V, 3, E]
        self.skin = as_array(head.skinning_weights)[:, list(JOINTED)]
        pose_basis = as_array(head.pose_basis)[9:]  # the neck's nine stay zero
        self.pose_basis = (
            np.ascontiguousarray(np.moveaxis(pose_basis, 0, -1)) if len(pose_basis) else np.zeros((*self.template.shape, 0))
        )
        self.joints = as_array(head.joints)[list(JOINTED)]
        self.joint_shape_basis = np.moveaxis(as_array(head.joint_shape_basis)[:, list(JOINTED)], 0, -1)
        self.joint_expression_basis = np.moveaxis(as_array(head.joint_expression_basis)[:, list(JOINTED)], 0, -1)
        self.triangles = head.triangles.cpu().numpy()
        self.region = head.region.cpu().numpy()
        self.low = as_array(head.expression_low)
        self.high = as_array(head.expression_high)
        self.jaw_moves = bool((self.skin[:, 0] > 0).any())

    def surface(self, triangles: np.ndarray, barycentric: np.ndarray) -> Surface:
        """Points at barycentric places [P, 3] of triangles [P] (numbers)."""
        corners = self.triangles[triangles]

        def mix(values: np.ndarray) -> np.ndarray:
            weights = barycentric.reshape(*barycentric.shape, *[1] * (values.ndim - 1))
            return sum(weights[:, k] * values[corners[:, k]] for k in range(3))

        corner = self.template[corners]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return Surface(
            mix(self.template),
            mix(self.shape_basis),
            mix(self.expression_basis),
            normal / np.where(length > 0, length, 1),
            mix(self.skin),
            mix(self.pose_basis),
            self.joints,
            self.joint_shape_basis,
            self.joint_expression_basis,
        )

    def vertices(self) -> Surface:
        """All vertices as a surface (normals are zero)."""
        return Surface(
            self.template,
            self.shape_basis,
            self.expression_basis,
            np.zeros_like(self.template),
            self.skin,
            self.pose_basis,
            self.joints,
            self.joint_shape_basis,
            self.joint_expression_basis,
        )


def view_direction(pose: Pose) -> np.ndarray:
    """Where the camera stands as seen from the head [2]: across and down of the unit vector in the head frame."""
    return -(pose.rotation.T @ pose.translation)[:2] / np.linalg.norm(pose.translation)


def posed(surface: Surface, pose: Pose) -> Posed:
    """Points of a folded surface in one pose: expression, correctives, skinning about jaw and eyes, then the rigid motion."""
    count = surface.expression_basis.shape[2]
    rest = surface.base + (surface.expression_basis.reshape(-1, count) @ pose.expression).reshape(-1, 3)
    turns = camera.exp_rotation(pose.vectors)
    if surface.pose_basis.shape[2]:
        rest = rest + surface.pose_basis @ (turns - np.eye(3)).ravel()
    moving = np.flatnonzero(surface.skin.any(1))
    joints = surface.joints + surface.joint_expression_basis @ pose.expression
    skin = surface.skin[moving]
    blend = np.eye(3) + np.einsum("pk,kij->pij", skin, turns - np.eye(3))
    turned = np.einsum("kij,kpj->kpi", turns, rest[moving] - joints[:, None])
    head = rest
    if len(moving):
        head = rest.copy()
        head[moving] += np.einsum("pk,kpi->pi", skin, turned + joints[:, None] - rest[moving])
    if surface.view_basis is not None:
        head = head + surface.view_basis @ view_direction(pose)
    return Posed(surface, pose, head, head @ pose.rotation.T + pose.translation, moving, blend, skin.T[..., None] * turned)


@njit(cache=True)
def _fill(covector, at_head, point, arm, basis, out):
    for m in range(len(point)):
        p = point[m]
        gx, gy, gz = covector[m, 0], covector[m, 1], covector[m, 2]
        ax, ay, az = arm[p, 0], arm[p, 1], arm[p, 2]
        out[m, 0] = ay * gz - az * gy
        out[m, 1] = az * gx - ax * gz
        out[m, 2] = ax * gy - ay * gx
        out[m, 3] = gx
        out[m, 4] = gy
        out[m, 5] = gz
        for i in range(3):
            value = at_head[m, i]
            for e in range(basis.shape[2]):
                out[m, 6 + e] += value * basis[p, i, e]


def jacobian(posed_points: Posed, covector: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Derivative [M, d] of residuals with respect to one frame's unknowns.

    Args:
        covector: [M, 3] derivative of each residual with respect to its point in camera axes; point: [M] rows of the surface.

    The small movement of the joints with the expression (statistical models) is left out: it changes a step, not the minimum.
    """
    surface, pose = posed_points.surface, posed_points.pose
    count = surface.expression_basis.shape[2]
    out = np.zeros((len(point), POSE + count + GAZE + JAW))
    local = covector @ pose.rotation  # with respect to the head-frame point
    at_rest = local
    place = np.full(len(surface.base), -1)
    place[posed_points.moving] = np.arange(len(posed_points.moving))
    rows = np.flatnonzero(place[point] >= 0)
    if len(rows):
        at_rest = local.copy()
        at_rest[rows] = np.einsum("mi,mij->mj", local[rows], posed_points.blend[place[point[rows]]])
    arm = posed_points.points - pose.translation
    _fill(np.ascontiguousarray(covector), at_rest, point, arm, surface.expression_basis, out)
    if len(rows):
        _joint_columns(posed_points, local, at_rest, point, rows, place, out)
    if surface.view_basis is not None:
        slid = np.einsum("mi,mik->mk", local, surface.view_basis[point])
        distance = np.linalg.norm(pose.translation)
        axes = pose.rotation[:, :2]
        out[:, :3] += slid @ np.cross(pose.translation, axes.T) / distance
        unit = pose.translation / distance
        out[:, 3:POSE] -= slid @ (axes.T - np.outer(axes.T @ unit, unit)) / distance
    return out


def _joint_columns(
    posed_points: Posed,
    local: np.ndarray,
    at_rest: np.ndarray,
    point: np.ndarray,
    rows: np.ndarray,
    place: np.ndarray,
    out: np.ndarray,
) -> None:
    """Columns of gaze and jaw, for the rows whose points hang from a joint."""
    surface, pose = posed_points.surface, posed_points.pose
    start = POSE + surface.expression_basis.shape[2]
    columns = (
        (0, slice(start + GAZE, start + GAZE + JAW), 3),
        (1, slice(start, start + 2), 2),
        (2, slice(start + 2, start + 4), 2),
    )
    vectors = pose.vectors
    turns, left = camera.exp_rotation(vectors), camera.left_jacobian(vectors)
    for joint, column, axes in columns:
        some = rows[surface.skin[point[rows], joint] != 0]
        arms = posed_points.arms[joint][place[point[some]]]
        about = np.cross(arms, local[some])  # local . (w x arm) = w . (arm x local)
        out[some, column] = (about @ left[joint])[:, :axes]
    if surface.pose_basis.shape[2]:
        for joint, column, axes in columns:
            change = camera.cross_matrix(left[joint].T) @ turns[joint]  # [3 axes, 3, 3]: d R / d angle
            basis = surface.pose_basis[:, :, 9 * joint : 9 * joint + 9]
            some = np.flatnonzero(basis[point].any((1, 2)))
            moved = basis[point[some]] @ change.reshape(3, 9).T  # [m, 3, axes]
            out[some, column] += np.einsum("mi,mia->ma", at_rest[some], moved)[:, :axes]


def shape_columns(posed_points: Posed, unfolded: Surface, covector: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Derivative [M, S] with respect to the identity; unfolded is the surface before `folded`."""
    local = covector @ posed_points.pose.rotation
    basis = unfolded.shape_basis
    out = np.einsum("mi,mis->ms", local, basis[point], optimize=True)
    place = np.full(len(basis), -1)
    place[posed_points.moving] = np.arange(len(posed_points.moving))
    rows = np.flatnonzero(place[point] >= 0)
    if len(rows):
        joints = unfolded.joint_shape_basis  # [3, 3, S]
        turns = camera.exp_rotation(posed_points.pose.vectors)
        skin = unfolded.skin[point[rows]]
        moved = posed_points.blend[place[point[rows]]] @ basis[point[rows]]
        moved = moved + np.einsum("mk,kis->mis", skin, joints - turns @ joints)
        out[rows] = np.einsum("mi,mis->ms", local[rows], moved)
    return out
