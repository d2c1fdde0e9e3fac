"""The detector's habits: how its landmarks slide over the surface with identity, expression and view.

A landmark detector does not see points of a mesh: its cheek point lies elsewhere on a broad face than on a narrow one, and
moves as the head turns.  Taken as fixed points of the mesh, MediaPipe's landmarks are 3.6 mm off (rms) on renders of random
heads, and that error passes for identity and rotation.  Half of it is linear in what the fit solves for, so it is learned where
the truth is known: random heads of the head model itself are rendered, the detector looks at them, and a ridge regression
explains its points.  Renders are plain grey-brown shading: only geometry is learned.

The irises keep their place (a grey render's are no irises), and the slide with expression is regressed too but not kept: on
simulated clips with other paint it left the lids 0.4 mm worse.

Letters: N renders, L = 478 landmarks, D = 1 + S + 2 features (1, identity, view direction across and down).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fitting import camera, raster
from fitting.correspondence import POINTS, RIGHT_IRIS, paint
from fitting.head_model import HeadModel
from fitting.rig import Pose, Rig, posed, view_direction

SIZE_PX, CENTRE_PX, HEAD_PX_PER_M = 512, np.array([256.0, 256.0]), 1800.0
CONSTANT_SD_M, SHAPE_SD_M, EXPRESSION_SD_M, VIEW_SD_M, NOISE_SD_M = 0.003, 0.0003, 0.0005, 0.003, 0.001  # of the ridge
FACING = (0.2, 0.4)  # cosine towards the camera from which a point counts, and over which its weight grows to 1
LEAST_SIGMA_M = 0.0005
HELD_OUT = 8  # every eighth render is kept for the error


@dataclass(frozen=True)
class Habits:
    """What was learned."""

    slide: np.ndarray  # [478, 3, D] m per feature; zero for landmarks without a place
    sigma_m: np.ndarray  # [478] rms of what is left on renders kept out; NaN without a place
    before_mm: float  # median over landmarks of the rms error as fixed points, on renders kept out
    after_mm: float
    renders: int


@dataclass(frozen=True)
class _Seen:
    """One render and what the detector made of it."""

    features: np.ndarray  # [1 + S + E + 2]
    away_m: np.ndarray  # [L', 2] detected minus projected point, in metres at the head's distance
    jacobian: np.ndarray  # [L', 2, 3] of that with respect to the head-frame point
    weight: np.ndarray  # [L']


def learn(head: HeadModel, detect: Callable[[np.ndarray], np.ndarray | None], renders: int, seed: int = 0) -> Habits:
    """Render random heads, detect, regress.

    Args:
        head: with its landmarks placed; detect: uint8 RGB image [H, W, 3] -> points [478, 3] px, or None.

    Raises:
        ValueError: the face is found in fewer than half of the renders.
    """
    random = np.random.default_rng(seed)
    rig = Rig(head)
    triangles = head.landmark_triangles.numpy()
    placed = np.flatnonzero(triangles >= 0)
    points = rig.surface(triangles[placed], head.landmark_barycentric.numpy()[placed].astype(np.float64))
    colour, whole = paint(head), rig.vertices()
    seen = []
    for _ in range(renders):
        shape, pose, focal_px = _random_head(rig, random)
        vertices = posed(whole.folded(shape), pose).points
        tint, background = random.uniform(0.6, 1.15), random.uniform(0.2, 0.9)
        picture, _ = raster.shade(
            vertices, rig.triangles, focal_px, CENTRE_PX, (SIZE_PX, SIZE_PX), np.clip(colour * tint, 0, 1), background
        )
        found = detect(np.ascontiguousarray((picture.clip(0, 1) * 255).astype(np.uint8)))
        if found is None:
            continue
        at = posed(points.folded(shape), pose)
        metre = pose.translation[2] / focal_px
        cosine = -np.einsum("pi,pi->p", points.normal @ pose.rotation.T, at.points) / np.linalg.norm(at.points, axis=1)
        seen.append(
            _Seen(
                np.concatenate([[1.0], shape, pose.expression, view_direction(pose)]),
                (found[placed, :2] - camera.project(at.points, focal_px, CENTRE_PX)) * metre,
                camera.project_jacobian(at.points, focal_px) @ pose.rotation * metre,
                np.clip((cosine - FACING[0]) / FACING[1], 0, 1),
            )
        )
    if len(seen) < renders / 2:
        raise ValueError(f"the detector found the face in {len(seen)} of {renders} renders of the head model; it needs half")
    return _regress(rig, placed, seen)


def _random_head(rig: Rig, random: np.random.Generator) -> tuple[np.ndarray, Pose, float]:
    """Identity [S], pose and focal length of one render: selfie distances, turns up to half a radian, a few actions at once."""
    shape = random.normal(size=rig.shape_basis.shape[2]).clip(-2, 2)
    expression = np.zeros(len(rig.low))
    some = random.choice(len(expression), random.integers(0, min(5, len(expression) + 1)), replace=False)
    bounded = np.isfinite(rig.high)
    expression[some] = np.where(bounded[some], random.uniform(0, 0.9, len(some)), random.normal(size=len(some)))
    jaw = np.array([random.uniform(0, 0.2) * rig.jaw_moves, 0.0, 0.0])
    turn = np.eye(3)
    for axis, most in ((2, 0.15), (0, 0.25), (1, 0.55)):
        turn = turn @ camera.exp_rotation(np.eye(3)[axis] * random.uniform(-most, most))
    place = np.array([random.uniform(-0.03, 0.03), random.uniform(-0.02, 0.03), random.uniform(0.42, 0.8)])
    focal_px = HEAD_PX_PER_M * place[2] * random.uniform(0.85, 1.15)
    return shape, Pose(turn, place, expression, np.zeros(4), jaw), focal_px


def _regress(rig: Rig, placed: np.ndarray, seen: list[_Seen]) -> Habits:
    """Ridge regression a landmark, reweighted once for outliers; error on renders kept out."""
    features = np.stack([one.features for one in seen])
    away, jacobian = np.stack([one.away_m for one in seen]), np.stack([one.jacobian for one in seen])
    weight = np.stack([one.weight for one in seen])
    sizes = (1, rig.shape_basis.shape[2], len(rig.low), 2)
    spread = np.repeat([CONSTANT_SD_M, SHAPE_SD_M, EXPRESSION_SD_M, VIEW_SD_M], sizes)
    precision = np.diag((NOISE_SD_M / np.tile(spread, 3)) ** 2)
    kept = np.arange(len(seen)) % HELD_OUT == 0
    slide = np.zeros((POINTS, 3, features.shape[1]))
    sliding = np.concatenate([np.full(size, kept_part) for size, kept_part in zip(sizes, (True, True, False, True), strict=True)])
    for k, landmark in enumerate(placed):
        columns = np.einsum("nij,nd->nijd", jacobian[~kept, k], features[~kept]).reshape(-1, 3 * features.shape[1])
        target = away[~kept, k].ravel()
        root = np.sqrt(np.repeat(weight[~kept, k], 2))
        for _ in range(2):
            rows = columns * root[:, None]
            solved = np.linalg.solve(rows.T @ rows + precision, rows.T @ (target * root))
            left = np.linalg.norm((columns @ solved - target).reshape(-1, 2), axis=1)
            robust = np.minimum(1.0, 3 * NOISE_SD_M / np.maximum(left, 1e-9))
            root = np.sqrt(np.repeat(weight[~kept, k] * robust, 2))
        slide[landmark] = solved.reshape(3, -1)
    told = np.einsum("nlij,ljd,nd->nli", jacobian[kept], slide[placed], features[kept], optimize=True)
    total = weight[kept].sum(0)
    rms = lambda values: np.sqrt((weight[kept][..., None] * values**2).sum((0, 2)) / total.clip(1e-9))  # noqa: E731
    before, after = rms(away[kept]), np.maximum(rms(away[kept] - told), LEAST_SIGMA_M)
    after[total < 2] = np.nan  # hardly ever seen: the spread by group stays
    sigma = np.full(POINTS, np.nan)
    sigma[placed] = after
    slide[RIGHT_IRIS:], sigma[RIGHT_IRIS:] = 0.0, np.nan
    return Habits(slide[..., sliding], sigma, float(1e3 * np.median(before)), float(1e3 * np.nanmedian(after)), len(seen))
