"""Training learns, resumes to the bit, starts afresh when something changed, skips bad steps and stops with a reason."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_run import train_in, write_subject

from avatar import train
from avatar.learning import rays
from workflow.step import StepError


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_subject(tmp_path_factory.mktemp("subject"))


@pytest.fixture(autouse=True)
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rays, "best_precision", lambda device: torch.float32)


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["weights"]


def interrupt_after(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the middle of a step."""
    original, done = train.optimise, []

    def optimise(*arguments: object) -> float:
        done.append(1)
        if len(done) == steps:
            os.kill(os.getpid(), signal.SIGINT)
        return original(*arguments)

    monkeypatch.setattr(train, "optimise", optimise)


def test_four_frames_are_learned(inputs: dict[str, Path], tmp_path: Path) -> None:
    split = tmp_path / "split.json"
    split.write_text(json.dumps({"train": [0, 1, 2, 3], "test": [7]}))
    outputs = train_in(tmp_path, inputs | {"split": split}, steps=100, rays=384)
    report = json.loads(outputs["report"].read_text())
    rows = [line.split("\t") for line in outputs["curve"].read_text().splitlines()]
    assert rows[0] == ["step", "seconds", "loss", "probe_psnr"] and int(rows[-1][0]) == 100
    assert report["probe_psnr"] == pytest.approx(float(rows[-1][3]), abs=1e-3)
    assert report["probe_psnr"] > 20 and report["probe_psnr"] > float(rows[1][3]) + 4
    assert report["skipped_steps"] == 0 and report["steps"] == 100 and report["provenance"]["code"] == "c"


@pytest.mark.parametrize(
    "keys",
    [{}, {"representation": "codes_mlp", "warp": True}, {"sampling": "hierarchical", "coarse_samples": 8, "fine_samples": 8}],
    ids=["demo", "draws_and_warp", "hierarchical"],
)
def test_resumed_equals_uninterrupted_to_the_bit(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, keys: dict
) -> None:
    whole = train_in(tmp_path / "whole", inputs, steps=6, **keys)
    with monkeypatch.context() as patch:
        interrupt_after(3, patch)
        with pytest.raises(KeyboardInterrupt):
            train_in(tmp_path / "parts", inputs, steps=6, **keys)
    assert not (tmp_path / "parts" / "avatar.pt").exists()
    before = torch.load(tmp_path / "parts" / "checkpoints" / "last.pt", weights_only=True)["state"]
    assert before["step"] == 3 and before["seconds"] > 0
    with caplog.at_level("INFO"):
        parts = train_in(tmp_path / "parts", inputs, steps=6, **keys)
    assert "continuing at step 3 of 6" in caplog.text
    expected, found = weights(whole["avatar"]), weights(parts["avatar"])
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    curves = [[line.split("\t") for line in outputs["curve"].read_text().splitlines()] for outputs in (whole, parts)]
    assert [[row[0], *row[2:]] for row in curves[0]] == [[row[0], *row[2:]] for row in curves[1]]
    assert json.loads(parts["report"].read_text())["train_seconds"] > before["seconds"] - 0.01


@pytest.mark.parametrize("change", ["seed", "code", "input", "damage"])
def test_a_changed_run_never_continues_from_stale_weights(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, change: str
) -> None:
    with monkeypatch.context() as patch:
        interrupt_after(1, patch)
        with pytest.raises(KeyboardInterrupt):
            train_in(tmp_path, inputs, steps=2)
    keys: dict = {"seed": 1} if change == "seed" else {}
    if change == "input":
        track = dict(np.load(inputs["track"]))
        track["expression"] = track["expression"] * np.float32(0.9)
        np.savez(tmp_path / "track.npz", **track)
        inputs = inputs | {"track": tmp_path / "track.npz"}
    if change == "damage":
        (tmp_path / "checkpoints" / "last.pt").write_bytes(b"no checkpoint")
    with caplog.at_level("INFO"):
        train_in(tmp_path, inputs, steps=2, code="d" if change == "code" else "c", **keys)
    assert "starting afresh" in caplog.text and "continuing" not in caplog.text


def test_bad_steps_are_skipped_counted_and_stop_the_run(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, calls = rays.losses.photometric, []

    def one_bad(*arguments: object) -> torch.Tensor:
        calls.append(1)
        return original(*arguments) * (float("nan") if len(calls) == 2 else 1.0)

    monkeypatch.setattr(rays.losses, "photometric", one_bad)
    outputs = train_in(tmp_path / "one", inputs, steps=4)
    assert json.loads(outputs["report"].read_text())["skipped_steps"] == 1
    assert all(torch.isfinite(value).all() for value in weights(outputs["avatar"]).values())
    monkeypatch.setattr(rays.losses, "photometric", lambda *arguments: original(*arguments) * float("inf"))
    with pytest.raises(StepError, match=r"diverges at step 3: 3 of the last 3 steps .* on frames \["):
        train_in(tmp_path / "all", inputs, steps=6)


def test_a_network_that_died_stops_the_run(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = rays.make_avatar

    def dead(*arguments: object) -> torch.nn.Module:
        avatar = original(*arguments)
        torch.nn.init.constant_(avatar.field.mlp1.layers[-1].bias, -1e6)
        return avatar

    monkeypatch.setattr(rays, "make_avatar", dead)
    with pytest.raises(StepError, match="the network is dead"):
        train_in(tmp_path, inputs, steps=6)


def test_a_mesh_beside_the_person_stops_before_training(inputs: dict[str, Path], tmp_path: Path) -> None:
    track = dict(np.load(inputs["track"]))
    track["translation"] = track["translation"] + np.array([0.12, 0, 0], np.float32)
    np.savez(tmp_path / "track.npz", **track)
    with pytest.raises(StepError, match="overlap of only"):
        train_in(tmp_path, inputs | {"track": tmp_path / "track.npz"}, steps=2)


def test_a_pose_that_is_not_finite_stops_with_its_number(inputs: dict[str, Path], tmp_path: Path) -> None:
    track = dict(np.load(inputs["track"]))
    track["jaw"][2, 0] = np.nan
    np.savez(tmp_path / "track.npz", **track)
    with pytest.raises(StepError, match="frame 2 is not finite"):
        train_in(tmp_path, inputs | {"track": tmp_path / "track.npz"}, steps=2)


@pytest.mark.parametrize("part", [2, 4])
def test_frames_without_a_matte_and_all_background_batches_do_no_harm(inputs: dict[str, Path], tmp_path: Path, part: int) -> None:
    """Two of four frames without a matte, both in every step; then four of four but for the first look at the mesh."""
    split, alpha = tmp_path / "split.json", np.load(inputs["alpha"])
    split.write_text(json.dumps({"train": [1, 3, 0, 2], "test": [7]}))
    alpha[[1, 3, 0, 2][:part]] = 0
    np.save(tmp_path / "alpha.npy", alpha)
    changed = inputs | {"alpha": tmp_path / "alpha.npy", "split": split}
    if part == 4:
        with pytest.raises(StepError, match="overlap of only"):
            train_in(tmp_path, changed, steps=1)
        return
    for sampling in ("shell", "hierarchical"):
        keys = {"sampling": sampling, "coarse_samples": 6, "fine_samples": 6, "frames_per_step": 4}
        outputs = train_in(tmp_path / sampling, changed, steps=3, **keys)
        assert json.loads(outputs["report"].read_text())["skipped_steps"] == 0
        assert all(torch.isfinite(value).all() for value in weights(outputs["avatar"]).values())


@pytest.mark.parametrize("what", ["coarse", "warp"])
def test_a_forward_pass_that_is_not_finite_names_its_frames(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """NaN weights of the coarse network place the fine samples, a NaN latent moves the points: no tree is asked for those."""
    original = rays.make_avatar

    def poisoned(*arguments: object) -> torch.nn.Module:
        avatar = original(*arguments)
        torch.nn.init.constant_(avatar.coarse.density.bias if what == "coarse" else avatar.warp.latents, float("nan"))
        return avatar

    monkeypatch.setattr(rays, "make_avatar", poisoned)
    keys = {"coarse": {"sampling": "hierarchical", "coarse_samples": 6, "fine_samples": 6}, "warp": {"warp": True}}[what]
    with pytest.raises(train.TrainingFailed, match=r"not finite, the last on frames \["):
        train_in(tmp_path, inputs, steps=6, **keys)


def test_too_few_frames_and_mismatched_sizes(inputs: dict[str, Path], tmp_path: Path) -> None:
    split = tmp_path / "split.json"
    split.write_text(json.dumps({"train": [0], "test": [1]}))
    with pytest.raises(StepError, match="needs at least 2"):
        train_in(tmp_path, inputs | {"split": split}, steps=1)
    np.save(tmp_path / "alpha.npy", np.zeros((8, 3, 3), np.uint8))
    with pytest.raises(StepError, match="the frames are"):
        train_in(tmp_path, inputs | {"alpha": tmp_path / "alpha.npy"}, steps=1)
