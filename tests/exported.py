"""A head model with everything FLAME has, a track of it, and what is exported of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import torch
from toy_head import toy_head, toy_track

from fitting import export_nha, export_pose, export_vhap, verify_export
from fitting.camera import project
from fitting.head_model import HeadModel

FRAMES, SIZE = 9, (60, 48)


def flame_like(name: str = "flame") -> HeadModel:
    """The toy head with everything FLAME has: correctives, joints moved by shape and expression, eyes, an eyelid coefficient."""
    head = toy_head(rows=8, columns=12, shapes=4, expressions=5)
    random = torch.Generator().manual_seed(3)
    noise = lambda *shape: torch.randn(*shape, generator=random)  # noqa: E731
    weights = head.skinning_weights.clone()
    weights[:, 0] = 0.2 * (head.template[:, 1] > 0.05)
    weights[5:9], weights[9:13] = torch.eye(5)[3], torch.eye(5)[4]
    weights[:, 1] -= weights.sum(1) - 1
    joint_expression = 0.002 * noise(5, 5, 3)
    joint_expression[4] *= 0.2  # an eyelid's, of which the exported file must know nothing
    values = {item.name: getattr(head, item.name) for item in fields(HeadModel) if item.name != "joint_expression_basis"}
    basis = head.expression_basis.clone()
    basis[4] = basis[0].roll(1, 0)  # an eyelid
    values |= {
        "expression_basis": basis,
        "expression_names": ("e0", "e1", "e2", "e3", "eyelid_left"),
        "pose_basis": 0.004 * noise(36, head.vertex_count, 3),
        "joint_shape_basis": 0.002 * noise(4, 5, 3),
        "joint_expression_basis": joint_expression,
        "skinning_weights": weights,
        "name": name,
        "version": "2020",
    }
    double = {
        key: value.double() if torch.is_tensor(value) and value.is_floating_point() else value for key, value in values.items()
    }
    return HeadModel(**double)


def moving(head: HeadModel) -> dict[str, np.ndarray]:
    """A track that every joint and coefficient takes part in, inside the limits of the formats; an off-centre camera."""
    track, random = toy_track(head, FRAMES, 64, seed=4), np.random.default_rng(6)
    bounds = np.array([0.3, 0.5, 0.2])
    track["rotation"] = random.uniform(-1, 1, (FRAMES, 3)) * bounds
    track["neck"] = random.uniform(-1, 1, (FRAMES, 3)) * 0.3
    track["jaw"][:, 0] = random.uniform(0, 0.4, FRAMES)
    track["jaw"][:, 1:] = 0
    track["eyes"] = random.uniform(-1, 1, (FRAMES, 2, 3)) * [0.4, 0.5, 0.001]
    track["expression"][:, 4] = 0  # the eyelid
    track["centre_px"] = np.array([20.3, 37.1])
    track["usable"] = np.arange(FRAMES) != 2
    track = {name: value.astype(np.float32) if value.dtype.kind == "f" else value for name, value in track.items()}
    track["focal_px"] = np.float32(151.7)
    return track


def nha_file(head: HeadModel, track: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return export_nha.arrays(export_pose.of_track(head, track), float(track["focal_px"]), track["centre_px"], SIZE)


def vhap_file(head: HeadModel, track: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    canvas = export_vhap.Canvas.around(SIZE, track["centre_px"])
    pose = export_pose.of_track(head, track)
    return export_vhap.arrays(pose, float(track["focal_px"]), canvas, list(range(FRAMES)))


def difference(reader: Callable, file: dict, head: HeadModel, track: dict, centre_px: np.ndarray) -> verify_export.Difference:
    """What `reader` sees in a file against the project's own vertices and pixels."""
    found = verify_export.Difference()
    rows = np.arange(FRAMES)
    vertices = export_pose.vertices(head, track, rows)
    found.add(reader(file, verify_export.Flame.of(head), rows), vertices, project(vertices, float(track["focal_px"]), centre_px))
    return found


def nha_difference(file: dict, head: HeadModel, track: dict) -> verify_export.Difference:
    return difference(verify_export.nha, file, head, track, track["centre_px"])


def vhap_difference(file: dict, head: HeadModel, track: dict) -> verify_export.Difference:
    centre = export_vhap.Canvas.around(SIZE, track["centre_px"]).centre_px(track["centre_px"])
    return difference(verify_export.vhap, file, head, track, centre)
