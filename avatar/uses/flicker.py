"""Step `flicker`: how much a render flickers over a still stretch, beside the video's own flicker, and what smoothing takes away.

Input: head avatar track split index frames alpha landmarks lpips (AlexNet). Output: report, video (input | tracked | smoothed).
The paper (supplement D) says that its jitter comes from the fit. An avatar is a function of the driving parameters alone: held
parameters give one and the same picture, so all its flicker is in the parameters, as true motion or as the fit's noise. The same
stretch is rendered with the parameters as tracked and with smoothed ones, and the figures stand beside the video's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch

from avatar import lpips, metrics
from avatar.dataset import on_white
from avatar.regions import HULL_POINTS
from avatar.uses.config import FlickerConfig
from avatar.uses.motion import Motion, smoothed
from avatar.uses.studio import Studio, open_studio
from fitting.video import write_video
from workflow import step

WHITE_NOISE = (12 / np.pi) ** 0.5
"""Mean absolute second difference of white Gaussian noise of standard deviation 1: sqrt(6), times sqrt(2 / pi) for the mean."""
COARSE = 0.01
"""Blur of the coarse measure, as a part of the picture's longer side: sensor noise goes, what moves as a whole stays."""
LEAST_FRAMES = 5
LONGEST_GAP = 1.5  # median intervals between frames that follow each other
VIDEO, TRACKED, SMOOTHED = "video", "tracked", "smoothed"
MEANING = {
    "flicker": "mean |x(t-1) - 2 x(t) + x(t+1)| over pixels inside all heads, channels and frames, divided by 1.954: standard "
    "deviation in levels of 1/255 of white noise that flickers as much; constant and linear change count as 0",
    "flicker_coarse": f"the same after a Gaussian blur of {COARSE:g} of the longer side, inside the heads: without sensor noise",
    "jitter_px": "the same measure of landmarks in pixels of the frames: as detected, and of the head model",
    "stretch": "the consecutive tracked test frames whose detected landmarks lie nearest to their mean (rms, nothing removed)",
    "scores": "PSNR and LPIPS (AlexNet) of whole frames at the render's size, on white: what smoothing costs",
}


class Stretch(NamedTuple):
    """Frames that follow each other."""

    run: list[int]
    """All tracked test frames around them without a gap: what smoothing sees."""
    frames: list[int]
    rms_px: float
    """Of the landmarks' distances from their mean."""


def second_difference(values: np.ndarray) -> np.ndarray:
    """|x(t-1) - 2 x(t) + x(t+1)| / 1.954 along the first axis: [T, ...] -> [T - 2, ...]."""
    return np.abs(values[:-2] - 2 * values[1:-1] + values[2:]) / WHITE_NOISE


def flicker(frames: np.ndarray, mask: np.ndarray) -> float:
    """How much pictures change from frame to frame beyond steady change, in levels of 1/255.

    The second difference is used because the first one counts slow motion: of a drift it sees the speed, the second nothing,
    and of a movement of f Hz at r frames a second only the part (2 pi f / r)^2. The mean absolute value is taken because few
    pixels at edges would rule a mean square.

    Args:
        frames: [T, H, W, 3] in levels, at least three.
        mask: [H, W] bool, pixels that count.

    Raises:
        ValueError: too few frames, or no pixel.
    """
    if len(frames) < 3 or not mask.any():
        raise ValueError(f"flicker wants three frames and a pixel, found {len(frames)} and {int(mask.sum())}")
    return float(second_difference(frames[:, mask].astype(np.float32)).mean())


def blurred(frames: np.ndarray, mask: np.ndarray, sigma_px: float) -> np.ndarray:
    """Frames [T, H, W, 3] blurred inside a mask [H, W]: what lies outside counts nothing. float32."""
    weight = mask.astype(np.float32)
    total = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma_px), 1e-6)[..., None]
    inside = frames.astype(np.float32) * weight[..., None]
    return np.stack([cv2.GaussianBlur(frame, (0, 0), sigma_px) / total for frame in inside])


def stillest(points: np.ndarray, valid: np.ndarray, test: Sequence[int], time_s: Sequence[float], count: int) -> Stretch | None:
    """The `count` consecutive test frames whose landmarks lie nearest to their mean; None where there are not LEAST_FRAMES.

    Args:
        points: [T, 478, 2 or 3] px.
        valid: [T] bool, face found and tracked.
        test: test frames in order.
        time_s: [T] time of each frame.
        count: frames of the stretch; fewer where no run of valid frames is as long.
    """
    longest_s = LONGEST_GAP * float(np.median(np.diff(time_s)))
    runs: list[list[int]] = [[]]
    for frame in test:
        follows = runs[-1] and frame == runs[-1][-1] + 1 and time_s[frame] - time_s[frame - 1] <= longest_s
        if not valid[frame]:
            runs.append([])
        elif follows or not runs[-1]:
            runs[-1].append(frame)
        else:
            runs.append([frame])
    count = min(count, max(map(len, runs)))
    if count < LEAST_FRAMES:
        return None
    best = None
    for run in runs:
        for start in range(len(run) - count + 1):
            window = points[run[start] : run[start] + count, :HULL_POINTS, :2].astype(np.float64)
            rms = float(np.sqrt(np.square(window - window.mean(0)).sum(-1).mean()))
            if best is None or rms < best.rms_px:
                best = Stretch(run, run[start : start + count], rms)
    return best


def shrunk(picture: np.ndarray, size: tuple[int, int], scale: float) -> np.ndarray:
    """A frame [H, W, C] or matte [H, W] on the grid of a camera resized by `scale` to `size`: means of pixels."""
    if scale == 1:
        return picture
    rows, columns = (round(side / scale) for side in size)
    return cv2.resize(np.ascontiguousarray(picture[:rows, :columns]), size[::-1], interpolation=cv2.INTER_AREA)


def reading(measured: dict[str, float]) -> str:
    """What the coarse flicker of video, tracked and smoothed render says, in one sentence."""
    video, tracked, left = (measured[name] for name in (VIDEO, TRACKED, SMOOTHED))
    if tracked <= video:
        part = 100 * (1 - left / tracked) if tracked else 0
        beside = f"({tracked:.2f} and {video:.2f} levels)"
        return f"The render flickers no more than the video {beside}; smoothing takes away {part:.0f} % of it."
    share = (tracked - left) / (tracked - video)
    what = f"Smoothing takes away {100 * share:.0f} % of what the render flickers beyond the video"
    what += f" ({tracked:.2f} and {video:.2f} levels)"
    if share >= 0.5:
        return f"{what}: it comes from the fit's noise from frame to frame."
    return f"{what}: most of it is slower than that, and not the fit's noise from frame to frame."


def landmarks_px(studio: Studio, motion: Motion, placed: np.ndarray) -> np.ndarray:
    """The head model's landmarks of a mask [478] through the frames' own camera: [T, L, 2] px."""
    scene = studio.scene(motion)
    points = studio.head.landmarks(scene.vertices_m).double().numpy()
    return np.stack([scene.pixels_of(frame, points[frame, placed]) for frame in range(len(motion))])


def scores(truth: np.ndarray, render: np.ndarray, network: lpips.Lpips, device: str) -> dict[str, float]:
    """Mean PSNR and LPIPS of renders [T, H, W, 3] uint8 against pictures [T, H, W, 3] in [0, 1]."""
    found: dict[str, list[float]] = {"psnr": [], "lpips": []}
    for filmed, made in zip(truth, render, strict=True):
        pair = [torch.from_numpy(image).to(device).permute(2, 0, 1)[None] for image in (made.astype(np.float32) / 255, filmed)]
        found["psnr"].append(metrics.psnr(*pair).item())
        found["lpips"].append(network(*pair).item())
    return {name: round(float(np.mean(values)), 4) for name, values in found.items()}


def chosen_stretch(job: step.Job, studio: Studio) -> tuple[Stretch, np.ndarray]:
    """The stretch and all landmarks [T, 478, 2]; StepError where no test frames follow each other."""
    with np.load(job.input.landmarks, allow_pickle=False) as file:
        points, valid = file["points"][..., :2], file["found"] & studio.track["usable"]
    time_s = step.read_json(job.input.index)["time_s"]
    found = stillest(points, valid, studio.split["test"], time_s, job.config.frames)
    if found is None:
        what = f"{job.subject} has no {LEAST_FRAMES} consecutive test frames with a tracked face"
        raise step.StepError(f"{job.input.track}: {what}; use a longer video in which the face is seen at the end")
    return found, points


def measured(shown: dict[str, np.ndarray], mask: np.ndarray, coarse_px: float) -> dict[str, dict[str, float]]:
    """Both measures of the video and of each render: name -> [T, H, W, 3] uint8."""
    coarse = {name: blurred(content, mask, coarse_px) for name, content in shown.items()}
    return {
        "flicker": {name: round(flicker(content, mask), 4) for name, content in shown.items()},
        "flicker_coarse": {name: round(flicker(content, mask), 4) for name, content in coarse.items()},
    }


def run(job: step.Job) -> None:
    """Choose the stretch, render it twice, measure, and show the three beside each other."""
    studio = open_studio(job)
    try:
        network = lpips.load(job.input.lpips, job.device)
    except ValueError as error:
        raise step.StepError(f"{error}; delete it and run snakemake again to fetch it") from None
    found, points = chosen_stretch(job, studio)
    places = [frame - found.run[0] for frame in found.frames]
    whole = studio.motion(found.run)
    motions = {TRACKED: whole.take(places), SMOOTHED: smoothed(whole, job.config.smooth_s).take(places)}
    camera = studio.camera.resized(job.config.size)
    scale = min(1.0, job.config.size / max(studio.camera.size))
    pictures = {
        name: list(studio.render(job, studio.scene(motion, camera), range(len(places)), camera.size))
        for name, motion in motions.items()
    }
    frames, alpha = (
        np.stack([shrunk(array[frame], camera.size, scale) for frame in found.frames])
        for array in (np.load(job.input.frames, mmap_mode="r"), np.load(job.input.alpha, mmap_mode="r"))
    )
    images = {name: np.stack([picture.image for picture in several]) for name, several in pictures.items()}
    mask = (alpha > 127).all(0) & np.logical_and(*((image[..., 3] > 127).all(0) for image in images.values()))
    if not mask.any():
        raise step.StepError(f"{job.input.avatar}: its renders and the head of {job.subject} do not overlap; train it again")
    renders = {name: image[..., :3] for name, image in images.items()}
    figures = measured({VIDEO: frames} | renders, mask, COARSE * max(camera.size))
    truth = on_white(frames, alpha)
    placed = (studio.head.landmark_triangles >= 0).numpy()
    paths = {VIDEO: points[found.frames][:, placed]} | {
        name: landmarks_px(studio, motion, placed) for name, motion in motions.items()
    }
    content = {
        "frames": found.frames,
        "fps": studio.fps,
        "landmark_rms_px": round(found.rms_px, 3),
        "smooth_s": job.config.smooth_s,
        "pixels": int(mask.sum()),
        **figures,
        "jitter_px": {name: round(float(second_difference(path).mean()), 4) for name, path in paths.items()},
        "scores": {name: scores(truth, render, network, job.device) for name, render in renders.items()},
        "reading": reading(figures["flicker_coarse"]),
        "meaning": MEANING,
    }
    job.write_json(job.output.report, content | studio.report([picture for several in pictures.values() for picture in several]))
    filmed = (truth * 255 + 0.5).astype(np.uint8)
    rows = (np.concatenate(row, 1) for row in zip(filmed, *renders.values(), strict=True))
    write_video(job.output.video, rows, max(studio.fps, 1.0), studio.comment)
    job.log.info("%s", content["reading"])


if __name__ == "__main__":
    step.main(run, FlickerConfig)
