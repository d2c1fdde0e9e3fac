"""Which vertices are read together: mates along the mesh against a loop, two lips that touch, the candidates that are kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy_head import toy_head

from avatar.neighbours import (
    DETOUR,
    FARTHEST_M,
    SLACK_M,
    all_mates,
    keep_mates,
    nearest_by_tree,
    nearest_mates,
    resting_and_shut,
    surface_mates,
    tree_of,
)


def strips(gap_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Two strips of 3 x 20 vertices, 4 mm apart along each, `gap_m` between them: lips that are joined at one end."""
    points, triangles = [], []
    for strip in range(2):
        start = len(points)
        for i in range(20):
            points += [[0.004 * i, strip * gap_m, 0.004 * j] for j in range(3)]
        for i in range(19):
            for j in range(2):
                a = start + 3 * i + j
                triangles += [[a, a + 3, a + 1], [a + 1, a + 3, a + 4]]
    triangles += [[0, 60, 1], [60, 61, 1]]
    return np.array(points), np.array(triangles)


def test_touching_strips_are_mates_at_the_joint_alone() -> None:
    vertices, triangles = strips(0.0005)
    mates = surface_mates([vertices], triangles)
    assert (mates == mates.T).all() and mates.diagonal().all()
    across = mates[:60, 60:]
    facing = across.diagonal()  # a vertex and the one that it touches
    assert facing[0] and not facing[9:].any()
    assert mates[3 * 10, 3 * 11]


def test_mates_equal_a_loop_over_all_ways() -> None:
    vertices, triangles = strips(0.003)
    count = len(vertices)
    way = np.full((count, count), np.inf)
    np.fill_diagonal(way, 0)
    for triangle in triangles:
        for a in triangle:
            for b in triangle:
                way[a, b] = np.linalg.norm(vertices[a] - vertices[b])
    for middle in range(count):  # Floyd and Warshall
        way = np.minimum(way, way[:, [middle]] + way[[middle]])
    straight = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
    expected = (way <= DETOUR * straight + SLACK_M) & (way <= FARTHEST_M)
    np.testing.assert_array_equal(surface_mates([vertices], triangles), expected)


def test_coincident_vertices_and_flat_triangles_do_no_harm() -> None:
    vertices, triangles = strips(0.0)
    mates = surface_mates([vertices], np.concatenate([triangles, [[5, 5, 8], [7, 7, 7]]]))
    assert mates.diagonal().all() and not mates[45, 105]  # touching, 15 rows from the joint


def test_lids_that_only_touch_when_shut_are_no_mates() -> None:
    opened, triangles = strips(0.009)  # open eyes: the rims are 9 mm apart, the way around the corner is not three times that
    shut = opened.copy()
    shut[60:, 1] = 0.0005
    rim, other = 3 * 2, 60 + 3 * 2
    assert surface_mates([opened], triangles)[rim, other] and not surface_mates([opened, shut], triangles)[rim, other]
    head = toy_head()
    rest, same = resting_and_shut(head)
    assert np.array_equal(rest, same)  # a head without lids
    named = replace(head, expression_names=("eyeBlinkLeft", "jawOpen", "eyelid_right"))
    moved = resting_and_shut(named)[1] - rest
    np.testing.assert_allclose(moved, head.expression_basis[[0, 2]].double().sum(0), atol=1e-12)


def test_kept_candidates_are_mates_of_the_nearest_in_order() -> None:
    random = np.random.default_rng(0)
    vertices, triangles = strips(0.001)
    mates = surface_mates([vertices], triangles)
    points = vertices[random.integers(0, 120, 200)] + random.normal(size=(200, 3)) * 0.0007
    index = nearest_by_tree(tree_of(vertices), points, 12)
    kept = keep_mates(index, mates, 4)
    for row, candidates in zip(kept, index, strict=True):
        expected = [v for v in candidates if mates[candidates[0], v]][:4]
        assert row.tolist() == expected + [candidates[0]] * (4 - len(expected))
    lonely = keep_mates(index, np.eye(len(vertices), dtype=bool), 4)
    assert (lonely == index[:, :1]).all()
    assert keep_mates(index[:0], mates, 4).shape == (0, 4)


@pytest.mark.parametrize("k", [1, 4])
def test_searching_few_first_finds_the_same_mates(k: int) -> None:
    """As all candidates at once: between two strips that nearly touch, at their joint, and far away."""
    random = np.random.default_rng(0)
    vertices, triangles = strips(0.001)
    mates, tree = surface_mates([vertices], triangles), tree_of(vertices)
    points = vertices[random.integers(0, 120, 400)] + random.normal(size=(400, 3)) * random.choice([0.0007, 0.05], (400, 1))
    found = nearest_mates(tree, points, k, 3 * k, mates)
    np.testing.assert_array_equal(found, keep_mates(nearest_by_tree(tree, points, 3 * k), mates, k))
    nearest = nearest_by_tree(tree, points, k)
    together = np.array([all(mates[row[0], v] for v in row) for row in nearest])
    np.testing.assert_array_equal(all_mates(nearest, mates), together)
    assert k == 1 or (together.any() and not together.all())
    assert nearest_mates(tree, points[:0], k, 3 * k, mates).shape == (0, k)


def test_a_closed_mouth_reads_one_lip_at_a_time() -> None:
    vertices, triangles = strips(0.0005)
    mates = surface_mates([vertices], triangles)
    random = np.random.default_rng(0)
    points = vertices[random.integers(30, 60, 300)] + [0, 0.0002, 0] + random.normal(size=(300, 3)) * 0.0005
    lip = lambda index: index >= 60  # noqa: E731
    plain = nearest_by_tree(tree_of(vertices), points, 4)
    mixed = lip(plain).any(1) & ~lip(plain).all(1)
    assert mixed.mean() > 0.9  # what is to be cured
    kept = keep_mates(nearest_by_tree(tree_of(vertices), points, 12), mates, 4)
    assert not (lip(kept).any(1) & ~lip(kept).all(1)).any() and (kept[:, 0] == plain[:, 0]).all()
    assert all(len(set(row)) == 4 for row in kept)  # 12 candidates hold four of either lip
