"""The z-buffer against ray casting, and its hard cases."""

import numpy as np

from fitting import raster
from tests.toy_head import toy_head

CENTRE = np.array([16.0, 15.0])


def scene():
    head = toy_head()
    return head.template.numpy().astype(np.float64) + [0.005, -0.003, 0.6], head.triangles.numpy()


def cast(ray, corners):
    """Depth of the nearest of triangles [F, 3, 3] along one ray from the origin, by Moeller and Trumbore's equations."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(ray, second)
    determinant = (first * across).sum(1)
    inverse = 1 / np.where(np.abs(determinant) > 1e-18, determinant, np.nan)
    u = -(corners[:, 0] * across).sum(1) * inverse
    other = np.cross(-corners[:, 0], first)
    v = (ray * other).sum(1) * inverse
    distance = (second * other).sum(1) * inverse
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    return (distance[hit] * ray[2]).min() if hit.any() else np.inf


def test_equals_ray_casting():
    vertices, triangles = scene()
    index, depth, bary = raster.rasterise(raster.project(vertices, 90.0, CENTRE), triangles, (30, 32))
    rows, columns = np.mgrid[:30, :32]
    rays = np.stack([(columns + 0.5 - CENTRE[0]) / 90, (rows + 0.5 - CENTRE[1]) / 90, np.ones_like(rows, float)], -1).reshape(
        -1, 3
    )
    nearest = np.array([cast(ray, vertices[triangles]) for ray in rays])
    seen = np.isfinite(nearest)
    assert (seen == (index >= 0).ravel()).mean() > 0.998  # rays through an edge may fall either way
    both = seen & (index >= 0).ravel()
    np.testing.assert_allclose(depth.ravel()[both], nearest[both], atol=2e-6)
    hit = (vertices[triangles[index[index >= 0]]] * bary[index >= 0][..., None]).sum(1)
    np.testing.assert_allclose(
        raster.project(hit, 90.0, CENTRE)[:, :2], (np.stack([columns, rows], -1) + 0.5)[index >= 0], atol=1e-3
    )


def test_degenerate_flipped_behind_and_outside():
    points = np.array(
        [[5.0, 5, 1], [5, 5, 1], [9, 9, 1], [2, 2, 1], [12, 2, 1], [2, 12, 1], [3, 3, -1], [900, 900, 1], [np.nan, 1, 1]]
    )
    index, depth, _ = raster.rasterise(points, np.array([[0, 1, 2], [3, 5, 4], [3, 4, 6], [3, 4, 8]]), (8, 8))
    assert set(np.unique(index)) == {-1, 1}  # only the flipped one is drawn
    assert np.isfinite(depth[index >= 0]).all()
    assert (raster.rasterise(points, np.array([[7, 7, 7]]), (8, 8))[0] == raster.EMPTY).all()


def test_nearer_triangle_wins_and_normals_point_outwards():
    vertices, triangles = scene()
    normal = raster.vertex_normals(vertices, triangles)
    away = vertices - vertices.mean(0)
    assert ((normal * away).sum(1) > 0).mean() > 0.99
    image, index = raster.shade(vertices, triangles, 90.0, CENTRE, (30, 32), np.array([1.0, 0.5, 0.2]))
    assert image.shape == (30, 32, 3) and np.isfinite(image).all()
    assert (image[index < 0] == 1).all() and image[index >= 0].max() <= 1
