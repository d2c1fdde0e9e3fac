"""Step `baseline`: two trivial predictors of the test frames, so that an avatar's figures can be judged.

    mean_frame     the mean of the usable training frames: premultiplied colour and alpha averaged, shown on white
    nearest_frame  for each test frame the usable training frame nearest in expression and pose, with its own alpha on white

Input: head, frames, index (frames.json), alpha (trim), track, split. Output: render, report, video, as the step `render` has.
"""

from __future__ import annotations

import time

import numpy as np
import torch
from scipy.spatial.distance import cdist

from avatar import provenance
from avatar.config import BaselineConfig
from avatar.frames import chosen_frames
from fitting.camera import project
from fitting.files import load_head
from fitting.head_model import HeadModel
from fitting.video import write_video
from workflow import step

CHUNK_FRAMES = 16
VERTICES = 500
"""About this many vertices of the head model are compared."""
COUNTED = "all frames at once, divided by their number: a predictor renders nothing"
DISTANCE = "rms distance in pixels between the projected vertices of the two fitted heads"


def mean_frame(frames: np.ndarray, alpha: np.ndarray, train: list[int]) -> np.ndarray:
    """Mean training frame on white with its mean opacity.

    Args:
        frames: uint8 [T, H, W, 3] RGB.
        alpha: uint8 [T, H, W].
        train: frames to average.

    Returns:
        uint8 [H, W, 4].
    """
    colour = np.zeros((*frames.shape[1:3], 3))
    opacity = np.zeros(frames.shape[1:3])
    for start in range(0, len(train), CHUNK_FRAMES):
        chosen = train[start : start + CHUNK_FRAMES]
        mask = alpha[chosen].astype(np.float32) / 255
        colour += (frames[chosen] * mask[..., None]).sum(0)
        opacity += mask.sum(0)
    colour, opacity = colour / len(train), opacity / len(train)
    on_white = colour + 255 * (1 - opacity[..., None])
    return np.concatenate([on_white, 255 * opacity[..., None]], -1).round().clip(0, 255).astype(np.uint8)


def on_white(frame: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """A frame [H, W, 3] over white by its alpha [H, W], with that alpha: uint8 [H, W, 4]."""
    mask = alpha[..., None].astype(np.float32) / 255
    colour = (frame * mask + 255 * (1 - mask)).round().astype(np.uint8)
    return np.concatenate([colour, alpha[..., None]], -1)


def nearest_frames(pixels: np.ndarray, train: list[int], test: list[int]) -> tuple[list[int], np.ndarray]:
    """For each test frame the training frame nearest in expression and pose.

    In the picture expression, gaze and pose have one unit, pixels: no weights, hence nothing to tune.

    Args:
        pixels: [T, V, 2] projected vertices of the fitted head.
        train, test: frame indices; one training frame at least.

    Returns:
        a training frame for each test frame, and the rms distances [T_test] px.
    """
    flat = pixels.reshape(len(pixels), -1)
    distance = cdist(flat[test], flat[train])
    best = distance.argmin(1)
    return [train[index] for index in best], distance.min(1) / np.sqrt(pixels.shape[1])


def _pixels(head: HeadModel, track: dict[str, np.ndarray]) -> np.ndarray:
    """Projected vertices [T, about VERTICES, 2] px of every frame of a track."""
    names = ("expression", "rotation", "neck", "jaw", "eyes", "translation")
    shape = torch.from_numpy(track["shape"])
    some = slice(None, None, max(1, head.vertex_count // VERTICES))
    found = []
    for start in range(0, len(track["expression"]), CHUNK_FRAMES):
        values = (torch.from_numpy(track[name][start : start + CHUNK_FRAMES]) for name in names)
        found.append(head.forward(shape, *values)[:, some].numpy().astype(np.float64))
    return project(np.concatenate(found), float(track["focal_px"]), track["centre_px"])


def _predict(job: step.Job, frames: np.ndarray, alpha: np.ndarray, train: list[int], test: list[int]) -> tuple[np.ndarray, dict]:
    """The predicted frames uint8 [T_test, H, W, 4] and what the report says of them."""
    config: BaselineConfig = job.config
    started = time.perf_counter()
    if config.predictor == "mean_frame":
        picture = mean_frame(frames, alpha, train)
        render = np.broadcast_to(picture, (len(test), *picture.shape))
        facts = {"training_frames": len(train), "how": "premultiplied mean of the usable training frames, on white"}
    else:
        with np.load(job.input.track, allow_pickle=False) as file:
            track = {name: file[name] for name in file.files}
        chosen, distances = nearest_frames(_pixels(load_head(job.input.head), track), train, test)
        render = np.stack([on_white(frames[index], alpha[index]) for index in chosen])
        facts = {"training_frames": len(train), "how": DISTANCE, "nearest": chosen, "distance_px": distances.round(3).tolist()}
    mean = 1e3 * (time.perf_counter() - started) / len(test)
    return render, facts | {"ms_per_frame": mean, "ms": [round(mean, 3)] * len(test), "ms_counts": COUNTED}


def run(job: step.Job) -> None:
    """Predict the chosen test frames; StepError when no training frame is usable."""
    frames, alpha = (np.load(path, mmap_mode="r") for path in (job.input.frames, job.input.alpha))
    split, index = step.read_json(job.input.split), step.read_json(job.input.index)
    with np.load(job.input.track, allow_pickle=False) as file:
        usable = file["usable"]
    train = [frame for frame in split["train"] if usable[frame]]
    test = chosen_frames(split["test"], job.config.max_frames)
    if not train or not test:
        what = "usable training frames" if not train else "test frames"
        raise step.StepError(f"{job.input.track}: {job.subject} has no {what}; use a longer video in which the face is seen")
    render, facts = _predict(job, frames, alpha, train, test)
    with open(job.output.render, "wb") as file:
        np.save(file, render)
    inputs = (on_white(frames[frame], alpha[frame]) for frame in test)
    pairs = (np.concatenate(pair, 1)[..., :3] for pair in zip(inputs, render, strict=True))
    shown = float(index["fps"]) * len(test) / len(split["test"])  # frames left out must not speed it up
    write_video(job.output.video, pairs, max(1.0, shown), provenance.FILMED)
    job.write_json(job.output.report, {"predictor": True, "name": job.config.predictor, "frames": test} | facts)
    job.log.info("%s: %d test frames from %d training frames", job.config.predictor, len(test), len(train))


if __name__ == "__main__":
    step.main(run, BaselineConfig)
