"""Training of a layered avatar on the toy subject: it learns, resumes to the bit, finds a pose that was wrong."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from test_lpips import random_vgg16
from toy_head import toy_head, toy_images, toy_track
from toy_run import train_in, write_subject

from avatar import lpips, train
from avatar.dataset import Scene, on_white
from avatar.layered.perceptual import Perceptual
from avatar.learning.alignment import Alignment

KEYS = {"representation": "layers", "layers": 5, "bases": 2, "texture_size": 64}


@pytest.fixture
def vgg(tmp_path: Path) -> Path:
    path = tmp_path / "vgg.ckpt"
    path.write_bytes(pickle.dumps(random_vgg16(), 4))
    return path


@pytest.fixture
def inputs(tmp_path: Path, vgg: Path) -> dict[str, Path]:
    (tmp_path / "subject").mkdir()
    return write_subject(tmp_path / "subject") | {"vgg": vgg}


def test_it_learns(inputs: dict[str, Path], tmp_path: Path) -> None:
    outputs = train_in(tmp_path / "run", inputs, steps=60, **KEYS)
    report = json.loads(outputs["report"].read_text())
    curve = np.loadtxt(outputs["curve"], skiprows=1)
    assert report["skipped_steps"] == 0 and report["probe_psnr"] > 30 and curve[-1, 3] > curve[0, 3] + 1
    assert outputs["avatar"].stat().st_size < 10e6


def test_resumed_equals_uninterrupted_to_the_bit(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = train_in(tmp_path / "whole", inputs, steps=8, **KEYS)
    original, done = train.optimise, []

    def interrupted(*arguments: object) -> float:
        done.append(1)
        if len(done) == 6:
            raise KeyboardInterrupt
        return original(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(train, "CHECKPOINT_S", 0.0)
        patch.setattr(train, "optimise", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train_in(tmp_path / "parts", inputs, steps=8, **KEYS)
    parts = train_in(tmp_path / "parts", inputs, steps=8, **KEYS)
    expected, found = (torch.load(run["avatar"], weights_only=True)["weights"] for run in (whole, parts))
    assert all(torch.equal(expected["networks"][name], found["networks"][name]) for name in expected["networks"])
    assert torch.equal(expected["textures"]["bytes"], found["textures"]["bytes"])


def test_a_step_without_the_head_is_no_step(inputs: dict[str, Path], tmp_path: Path) -> None:
    """The head of one frame lies outside of its picture: nothing is learned from it, and nothing breaks."""
    track = dict(np.load(inputs["track"]))
    track["translation"][3] += np.array([3, 0, 0], np.float32)
    np.savez(tmp_path / "track.npz", **track)
    outputs = train_in(tmp_path / "run", inputs | {"track": tmp_path / "track.npz"}, steps=12, **KEYS)
    assert json.loads(outputs["report"].read_text())["skipped_steps"] == 0


def test_alignment_finds_a_turn_and_a_shift() -> None:
    """The picture of a head moved by a known turn and shift, against its render where it was thought to be."""
    size = 96
    head = toy_head(24, 36)
    track = toy_track(head, 2, size)
    scene = Scene(head, track, range(2))
    image, alpha = toy_images(head, track, size)
    moved = {name: value.copy() for name, value in track.items()}
    moved["rotation"][0] += np.array([0.004, -0.006, 0.005], np.float32)
    moved["translation"][0] += np.array([0.0006, -0.0004, 0.0], np.float32)
    truth, matte = toy_images(head, moved, size)
    view, middle = scene.view(0, (size, size)), scene.neutral_m.double().numpy().mean(0)
    drawn = np.concatenate([on_white(image[0], alpha[0]), alpha[0][..., None] / np.float32(255)], -1)
    camera = scene.vertices_m[0].double().numpy() @ view.rotation.T + view.offset_m
    depth = np.full((size, size), camera[:, 2].min() + 0.01, np.float32)
    alignment = Alignment(2)
    for _ in range(6):  # without a new render the residual stays: the correction approaches what one linear step says
        alignment.learn(0, view, middle, drawn, depth, on_white(truth[0], matte[0]))
    corrected = alignment.applied(0, view, middle)
    wanted = Scene(head, moved, range(2)).view(0, (size, size))
    points = scene.vertices_m[0].double().numpy()
    front = camera[:, 2] < np.median(camera[:, 2])
    before, after = (
        np.linalg.norm(one.pixels_of(points)[front, :2] - wanted.pixels_of(points)[front, :2], axis=1).mean()
        for one in (view, corrected)
    )
    # Two frames, one of them at rest: taking out the mean leaves half of the correction.
    assert after < 0.75 * before and before > 0.3
    assert not alignment.moves[1].any() and np.isfinite(alignment.moves).all()


def test_alignment_of_an_empty_picture_does_nothing() -> None:
    head = toy_head()
    view = Scene(head, toy_track(head, 1, 24), range(1)).view(0, (24, 24))
    alignment = Alignment(1)
    white = np.ones((24, 24, 4), np.float32) * [1, 1, 1, 0]
    alignment.learn(
        0, view, np.zeros(3), white.astype(np.float32), np.zeros((24, 24), np.float32), white[..., :3].astype(np.float32)
    )
    assert not alignment.moves.any() and alignment.applied(0, view, np.zeros(3)).focal_px == view.focal_px


def test_perceptual_distance(vgg: Path, assets: Path) -> None:
    network = Perceptual(lpips.load(vgg, network="vgg16"), torch.float32)
    torch.manual_seed(0)
    image = torch.rand(1, 3, 32, 40)
    assert network(image, image) == 0
    other = (image + 0.1 * torch.randn_like(image)).requires_grad_()
    near, far = network(other, image), network(torch.rand_like(image), image)
    assert 0 < near < far
    near.backward()
    assert torch.isfinite(other.grad).all() and other.grad.abs().sum() > 0
    with pytest.raises(ValueError, match="VGG16"):
        Perceptual(lpips.load(assets / "lpips_alexnet.ckpt"), torch.float32)
