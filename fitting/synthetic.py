"""Simulated subjects: a head with known parameters, posed over time, to measure what a fit gets wrong.

No inverse crime: the identity comes from a richer basis than the one that is fitted, plus a smooth displacement that no basis
holds; expressions are the model's actions plus bumps that no basis holds; the neck makes a part of each turn; the lens may be
distorted.  `make` poses, `Renderer` (fitting.synthetic_render) draws, `landmark_track` (fitting.synthetic_landmarks) makes
landmarks without pixels, `fitting.synthetic_errors` compares a fit.  T frames, V vertices, S shape, E expression, B bumps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from fitting import camera, synthetic_motion
from fitting.head_model import JOINTS, REGIONS, HeadModel
from fitting.synthetic_errors import aperture

FOCAL_PER_LONG_SIDE = 1.3  # of a phone's front camera
WAVELENGTHS_M = (0.035, 0.09)  # of the displacement that no basis holds
BUMP_RADIUS_M = (0.012, 0.02)
SHAPE_LIMIT = 2.0  # standard deviations


@dataclass(frozen=True)
class Camera:
    """A pinhole with one radial term, in the source video's pixels."""

    focal_px: float
    centre_px: np.ndarray  # [2]
    size: tuple[int, int]  # (H, W)
    k1: float = 0.0

    @staticmethod
    def of(size: tuple[int, int], focal_px: float | None = None, k1: float = 0.0) -> Camera:
        """Camera of a phone: focal length 1.3 x the longer side unless given, principal point at the centre."""
        height, width = size
        focal = FOCAL_PER_LONG_SIDE * max(size) if focal_px is None else focal_px
        return Camera(float(focal), np.array([width / 2, height / 2]), (height, width), k1)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels [..., 2] of camera-space points [..., 3] m; `x (1 + k1 r^2)` on the normalised plane."""
        plane = camera.project(points, 1.0, np.zeros(2))
        return self.focal_px * plane * (1 + self.k1 * (plane**2).sum(-1, keepdims=True)) + self.centre_px


@dataclass(frozen=True)
class Clip:
    """A simulated subject over time; `arrays` is the content of the truth file."""

    head: HeadModel  # the subject's own: displaced template, bumps behind the actions
    shape: np.ndarray  # [S] of the rich basis
    motion: synthetic_motion.Motion
    camera: Camera
    exposure: np.ndarray  # [T] gain
    light: np.ndarray  # [9] spherical harmonics of the irradiance, grey
    neutral: np.ndarray  # [V, 3] m
    vertices: np.ndarray  # [T, V, 3] float32 m, camera axes
    rich_digest: str
    kind: str
    seed: int
    fps: float

    def arrays(self) -> dict[str, np.ndarray]:
        """Truth as plain arrays, conventions of track.npz; focal length and centre in source pixels."""
        action_count = self.motion.expression.shape[1]
        real = {
            "shape": self.shape,
            "expression": self.motion.expression,
            "bumps": self.motion.bumps,
            "rotation": self.motion.rotation,
            "neck": self.motion.neck,
            "jaw": np.zeros_like(self.motion.rotation),
            "eyes": self.motion.eyes,
            "translation": self.motion.translation,
            "focal_px": np.array(self.camera.focal_px),
            "centre_px": self.camera.centre_px,
            "k1": np.array(self.camera.k1),
            "exposure": self.exposure,
            "light": self.light,
            "fps": np.array(self.fps),
            "neutral_vertices": self.neutral,
            "vertices": self.vertices,
        }
        return {name: np.asarray(value, np.float32) for name, value in real.items()} | {
            "expression_names": np.array(self.head.expression_names[:action_count]),
            "size": np.array(self.camera.size, np.int64),
            "head_digest": np.array(self.rich_digest),
            "kind": np.array(self.kind),
            "seed": np.array(self.seed, np.int64),
        }


def make(
    rich: HeadModel,
    kind: str,
    frames: int,
    lens: Camera,
    seed: int = 0,
    fps: float = 30.0,
    distance_m: float = 0.5,
    displacement_m: float = 0.0007,
    bump_m: float = 0.0015,
    bump_count: int = 3,
    exposure_stops: float = 0.0,
) -> Clip:
    """Simulate a subject and a clip of it.

    Args:
        rich: head model with more identity components than the one that will be fitted, same topology.
        kind: one of `synthetic_motion.KINDS`.
        displacement_m: rms over the skin of the displacement that no basis holds; bump_m: height of the expression bumps.
        exposure_stops: slow drift of the exposure, +- this many stops.
    """
    shape = np.random.default_rng([seed, 0]).normal(size=len(rich.shape_basis)).clip(-SHAPE_LIMIT, SHAPE_LIMIT)
    head = _with_bumps(_displaced(rich, displacement_m, seed), bump_m, bump_count, seed)
    motion = synthetic_motion.make(kind, frames, fps, rich.expression_names, bump_count, distance_m, seed)
    motion = replace(motion, expression=_closing_fully(head, shape, motion.expression))
    random = np.random.default_rng([seed, 4])
    drift = gaussian_filter1d(random.normal(size=frames), fps, mode="nearest")
    exposure = 2.0 ** (exposure_stops * np.tanh(drift / (drift.std() + 1e-12)))
    with torch.no_grad():
        neutral = head.shaped(_tensor(shape)).numpy()
    clip = Clip(head, shape, motion, lens, exposure, light(random), neutral, np.zeros((0, 0, 3), np.float32),
                rich.digest, kind, seed, fps)  # fmt: skip
    return replace(clip, vertices=_pose(clip))


def light(random: np.random.Generator) -> np.ndarray:
    """Soft light from the upper front and one side: nine coefficients of the irradiance for `harmonics`."""
    side = random.choice([-1.0, 1.0])
    towards = np.array([0.55 * side, -0.5, -0.75])
    towards /= np.linalg.norm(towards)
    x, y, z = towards
    first = 0.45 * np.array([y, z, x])
    second = 0.10 * np.array([x * y, y * z, 0.5 * (3 * z * z - 1) / np.sqrt(3), x * z, 0.5 * (x * x - y * y)])
    return np.concatenate([[0.60], first, second])


def harmonics(normal: np.ndarray) -> np.ndarray:
    """The nine functions [..., 9] that multiply `light`, of unit normals [..., 3] (plain monomials, no normalising factors)."""
    x, y, z = np.moveaxis(normal, -1, 0)
    second = [x * y, y * z, 0.5 * (3 * z * z - 1) / np.sqrt(3), x * z, 0.5 * (x * x - y * y)]
    return np.stack([np.ones_like(x), y, z, x, *second], -1)


def smooth_field(points: np.ndarray, lengths_m: tuple[float, float], random: np.random.Generator, waves: int = 24) -> np.ndarray:
    """Random smooth vector field [N, 3] at points [N, 3]: a sum of plane waves, wavelengths lengths_m, about unit rms."""
    direction = random.normal(size=(waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    wave = direction * (2 * np.pi / random.uniform(*lengths_m, waves))[:, None]
    phase = random.uniform(0, 2 * np.pi, waves)
    amplitude = random.normal(size=(waves, 3)) * np.sqrt(2 / (3 * waves))
    return np.cos(points @ wave.T + phase) @ amplitude


def _displaced(rich: HeadModel, rms_m: float, seed: int) -> HeadModel:
    """The head with a smooth displacement of its skin; each eyeball and its joint move as one, with the skin around them."""
    template, joints = rich.template.numpy().astype(np.float64), rich.joints.numpy().astype(np.float64)
    places = np.concatenate([template, joints])
    field = smooth_field(places, WAVELENGTHS_M, np.random.default_rng([seed, 2]))
    field, at_joints = field[: len(template)], field[len(template) :]
    region = rich.region.numpy()
    skin = np.isin(region, [REGIONS.index(name) for name in ("face", "scalp", "ears", "neck")])
    scale = rms_m / np.sqrt((field[skin] ** 2).sum(1).mean()) if rms_m > 0 else 0.0
    moved = np.zeros_like(joints)
    for joint in (3, 4):
        moved[joint] = at_joints[joint]
        field[(rich.skinning_weights.numpy()[:, joint] > 0.5) & (region == REGIONS.index("eyeballs"))] = at_joints[joint]
    return replace(rich, template=_tensor(template + scale * field), joints=_tensor(joints + scale * moved))


def _with_bumps(head: HeadModel, height_m: float, count: int, seed: int) -> HeadModel:
    """The head with `count` more expression directions: smooth swellings of the cheeks, lips and brows along the normal."""
    if not count:
        return head
    random = np.random.default_rng([seed, 3])
    template = head.template.numpy().astype(np.float64)
    face = (head.region.numpy() == REGIONS.index("face")) & (template[:, 2] < np.quantile(template[:, 2], 0.4))
    inside = template.mean(0)
    outward = (template - inside) / np.linalg.norm(template - inside, axis=1, keepdims=True).clip(1e-9)
    skin = (head.region.numpy() != REGIONS.index("eyeballs"))[:, None]
    bumps = []
    for centre in template[random.choice(np.flatnonzero(face), count)]:
        radius = random.uniform(*BUMP_RADIUS_M)
        fall = np.exp(-0.5 * ((template - centre) ** 2).sum(1) / radius**2)
        bumps.append(height_m * random.uniform(0.7, 1.3) * fall[:, None] * outward * skin)
    return replace(
        head,
        expression_basis=torch.cat([head.expression_basis, _tensor(np.stack(bumps))]),
        expression_low=torch.cat([head.expression_low, -torch.ones(count)]),
        expression_high=torch.cat([head.expression_high, torch.ones(count)]),
        expression_names=(*head.expression_names, *(f"bump{k}" for k in range(count))),
        joint_expression_basis=torch.cat([head.joint_expression_basis, torch.zeros(count, len(JOINTS), 3)]),
    )


def _closing_fully(head: HeadModel, shape: np.ndarray, expression: np.ndarray) -> np.ndarray:
    """Actions [T, E] whose blinks are scaled so that this subject's lids meet and do not cross, an eye at a time.

    The actions move every identity's lids by the same millimetres: narrow eyes would shut too far.
    """
    out, names = expression.copy(), head.expression_names
    blinking = torch.zeros(2, len(names))
    columns = [names.index(name) if name in names else None for name in synthetic_motion.LIDS]
    for column in columns:
        if column is not None:
            blinking[1, column] = 1.0
    with torch.no_grad():
        open_, shut = aperture(head, head.local(_tensor(shape), blinking, torch.zeros(2, 3)).numpy())
    for eye, column in enumerate(columns):
        if column is not None and shut[eye] < 0 < open_[eye]:  # NaN (no landmarks) compares as False
            out[:, column] *= open_[eye] / (open_[eye] - shut[eye])
    return out


def exaggerated(clip: Clip, factor: float) -> Clip:
    """The clip with every expression `factor` times as strong, bumps included (blinks not: see `synthetic_motion`)."""
    motion, names = clip.motion, clip.head.expression_names[: clip.motion.expression.shape[1]]
    stronger = synthetic_motion.exaggerated(motion.expression, names, factor)
    clip = replace(clip, motion=replace(motion, expression=stronger, bumps=factor * motion.bumps))
    return replace(clip, vertices=_pose(clip))


def _pose(clip: Clip, block: int = 64) -> np.ndarray:
    """Vertices [T, V, 3] float32 m in camera axes, everything included."""
    motion = clip.motion
    everything = np.concatenate([motion.expression, motion.bumps], 1)
    done = []
    with torch.no_grad():
        for start in range(0, len(everything), block):  # bounds memory
            part = slice(start, start + block)
            rows = (everything[part], motion.rotation[part], motion.neck[part], np.zeros_like(motion.neck[part]))
            rows = (*rows, motion.eyes[part], motion.translation[part])
            done.append(clip.head.forward(_tensor(clip.shape), *map(_tensor, rows)).numpy())
    return np.concatenate(done)


def camera_of(truth: Mapping[str, np.ndarray]) -> Camera:
    """The camera of a truth file."""
    size = tuple(int(side) for side in truth["size"])
    return Camera(float(truth["focal_px"]), np.asarray(truth["centre_px"], np.float64), size, float(truth["k1"]))


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
