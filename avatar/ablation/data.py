"""Step: what every cell of the ablation is trained on: a tracked clip cut to the head at a small size, and its split.

    python -m avatar.ablation.data --input head=... frames=... index=... alpha=... track=... split=... \\
        --output frames=... alpha=... track=... split=... half=... four=...

A simulated clip has its true matte (input `matte`, in the source video's pixels), cut with the tracked mesh as `trim` does: the
test frames with doubled codes (`avatar.ablation.truth`) have no other, and both are to be scored alike.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from avatar.ablation.config import AblationDataConfig
from avatar.frames import chosen_frames
from fitting import extract, trim
from fitting.files import load_head
from workflow import step

FEW = 4  # frames that a cell learns by heart
MARGIN = 0.06  # around the head: a mouth opens further with doubled codes
Crop = tuple[dict[str, int], tuple[int, int], float]
"""As `extract.fit_crop` returns it: the part that is read, size (H, W), scale."""


def run(job: step.Job) -> None:
    """Write frames, mattes and track at the small size, and the split with all and with half of the training frames."""
    frames, track = np.load(job.input.frames, mmap_mode="r"), load_track(job)
    mattes = true_mattes(job, track) if hasattr(job.input, "matte") else np.load(job.input.alpha, mmap_mode="r")
    crop = extract.fit_crop(head_box(mattes, track["usable"]), job.config.size)
    rgb = np.empty((len(frames), *crop[1], 3), np.uint8)
    alpha = np.empty((len(frames), *crop[1]), np.uint8)
    for row in job.progress(range(len(frames)), "shrink"):
        rgb[row], alpha[row] = extract.cut(frames[row], *crop[:2]), extract.cut(mattes[row], *crop[:2])
    for output, content in ((job.output.frames, rgb), (job.output.alpha, alpha)):
        with open(output, "wb") as file:
            np.save(file, content)
    save_track(job.output.track, shrink(track, crop))
    split = small_split(step.read_json(job.input.split), track["usable"], job.config.test_frames) | {"crop": crop}
    half = split | {"train": split["train"][: (len(split["train"]) + 1) // 2]}
    few = chosen_frames(split["train"], FEW)
    four = split | {"train": few, "test": few}
    for output, content in ((job.output.split, split), (job.output.half, half), (job.output.four, four)):
        output.write_text(json.dumps(content), encoding="utf-8")
    job.log.info("%d frames of %dx%d, %d to train on", len(rgb), crop[1][1], crop[1][0], len(split["train"]))


def true_mattes(job: step.Job, track: dict[str, np.ndarray]) -> np.ndarray:
    """The simulator's mattes [T, H, W] uint8 in the frames' pixels, cut with the tracked mesh."""
    head, index = load_head(job.input.head), step.read_json(job.input.index)
    whole = np.load(job.input.matte, mmap_mode="r")
    return np.stack([
        trim.trim(head, track, row, in_crop(whole[source], index), job.config.trim.neck_margin_m)[0]
        for row, source in enumerate(job.progress(index["source_frame"], "trim"))
    ])  # fmt: skip


def head_box(mattes: np.ndarray, usable: np.ndarray) -> dict[str, int]:
    """The box around the head over all frames that could be tracked, with a margin: at this size no pixel is to be wasted.

    Raises:
        StepError: every matte is empty.
    """
    seen = np.zeros(mattes.shape[1:], bool)
    for row in np.flatnonzero(usable):
        seen |= mattes[row] > 127
    if not seen.any():
        raise step.StepError("the mattes are empty; look at trim/alpha.npy")
    ends = []
    for axis, size in ((1, seen.shape[0]), (0, seen.shape[1])):
        places = np.flatnonzero(seen.any(axis))
        margin = round(MARGIN * (places[-1] + 1 - places[0]))
        ends.append((max(0, int(places[0]) - margin), min(size, int(places[-1]) + 1 + margin)))
    (top, bottom), (left, right) = ends
    return {"x": left, "y": top, "width": right - left, "height": bottom - top}


def load_track(job: step.Job) -> dict[str, np.ndarray]:
    """The arrays of the tracked clip; StepError where a frame is without a pose."""
    with np.load(job.input.track, allow_pickle=False) as file:
        track = {name: file[name] for name in file.files}
    count = len(step.read_json(job.input.index)["source_frame"])
    if len(track["usable"]) != count:
        raise step.StepError(f"{job.input.track}: {len(track['usable'])} rows for {count} frames; run snakemake again")
    return track


def save_track(path: Any, track: dict[str, np.ndarray]) -> None:
    """Write a track under a temporary name as it is, without another suffix."""
    with open(path, "wb") as file:
        np.savez(file, **track)


def in_crop(picture: np.ndarray, index: dict[str, Any]) -> np.ndarray:
    """A picture in the source video's pixels cut as the pipeline's frames are. index: content of frames.json."""
    return extract.cut(picture, index["crop"], tuple(index["size"]))


def shrink(track: dict[str, np.ndarray], crop: Crop) -> dict[str, np.ndarray]:
    """The track with its camera in the small frames' pixels."""
    corner = np.array([crop[0]["x"], crop[0]["y"]])
    centre = (track["centre_px"] - corner) * crop[2]
    return track | {"centre_px": np.float32(centre), "focal_px": np.float32(track["focal_px"] * crop[2])}


def small_split(split: dict[str, Any], usable: np.ndarray, test_frames: int) -> dict[str, list[int]]:
    """The training frames, and evenly spaced test frames among those that could be tracked.

    Raises:
        StepError: there is no such test frame.
    """
    test = [frame for frame in split["test"] if usable[frame]]
    if not test:
        raise step.StepError("none of the test frames could be tracked; keep the face in view in the last quarter of the video")
    return {"train": [frame for frame in split["train"] if usable[frame]], "test": chosen_frames(test, test_frames)}


if __name__ == "__main__":
    step.main(run, AblationDataConfig)
