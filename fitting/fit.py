"""Step: camera and head parameters of every frame, shared unknowns from training frames only.

    python -m fitting.fit --input head=resources/heads/anny.npz frames=... index=... landmarks=... alpha=... split=... \\
        --output track=results/ann/fit/track.npz report=results/ann/fit/fit.json overlay=results/ann/fit/overlay.mp4
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import torch

from fitting import camera, fit_report, settings, tracking
from fitting.config import FitConfig
from fitting.files import load_head
from fitting.head_model import HeadModel
from fitting.landmark_model import LandmarkModel
from fitting.observed import observe
from fitting.overlay import overlay
from fitting.rig import Rig, posed
from fitting.video import write_video
from workflow import step


def run(job: step.Job) -> None:
    """Fit one subject."""
    head = load_head(job.input.head)
    clip = read_clip(job, head)
    try:
        fitted = tracking.fit_clip(clip, job.config, job.progress)
    except tracking.LostFace as error:
        raise step.StepError(f"{job.input.landmarks}: {error}") from error
    calibration = fitted.calibration
    job.log.info(
        "focal %.0f px (relative sd %.3f), largest shape coefficient %.1f",
        fitted.state.focal_px,
        calibration.focal_sd,
        np.abs(fitted.state.shape).max(),
    )
    track = track_arrays(head, clip, fitted)
    np.savez(job.output.track, **track)
    started = time.perf_counter()
    write_video(job.output.overlay, _overlays(job, head, clip, fitted, track), 1 / np.median(np.diff(clip.time_s)))
    fitted.seconds["overlay"] = time.perf_counter() - started
    job.write_json(job.output.report, fit_report.report(head, clip, fitted, job.config))


def read_clip(job: step.Job, head: HeadModel) -> tracking.Clip:
    """Everything the fit reads, from the step's inputs; frames and mattes stay memory-mapped.

    Raises:
        StepError: landmarks and frames do not belong together.
    """
    rig = Rig(head)
    model = landmark_model(rig, head)
    index, split = step.read_json(job.input.index), step.read_json(job.input.split)
    with np.load(job.input.landmarks, allow_pickle=False) as file:
        seen = {name: file[name] for name in ("points", "found", "blendshapes", "blendshape_names")}
    if len(seen["found"]) != len(index["time_s"]):
        raise step.StepError(f"{job.input.landmarks}: {len(seen['found'])} rows for {len(index['time_s'])} frames; delete it")
    source = np.array(index["source_size"][::-1], np.float64)
    centre = (source / 2 - [index["crop"]["x"], index["crop"]["y"]]) * index["scale"]  # of the uncropped picture
    focal = (job.config.focal_px or settings.FOCAL_OF_LONG_SIDE * source.max()) * index["scale"]
    observed = observe(
        model,
        seen["points"],
        seen["found"],
        seen["blendshapes"],
        list(seen["blendshape_names"]),
        head.expression_names,
        centre,
        tuple(index["size"]),
    )
    return tracking.Clip(
        rig,
        model,
        observed,
        np.load(job.input.frames, mmap_mode="r"),
        np.load(job.input.alpha, mmap_mode="r"),
        np.array(index["time_s"]),
        np.array(split["train"], int),
        np.array(split["test"], int),
        float(np.log(focal)),
    )


def landmark_model(rig: Rig, head: HeadModel) -> LandmarkModel:
    """The head model's landmarks with the detector's habits in them."""
    names = ("landmark_triangles", "landmark_barycentric", "landmark_slide", "landmark_sigma")
    return LandmarkModel.of(rig, *(getattr(head, name).numpy() for name in names))


def track_arrays(head: HeadModel, clip: tracking.Clip, fitted: tracking.Fitted) -> dict[str, np.ndarray]:
    """The content of track.npz (design note 3), float32."""
    state = fitted.state
    frames = len(state)
    shape, expression = (torch.from_numpy(values.astype(np.float32)) for values in (state.shape, state.expression))
    root = head.joints_of(shape, expression)[:, 0].numpy().astype(np.float64)
    # The solver turns about the origin, HeadModel about its root joint.
    translation = state.translation + np.einsum("tij,tj->ti", state.rotation, root) - root
    eyes = np.stack([state.pose(k).vectors[1:] for k in range(frames)])
    real = {
        "shape": state.shape,
        "expression": state.expression,
        "rotation": camera.log_rotation(state.rotation),
        "neck": np.zeros((frames, 3)),
        "jaw": state.jaw,
        "eyes": eyes,
        "translation": translation,
        "focal_px": np.array(state.focal_px),
        "centre_px": clip.observed.centre_px,
        "reprojection_px": fitted.error_px,
        "heldout_px": fitted.held_out_px,
        "landmark_bias": state.bias,
    }
    return {name: np.asarray(value, np.float32) for name, value in real.items()} | {
        "reinit": fitted.reinit,
        "usable": fitted.usable,
        "head_digest": np.array(head.digest),
    }


def _overlays(
    job: step.Job, head: HeadModel, clip: tracking.Clip, fitted: tracking.Fitted, track: dict[str, np.ndarray]
) -> Iterator[np.ndarray]:
    """One overlay picture a frame: the mesh posed from what track.npz will say, the landmarks from the solver's own state."""
    as_tensor = lambda values: torch.from_numpy(np.asarray(values, np.float32))  # noqa: E731
    triangles = head.triangles.numpy()
    surface = fitted.state.fold(clip.model).surface
    for row in job.progress(range(len(clip.frames)), "overlay"):
        one = slice(row, row + 1)
        vertices = head.forward(
            as_tensor(track["shape"]),
            *(as_tensor(track[name][one]) for name in ("expression", "rotation", "neck", "jaw", "eyes", "translation")),
        )[0].numpy()
        points = posed(surface, fitted.state.pose(row)).points
        yield overlay(clip.frames[row], vertices, triangles, points, fitted.state.focal_px, clip.observed.centre_px)


if __name__ == "__main__":
    step.main(run, FitConfig)
