"""How far a fitted track lies from a simulated truth, in the units a user sees: millimetres, degrees, per cent.

Fitted and true head have the same topology but not the same neutral frame, so rotations are compared by aligning the parts
that do not move (skull and upper face), and one constant offset a clip can be taken out.  T frames, V vertices.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from fitting.correspondence import LEFT_IRIS, RIGHT_IRIS
from fitting.head_model import REGIONS, HeadModel
from fitting.landmark_model import LID_PAIRS

CORNERS = ((362, 263), (33, 133))  # of the left and right eye, towards the subject's left
MAX_LAG_FRAMES = 5
POSE_NAMES = ("shape", "rotation", "neck", "translation", "expression")
TRACK_NAMES = ("expression", "rotation", "neck", "jaw", "eyes", "translation")


@dataclass(frozen=True)
class Errors:
    """Per-frame arrays [T] by name (with units in the names), and one number a clip by name."""

    frames: dict[str, np.ndarray]
    clip: dict[str, float]

    def summary(self) -> dict[str, dict[str, float] | float]:
        """Median and 95th percentile of every per-frame array, and the numbers of the clip."""
        part = lambda values, q: round(float(np.nanpercentile(values, q)), 4) if np.isfinite(values).any() else float("nan")  # noqa: E731
        out = {name: {"p50": part(values, 50), "p95": part(values, 95)} for name, values in self.frames.items()}
        return out | {name: round(float(value), 4) for name, value in self.clip.items()}


def compare(
    head: HeadModel,
    track: Mapping[str, np.ndarray],
    truth: Mapping[str, np.ndarray],
    focal_scale: float = 1.0,
    rows: np.ndarray | None = None,
) -> Errors:
    """Compare a fit with the truth.

    Args:
        head: the model that was fitted; track: as track.npz; truth: as `synthetic.Clip.arrays`.
        focal_scale: pixels of the fitted picture a source pixel (frames.json's scale).
        rows: source frame number of each row of the track; None: all, in order.

    Returns:
        `face_mm`, `skull_mm`, `neck_mm`: mean vertex distance after one factor a clip on all coordinates (`scale`), which is the
        scale that a camera cannot see; `*_raw_mm` without it.  A wrong focal length moves the head in depth without making it
        larger, which no such factor undoes: see `depth_percent`, and `face_alone_mm`, where every frame's pose and one size a
        clip (`size`) are taken out too.

    Raises:
        ValueError: the topology or the number of frames differs.
    """
    true = _true_vertices(head, track, truth, rows)
    fitted, neutral = posed(head, track)
    true_neutral = np.asarray(truth["neutral_vertices"], np.float64)
    face, skull, neck, rigid = _parts(head)
    scale = float((fitted[:, face] * true[:, face]).sum() / (fitted[:, face] ** 2).sum())
    millimetres = lambda part, factor: 1e3 * np.linalg.norm(factor * fitted[:, part] - true[:, part], axis=-1).mean(1)  # noqa: E731
    alone, size = _alone(fitted[:, face], true[:, face])
    turn = _turns(fitted[:, rigid], true[:, rigid])
    with torch.no_grad():
        pose = head.rigid(*(_tensor(track[name]) for name in POSE_NAMES))[0].numpy()
    in_head = np.einsum("tji,tjk,tkl->til", pose, turn, pose)  # constant if only the neutral frames differ
    constant = _nearest_rotation(in_head.mean(0))
    frames = {
        "face_mm": millimetres(face, scale),
        "skull_mm": millimetres(skull, scale),
        "neck_mm": millimetres(neck, scale),
        "face_raw_mm": millimetres(face, 1.0),
        "skull_raw_mm": millimetres(skull, 1.0),
        "neck_raw_mm": millimetres(neck, 1.0),
        "face_alone_mm": alone,
        "depth_percent": 100 * (fitted[:, face, 2].mean(1) / true[:, face, 2].mean(1) - 1),
        "rotation_deg": _angle(turn),
        "rotation_less_constant_deg": _angle(in_head @ constant.T),
        "expression_mm": _expression(fitted * size, neutral * size, true, true_neutral, face, rigid),
        "jitter_fit_mm": _jitter(fitted[:, face]),
        "jitter_true_mm": _jitter(true[:, face]),
    }
    clip = {
        "scale": scale,
        "size": size,
        "constant_rotation_deg": float(_angle(constant[None])[0]),
        "focal_percent": 100 * (float(track["focal_px"]) / (focal_scale * float(truth["focal_px"])) - 1),
    }
    _eyes(head, fitted * size, true, frames, clip)
    return Errors(frames, clip)


def _true_vertices(
    head: HeadModel, track: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray], rows: np.ndarray | None
) -> np.ndarray:
    """True vertices [T, V, 3] m of the track's frames; ValueError where they cannot be of one clip and topology."""
    true = np.asarray(truth["vertices"], np.float64)
    true = true if rows is None else true[rows]
    if true.shape[1] != head.vertex_count or len(true) != len(track["rotation"]):
        raise ValueError(
            f"the truth has {true.shape[0]} frames of {true.shape[1]} vertices, "
            f"the fit {len(track['rotation'])} of {head.vertex_count}"
        )
    return true


def posed(head: HeadModel, track: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Fitted vertices [T, V, 3] m in camera axes and neutral vertices [V, 3] of a track."""
    shape = _tensor(track["shape"])
    with torch.no_grad():
        blocks = [
            head.forward(shape, *(_tensor(track[name][start : start + 64]) for name in TRACK_NAMES)).numpy()
            for start in range(0, len(track["rotation"]), 64)
        ]
        return np.concatenate(blocks).astype(np.float64), head.shaped(shape).numpy().astype(np.float64)


def _parts(head: HeadModel) -> tuple[np.ndarray, ...]:
    """Vertex numbers of the face, of skull with ears, of the neck, and of what expressions and the neck joint leave alone."""
    region, template = head.region.numpy(), head.template.numpy()
    number = lambda *names: np.isin(region, [REGIONS.index(name) for name in names])  # noqa: E731
    face, skull, neck = number("face"), number("scalp", "ears"), number("neck")
    on_head = head.skinning_weights.numpy()[:, 1] > 0.99
    still = np.linalg.norm(head.expression_basis.numpy(), axis=-1).max(0) < 5e-4
    eye_height = head.joints.numpy()[3:, 1].mean()
    rigid = (skull | (face & (template[:, 1] < eye_height + 0.01))) & on_head & still
    if rigid.sum() < 3:  # a toy without a skull
        rigid = (face | skull) & on_head
    return tuple(np.flatnonzero(part) for part in (face, skull, neck, rigid))


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Rotations nearest to matrices [..., 3, 3]."""
    u, _, v = np.linalg.svd(matrix)
    sign = np.sign(np.linalg.det(u @ v))
    u[..., -1] *= sign[..., None]
    return u @ v


def _turns(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Rotations [T, 3, 3] that lay source [T, N, 3] best onto target [T or 1, N, 3]."""
    source, target = source - source.mean(1, keepdims=True), target - target.mean(1, keepdims=True)
    return _nearest_rotation(np.einsum("tni,tnj->tij", np.broadcast_to(target, source.shape), source))


def _alone(fitted: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean distance [T] mm of points [T, N, 3] after the best rigid motion of each frame and one size a clip; that size."""
    fitted, true = fitted - fitted.mean(1, keepdims=True), true - true.mean(1, keepdims=True)
    fitted = np.einsum("tij,tnj->tni", _turns(fitted, true), fitted)
    size = float((fitted * true).sum() / (fitted**2).sum())
    return 1e3 * np.linalg.norm(size * fitted - true, axis=-1).mean(1), size


def _angle(matrix: np.ndarray) -> np.ndarray:
    """Angle [T] in degrees of rotations [T, 3, 3], exact near zero."""
    skew = np.stack([matrix[:, 2, 1] - matrix[:, 1, 2], matrix[:, 0, 2] - matrix[:, 2, 0], matrix[:, 1, 0] - matrix[:, 0, 1]], 1)
    return np.degrees(np.arctan2(np.linalg.norm(skew, axis=1), np.trace(matrix, axis1=1, axis2=2) - 1))


def _in_head(vertices: np.ndarray, neutral: np.ndarray, part: np.ndarray, rigid: np.ndarray) -> np.ndarray:
    """Displacement [T, N, 3] of a part from the neutral head, after the rigid motion of the parts that do not move."""
    turn = _turns(vertices[:, rigid], neutral[None, rigid])
    middle = vertices[:, rigid].mean(1, keepdims=True)
    moved = np.einsum("tij,tnj->tni", turn, vertices[:, part] - middle) + neutral[rigid].mean(0)
    return moved - neutral[part]


def _expression(
    fitted: np.ndarray, neutral: np.ndarray, true: np.ndarray, true_neutral: np.ndarray, face: np.ndarray, rigid: np.ndarray
) -> np.ndarray:
    """Rms distance [T] mm of the face's displacements from either neutral, in the true neutral's axes."""
    axes = _turns(neutral[None, rigid], true_neutral[None, rigid])[0]
    difference = _in_head(fitted, neutral, face, rigid) @ axes.T - _in_head(true, true_neutral, face, rigid)
    return 1e3 * np.sqrt((difference**2).sum(-1).mean(1))


def _jitter(vertices: np.ndarray) -> np.ndarray:
    """Rms second difference [T] mm; NaN in the first and the last frame."""
    out = np.full(len(vertices), np.nan)
    if len(vertices) > 2:
        out[1:-1] = 1e3 * np.sqrt((np.diff(vertices, 2, axis=0) ** 2).sum(-1).mean(1))
    return out


def aperture(head: HeadModel, vertices: np.ndarray) -> np.ndarray:
    """Opening of the lids [T, 2] m (left, right): how far the upper lid's landmarks lie above the lower's, negative if below.

    Above is along the eye's own vertical: across the line of its corners and the way the eyeball faces.  NaN where a landmark
    has no place or the head no eyeballs.
    """
    points, weight = _landmarks(head, vertices), head.skinning_weights.numpy()
    out = []
    for joint, (first, second), pairs in zip((3, 4), CORNERS, LID_PAIRS, strict=True):
        ball = weight[:, joint] > 0.5
        middle = vertices[:, ball].mean(1) if ball.any() else np.nan
        up = np.cross((points[:, first] + points[:, second]) / 2 - middle, points[:, second] - points[:, first])
        up /= np.linalg.norm(up, axis=-1, keepdims=True)
        out.append(np.mean([((points[:, upper] - points[:, lower]) * up).sum(-1) for upper, lower in pairs], 0))
    return np.stack(out, 1)


def gaze(head: HeadModel, vertices: np.ndarray) -> np.ndarray:
    """Unit gaze directions [T, 2, 3] (left, right): from the middle of each eyeball through its pupil."""
    points, weight = _landmarks(head, vertices), head.skinning_weights.numpy()
    out = []
    for joint, landmark in ((3, LEFT_IRIS), (4, RIGHT_IRIS)):
        ball = weight[:, joint] > 0.5
        towards = points[:, landmark] - (vertices[:, ball].mean(1) if ball.any() else np.nan)
        out.append(towards / np.linalg.norm(towards, axis=-1, keepdims=True))
    return np.stack(out, 1)


def _eyes(head: HeadModel, fitted: np.ndarray, true: np.ndarray, frames: dict[str, np.ndarray], clip: dict[str, float]) -> None:
    """Lids and gaze; the lag is that of the fit behind the truth (positive: late), NaN for lids that do not move."""
    opening, true_opening = 1e3 * aperture(head, fitted), 1e3 * aperture(head, true)
    frames["aperture_mm"] = np.abs(opening - true_opening).mean(1)
    clip["aperture_rmse_mm"] = float(np.sqrt(((opening - true_opening) ** 2).mean()))
    clip["aperture_lag_frames"] = lag(opening.mean(1), true_opening.mean(1))
    cosine = (gaze(head, fitted) * gaze(head, true)).sum(-1).clip(-1, 1)
    frames["gaze_deg"] = np.degrees(np.arccos(cosine)).mean(1)


def lag(values: np.ndarray, true: np.ndarray, most: int = MAX_LAG_FRAMES) -> float:
    """Delay in frames (with a parabola's fraction) at which a curve [T] correlates best with the true one [T]."""
    if not np.isfinite(values).all() or values.std() < 1e-6 or true.std() < 1e-6 or len(true) < 4 * most:
        return float("nan")
    inner = true[most:-most] - true[most:-most].mean()
    score = []
    for shift in range(-most, most + 1):
        moved = values[most + shift : len(values) - most + shift]
        score.append(float((inner * (moved - moved.mean())).sum() / (moved.std() + 1e-12)))
    best = int(np.argmax(score))
    if best in (0, 2 * most):
        return float(best - most)
    before, at, after = score[best - 1 : best + 2]
    return best - most + 0.5 * (before - after) / (before - 2 * at + after)


def _landmarks(head: HeadModel, vertices: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return head.landmarks(_tensor(vertices)).numpy().astype(np.float64)


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
