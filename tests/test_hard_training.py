"""Hard cases of training: drifting exposure, far past convergence, two frames, odd sizes, wild poses and wrong pixel types."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_head import toy_head, toy_images, toy_track
from toy_run import train_in, write_subject

from avatar import build, learning, render
from avatar.dataset import Scene, on_white
from avatar.learning import rays
from workflow.step import StepError

TINY = {
    "representation": "static",
    "rays": 64,
    "mlp_width": 32,
    "mlp_depth": 2,
    "colour_width": 16,
    "feature_channels": 8,
    "bands": 4,
    "max_samples": 6,
}
SIZE = 40


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_subject(tmp_path_factory.mktemp("subject"), 8, SIZE)


@pytest.fixture(autouse=True)
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rays, "best_precision", lambda device: torch.float32)


def curve_of(outputs: dict[str, Path]) -> np.ndarray:
    """Rows of step, seconds, loss, probe PSNR."""
    return np.loadtxt(outputs["curve"], skiprows=1, ndmin=2)


def report_of(outputs: dict[str, Path]) -> dict:
    return json.loads(outputs["report"].read_text())


def rendered(outputs: dict[str, Path], inputs: dict[str, Path], frame: int, size: tuple[int, int]) -> np.ndarray:
    """One frame [H, W, 3] in [0, 1]."""
    head = toy_head(24, 36)
    avatar = build.restore(torch.load(outputs["avatar"], weights_only=True), head)
    scene = Scene(head, dict(np.load(inputs["track"])), [frame])
    return render.render_frame(avatar, scene, frame, size, torch.float32, "cpu")[0][..., :3] / 255.0


def held_out_error(outputs: dict[str, Path], inputs: dict[str, Path]) -> float:
    """Root mean square over the two test frames of the toy subject as it is without drift."""
    images, alpha = np.load(inputs["frames"]), np.load(inputs["alpha"])
    differences = [rendered(outputs, inputs, frame, (SIZE, SIZE)) - on_white(images[frame], alpha[frame]) for frame in (6, 7)]
    return float(np.sqrt(np.mean(np.square(differences))))


def test_exposure_drift_costs_no_more_than_itself(inputs: dict[str, Path], tmp_path: Path) -> None:
    """Gains from 0.8 to 1.2 over the clip: no skipped step, and on frames of gain 1 half of the drift itself more at most."""
    images, alpha = np.load(inputs["frames"]), np.load(inputs["alpha"])
    gain = np.interp(np.arange(8), [0, 5], [0.8, 1.2])[:, None, None, None]
    drifting = (images * gain).clip(0, 255).round().astype(np.uint8)
    np.save(tmp_path / "frames.npy", drifting)
    plain = train_in(tmp_path / "plain", inputs, steps=200, **(TINY | {"rays": 128}))
    drifted = train_in(tmp_path / "drifted", inputs | {"frames": tmp_path / "frames.npy"}, steps=200, **(TINY | {"rays": 128}))
    assert report_of(drifted)["skipped_steps"] == 0 and np.isfinite(curve_of(drifted)).all()
    drift = np.sqrt(np.mean((on_white(drifting[:6], alpha[:6]) - on_white(images[:6], alpha[:6])) ** 2))
    clean = held_out_error(plain, inputs)
    assert clean < 0.15 and held_out_error(drifted, inputs) < clean + drift / 2


def test_a_tiny_model_far_past_convergence_stays_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """1500 steps, over ten times the other runs here, at a rate that only halves: nothing skipped, and what was learned stays."""
    subject, posed, known = write_subject(tmp_path, 6, 32), rays.Batches.posed, {}

    def kept(self: rays.Batches, frames: list[int], *more: object, **named: object) -> object:
        """The heads of a step, posed once: they are the same four in every step."""
        key = (*frames, *more, *named.items())
        if key not in known:
            known[key] = posed(self, frames, *more, **named)
        return known[key]

    monkeypatch.setattr(rays.Batches, "posed", kept)
    monkeypatch.setattr(learning, "PROBE_STRIDE", 1)  # every 4th of 32 pixels would be a figure of 64 pixels
    monkeypatch.setattr(
        rays.losses, "learning_rate", lambda start, step, steps: start * min(1, (step + 1) / 30) * 0.5 ** (step / steps)
    )
    tiny = {
        "mlp_width": 16,
        "mlp_depth": 1,
        "colour_width": 8,
        "feature_channels": 4,
        "bands": 2,
        "view_bands": 1,
        "max_samples": 4,
    }
    outputs = train_in(tmp_path / "run", subject, steps=1500, frames_per_step=4, **(TINY | tiny))
    curve, weights = curve_of(outputs), torch.load(outputs["avatar"], weights_only=True)["weights"]
    assert report_of(outputs)["skipped_steps"] == 0 and np.isfinite(curve).all() and len(curve) == 10
    assert curve[-1, 2] < curve[0, 2] and curve[-1, 3] > curve[:, 3].max() - 0.5 and curve[-1, 3] > 22
    assert all(torch.isfinite(value).all() and value.abs().max() < 100 for value in weights.values() if value.numel())


def test_a_clip_of_two_frames(tmp_path: Path) -> None:
    subject = write_subject(tmp_path, 4, 24)
    outputs = train_in(tmp_path, subject, steps=40, **(TINY | {"frames_per_step": 8}))
    report = report_of(outputs)
    assert report["training_frames"] == 2 and report["probe_frames"] == [0] and report["skipped_steps"] == 0
    assert np.isfinite(curve_of(outputs)).all() and curve_of(outputs)[-1, 3] > curve_of(outputs)[0, 3]
    assert np.isfinite(rendered(outputs, subject, 3, (24, 24))).all()


def cropped(inputs: dict[str, Path], folder: Path) -> tuple[dict[str, Path], int, int]:
    """The toy subject as 33 rows of 41 columns of a larger picture, its principal point not the middle; first row, column."""
    head, big, row, column = toy_head(24, 36), 56, 9, 4
    track = toy_track(head, 8, big)
    track["focal_px"] = np.float32(1.7 * big)
    images, alpha = toy_images(head, track, big)
    folder.mkdir()
    np.savez(folder / "whole.npz", **track)
    moved = track | {"centre_px": track["centre_px"] - np.array([column, row], np.float32)}
    np.savez(folder / "track.npz", **moved)
    window = np.s_[:, row : row + 33, column : column + 41]
    np.save(folder / "frames.npy", images[window])
    np.save(folder / "alpha.npy", alpha[window])
    return (
        inputs | {name: folder / f"{name}{'.npz' if name == 'track' else '.npy'}" for name in ("track", "frames", "alpha")},
        row,
        column,
    )


def test_odd_size_and_a_principal_point_off_the_middle(inputs: dict[str, Path], tmp_path: Path) -> None:
    """33 x 41 pixels: it learns, and its picture is to the rounding the same window of the whole picture."""
    subject, row, column = cropped(inputs, tmp_path / "subject")
    outputs = train_in(tmp_path, subject, steps=140, **TINY)
    report = report_of(outputs)
    assert report["skipped_steps"] == 0 and report["preflight_overlap"] > 0.7
    assert report["probe_psnr"] > curve_of(outputs)[0, 3] + 2
    window = rendered(outputs, subject, 6, (33, 41))
    whole = rendered(outputs, subject | {"track": tmp_path / "subject" / "whole.npz"}, 6, (56, 56))
    assert np.abs(window - whole[row : row + 33, column : column + 41]).max() < 0.02
    truth = on_white(np.load(subject["frames"])[6], np.load(subject["alpha"])[6])
    assert np.mean((window - truth) ** 2) < np.mean((1 - truth) ** 2) / 3
    turned = np.mean((window[:, ::-1] - truth) ** 2), np.mean((window[::-1] - truth) ** 2)
    assert np.mean((window - truth) ** 2) < min(turned)


@pytest.mark.parametrize(("code", "sampling"), [(10.0, "shell"), (1e36, "shell"), (10.0, "hierarchical"), (1e12, "hierarchical")])
def test_a_wild_but_finite_code_in_one_training_frame_does_not_spoil_the_others(
    inputs: dict[str, Path], tmp_path: Path, code: float, sampling: str
) -> None:
    """A lost frame: at 10 a head of bumps, beyond it one that is out of reach. No step is bad for it."""
    track = dict(np.load(inputs["track"]))
    track["expression"][2] = code
    np.savez(tmp_path / "track.npz", **track)
    keys = {"representation": "ours_d", "static_features": True, "frames_per_step": 6, "rays": 60}
    keys |= {"sampling": sampling, "coarse_samples": 6, "fine_samples": 6}
    outputs = train_in(tmp_path, inputs | {"track": tmp_path / "track.npz"}, steps=3, **(TINY | keys))
    weights = torch.load(outputs["avatar"], weights_only=True)["weights"]
    assert report_of(outputs)["skipped_steps"] == 0 and np.isfinite(curve_of(outputs)).all()
    assert all(torch.isfinite(value).all() for value in weights.values())


@pytest.mark.parametrize("name", ["expression", "eyes"])
def test_an_infinite_code_stops_before_training_with_the_frame(inputs: dict[str, Path], tmp_path: Path, name: str) -> None:
    track = dict(np.load(inputs["track"]))
    track[name][3] = np.inf
    np.savez(tmp_path / "track.npz", **track)
    with pytest.raises(StepError, match=rf"frame 3 is not finite \({name}\)"):
        train_in(tmp_path, inputs | {"track": tmp_path / "track.npz"}, steps=2)


@pytest.mark.parametrize("name, broken", [("frames", "nan"), ("frames", "int16"), ("alpha", "float")])
def test_pixels_that_are_not_bytes_are_refused(inputs: dict[str, Path], tmp_path: Path, name: str, broken: str) -> None:
    """A float picture would be divided by 255 once more, in silence; a NaN can only come in one."""
    pixels = np.load(inputs[name]).astype(np.int16 if broken == "int16" else np.float32)
    if broken == "nan":
        pixels[2] = np.nan
    np.save(tmp_path / f"{name}.npy", pixels)
    with pytest.raises(StepError, match=f"{name}.npy.*uint8"):
        train_in(tmp_path, inputs | {name: tmp_path / f"{name}.npy"}, steps=2, **TINY)
