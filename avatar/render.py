"""render: the test frames of an avatar, composited on white, and a video beside the input."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import torch

from avatar import build
from avatar.config import RenderConfig
from avatar.dataset import Scene, on_white
from avatar.frames import chosen_frames
from avatar.networks import best_precision
from avatar.provenance import synthetic_comment
from fitting.files import load_head
from fitting.video import write_video
from workflow import step

COUNTED = (
    "all work of a frame never seen before: head model, networks, geometry, drawing, in PyTorch's types (`play` is faster); "
    "loading the avatar, reading and writing files are left out"
)


def load(job: step.Job) -> tuple[torch.nn.Module, Scene, list[int]]:
    """The avatar, the posed scene and the frames to render; StepError names what does not fit together."""
    head = load_head(job.input.head)
    try:
        avatar = build.restore(torch.load(job.input.avatar, map_location=job.device, weights_only=True), head)
    except (ValueError, RuntimeError, KeyError) as error:
        raise step.StepError(f"{job.input.avatar}: {error}; train the avatar again") from error
    avatar.sharpen(job.config.sample_factor)
    frames = chosen_frames(step.read_json(job.input.split)["test"], job.config.max_frames)
    if not frames:
        raise step.StepError(f"{job.input.split}: there is no test frame; use a longer clip")
    try:
        return avatar.to(job.device), Scene(head, track_of(job), frames), frames
    except ValueError as error:
        raise step.StepError(f"{job.input.track}: {error}; fit the clip again") from error


def track_of(job: step.Job) -> dict[str, np.ndarray]:
    """Arrays of the job's track."""
    with np.load(job.input.track, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def render_frame(
    avatar: torch.nn.Module, scene: Scene, frame: int, size: tuple[int, int], precision: torch.dtype, device: str
) -> tuple[np.ndarray, int]:
    """One image [H, W, 4] uint8 (RGB on white, A opacity) and the number of field evaluations."""
    posed = avatar.pose(*scene.heads([frame], device))
    rendered, evaluations = avatar.picture(posed, scene.view(frame, size), precision)
    image = torch.cat([rendered.colour, rendered.opacity[:, None]], 1).clamp(0, 1)
    if not torch.isfinite(image).all():
        raise step.StepError(f"the render of frame {frame} is not finite; train the avatar again")
    return (image * 255 + 0.5).byte().numpy().reshape(*size, 4), evaluations


def side_by_side(frames: np.ndarray, alpha: np.ndarray, rendered: np.ndarray, chosen: list[int]) -> Iterator[np.ndarray]:
    """Input on white beside its render, [H, 2 W, 3] uint8 each."""
    for place, frame in enumerate(chosen):
        yield np.concatenate([(on_white(frames[frame], alpha[frame]) * 255 + 0.5).astype(np.uint8), rendered[place, ..., :3]], 1)


def run(job: step.Job) -> None:
    """Inputs head avatar frames index track alpha split; outputs render report video."""
    avatar, scene, chosen = load(job)
    track = track_of(job)
    frames, alpha = np.load(job.input.frames, mmap_mode="r"), np.load(job.input.alpha, mmap_mode="r")
    size, precision = frames.shape[1:3], best_precision(job.device)
    rendered = np.empty((len(chosen), *size, 4), np.uint8)
    milliseconds, evaluations = [], 0
    render_frame(avatar, scene, chosen[0], (8, 8), precision, job.device)  # compile and allocate before the clock runs
    for place, frame in enumerate(job.progress(chosen, "rendering")):
        started = time.perf_counter()
        alone = Scene(scene.head, track, [frame])  # posed anew, within the clock: a frame never seen costs the head model too
        rendered[place], count = render_frame(avatar, alone, frame, size, precision, job.device)
        milliseconds.append(1000 * (time.perf_counter() - started))
        evaluations += count
    with open(job.output.render, "wb") as file:
        np.save(file, rendered)
    covered = int((rendered[..., 3] > 0).sum())
    job.write_json(
        job.output.report,
        {
            "frames": chosen,
            "ms_per_frame": round(float(np.median(milliseconds)), 1),
            "ms": [round(value, 1) for value in milliseconds],
            "ms_counts": COUNTED,
            "size": list(size),
            "precision": str(getattr(avatar, "precision", precision)).split(".")[1],
            "evaluations_per_frame": evaluations // len(chosen),
            "evaluations_per_ray": round(evaluations / (len(chosen) * size[0] * size[1]), 3),
            "evaluations_per_covered_ray": round(evaluations / max(covered, 1), 3),
        },
    )
    fps = float(step.read_json(job.input.index)["fps"])
    shown = fps * len(chosen) / max(len(step.read_json(job.input.split)["test"]), 1)  # frames left out must not speed it up
    comment = synthetic_comment(job.input.avatar)
    write_video(job.output.video, side_by_side(frames, alpha, rendered, chosen), max(shown, 1.0), comment)


if __name__ == "__main__":
    step.main(run, RenderConfig)
