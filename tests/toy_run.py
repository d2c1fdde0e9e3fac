"""A toy subject on disk, and the steps train and render run on it in this process."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from toy_head import toy_head, toy_images, toy_track

from avatar import guide, marching, sampling, shell, train
from avatar.config import TrainConfig
from avatar.radiance import Posed, RadianceAvatar
from avatar.volume import Rays, Rendered
from workflow.step import Job

SMALL = {
    "rays": 192,
    "frames_per_step": 1,
    "mlp_width": 64,
    "colour_width": 32,
    "feature_channels": 16,
    "bands": 6,
    "max_samples": 8,
    "sample_step_m": 0.004,
    "learning_rate": 3e-3,
    "static_features": True,
}


def write_subject(folder: Path, frames: int = 8, size: int = 40) -> dict[str, Path]:
    """Frames, mattes, track, split and head model of a toy subject; the last two frames are the test."""
    head = toy_head(24, 36)
    track = toy_track(head, frames, size)
    images, alpha = toy_images(head, track, size)
    paths = {
        "head": folder / "head.npz",
        "frames": folder / "frames.npy",
        "alpha": folder / "alpha.npy",
        "track": folder / "track.npz",
        "split": folder / "split.json",
        "index": folder / "frames.json",
    }
    head.save(paths["head"])
    np.save(paths["frames"], images)
    np.save(paths["alpha"], alpha)
    np.savez(paths["track"], **track)
    paths["split"].write_text(json.dumps({"train": list(range(frames - 2)), "test": [frames - 2, frames - 1]}))
    paths["index"].write_text(json.dumps({"fps": 25}))
    return paths


def job(config: object, inputs: dict[str, Path], outputs: dict[str, Path], code: str = "c") -> Job:
    """A job as the harness makes it, but with outputs written in place."""
    for path in outputs.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    names = SimpleNamespace(**outputs)
    return Job(config, SimpleNamespace(**inputs), names, names, "toy", 1, "cpu", code, logging.getLogger("toy"))


def train_in(folder: Path, inputs: dict[str, Path], code: str = "c", **keys: object) -> dict[str, Path]:
    """Train into a folder; returns the outputs."""
    outputs = {"avatar": folder / "avatar.pt", "curve": folder / "curve.tsv", "report": folder / "train.json"}
    train.run(job(TrainConfig(**(SMALL | keys)), inputs, outputs, code))
    return outputs


def marched_in_one_pass(avatar: RadianceAvatar, posed: Posed, rays: Rays) -> Rendered:
    """What `march` draws in the shell, layer by layer in one pass, from the density of every voxel, whether seen or not."""

    def seen(points_m: np.ndarray, directions: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        index = torch.from_numpy(avatar.nearest(posed, 0, points_m))
        terms = avatar.field.vertex_terms(avatar.source(posed.condition).values, torch.float32)[0]
        return avatar.field.plainly(*map(torch.from_numpy, (points_m, directions)), posed.vertices_m[0], index, terms)

    grid, most = posed.grids[0], round(avatar.max_samples * marching.GUIDED)
    place = np.argwhere(grid.labels == shell.SHELL)
    centres = ((place + 0.5) * shell.VOXEL_M + grid.origin).astype(np.float32)
    density = np.full(grid.labels.shape, guide.UNKNOWN)
    with torch.no_grad():
        density[tuple(place.T)] = seen(centres, np.zeros_like(centres))[0].numpy()
        samples, stops = guide.guided(grid, density, rays, avatar.step_m, most, marching.END)

        def drawn(samples: shell.Samples) -> Rendered:
            packed = sampling.pack(rays, samples)
            return marching.composited(samples, *seen(packed.points_m, packed.directions), len(rays.origins_m))[0]

        left = np.isfinite(stops) & (1 - drawn(samples).opacity.numpy() > marching.END)
        later = rays.origins_m + np.where(left, stops, 0)[:, None].astype(np.float32) * rays.directions
        rest = sampling.in_shell(grid, Rays(later, rays.directions), avatar.step_m, most, None)
        rest = shell.Samples(*(array[left[rest.ray]] for array in rest))
        rest = rest._replace(distance_m=rest.distance_m + stops[rest.ray].astype(np.float32), slot=rest.slot + most)
        both = [np.concatenate(pair) for pair in zip(samples, rest, strict=True)]
        order = np.lexsort((both[3], both[2]))
        return drawn(shell.Samples(*(array[order] for array in both)))
