"""Exports of a model file whose eye joints come in either order: other programs count joints as the file does."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from fitting import export_nha, export_pose, export_vhap, flame, verify_export
from tests import flame_file

TRACK = {
    "shape": 20,
    "expression": (3, 12),
    "rotation": (3, 3),
    "neck": (3, 3),
    "jaw": (3, 3),
    "eyes": (3, 2, 3),
    "translation": (3, 3),
}


@pytest.mark.parametrize("order", ["left first", "right first"])
def test_exports_count_joints_as_the_file_does(tmp_path: Path, order: str) -> None:
    """The model file's own arrays, posed by the exported codes, give the track's head; swapped eyes do not."""
    arrays = (
        flame_file.checked()
        if order == "left first"
        else flame.read(flame_file.write(tmp_path / "generic_model.pkl", flame_file.other_eye_order()))
    )
    head = flame.bake(arrays, 20, 10)
    assert head.source_joints.tolist() == ([0, 1, 2, 3, 4] if order == "left first" else [0, 1, 2, 4, 3])
    random = np.random.default_rng(7)
    track = {name: 0.2 * random.normal(size=size) for name, size in TRACK.items()}
    track["expression"][:, 10:] = 0  # lids are no part of FLAME
    track["eyes"] *= [1, 1, 0]  # NHA's eyes hardly roll
    track["neck"], track["jaw"] = 0.3 * track["neck"], np.abs(track["jaw"]) * [1, 0, 0]
    mine = export_pose.vertices(head, {name: np.float32(value) for name, value in track.items()}, slice(None))
    raw = verify_export.Flame(
        template=arrays["v_template"],
        shape_basis=arrays["shapedirs"].transpose(2, 0, 1)[:20],
        expression_basis=arrays["shapedirs"].transpose(2, 0, 1)[300:310],
        pose_basis=arrays["posedirs"].transpose(2, 0, 1),
        joints=arrays["J_regressor"] @ arrays["v_template"],
        joint_shape_basis=np.einsum("jv,vds->sjd", arrays["J_regressor"], arrays["shapedirs"][..., :20]),
        joint_expression_basis=np.einsum("jv,vds->sjd", arrays["J_regressor"], arrays["shapedirs"][..., 300:310]),
        weights=arrays["weights"],
    )
    rebuilt = verify_export.Flame.of(head)
    for item in fields(raw):
        np.testing.assert_allclose(getattr(rebuilt, item.name), getattr(raw, item.name), atol=1e-6, err_msg=item.name)
    pose, centre = export_pose.of_track(head, track), np.array([200.0, 200.0])
    for name, value in export_pose.own(head, pose).items():
        np.testing.assert_allclose(value, track[name], atol=1e-12)
    canvas = export_vhap.Canvas.around((400, 400), centre)
    for reader, file in (
        (verify_export.nha, export_nha.arrays(pose, 900.0, centre, (400, 400))),
        (verify_export.vhap, export_vhap.arrays(pose, 900.0, canvas, list(range(3)))),
    ):
        assert np.abs(reader(file, raw, np.arange(3))[0] - mine).max() < 1e-5
        swapped = file | {"eyes_pose": file["eyes_pose"][:, [3, 4, 5, 0, 1, 2]]}
        assert np.abs(reader(swapped, raw, np.arange(3))[0] - mine).max() > 1e-4
