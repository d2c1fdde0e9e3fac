"""A toy head with landmarks, and made sequences with known truth: detected landmarks, pictures, mattes."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import torch

from fitting import camera, raster, settings
from fitting.energy import Camera
from fitting.head_model import HeadModel
from fitting.landmark_model import IRIS_RINGS, LID_PAIRS, LandmarkModel
from fitting.observed import Observed
from fitting.rig import GAZE, POSE, Pose, Posed, Rig, posed
from fitting.state import State
from tests.toy_head import toy_head

CENTRE_PX = np.array([128.0, 120.0])
SIZE = (240, 256)
WEIGHTS = settings.WEIGHTS
FOCAL_PX, DEPTH_M = 420.0, 0.6
LENS = Camera(FOCAL_PX, CENTRE_PX)
EYE_X, EYE_Y = 0.03, -0.012


def _places() -> dict[int, tuple[float, float]]:
    """Where the landmarks of the eyes lie (x, y; m), seen from the front."""
    places = {33: (-0.05, EYE_Y), 133: (-0.014, EYE_Y), 263: (0.05, EYE_Y), 362: (0.014, EYE_Y)}
    for side, (ring, pairs) in zip((1, -1), zip(IRIS_RINGS, LID_PAIRS, strict=True), strict=True):
        for k, landmark in enumerate(ring):
            angle = k * np.pi / 2
            away = 0.0 if k == 0 else 0.004
            places[landmark] = (side * EYE_X + away * np.cos(angle), EYE_Y + away * np.sin(angle))
        for k, (upper, lower) in enumerate(pairs):
            x = side * (EYE_X + 0.007 * (k - 1))
            places[upper], places[lower] = (x, EYE_Y - 0.005), (x, EYE_Y + 0.005)
    return places


def landmarked_head(seed: int = 0, expressions: int = 3, shapes: int = 4) -> HeadModel:
    """The toy head with all 478 points on its front; the vertices around a pupil hang from the eye's joint."""
    head = toy_head(rows=24, columns=32, expressions=expressions, shapes=shapes)
    random = np.random.default_rng(seed)
    triangles, template = head.triangles.numpy(), head.template.numpy().astype(np.float64)
    front = np.flatnonzero((template[triangles][..., 2] < -0.02).all(1))
    chosen, weight = random.choice(front, 478), random.dirichlet([2, 2, 2], 478)
    for landmark, place in _places().items():
        chosen[landmark], weight[landmark] = _under(template[triangles[front]], front, np.array(place))
    skin = head.skinning_weights.clone()
    for ring, joint in zip(IRIS_RINGS, (3, 4), strict=True):
        skin[triangles[chosen[ring[0]]]] = torch.eye(5)[joint]
    return dataclasses.replace(
        head,
        skinning_weights=skin,
        landmark_triangles=torch.from_numpy(chosen),
        landmark_barycentric=torch.from_numpy(weight.astype(np.float32)),
        digest="",
    )


def _under(corners: np.ndarray, numbers: np.ndarray, place: np.ndarray) -> tuple[int, np.ndarray]:
    """Triangle and barycentric place that a ray along z through `place` meets."""
    first, second, third = corners[:, 0, :2], corners[:, 1, :2], corners[:, 2, :2]
    matrix = np.stack([second - first, third - first], -1)
    inside = np.linalg.solve(matrix, (place - first)[..., None])[..., 0]
    weights = np.column_stack([1 - inside.sum(1), inside])
    best = weights.min(1).argmax()
    return numbers[best], np.clip(weights[best], 0, 1) / np.clip(weights[best], 0, 1).sum()


def statistical_head(seed: int = 3) -> HeadModel:
    """A small head with everything that FLAME has: correctives, joints that move with shape and expression, open ranges."""
    head = landmarked_head()
    random = np.random.default_rng(seed)
    count, shapes, expressions = head.vertex_count, len(head.shape_basis), len(head.expression_basis)
    draw = lambda *size, amount: torch.from_numpy(amount * random.normal(size=size)).float()  # noqa: E731
    return dataclasses.replace(
        head,
        pose_basis=draw(36, count, 3, amount=0.002),
        joint_shape_basis=draw(shapes, 5, 3, amount=0.002),
        joint_expression_basis=draw(expressions, 5, 3, amount=0.001),
        skinning_weights=torch.from_numpy(random.dirichlet([0.4] * 5, count)).float(),
        expression_low=torch.full((expressions,), -torch.inf),
        expression_high=torch.full((expressions,), torch.inf),
    )


def model_of(head: HeadModel) -> tuple[Rig, LandmarkModel]:
    """What the fit makes of a head model."""
    rig = Rig(head)
    return rig, LandmarkModel.of(rig, head.landmark_triangles.numpy(), head.landmark_barycentric.numpy())


def random_state(model: LandmarkModel, frames: int, seed: int = 1, amount: float = 1.0, yaw: float = 0.45) -> State:
    """A plausible state: head 0.6 m away, turning, expressions inside their range."""
    random = np.random.default_rng(seed)
    time = np.arange(frames)
    angle = amount * np.stack([0.15 * np.sin(time / 7), yaw * np.sin(time / 11), 0.05 * np.cos(time / 5)], 1)
    phase = random.uniform(0, 6, len(model.low))
    return State(
        camera.exp_rotation(angle),
        np.array([0.01, -0.01, DEPTH_M]) + 0.01 * random.normal(size=(1, 3)) + 0.01 * np.sin(time / 9)[:, None],
        0.5 + 0.35 * np.sin(time[:, None] / 6 + phase),
        0.1 * np.sin(time[:, None] / 8 + np.array([0, 1, 0, 1])) * amount,
        amount * np.stack([0.06 + 0.05 * np.sin(time / 4), 0 * time, 0 * time], 1),
        float(np.log(FOCAL_PX)),
        random.normal(size=model.surface.shape_basis.shape[2]),
        np.zeros_like(model.surface.base),
    )


def points_of(model: LandmarkModel, state: State) -> np.ndarray:
    """The landmarks in camera axes [T, L, 3] m."""
    surface = state.fold(model).surface
    return np.stack([posed(surface, state.pose(k)).points for k in range(len(state))])


def detected(model: LandmarkModel, state: State, noise_px: float, seed: int = 2) -> Observed:
    """What a detector with that noise would report of a state, eyes open, the blendshape scores all 0.5."""
    random = np.random.default_rng(seed)
    points = points_of(model, state)
    pixel = camera.project(points, state.focal_px, CENTRE_PX)
    pixel = pixel + noise_px * random.normal(size=pixel.shape)
    corners = [model.surface.base[np.flatnonzero(model.ids == number)[0]] for number in (33, 263)]
    scale = state.focal_px * np.linalg.norm(corners[0] - corners[1]) / state.translation[:, 2]
    frames = len(pixel)
    return Observed(
        pixel,
        np.ones(frames, bool),
        scale,
        np.full(state.expression.shape, 0.5),
        np.ones(pixel.shape[:2], bool),
        np.ones((frames, 2)),
        CENTRE_PX,
    )


def picture(
    rig: Rig,
    state: State,
    k: int,
    colour: np.ndarray | None = None,
    background: tuple[int, int, int] = (40, 70, 160),
    supersample: int = 3,
) -> tuple[np.ndarray, np.ndarray]:
    """One frame [H, W, 3] uint8 and its matte [H, W] uint8: the mesh with colours [V, 3] (0 to 255) on its vertices, unlit."""
    lens = Camera(state.focal_px * supersample, CENTRE_PX * supersample)
    points = posed(rig.vertices().folded(state.shape), state.pose(k)).points
    shape = (SIZE[0] * supersample, SIZE[1] * supersample)
    index, _, barycentric = raster.rasterise(raster.project(points, lens.focal_px, lens.centre_px), rig.triangles, shape)
    paint = texture(rig) if colour is None else colour
    image = np.full((*shape, 3), background, np.float32)
    seen = index >= 0
    image[seen] = np.einsum("nk,nkc->nc", barycentric[seen], paint[rig.triangles[index[seen]]].astype(np.float32))
    small = cv2.resize(image, SIZE[::-1], interpolation=cv2.INTER_AREA)
    alpha = cv2.resize(seen.astype(np.float32) * 255, SIZE[::-1], interpolation=cv2.INTER_AREA)
    return small.round().astype(np.uint8), alpha.round().astype(np.uint8)


def texture(rig: Rig) -> np.ndarray:
    """A skin-coloured pattern [V, 3] that belongs to the surface."""
    waves = np.sin(rig.template @ np.array([[130.0, 60, -90], [-70, 150, 80], [90, 70, 110]]) + [0.3, 1.1, 2.0]).sum(1)
    return np.array([165, 120, 100]) * (1 + 0.12 * waves[:, None])


def differences(function, pose: Pose, step: float = 1e-6) -> np.ndarray:
    """Central differences [..., d] of function(pose) with respect to one frame's unknowns."""
    size = POSE + len(pose.expression) + GAZE + 3
    columns = []
    for unknown in range(size):
        away = np.zeros(size)
        away[unknown] = step
        columns.append((np.asarray(function(pose.moved(away))) - np.asarray(function(pose.moved(-away)))) / (2 * step))
    return np.stack(columns, -1)


def all_columns(at: Posed) -> tuple[np.ndarray, np.ndarray]:
    """Covectors and rows that read every coordinate of every point: the Jacobian of the points themselves."""
    count = len(at.points)
    return np.tile(np.eye(3), (count, 1)), np.repeat(np.arange(count), 3)


def random_pose(expressions: int, seed: int = 0, spread: float = 0.3) -> Pose:
    """A pose half a metre away with every unknown away from zero."""
    random = np.random.default_rng(seed)
    return Pose(
        camera.exp_rotation(random.normal(0, spread, 3)),
        np.array([0.02, -0.03, 0.55]),
        random.uniform(0.1, 0.8, expressions),
        random.normal(0, 0.15, 4),
        random.normal(0, 0.2, 3),
    )


def degrees_apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle between rotations."""
    return np.degrees(np.linalg.norm(camera.log_rotation(first @ second.swapaxes(-1, -2)), axis=-1))
