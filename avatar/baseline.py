"""Step `baseline`: two trivial predictors of the test frames, so that an avatar's figures can be judged.

    mean_frame     the mean of the usable training frames: premultiplied colour and alpha averaged, shown on white
    nearest_frame  for each test frame the usable training frame nearest in expression and pose, with its own alpha on white

Input: head, frames, index (frames.json), alpha (trim), track, split. Output: render, report, video, as the step `render` has.
"""

from __future__ import annotations

import time

import numpy as np
import torch

from avatar.config import BaselineConfig
from avatar.frames import chosen_frames
from fitting.head_model import HeadModel
from fitting.video import write_video
from workflow import step

CHUNK_FRAMES = 16
STILL = 0.01
"""A coefficient that spreads less than this share of the most moving one is noise and is left out of the distance."""
EXPRESSION_WEIGHT = 0.25
"""Pose moves every pixel, expression few: with equal weights the predictor is 0.9 dB weaker on nerface.mp4, a lower bar."""
DISTANCE = (
    f"squared distance = {EXPRESSION_WEIGHT} (standardised expression and jaw)^2 + (angle between head rotations)^2 + (distance "
    "between head centres)^2, each term divided by its mean over pairs of training frames"
)


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


def nearest_frames(
    expression: np.ndarray, rotation: np.ndarray, centre: np.ndarray, train: list[int], test: list[int]
) -> tuple[list[int], np.ndarray]:
    """For each test frame the training frame nearest in expression and pose; `DISTANCE` says how.

    Args:
        expression: [T, E] expression and jaw coefficients.
        rotation: [T, 3, 3] head to camera.
        centre: [T, 3] m, head's origin in camera axes.
        train, test: frame indices; one training frame at least.

    Returns:
        a training frame for each test frame, and the distances [T_test].
    """
    spread = expression[train].std(0)
    moving = spread > STILL * spread.max()
    codes = expression[:, moving] / spread[moving] if moving.any() else np.zeros((len(expression), 1))

    def squared(first: list[int], second: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The three squared distances, each [first, second]."""
        apart = ((codes[first, None] - codes[None, second]) ** 2).mean(-1)
        cosine = (np.einsum("aij,bij->ab", rotation[first], rotation[second]) - 1) / 2
        moved = ((centre[first, None] - centre[None, second]) ** 2).sum(-1)
        return apart, np.arccos(np.clip(cosine, -1, 1)) ** 2, moved

    few = train[:: max(1, len(train) // 200)]  # spreads from at most 400 frames: 1500^2 pairs of 52 codes are 1 GB
    scales = [max(float(values.mean()), 1e-12) for values in squared(few, few)]
    chosen, distances = [], []
    for frame in test:
        apart, angle, moved = (values[0] / scale for values, scale in zip(squared([frame], train), scales, strict=True))
        total = EXPRESSION_WEIGHT * apart + angle + moved
        best = int(total.argmin())
        chosen.append(train[best])
        distances.append(float(np.sqrt(total[best])))
    return chosen, np.array(distances)


def _pose(head: HeadModel, track: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Head rotation [T, 3, 3] and centre [T, 3] m of every frame: root and neck in one."""
    values = [torch.from_numpy(track[name]).double() for name in ("shape", "rotation", "neck", "translation")]
    rotation, centre = head.rigid(*values)
    return rotation.numpy(), centre.numpy()


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
        rotation, centre = _pose(HeadModel.load(job.input.head, torch.float64), track)
        codes = np.concatenate([track["expression"], track["jaw"]], -1).astype(np.float64)
        chosen, distances = nearest_frames(codes, rotation, centre, train, test)
        render = np.stack([on_white(frames[index], alpha[index]) for index in chosen])
        facts = {"training_frames": len(train), "how": DISTANCE, "nearest": chosen, "distance": distances.round(4).tolist()}
    return render, facts | {"ms_per_frame": 1e3 * (time.perf_counter() - started) / len(test)}


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
    stride = max(1, round(len(split["test"]) / len(test)))
    write_video(job.output.video, pairs, max(1.0, float(index["fps"]) / stride))
    job.write_json(job.output.report, {"predictor": True, "name": job.config.predictor, "frames": test} | facts)
    job.log.info("%s: %d test frames from %d training frames", job.config.predictor, len(test), len(train))


if __name__ == "__main__":
    step.main(run, BaselineConfig)
