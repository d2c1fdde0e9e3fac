"""What the programs that read the exported files will see: FLAME posed from the files alone, in plain numpy.

Written from the readers' side and sharing no conversion with what writes the files, so that a wrong axis, sign, limit or
centring on either side shows as millimetres.  Every reader returns vertices in the project's camera axes (OpenCV) and pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fitting.head_model import HeadModel

PARENTS = (-1, 0, 1, 1, 1)
NHA_LOWEST_DEG = {"neck_pose": (-90, -60, -80), "jaw_pose": (-5, -0.1, -0.1), "eyes_pose": (-50, -50, -0.1)}
NHA_HIGHEST_DEG = {"neck_pose": (90, 60, 80), "jaw_pose": (60, 0.1, 0.1), "eyes_pose": (50, 50, 0.1)}

Seen = tuple[np.ndarray, np.ndarray]
"""Vertices [n, V, 3] m in OpenCV camera axes, pixels [n, V, 2]."""


@dataclass(frozen=True)
class Flame:
    """FLAME as its file holds it: joints in its order, axes x left of the subject, y up, z towards the viewer."""

    template: np.ndarray  # [V, 3] m
    shape_basis: np.ndarray  # [S, V, 3]
    expression_basis: np.ndarray  # [E, V, 3], eyelids left out
    pose_basis: np.ndarray  # [36, V, 3]
    joints: np.ndarray  # [5, 3] m
    joint_shape_basis: np.ndarray  # [S, 5, 3]
    joint_expression_basis: np.ndarray  # [E, 5, 3]
    weights: np.ndarray  # [V, 5]

    @staticmethod
    def of(head: HeadModel) -> Flame:
        """The arrays of a baked head model in FLAME's own axes."""
        plain = [e for e, name in enumerate(head.expression_names) if not name.startswith("eyelid")]
        signs = np.array([1.0, -1.0, -1.0])
        array = lambda tensor: np.asarray(tensor, np.float64)  # noqa: E731
        file = np.argsort(array(head.source_joints))  # the baked joint that is the file's joint 0, 1, ...
        correctives = array(head.pose_basis).reshape(4, 9, -1, 3)[file[1:] - 1].reshape(36, -1, 3)
        # A corrective belongs to an entry of R - I; entry (i, j) changes sign with axes i and j.
        entry = np.tile(np.outer(signs, signs).reshape(9), 4)[:, None, None]
        return Flame(
            template=array(head.template) * signs,
            shape_basis=array(head.shape_basis) * signs,
            expression_basis=array(head.expression_basis)[plain] * signs,
            pose_basis=correctives * signs * entry,
            joints=array(head.joints)[file] * signs,
            joint_shape_basis=array(head.joint_shape_basis)[:, file] * signs,
            joint_expression_basis=array(head.joint_expression_basis)[plain][:, file] * signs,
            weights=array(head.skinning_weights)[:, file],
        )

    def posed(self, shape: np.ndarray, expression: np.ndarray, pose: np.ndarray) -> Seen:
        """Linear blend skinning by 4x4 transforms down the chain of joints.

        Args:
            shape: [300] as in the file.
            expression: [n, 100].
            pose: [n, 5, 3] rad, axis-angle of root, neck, jaw and both eyes.

        Returns:
            vertices [n, V, 3] m and joints [n, 5, 3] m before posing.

        Raises:
            ValueError: the file uses coefficients that this model does not have.
        """
        shapes, expressions = len(self.shape_basis), len(self.expression_basis)
        if np.any(shape[shapes:]) or np.any(expression[:, expressions:]):
            raise ValueError(f"coefficients beyond the model's {shapes} and {expressions} are not zero")
        beta, psi = shape[:shapes].astype(np.float64), expression[:, :expressions].astype(np.float64)
        shaped = self.template + np.tensordot(beta, self.shape_basis, 1) + np.tensordot(psi, self.expression_basis, 1)
        joints = self.joints + np.tensordot(beta, self.joint_shape_basis, 1) + np.tensordot(psi, self.joint_expression_basis, 1)
        rotations = Rotation.from_rotvec(pose.reshape(-1, 3).astype(np.float64)).as_matrix().reshape(-1, 5, 3, 3)
        correctives = (rotations[:, 1:] - np.eye(3)).reshape(-1, 36)
        shaped = shaped + np.tensordot(correctives, self.pose_basis, 1)
        chain = np.zeros((len(pose), 5, 4, 4))
        for joint, parent in enumerate(PARENTS):
            local = np.zeros((len(pose), 4, 4))
            local[:, :3, :3], local[:, 3, 3] = rotations[:, joint], 1
            local[:, :3, 3] = joints[:, joint] - (joints[:, parent] if parent >= 0 else 0)
            chain[:, joint] = local if parent < 0 else chain[:, parent] @ local
        moved = chain.copy()
        moved[..., :3, 3] -= np.einsum("njab,njb->nja", chain[..., :3, :3], joints)
        blended = np.tensordot(moved, self.weights, (1, 1))  # [n, 4, 4, V]
        vertices = np.einsum("nabv,nvb->nva", blended[:, :3, :3], shaped) + np.moveaxis(blended[:, :3, 3], 1, 2)
        return vertices, joints


def nha(file: Mapping[str, np.ndarray], flame: Flame, rows: np.ndarray) -> Seen:
    """What NHA sees in some rows of `tracked_flame_params.npz`: FlameHead with its limits, PyTorch3D's camera."""
    joints = [file["rotation"][rows]]
    for name in NHA_LOWEST_DEG:
        low, high = np.radians(NHA_LOWEST_DEG[name]), np.radians(NHA_HIGHEST_DEG[name])
        raw = file[name][rows].astype(np.float64).reshape(len(rows), -1, 3)
        angles = low + (np.tanh(raw) + 1) / 2 * (high - low)
        joints += list(np.moveaxis(angles, 1, 0))
    vertices, rest = flame.posed(file["shape"], file["expr"][rows], np.stack(joints, 1))
    vertices = vertices - rest[:, :1] + file["translation"][rows][:, None]
    extrinsic = file["RT"].astype(np.float64)
    view = vertices @ extrinsic[:, :3] + extrinsic[:, 3]  # PyTorch3D multiplies rows from the left; x left, y up, z forward
    height, width = (int(side) for side in file["image_size"])
    focal = float(file["K"][0]) * max(height, width)
    point = np.array([float(file["K"][1]) * width, height - float(file["K"][2]) * height])
    return view * [-1, -1, 1], point - focal * view[..., :2] / view[..., 2:]


def vhap(file: Mapping[str, np.ndarray], flame: Flame, rows: np.ndarray) -> Seen:
    """What VHAP sees in some rows of `tracked_flame_params_0.npz`: camera at (0, 0, 1), principal point in the middle."""
    height, width = (int(side) for side in file["image_size"])
    focal = float(file["focal_length"][0]) * max(height, width)
    world_to_camera = np.eye(4)
    world_to_camera[2, 3] = -1
    points = _vhap_vertices(file, flame, rows) + world_to_camera[:3, 3]
    return _opengl(points, focal, np.array([width / 2, height / 2]))


def nerf_folder(params: Mapping[str, np.ndarray], flame: Flame, frame: Mapping[str, Any], centred: bool = False) -> Seen:
    """What the folder's readers see in one frame.

    Args:
        params: content of the frame's `flame_param` file.
        flame: the model.
        frame: the frame's entry in `transforms.json`.
        centred: as GaussianAvatars, which reads the angles of view and takes the middle of the picture as principal point.
    """
    world_to_camera = np.linalg.inv(np.array(frame["transform_matrix"]))
    points = _vhap_vertices(params, flame, np.zeros(1, int)) @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    if not centred:
        return _opengl(points, frame["fl_x"], np.array([frame["cx"], frame["cy"]]))
    focal = frame["w"] / (2 * np.tan(frame["camera_angle_x"] / 2))
    return _opengl(points, focal, np.array([frame["w"], frame["h"]]) / 2)


def _vhap_vertices(file: Mapping[str, np.ndarray], flame: Flame, rows: np.ndarray) -> np.ndarray:
    """World vertices [n, V, 3] m: FLAME as it is plus the translation."""
    parts = [file[name][rows].reshape(len(rows), -1, 3) for name in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")]
    vertices, _ = flame.posed(file["shape"], file["expr"][rows], np.concatenate(parts, 1))
    if file["static_offset"].any():  # its vertices are FLAME's and teeth; ours may have a mouth cavity instead
        raise ValueError("offsets of single vertices are not zero")
    return vertices + file["translation"][rows].astype(np.float64)[:, None]


def _opengl(points: np.ndarray, focal_px: float, centre_px: np.ndarray) -> Seen:
    """Camera-space points in OpenGL's axes (x right, y up, z back) as OpenCV's points and pixels."""
    pixels = focal_px * points[..., :2] * [1, -1] / -points[..., 2:] + centre_px
    return points * [1, -1, -1], pixels


@dataclass
class Difference:
    """The largest difference between what a reader sees and what the project means."""

    vertex_mm: float = 0.0
    pixel_px: float = 0.0
    frames: int = 0

    def add(self, seen: Seen, vertices: np.ndarray, pixels: np.ndarray) -> None:
        """Take in n frames: the project's own vertices [n, V, 3] m and pixels [n, V, 2] of the same rows."""
        self.vertex_mm = _largest(self.vertex_mm, 1000 * np.linalg.norm(seen[0] - vertices, axis=-1))
        self.pixel_px = _largest(self.pixel_px, np.linalg.norm(seen[1] - pixels, axis=-1))
        self.frames += len(vertices)


def _largest(before: float, values: np.ndarray) -> float:
    """NaN stays: a file with a NaN in it is not verified."""
    return float(np.maximum(before, values.max(initial=0.0)))


def chunks(rows: Iterable[int], size: int = 16) -> list[np.ndarray]:
    """Rows in pieces that fit into a processor's cache."""
    every = np.fromiter(rows, int)
    return [every[k : k + size] for k in range(0, len(every), size)]
