"""A tiny subject in the data contract's shapes: a disc for a head that moves with the pose and opens a mouth with a code."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import torch

from fitting.head_model import HeadModel

FRAMES, HEIGHT, WIDTH = 24, 64, 72
TRAIN, TEST = list(range(16)), list(range(16, 24))
UNUSABLE, NOT_FOUND = 20, 18
FOCAL_PX, DEPTH_M = 100.0, 0.8


def head_model() -> HeadModel:
    """A head model of four vertices: enough for poses."""
    corners = torch.tensor([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    return HeadModel(
        template=corners,
        shape_basis=torch.zeros(2, 4, 3),
        expression_basis=torch.zeros(3, 4, 3),
        expression_low=torch.zeros(3),
        expression_high=torch.ones(3),
        expression_names=("a", "b", "c"),
        pose_basis=torch.zeros(0, 4, 3),
        joints=torch.zeros(5, 3),
        joint_shape_basis=torch.zeros(2, 5, 3),
        skinning_weights=torch.eye(5)[[1, 1, 1, 1]],
        triangles=torch.tensor([[0, 1, 2]]),
        uvs=torch.zeros(3, 2),
        uv_triangles=torch.tensor([[0, 1, 2]]),
        region=torch.zeros(4, dtype=torch.int64),
        landmark_triangles=torch.zeros(478, dtype=torch.int64),
        landmark_barycentric=torch.full((478, 3), 1 / 3),
        name="tiny",
        licence="CC0",
        digest="0" * 16,
    )


def pose(frame: int) -> tuple[float, float]:
    """Head's centre x in px and opening of the mouth in [0, 1]: training sees every place that the tail visits."""
    return 36 + 10 * np.sin(frame * 0.9), 0.5 + 0.5 * np.sin(frame * 2.1)


def picture(frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Colour uint8 [H, W, 3] and alpha uint8 [H, W] of one frame."""
    centre, mouth = pose(frame)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    radius = np.hypot(x - centre, y - 32)
    colour = np.stack([180 + 40 * np.sin(0.5 * x), 120 + 30 * np.cos(0.4 * y), 100 + 0 * x], -1)
    colour[np.hypot((x - centre) / 1.5, (y - 40) / max(mouth, 0.05)) < 5] = 20
    colour[radius > 22] = 70  # background
    return colour.round().astype(np.uint8), (255 * np.clip(22.5 - radius, 0, 1)).round().astype(np.uint8)


def landmarks(frame: int) -> np.ndarray:
    """Points float32 [478, 3] px on an ellipse inside the head."""
    angle = np.linspace(0, 2 * np.pi, 478, endpoint=False)
    return np.stack([pose(frame)[0] + 14 * np.cos(angle), 32 + 17 * np.sin(angle), 0 * angle], -1).astype(np.float32)


def make(folder: Path) -> dict[str, Path]:
    """Write the subject's files and return them by input name; `lpips` is a checkpoint of random weights."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = {
        name: folder / file
        for name, file in {
            "head": "head.npz",
            "frames": "frames.npy",
            "index": "frames.json",
            "alpha": "alpha.npy",
            "landmarks": "landmarks.npz",
            "track": "track.npz",
            "split": "split.json",
            "lpips": "lpips.ckpt",
        }.items()
    }
    head_model().save(paths["head"])
    colours, alphas = zip(*(picture(frame) for frame in range(FRAMES)), strict=True)
    np.save(paths["frames"], np.stack(colours))
    np.save(paths["alpha"], np.stack(alphas))
    paths["index"].write_text(
        json.dumps({"fps": 25.0, "time_s": [frame / 25 for frame in range(FRAMES)], "size": [HEIGHT, WIDTH]})
    )
    paths["split"].write_text(json.dumps({"train": TRAIN, "test": TEST}))
    found, usable = np.ones(FRAMES, bool), np.ones(FRAMES, bool)
    found[NOT_FOUND] = usable[UNUSABLE] = False
    np.savez(paths["landmarks"], points=np.stack([landmarks(frame) for frame in range(FRAMES)]), found=found)
    poses = np.array([pose(frame) for frame in range(FRAMES)])
    expression, translation = np.zeros((FRAMES, 3)), np.zeros((FRAMES, 3))
    expression[:, 0], translation[:, 0], translation[:, 2] = poses[:, 1], (poses[:, 0] - 36) * DEPTH_M / FOCAL_PX, DEPTH_M
    zeros = np.zeros((FRAMES, 3), np.float32)
    np.savez(
        paths["track"],
        shape=np.zeros(2, np.float32),
        expression=expression.astype(np.float32),
        rotation=zeros,
        neck=zeros,
        jaw=zeros,
        eyes=np.zeros((FRAMES, 2, 3), np.float32),
        translation=translation.astype(np.float32),
        focal_px=np.float32(FOCAL_PX),
        centre_px=np.array([WIDTH / 2, HEIGHT / 2], np.float32),
        usable=usable,
    )
    paths["lpips"].write_bytes(pickle.dumps(random_lpips(), 4))
    return paths


def random_lpips() -> dict:
    """Arrays of the LPIPS checkpoint's names and shapes, with random convolutions and positive heads."""
    generator = np.random.default_rng(3)
    weights: dict = {"AlexNet_0": {}}
    for index, (channels, inputs, size) in enumerate(((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))):
        kernel = generator.normal(0, (inputs * size**2) ** -0.5, (size, size, inputs, channels))
        weights["AlexNet_0"][f"Conv_{index}"] = {"kernel": kernel.astype(np.float32), "bias": np.zeros(channels, np.float32)}
        weights[f"NetLinLayer_{index}"] = {"Conv_0": {"kernel": np.full((1, 1, channels, 1), 1 / channels, np.float32)}}
    return weights


def arguments(config: dict, inputs: dict[str, Path | list[Path]], outputs: dict[str, Path], subject: str = "ann") -> list[str]:
    """The command line that a rule would give a step."""
    named = [f"{name}={path}" for name, value in inputs.items() for path in (value if isinstance(value, list) else [value])]
    return [
        "--subject",
        subject,
        "--config",
        json.dumps(config),
        "--code",
        "test",
        "--threads",
        "1",
        "--input",
        *named,
        "--output",
        *(f"{name}={path}" for name, path in outputs.items()),
    ]
