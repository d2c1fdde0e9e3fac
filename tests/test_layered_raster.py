"""The stack's rasteriser against rays cast in float64 and against its tensor path; cracks, hard triangles, windows, buffers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from toy_head import toy_head

from avatar.layered.raster import Fragments, empty, rasterise, rasterise_tensors

HEIGHT, WIDTH, FOCAL_PX = 72, 80, 160.0
WINDOW = (0, 0, WIDTH, HEIGHT)


def projected(camera_m: np.ndarray) -> np.ndarray:
    """[..., 3] px, px, m of points in camera axes."""
    centre = np.array([WIDTH, HEIGHT]) / 2
    return np.concatenate([FOCAL_PX * camera_m[..., :2] / camera_m[..., 2:] + centre, camera_m[..., 2:]], -1).astype(np.float32)


@pytest.fixture(scope="module")
def stack() -> dict[str, np.ndarray]:
    """Three concentric heads of 1,700 triangles, the last without its upper half."""
    head = toy_head(24, 36)
    vertices, triangles = head.template.numpy().astype(np.float64), head.triangles.numpy().astype(np.int32)
    turn = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    camera = np.stack([scale * vertices @ turn.T + [0.01, 0, 0.45] for scale in (1.15, 1.0, 0.7)])
    drawn = np.ones((3, len(triangles)), bool)
    drawn[2] = vertices[triangles, 1].mean(1) > 0
    uv = head.uvs.numpy()[head.uv_triangles.numpy()].astype(np.float32)
    return {"points": projected(camera), "triangles": triangles, "corner_uv": uv, "drawn": drawn}


def cast(points: np.ndarray, triangles: np.ndarray, corner_uv: np.ndarray) -> tuple[np.ndarray, ...]:
    """Every pixel's ray against every triangle (Moeller and Trumbore), front faces; distance from the nearest edge in px too."""
    z = points[:, 2:].astype(np.float64)
    camera = np.concatenate([(points[:, :2] - np.array([WIDTH, HEIGHT]) / 2) * z / FOCAL_PX, z], 1)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(columns - WIDTH / 2) / FOCAL_PX, (rows - HEIGHT / 2) / FOCAL_PX, np.ones_like(rows)], -1).reshape(-1, 3)
    a, b, c = (camera[triangles[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    front = (normal * a).sum(1) < 0
    depth, uv, margin = np.full(len(rays), np.inf), np.zeros((len(rays), 2)), np.full(len(rays), np.inf)
    for f in np.nonzero(front)[0]:
        distance = (normal[f] @ a[f]) / (rays @ normal[f])
        at = rays * distance[:, None]
        weights = np.stack([np.cross(q - p, at - p) @ normal[f] for p, q in ((b[f], c[f]), (c[f], a[f]), (a[f], b[f]))], 1) / (
            normal[f] @ normal[f]
        )
        inside = (weights >= 0).all(1)
        xy = points[triangles[f], :2].astype(np.float64)
        for p, q in ((0, 1), (1, 2), (2, 0)):
            line = xy[q] - xy[p]
            from_p = np.stack([columns.ravel(), rows.ravel()], 1) - xy[p]
            along = np.clip(from_p @ line / (line @ line), 0, 1)
            margin = np.minimum(margin, np.linalg.norm(from_p - along[:, None] * line, axis=1))
        nearer = inside & (distance < depth)
        depth[nearer], uv[nearer] = distance[nearer], weights[nearer] @ corner_uv[f]
    return depth.reshape(HEIGHT, WIDTH), uv.reshape(HEIGHT, WIDTH, 2), margin.reshape(HEIGHT, WIDTH)


def test_equals_rays_cast_at_every_triangle(stack: dict[str, np.ndarray]) -> None:
    fragments = rasterise(**stack, window=WINDOW)
    for layer in range(3):
        chosen = stack["drawn"][layer]
        depth, uv, margin = cast(stack["points"][layer], stack["triangles"][chosen], stack["corner_uv"][chosen])
        seen, clear = fragments.inverse_depth[layer] > 0, margin > 1e-3
        assert clear.mean() > 0.98 and 200 < np.isfinite(depth).sum() < HEIGHT * WIDTH
        agree = seen == np.isfinite(depth)
        assert agree[clear].all()
        both = seen & np.isfinite(depth) & clear
        np.testing.assert_allclose(fragments.inverse_depth[layer][both], 1 / depth[both], rtol=2e-6)
        np.testing.assert_allclose(fragments.uv[layer][both], uv[both], atol=2e-5)
    assert (fragments.inverse_depth[2] > 0).sum() < 0.4 * (fragments.inverse_depth[1] > 0).sum()


def test_two_samples_of_a_pixel_are_the_picture_moved_by_a_quarter_of_one(stack: dict[str, np.ndarray]) -> None:
    both = rasterise(**stack, window=WINDOW, samples=2)
    assert both.inverse_depth.shape == (3, 2 * HEIGHT, WIDTH)
    for sample, move in ((0, 0.25), (1, -0.25)):
        moved = stack["points"] + np.array([move, move, 0], np.float32)
        alone = rasterise(**(stack | {"points": moved}), window=WINDOW)
        depth, uv = both.inverse_depth[:, sample::2], both.uv[:, sample::2]
        agree = (depth > 0) == (alone.inverse_depth > 0)
        assert agree.mean() > 0.9999  # float32 moves an edge by a millionth of a pixel
        seen = agree & (depth > 0)
        np.testing.assert_allclose(depth[seen], alone.inverse_depth[seen], rtol=1e-4)
        assert np.quantile(np.abs(uv[seen] - alone.uv[seen]), 0.999) < 1e-4


@pytest.mark.parametrize("samples", [1, 2])
def test_tensor_path_covers_the_same_pixels(stack: dict[str, np.ndarray], samples: int) -> None:
    window = (11, 7, 50, 40)
    ours = rasterise(**stack, window=window, samples=samples)
    theirs = rasterise_tensors(*(torch.from_numpy(stack[name]) for name in stack), window, samples)
    seen = ours.inverse_depth > 0
    assert (seen == (theirs.inverse_depth.numpy() > 0)).all() and seen.any()
    np.testing.assert_allclose(theirs.inverse_depth.numpy(), ours.inverse_depth, atol=1e-5)
    np.testing.assert_allclose(theirs.uv.numpy()[seen], ours.uv[seen], atol=1e-5)


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("tensors", [False, True])
def test_neighbours_leave_no_crack_and_share_no_pixel(tensors: bool, samples: int) -> None:
    """A jittered flat grid whose corners often lie on samples: one layer a triangle, each sample in exactly one."""
    random = np.random.default_rng(1)
    side = 7
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2) * 5.0
    inner = ((grid > 0) & (grid < 5 * (side - 1))).all(1)
    grid[inner] += random.integers(-4 * samples, 4 * samples + 1, (inner.sum(), 2)) / (2 * samples)
    points = np.concatenate([grid, np.ones((len(grid), 1))], 1).astype(np.float32)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    triangles = np.concatenate([np.stack([a, a + side, a + 1], 1), np.stack([a + 1, a + side, a + side + 1], 1)]).astype(np.int32)
    count = len(triangles)
    arguments = (np.repeat(points[None], count, 0), triangles, np.zeros((count, 3, 2), np.float32), np.eye(count, dtype=bool))
    window = (0, 0, 30, 30)
    if tensors:
        hits = rasterise_tensors(*map(torch.from_numpy, arguments), window, samples).inverse_depth.numpy() > 0
    else:
        hits = rasterise(*arguments, window, samples=samples).inverse_depth > 0
    assert hits.shape[1:] == (30 * samples, 30)
    assert (hits.sum(0) == 1).all()
    assert not rasterise(arguments[0], triangles[:, ::-1], *arguments[2:], window).inverse_depth.any()  # seen from behind


def test_hard_triangles_draw_nothing_and_harm_nobody() -> None:
    good = [[10, 10, 2], [10, 30, 2], [30, 10, 2]]
    nan, inf = np.nan, np.inf
    hard = [
        [[5, 5, 1], [5, 5, 1], [40, 40, 1]],  # without area
        [[5, 5, 1], [20, 20, 1], [40, 40, 1]],
        [[5, 5, nan], [5, 40, 1], [40, 5, 1]],
        [[5, 5, inf], [5, 40, 1], [40, 5, 1]],
        [[5, 5, 1e30], [5, 40, 1], [40, 5, 1]],
        [[nan, 5, 1], [5, 40, 1], [40, 5, 1]],
        [[5, nan, 1], [5, 40, 1], [40, 5, 1]],
        [[5, 5, 1], [5, inf, 1], [40, 5, 1]],
        [[-inf, 5, 1], [5, 40, 1], [40, 5, 1]],
        [[5, 5, 1], [5, 1e30, 1], [1e30, 5, 1]],
        [[5, 5, 0], [5, 40, 1], [40, 5, 1]],  # at the camera
        [[5, 5, 1], [5, 40, -1], [40, 5, 1]],  # behind it
        [[-50, 5, 1], [-50, 40, 1], [-10, 5, 1]],  # outside
        [[5, 500, 1], [5, 540, 1], [40, 500, 1]],
        [[5.6, 5.6, 1], [5.6, 5.9, 1], [5.9, 5.6, 1]],  # between pixel centres
    ]
    points = np.array([*hard, good], np.float32).reshape(1, -1, 3)
    triangles = np.arange(points.shape[1], dtype=np.int32).reshape(-1, 3)
    uv, drawn = np.full((len(triangles), 3, 2), 0.5, np.float32), np.ones((1, len(triangles)), bool)
    everything = rasterise(points, triangles, uv, drawn, WINDOW)
    alone = rasterise(points, triangles[-1:], uv[-1:], drawn[:, -1:], WINDOW)
    assert (everything.inverse_depth > 0).sum() == 190 and (everything.inverse_depth == alone.inverse_depth).all()
    tensors = rasterise_tensors(*map(torch.from_numpy, (points, triangles, uv, drawn)), WINDOW)
    assert (tensors.inverse_depth.numpy() == alone.inverse_depth).all()
    nothing = rasterise(points, triangles[:0], uv[:0], drawn[:, :0], WINDOW)
    assert not nothing.inverse_depth.any()
    assert not rasterise_tensors(*map(torch.from_numpy, (points, triangles, uv, ~drawn)), WINDOW).inverse_depth.any()


def test_texture_is_perspective_correct_and_the_nearer_triangle_wins() -> None:
    """A plane tilted in depth: u, linear in space, is a hyperbola on the screen; behind it a second one, drawn later."""
    camera = np.array([[-0.2, -0.2, 0.5], [-0.2, 0.2, 0.5], [0.6, 0.6, 1.5], [0.6, -0.6, 1.5]])
    points = projected(np.concatenate([camera, camera * 1.5]))[None]
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    corner = np.array([[0, 0], [0, 1], [1, 1], [1, 0]] * 2, np.float32)
    fragments = rasterise(points, triangles, corner[triangles], np.ones((1, 4), bool), WINDOW)
    slope = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL_PX  # x = slope z; x = 0.8 u - 0.2, z = 0.5 + u
    u = (0.2 + 0.5 * slope) / (0.8 - slope)
    seen = fragments.inverse_depth[0] > 0
    assert seen.sum() > 1000
    np.testing.assert_allclose(fragments.uv[0, ..., 0][seen], np.broadcast_to(u, seen.shape)[seen], atol=1e-5)
    np.testing.assert_allclose(1 / fragments.inverse_depth[0][seen], 0.5 + np.broadcast_to(u, seen.shape)[seen], atol=1e-5)


def test_windows_threads_and_buffers_change_nothing(stack: dict[str, np.ndarray]) -> None:
    whole = rasterise(**stack, window=WINDOW)
    part = rasterise(**stack, window=(13, 21, 40, 30))
    seen = part.inverse_depth > 0
    np.testing.assert_allclose(part.inverse_depth, whole.inverse_depth[:, 21:51, 13:53], rtol=1e-6)
    np.testing.assert_allclose(part.uv[seen], whole.uv[:, 21:51, 13:53][seen], atol=1e-6)
    wide = rasterise(**stack, window=(-5, -3, WIDTH + 10, HEIGHT + 6))
    np.testing.assert_allclose(wide.inverse_depth[:, 3:-3, 5:-5], whole.inverse_depth, rtol=1e-6)
    one = rasterise(**stack, window=WINDOW, shares=3)
    assert (one.inverse_depth == whole.inverse_depth).all()
    two = [rasterise(**stack, window=WINDOW, shares=shares, samples=2).inverse_depth for shares in (1, 3)]
    assert (two[0] == two[1]).all()
    part, used = rasterise(**stack, window=(13, 21, 40, 30), samples=2), empty(3, 60, 40)  # an odd first row
    used.inverse_depth.fill(1e9)
    np.testing.assert_allclose(part.inverse_depth, two[0][:, 42:102, 13:53], rtol=1e-6)
    assert (rasterise(**stack, window=(13, 21, 40, 30), out=used, samples=2).inverse_depth == part.inverse_depth).all()
    wide = rasterise(**stack, window=(-5, -3, WIDTH + 10, HEIGHT + 6), samples=2)
    np.testing.assert_allclose(wide.inverse_depth[:, 6:-6, 5:-5], two[0], rtol=1e-6)
    buffers = empty(3, HEIGHT, WIDTH)
    buffers.inverse_depth.fill(1e9)
    again = rasterise(**stack, window=WINDOW, out=buffers)
    assert again is buffers and (again.inverse_depth == whole.inverse_depth).all()


def test_what_does_not_fit_is_refused(stack: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError, match="do not fit 3 layers of 72x80"):
        rasterise(**stack, window=WINDOW, out=empty(2, HEIGHT, WIDTH))
    with pytest.raises(ValueError, match="do not fit 3 layers of 144x80"):
        rasterise(**stack, window=WINDOW, out=empty(3, HEIGHT, WIDTH), samples=2)
    with pytest.raises(ValueError, match="one or two samples, not 3"):
        rasterise(**stack, window=WINDOW, samples=3)
    with pytest.raises(ValueError, match="points are"):
        rasterise(**(stack | {"points": stack["points"][..., :2]}), window=WINDOW)
    with pytest.raises(ValueError, match="need flags"):
        rasterise(**(stack | {"drawn": stack["drawn"][:1]}), window=WINDOW)
    with pytest.raises(ValueError, match="corners"):
        rasterise(**(stack | {"corner_uv": stack["corner_uv"][:5]}), window=WINDOW)
    with pytest.raises(ValueError, match="name vertices"):
        rasterise(**(stack | {"triangles": stack["triangles"] + 5}), window=WINDOW)
    assert isinstance(rasterise(**stack, window=(0, 0, 0, 0)), Fragments)  # no pixels: nothing to draw
