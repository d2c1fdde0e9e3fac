"""Distances between fitted heads, the limit that tells people apart, and the calibration's steps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from toy_head import toy_head
from toy_run import job

from avatar.uses import identity, identity_calibration, identity_parts
from avatar.uses.config import IdentityCalibrationConfig
from fitting.tracking import Clip
from workflow.step import StepError

HEAD = toy_head()
ROWS = {
    "ann": [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]],
    "bob": [[1.0, 0.2], [1.1, 0.2], [1.0, 0.3]],
    "cho": [[-0.2, 1.4], [-0.3, 1.4], [-0.2, 1.5]],
}


def test_distances_are_zero_for_equal_shapes_and_alike_both_ways() -> None:
    here, there = np.array([0.5, -1.0]), np.array([-0.3, 0.4])
    for distance in identity.DISTANCES.values():
        assert distance(HEAD, here, here) == pytest.approx(0, abs=1e-9)
        assert distance(HEAD, here, there) == pytest.approx(distance(HEAD, there, here), rel=0.05)
        assert distance(HEAD, here, there) > 0.01
    assert identity.code_distance(HEAD, here, there) == pytest.approx(np.sqrt((0.8**2 + 1.4**2) / 2))


def test_size_place_and_turn_are_no_difference_of_a_surface() -> None:
    """A basis whose two codes make the head larger and move it: another code, the same face."""
    basis = torch.stack([0.2 * HEAD.template, torch.full_like(HEAD.template, 0.01)])
    scaled = replace(HEAD, shape_basis=basis)
    assert identity.face_distance(scaled, np.zeros(2), np.array([1.0, 1.0])) == pytest.approx(0, abs=1e-4)
    assert identity.code_distance(scaled, np.zeros(2), np.array([1.0, 1.0])) == pytest.approx(1)


def test_the_surface_distance_is_in_millimetres() -> None:
    """One vertex in N pulled out by d moves the root mean square by d / sqrt(N), alignment aside."""
    pulled = torch.zeros(1, HEAD.vertex_count, 3)
    vertex = int(np.flatnonzero(identity.vertices_of(HEAD))[40])
    pulled[0, vertex, 2] = 0.001
    found = identity.face_distance(replace(HEAD, shape_basis=pulled), np.zeros(1), np.ones(1))
    assert found == pytest.approx(1 / np.sqrt(identity.vertices_of(HEAD).sum()), rel=0.05)


def test_alignment_against_scipy_and_never_a_mirror() -> None:
    random = np.random.default_rng(0)
    target = random.normal(size=(30, 3))
    points = target @ Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix() + random.normal(0, 0.01, (30, 3))
    expected = Rotation.align_vectors(target, points)[0].apply(points)
    np.testing.assert_allclose(identity.aligned(points, target), expected, atol=1e-9)
    mirrored = target * (-1, 1, 1)
    turned = identity.aligned(mirrored, target)
    assert np.linalg.det(np.linalg.lstsq(mirrored, turned, rcond=None)[0]) == pytest.approx(1)


def people() -> list[list[np.ndarray]]:
    return [[np.array(shape) for shape in parts] for parts in ROWS.values()]


def test_all_pairs_are_compared() -> None:
    found = identity.separation(HEAD, people(), identity.code_distance)
    assert len(found.same) == 9 and len(found.different) == 27
    assert found.area == 1 and found.gap > 1
    assert found.same.max() < found.threshold < found.different.min()
    assert found.refused(found.threshold) == found.missed(found.threshold) == 0
    for few in ([people()[0]], [[part] for part in people()[0]], []):
        with pytest.raises(ValueError, match="at least two clips"):
            identity.separation(HEAD, few, identity.code_distance)


def test_one_part_that_lies_off_does_not_let_other_people_through() -> None:
    found = identity.Separation(np.array([0.1, 0.1, 0.2, 0.9]), np.array([0.4, 0.5, 0.5, 0.9, 1.0]))
    assert found.threshold == pytest.approx(np.sqrt(0.2 * 0.4))
    assert found.refused(found.threshold) == 0.25 and found.missed(found.threshold) == 0
    slow = np.mean([(b > a) + 0.5 * (b == a) for a in found.same for b in found.different])
    assert found.area == pytest.approx(slow)


@pytest.mark.parametrize("distance, word", [(0.0, "same"), (0.79, "same"), (0.8, "doubtful"), (0.99, "doubtful"), (1.0, "other")])
def test_verdicts(distance: float, word: str) -> None:
    assert identity.Verdict(distance, 1.0).word == word


def test_the_verdict_of_two_shapes() -> None:
    found = identity.verdict(HEAD, np.zeros(2), np.full(2, 0.5))
    assert found.word == "other" and found.refused_from == identity.REFUSED_FROM
    assert identity.verdict(HEAD, np.zeros(2), np.full(2, 0.5), limit=0.55).word == "doubtful"
    with pytest.raises(ValueError, match="cannot be compared"):
        identity.verdict(HEAD, np.zeros(2), np.zeros(3))


def test_a_part_of_a_clip_holds_its_own_frames_only() -> None:
    from fitting.observed import Observed

    frames = 30
    seen = Observed(
        np.arange(frames)[:, None, None] + np.zeros((frames, 4, 2)), np.arange(frames) != 12, np.arange(frames) + 1.0,
        np.zeros((frames, 3)), np.ones((frames, 4), bool), np.ones((frames, 2)), np.array([8.0, 8.0]),
    )  # fmt: skip
    pixels = np.arange(frames)[:, None, None, None] + np.zeros((frames, 4, 4, 3), np.uint8)
    clip = Clip(None, None, seen, pixels, pixels[..., 0], np.arange(frames) / 25, np.arange(20), np.arange(20, 30), 5.0)
    part = identity_parts.part_of(clip, np.arange(10, 20))
    assert part.train.tolist() == [0, 1, 2, 3, 4, 5] and part.test.tolist() == [6, 7, 8, 9]
    assert part.observed.points[:, 0, 0].tolist() == part.frames[:, 0, 0, 0].tolist() == list(range(10, 20))
    assert part.observed.found.tolist() == [True, True, False] + 7 * [True]
    assert part.time_s[0] == pytest.approx(0.4) and part.alpha.shape == (10, 4, 4)


@pytest.fixture
def inputs(tmp_path: Path) -> dict[str, Path | list[Path]]:
    HEAD.save(tmp_path / "head.npz")
    rows = []
    for name, shapes in ROWS.items():
        rows.append(tmp_path / f"{name}.json")
        parts = [{"frames": [0, 9], "usable": 10, "focal_px": 600.0, "shape": shape} for shape in shapes]
        row = {"subject": name, "head_digest": HEAD.digest, "parts": parts, "left_out": []}
        rows[-1].write_text(json.dumps(row))
    return {"head": tmp_path / "head.npz", "rows": rows}


def calibrate(folder: Path, inputs: dict[str, Path | list[Path]]) -> SimpleNamespace:
    outputs = {"report": folder / "identity.json", "markdown": folder / "identity.md", "plot": folder / "identity.svg"}
    identity_calibration.run(job(IdentityCalibrationConfig(), inputs, outputs))
    return SimpleNamespace(**outputs)


def test_the_calibration(tmp_path: Path, inputs: dict[str, Path | list[Path]]) -> None:
    outputs = calibrate(tmp_path, inputs)
    report = json.loads(outputs.report.read_text())
    assert report["parts"] == {"ann": 3, "bob": 3, "cho": 3} and report["used"] == identity.CHOSEN
    codes = report["distances"]["codes"]
    assert (codes["pairs_of_one_person"], codes["pairs_of_two_people"], codes["area_under_roc"]) == (9, 27, 1.0)
    assert codes["one_person"] == sorted(codes["one_person"]) and len(codes["two_people"]) == 27
    text = outputs.markdown.read_text()
    assert "| 0 of 9 | 0 of 27 |" in text and "ann (3), bob (3), cho (3)" in text and "two sessions lie further apart" in text
    assert outputs.plot.read_text().startswith("<?xml") and "NaN" not in outputs.plot.read_text()


def test_rows_that_do_not_belong_together(tmp_path: Path, inputs: dict[str, Path | list[Path]]) -> None:
    with pytest.raises(StepError, match="at least two clips are needed; put more videos"):
        calibrate(tmp_path, inputs | {"rows": inputs["rows"][:1]})
    row = json.loads(inputs["rows"][0].read_text()) | {"head_digest": "other"}
    inputs["rows"][0].write_text(json.dumps(row))
    with pytest.raises(StepError, match="belongs to head model other"):
        calibrate(tmp_path, inputs)
