"""fit.json: errors, decisions with their reasons, what the clip does not determine, seconds."""

from __future__ import annotations

import numpy as np

from fitting import camera, measures, settings
from fitting.config import FitConfig
from fitting.head_model import HeadModel
from fitting.tracking import Clip, Fitted

NARROW_DEGREES = 40  # a head that turns less than this shows no side


def report(head: HeadModel, clip: Clip, fitted: Fitted, config: FitConfig) -> dict:
    """The content of fit.json."""
    state, usable, calibration = fitted.state, fitted.usable, fitted.calibration
    scale = clip.observed.scale_px
    yaw, pitch = np.degrees(camera.log_rotation(state.rotation[usable])[:, :2].T[::-1])
    held = fitted.held_out_px / scale
    tracked = sum(fitted.seconds.get(name, 0.0) for name in ("track", "pixels", "bundle"))
    return {
        "frames": len(usable),
        "usable": int(usable.sum()),
        "unusable_frames": np.flatnonzero(~usable).tolist(),
        "cuts": np.flatnonzero(fitted.cut).tolist(),
        "reinitialised": np.flatnonzero(fitted.reinit).tolist(),
        "keyframes": calibration.keyframes.tolist(),
        "reprojection_percent_of_interocular": _percentiles((fitted.error_px / scale)[usable]),
        "heldout_percent_of_interocular": _percentiles(held) if np.isfinite(held).any() else None,
        "interocular_px": round(float(np.median(scale[usable])), 2),
        "focal_px": round(state.focal_px, 2),
        "focal_relative_sd": None if np.isinf(calibration.focal_sd) else round(calibration.focal_sd, 4),
        "shape_largest_sigma": round(float(np.abs(state.shape).max()), 3),
        "yaw_degrees": [round(float(yaw.min()), 1), round(float(yaw.max()), 1)],
        "pitch_degrees": [round(float(pitch.min()), 1), round(float(pitch.max()), 1)],
        "jitter": {name: round(value, 4) for name, value in measures.jitter(clip.rig, state, usable).items()},
        "seams": {when: {name: round(value, 4) for name, value in found.items()} for when, found in fitted.seams.items()},
        "expression_spread": _spread(head, state.expression[usable]),
        "decisions": _decisions(head, clip, fitted, config),
        "not_determined": _unknown(clip, fitted, config, yaw),
        "seconds_by_stage": {name: round(value, 2) for name, value in fitted.seconds.items()},
        "landmark_ms_per_frame": round(1e3 * fitted.seconds["track"] / len(usable), 2),
        "track_ms_per_frame": round(1e3 * tracked / len(usable), 2),
    }


def _percentiles(values: np.ndarray) -> dict[str, float]:
    return {f"p{q}": round(float(100 * np.nanpercentile(values, q)), 3) for q in (50, 90, 99)}


def _spread(head: HeadModel, expression: np.ndarray) -> dict[str, float | str]:
    """Standard deviation of the codes over time, mean over dimensions (the paper's supplement C), with their basis."""
    statistical = ~np.isfinite(head.expression_high.numpy())
    out: dict[str, float | str] = {"basis": head.name, "std_mean_over_dimensions": round(float(expression.std(0).mean()), 4)}
    if statistical.any() and not statistical.all():
        out["std_mean_over_statistical_dimensions"] = round(float(expression[:, statistical].std(0).mean()), 4)
    return out


def _decisions(head: HeadModel, clip: Clip, fitted: Fitted, config: FitConfig) -> dict[str, str]:
    """What was freed and what was held, each with its reason."""
    calibration = fitted.calibration
    if config.focal_px is not None:
        focal = "fixed: given in config"
    elif calibration.focal_kept_prior:
        focal = (
            f"fixed at its prior: the clip gives it only to {100 * calibration.focal_sd:.0f} % "
            f"(limit {100 * settings.MAX_FOCAL_SD:.0f} %)"
        )
    else:
        focal = f"free: the clip determines it to {100 * calibration.focal_sd:.1f} %"
    held = [name for name, free in zip(head.expression_names, calibration.actions, strict=True) if not free]
    total = len(calibration.actions)
    expression = f"{total - len(held)} of {total} coefficients free"
    if held:
        expression += f"; held, because the landmarks tell them to no better than their prior does: {', '.join(held)}"
    shut = 100 * float((clip.observed.open_eyes[clip.observed.found] < 0.1).any(1).mean())
    decisions = {
        "focal": focal,
        "principal point": "fixed at the centre of the uncropped picture",
        "neck": "fixed straight: without tracked shoulders it cannot be told from the head's own rotation",
        "jaw joint": "free: this head model opens its mouth with it"
        if clip.rig.jaw_moves
        else "fixed: this head model opens its mouth by actions",
        "gaze": f"free: two angles an eye from the iris centres; held while an eye is shut ({shut:.0f} % of frames)",
        "expression": expression,
    }
    appearance = fitted.pictures.appearance if fitted.pictures is not None else None
    if appearance is None:
        decisions["light"] = "not modelled: the photometric term is off"
    elif appearance.light.any():
        decisions["light"] = f"free: it explains {100 * appearance.explained:.0f} % of the skin's change on keyframes left out"
    else:
        decisions["light"] = (
            f"constant: a directed one explains {100 * appearance.explained:.0f} % of the skin's change on keyframes left out"
        )
    return decisions


def _unknown(clip: Clip, fitted: Fitted, config: FitConfig, yaw: np.ndarray) -> list[str]:
    """What the clip does not determine, in a user's words."""
    unknown = []
    if np.ptp(yaw) < NARROW_DEGREES:
        unknown.append(
            f"the head turns over {np.ptp(yaw):.0f} degrees only: back of the head and views from the side are guesses"
        )
    if fitted.calibration.focal_kept_prior and config.focal_px is None:
        unknown.append("the focal length, hence the distance and the depth of the head")
    unknown.append("the skull under the hair: it is kept a hair's thickness inside the matte and follows the shape prior")
    return unknown
