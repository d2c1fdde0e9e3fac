"""A toy subject: an ellipsoid head with random smooth bases, and a ray caster that draws it with a texture on its surface."""

from __future__ import annotations

import numpy as np
import torch

from fitting.head_model import REGIONS, HeadModel

RADII_M = (0.075, 0.105, 0.09)


def toy_head(rows: int = 14, columns: int = 20, shapes: int = 2, expressions: int = 3, seed: int = 0) -> HeadModel:
    """UV sphere with a seam (first and last column share vertices), outward triangles, an upper 'scalp' and a lower 'neck'."""
    latitude = np.linspace(0, np.pi, rows + 1)
    index = np.zeros((rows + 1, columns), np.int64)
    points, uvs, uv_index = [], [], np.zeros((rows + 1, columns + 1), np.int64)
    for r in range(rows + 1):
        for c in range(columns):
            if r in (0, rows) and c:
                index[r, c] = index[r, 0]
                continue
            index[r, c] = len(points)
            longitude = 2 * np.pi * c / columns
            points.append(
                [np.sin(latitude[r]) * np.sin(longitude), -np.cos(latitude[r]), np.sin(latitude[r]) * np.cos(longitude)]
            )
        for c in range(columns + 1):
            uv_index[r, c] = len(uvs)
            uvs.append([0.02 + 0.96 * c / columns, 0.98 - 0.96 * r / rows])
    triangles, uv_triangles = [], []
    for r in range(rows):
        for c in range(columns):
            a, b, d, e = index[r, c], index[r, (c + 1) % columns], index[r + 1, c], index[r + 1, (c + 1) % columns]
            ua, ub, ud, ue = uv_index[r, c], uv_index[r, c + 1], uv_index[r + 1, c], uv_index[r + 1, c + 1]
            if r > 0:
                triangles.append([a, b, d]), uv_triangles.append([ua, ub, ud])
            if r < rows - 1:
                triangles.append([b, e, d]), uv_triangles.append([ub, ue, ud])
    unit = np.array(points)
    template = unit * RADII_M
    triangles = np.array(triangles)
    a, b, c = (template[triangles[:, i]] for i in range(3))
    if (np.cross(b - a, c - a) * (a + b + c)).sum() < 0:
        triangles, uv_triangles = triangles[:, ::-1].copy(), np.array(uv_triangles)[:, ::-1].copy()
    expression = np.zeros((expressions, len(unit), 3))
    for e in range(expressions):  # a bump on the front (-z) side that moves outwards
        centre = np.array([0.5 * (e - 1), 0.2 + 0.2 * e, -0.8])
        expression[e] = unit * np.exp(-((unit - centre) ** 2).sum(1, keepdims=True) / 0.15) * 0.012
    shape = np.stack([unit * 0.003 * np.sin(3 * unit[:, s % 3 : s % 3 + 1] + s) for s in range(shapes)])
    jaw_weight = np.clip((unit[:, 1] - 0.3) * 2, 0, 0.5) * (unit[:, 2] < 0)
    skin = np.zeros((len(unit), 5))
    skin[:, 2] = jaw_weight
    skin[:, 1] = 1 - jaw_weight
    region = np.where(
        unit[:, 1] < -0.4, REGIONS.index("scalp"), np.where(unit[:, 1] > 0.85, REGIONS.index("neck"), REGIONS.index("face"))
    )

    def tensor(x):
        return torch.tensor(np.asarray(x), dtype=torch.float32)

    return HeadModel(
        template=tensor(template),
        shape_basis=tensor(shape),
        expression_basis=tensor(expression),
        expression_low=torch.zeros(expressions),
        expression_high=torch.ones(expressions),
        expression_names=tuple(f"bump{e}" for e in range(expressions)),
        pose_basis=torch.zeros(0, len(unit), 3),
        joints=tensor([[0, 0.09, 0], [0, 0.07, 0.01], [0, 0.02, 0.0], [0.03, 0, -0.05], [-0.03, 0, -0.05]]),
        joint_shape_basis=torch.zeros(shapes, 5, 3),
        skinning_weights=tensor(skin),
        triangles=torch.from_numpy(triangles),
        uvs=tensor(uvs),
        uv_triangles=torch.tensor(np.array(uv_triangles)),
        region=torch.from_numpy(region),
        landmark_triangles=torch.full((478,), -1),
        landmark_barycentric=torch.zeros(478, 3),
        name="toy",
        licence="none",
        digest=f"toy{rows}x{columns}s{seed}",
    )


def toy_track(head: HeadModel, frames: int, size: int = 64, seed: int = 1, motion: float = 1.0) -> dict[str, np.ndarray]:
    """Random smooth expressions and poses, a camera that sees the whole head."""
    random = np.random.default_rng(seed)
    zeros = np.zeros((frames, 3), np.float32)
    track = {
        "shape": random.normal(size=head.shape_basis.shape[0]),
        "expression": np.clip(random.random((frames, head.expression_basis.shape[0])) * motion, 0, 1),
        "rotation": np.stack(
            [random.uniform(-0.15, 0.15, frames), random.uniform(-0.5, 0.5, frames), random.uniform(-0.1, 0.1, frames)], 1
        )
        * motion,
        "neck": zeros,
        "jaw": np.stack([random.uniform(0, 0.2, frames), zeros[:, 0], zeros[:, 0]], 1) * motion,
        "eyes": np.zeros((frames, 2, 3)),
        "translation": np.array([0, 0, 0.8]) + random.normal(size=(frames, 3)) * 0.004 * motion,
        "focal_px": np.array(2.6 * size),
        "centre_px": np.array([size / 2, size / 2]),
    }
    track = {name: np.asarray(value, np.float32) for name, value in track.items()}
    return track | {"usable": np.ones(frames, bool), "head_digest": np.array(head.digest)}


def toy_images(head: HeadModel, track: dict[str, np.ndarray], size: int, supersample: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Frames [T, size, size, 3] uint8 (grey behind the head) and alpha [T, size, size] uint8, by a z-buffer of triangles.

    The colour is a smooth pattern attached to the template surface, so it moves with the head and its expressions.
    """
    big = size * supersample
    values = {name: torch.from_numpy(np.asarray(track[name])).float() for name in track if track[name].dtype.kind == "f"}
    posed = head.forward(
        *(values[name] for name in ("shape", "expression", "rotation", "neck", "jaw", "eyes", "translation"))
    ).numpy()
    pattern = head.template.numpy()
    colours = 0.5 + 0.4 * np.sin(pattern @ np.array([[60.0, 35, -45], [40, -70, 30], [30, 50, 60]]) + np.array([0, 1, 2]))
    frames = np.full((len(posed), size, size, 3), 128, np.uint8)
    alphas = np.zeros((len(posed), size, size), np.uint8)
    triangles = head.triangles.numpy()
    for t, points in enumerate(posed):
        pixel = (points[:, :2] / points[:, 2:] * float(track["focal_px"]) + track["centre_px"]) * supersample
        image, depth, cover = np.full((big, big, 3), 0.5), np.full((big, big), np.inf), np.zeros((big, big))
        for triangle in triangles:
            a, b, c = pixel[triangle]
            area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            low = np.clip(np.floor(pixel[triangle].min(0) - 0.5), 0, big).astype(int)
            high = np.clip(np.ceil(pixel[triangle].max(0) + 0.5), 0, big).astype(int)
            if abs(area) < 1e-9 or (high <= low).any():
                continue
            x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
            second = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
            third = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
            weights = np.stack([1 - second - third, second, third], -1)
            z = weights @ points[triangle, 2]
            box = np.s_[low[1] : high[1], low[0] : high[0]]
            hit = (weights >= 0).all(-1) & (z < depth[box])
            depth[box][hit], cover[box][hit], image[box][hit] = z[hit], 1, (weights @ colours[triangle])[hit]
        shrink = (size, supersample, size, supersample)
        alpha = cover.reshape(shrink).mean((1, 3))
        colour = (image * cover[..., None]).reshape(*shrink, 3).sum((1, 3)) / np.maximum(alpha[..., None] * supersample**2, 1e-6)
        frames[t] = np.where(alpha[..., None] > 0, colour * 255, 128).round().astype(np.uint8)
        alphas[t] = (alpha * 255).round().astype(np.uint8)
    return frames, alphas
