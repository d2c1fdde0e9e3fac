"""Step: camera and head parameters of every frame, shared unknowns from training frames only.

    python -m fitting.fit --input head=resources/heads/anny.npz frames=... index=... landmarks=... alpha=... split=... \\
        --output track=results/ann/fit/track.npz report=results/ann/fit/fit.json overlay=results/ann/fit/overlay.mp4
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import torch

from fitting import bundle, camera, energy, stages
from fitting.config import FitConfig
from fitting.files import load_head
from fitting.head_model import HeadModel
from fitting.landmark_model import LandmarkModel
from fitting.overlay import overlay
from fitting.video import write_video
from workflow import step

# The solver's constants, chosen on training frames of the shared clips (held-out landmarks, largest shape coefficient).
WEIGHTS = energy.Weights(
    landmark_sigma=0.012,
    robust_sigmas=3.0,
    correlated=8.0,
    expression_sd=0.3,
    action_wall_sd=0.03,
    gaze_sd_rad=np.radians(15),
    vergence_sd_rad=np.radians(2),
    log_focal_sd=0.3,
    shape_sd=1.0,
)
SMOOTHNESS = bundle.Smoothness(
    rotation_rad=np.radians(0.4), across_m=0.0005, depth_m=0.001, expression=0.15, gaze_rad=np.radians(4)
)
SWEEPS = 5
BIAS_SD_M = 0.0015  # what the embedding's own views disagree by
PRIOR_FROM_SCORES = (
    1.0  # centring the expression prior on the blendshape scores: shape within 2 sd instead of 4, same held-out error
)
FOCAL_OF_LONG_SIDE = 1.2  # prior of focal length over the longer source side (45 degrees)
MAX_FOCAL_SD = 0.15
LOST_OF_MEDIAN, LOST_OF_EYES = 4.0, 0.05  # a frame this much worse than the median, and this bad, is lost


def run(job: step.Job) -> None:
    """Fit one subject."""
    head = load_head(job.input.head)
    model = LandmarkModel.of(head)
    index, split = step.read_json(job.input.index), step.read_json(job.input.split)
    observed, log_focal = _observe(job, head, model, index)
    times = {}
    train = np.array(split["train"])
    good = train[observed.found[train]]
    if len(good) < 5:
        raise step.StepError(
            f"{job.input.landmarks}: a face is found in {len(good)} of {len(train)} training frames; at least 5 are needed"
        )
    started = time.perf_counter()
    frames = np.load(job.input.frames, mmap_mode="r")
    sharpness = _sharpness(frames, observed, good)
    blank = stages.neutral(model, 1, log_focal)
    keyframes = stages.choose_keyframes(observed, good, stages.pnp(model, observed, good, blank), sharpness, job.config.keyframes)
    known = job.config.focal_px is not None
    weights = replace(WEIGHTS, log_focal_sd=1e-3) if known else WEIGHTS
    calibration = stages.calibrate(model, observed, keyframes, weights, log_focal, BIAS_SD_M, MAX_FOCAL_SD)
    times["calibrate"] = time.perf_counter() - started
    job.log.info(
        "focal %.0f px (relative sd %.3f), largest shape coefficient %.1f",
        calibration.state.focal_px,
        calibration.focal_sd,
        np.abs(calibration.state.shape).max(),
    )
    started = time.perf_counter()
    state, reinit = _track(job, model, observed, split, calibration.state, float(index["fps"]))
    times["track"] = time.perf_counter() - started
    rows = np.arange(len(observed.found))
    error = stages.reprojection_px(model, observed, rows, state)
    relative = error / observed.scale_px
    median = np.median(relative[good])  # of training frames: the test tail decides nothing
    usable = observed.found & ~((relative > LOST_OF_MEDIAN * median) & (relative > LOST_OF_EYES))
    for part in ("train", "test"):
        if not usable[split[part]].any():
            count = len(split[part])
            raise step.StepError(f"{job.input.landmarks}: the face is lost in all {count} {part} frames; use another clip")
    state = _hold(state, usable)
    started = time.perf_counter()
    checked = np.setdiff1d(rows[usable], keyframes)[:: max(1, usable.sum() // 60)]
    held_out = np.full(len(rows), np.nan)
    held_out[checked] = stages.held_out_px(model, observed, checked, WEIGHTS, state.frame(checked), job.config.iterations)
    times["held_out"] = time.perf_counter() - started
    track = _track_arrays(head, state, observed, error, held_out, reinit, usable)
    np.savez(job.output.track, **track)
    started = time.perf_counter()
    write_video(job.output.overlay, _overlays(job, head, model, state, frames, observed, track), index["fps"])
    times["overlay"] = time.perf_counter() - started
    job.write_json(job.output.report, _report(job, model, calibration, observed, relative, held_out, usable, state, times, known))


def _observe(job: step.Job, head: HeadModel, model: LandmarkModel, index: dict) -> tuple[stages.Observed, float]:
    """Landmarks in the crop's pixels and the logarithm of the focal length to start from."""
    with np.load(job.input.landmarks, allow_pickle=False) as file:
        seen = {name: file[name] for name in ("points", "found", "blendshapes", "blendshape_names")}
    if len(seen["found"]) != len(index["time_s"]):
        raise step.StepError(f"{job.input.landmarks}: {len(seen['found'])} rows for {len(index['time_s'])} frames; delete it")
    source = np.array(index["source_size"][::-1], np.float64)
    centre = (source / 2 - [index["crop"]["x"], index["crop"]["y"]]) * index["scale"]  # of the uncropped picture
    focal = (job.config.focal_px or FOCAL_OF_LONG_SIDE * source.max()) * index["scale"]
    observed = stages.observe(
        model,
        seen["points"],
        seen["found"],
        seen["blendshapes"],
        list(seen["blendshape_names"]),
        head.expression_names,
        centre,
        tuple(index["size"]),
        PRIOR_FROM_SCORES,
    )
    return observed, float(np.log(focal))


def _sharpness(frames: np.ndarray, observed: stages.Observed, rows: np.ndarray) -> np.ndarray:
    """Variance of the Laplacian inside the landmarks' box [T], zero for frames not asked for."""
    out = np.zeros(len(frames))
    for row in rows:
        low = np.clip(observed.points[row].min(0).astype(int), 0, None)
        high = observed.points[row].max(0).astype(int) + 1
        box = cv2.cvtColor(np.ascontiguousarray(frames[row][low[1] : high[1], low[0] : high[0]]), cv2.COLOR_RGB2GRAY)
        out[row] = cv2.Laplacian(cv2.resize(box, (128, 128), interpolation=cv2.INTER_AREA), cv2.CV_32F).var()
    return out


def _track(
    job: step.Job, model: LandmarkModel, observed: stages.Observed, split: dict, shared: energy.State, fps: float
) -> tuple[energy.State, np.ndarray]:
    """All frames in blocks that start afresh, then a bundle that closes the seams; nothing crosses the split."""
    count = len(observed.found)
    reinit = np.zeros(count, bool)
    poses = stages.neutral(model, count, shared.log_focal)
    poses = replace(poses, shape=shared.shape, bias=shared.bias)
    blocks = []
    for part in ("train", "test"):
        rows = np.array(split[part], int)
        blocks += [rows[k : k + job.config.reinit_every] for k in range(0, len(rows), job.config.reinit_every)]
    for rows in job.progress(blocks, "blocks"):
        if not observed.found[rows].any():
            continue
        reinit[rows[0]] = True
        block = stages.track_block(model, observed, rows, WEIGHTS, shared, job.config.iterations)
        for name in ("rotation", "translation", "expression", "gaze"):
            getattr(poses, name)[rows] = getattr(block, name)
    smoothness = SMOOTHNESS.at_rate(fps)
    for part in ("train", "test"):  # no temporal term crosses the split
        rows = np.array(split[part], int)
        seen = rows[observed.found[rows]]
        if not len(seen):
            continue
        nearest = seen[np.abs(rows[:, None] - seen).argmin(1)]  # a block without any face must not pull at its neighbours
        bundled = bundle.smooth(model, observed, rows, WEIGHTS, poses.frame(nearest), smoothness, SWEEPS)
        for name in ("rotation", "translation", "expression", "gaze"):
            getattr(poses, name)[rows] = getattr(bundled, name)
    return poses, reinit


def _hold(state: energy.State, usable: np.ndarray) -> energy.State:
    """Unusable frames take the nearest usable frame's parameters."""
    rows = np.flatnonzero(usable)
    nearest = rows[np.abs(np.arange(len(usable))[:, None] - rows[None]).argmin(1)]
    return state.frame(nearest)


def _track_arrays(
    head: HeadModel,
    state: energy.State,
    observed: stages.Observed,
    error: np.ndarray,
    held_out: np.ndarray,
    reinit: np.ndarray,
    usable: np.ndarray,
) -> dict[str, np.ndarray]:
    """The content of track.npz (design note 3), float32."""
    frames = len(error)
    zeros = np.zeros((frames, 3), np.float32)
    root = head.joints_of(torch.from_numpy(state.shape.astype(np.float32)))[0].numpy().astype(np.float64)
    translation = (
        state.translation + state.rotation @ root - root
    )  # the solver turns about the origin, HeadModel about its root joint
    real = {
        "shape": state.shape,
        "expression": state.expression,
        "rotation": camera.log_rotation(state.rotation),
        "neck": zeros,
        "jaw": zeros,
        "eyes": energy.gaze_vectors(state.gaze),
        "translation": translation,
        "focal_px": np.array(state.focal_px),
        "centre_px": observed.centre_px,
        "reprojection_px": error,
        "heldout_px": held_out,
        "landmark_bias": state.bias,
    }
    return {name: value.astype(np.float32) for name, value in real.items()} | {
        "reinit": reinit,
        "usable": usable,
        "head_digest": np.array(head.digest),
    }


def _overlays(
    job: step.Job,
    head: HeadModel,
    model: LandmarkModel,
    state: energy.State,
    frames: np.ndarray,
    observed: stages.Observed,
    track: dict[str, np.ndarray],
) -> Iterator[np.ndarray]:
    """One overlay picture a frame: the mesh posed from what track.npz will say, the landmarks from the solver's own state."""
    as_tensor = lambda values: torch.from_numpy(np.asarray(values, np.float32))  # noqa: E731
    triangles = head.triangles.numpy()
    for row in job.progress(range(len(frames)), "overlay"):
        one = slice(row, row + 1)
        vertices = head.forward(
            as_tensor(track["shape"]),
            *(as_tensor(track[name][one]) for name in ("expression", "rotation", "neck", "jaw", "eyes", "translation")),
        )[0].numpy()
        points = energy.head_points(model, state.frame(slice(row, row + 1)))[0] @ state.rotation[row].T + state.translation[row]
        yield overlay(frames[row], vertices, triangles, points, state.focal_px, observed.centre_px)


def _report(
    job: step.Job,
    model: LandmarkModel,
    calibration: stages.Calibration,
    observed: stages.Observed,
    relative: np.ndarray,
    held_out: np.ndarray,
    usable: np.ndarray,
    state: energy.State,
    times: dict[str, float],
    focal_known: bool,
) -> dict:
    """fit.json: errors, decisions with reasons, what the clip does not determine, seconds."""
    yaw, pitch = np.degrees(camera.log_rotation(state.rotation[usable])[:, :2].T[::-1])
    held = held_out / observed.scale_px
    percent = lambda values: {f"p{q}": round(float(100 * np.nanpercentile(values, q)), 3) for q in (50, 90, 99)}  # noqa: E731
    if focal_known:
        focal = "fixed: given in config"
    elif calibration.focal_kept_prior:
        focal = (
            f"fixed at its prior: the clip gives it only to {100 * calibration.focal_sd:.0f} % (limit {100 * MAX_FOCAL_SD:.0f} %)"
        )
    else:
        focal = f"free: the clip determines it to {100 * calibration.focal_sd:.1f} %"
    unknown = []
    if np.ptp(yaw) < 40:
        unknown.append(
            f"the head turns over {np.ptp(yaw):.0f} degrees only: ears, back of the head and views from the side are guesses"
        )
    if calibration.focal_kept_prior and not focal_known:
        unknown.append("the focal length, hence the distance and the depth of the head")
    unknown.append("the skull under the hair: landmarks end at the hairline, it follows the shape prior")
    return {
        "frames": len(usable),
        "usable": int(usable.sum()),
        "unusable_frames": np.flatnonzero(~usable).tolist(),
        "keyframes": calibration.keyframes.tolist(),
        "reprojection_percent_of_interocular": percent(relative[usable]),
        "heldout_percent_of_interocular": percent(held) if np.isfinite(held).any() else None,
        "interocular_px": round(float(np.median(observed.scale_px[usable])), 2),
        "focal_px": round(calibration.state.focal_px, 2),
        "focal_relative_sd": None if np.isinf(calibration.focal_sd) else round(calibration.focal_sd, 4),
        "shape_largest_sigma": round(float(np.abs(state.shape).max()), 3),
        "yaw_degrees": [round(float(yaw.min()), 1), round(float(yaw.max()), 1)],
        "pitch_degrees": [round(float(pitch.min()), 1), round(float(pitch.max()), 1)],
        "expression_spread": {
            "basis": "anny actions",
            "std_mean_over_dimensions": round(float(state.expression[usable].std(0).mean()), 4),
        },
        "decisions": {
            "focal": focal,
            "principal point": "fixed at the centre of the uncropped picture",
            "neck": "fixed straight: without tracked shoulders it cannot be told from the head's own rotation",
            "jaw joint": "fixed: this head model opens its jaw by four actions",
            "gaze": "free: two angles an eye from the iris centres",
        },
        "not_determined": unknown,
        "seconds_by_stage": {name: round(value, 2) for name, value in times.items()},
        "track_ms_per_frame": round(1e3 * times["track"] / len(usable), 2),
    }


if __name__ == "__main__":
    step.main(run, FitConfig)
