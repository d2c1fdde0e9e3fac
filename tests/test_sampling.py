"""Samples on rays: dense ones against loops, importance sampling against the distribution it follows, the hierarchical avatar."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from toy_head import toy_head, toy_track
from toy_run import SMALL, train_in, write_subject

from avatar import build, sampling, shell
from avatar.config import TrainConfig
from avatar.dataset import Scene
from avatar.volume import Rays
from fitting.raster import vertex_normals

NEAR, FAR = np.array([0.3, 0.5]), np.array([0.7, 0.6])


def test_uniform_samples_lie_one_in_each_stratum_and_none_at_infinity() -> None:
    jitter = np.random.default_rng(0).random((2, 8), dtype=np.float32)
    samples = sampling.uniform(NEAR, FAR, 8, jitter)
    for n in range(2):
        own = samples.distance_m[samples.ray == n]
        for s in range(8):
            low = NEAR[n] + s * (FAR[n] - NEAR[n]) / 8
            assert own[s] == pytest.approx(low + jitter[n, s] * (FAR[n] - NEAR[n]) / 8, abs=1e-6)
        assert samples.step_m[samples.ray == n].sum() == pytest.approx(FAR[n] - NEAR[n], rel=1e-5)
        assert samples.slot[samples.ray == n].tolist() == list(range(8))
    assert not samples.closed.any()


def test_by_weight_equals_a_loop_that_inverts_the_distribution() -> None:
    random = np.random.default_rng(1)
    weights, jitter = random.random((2, 5)), random.random((2, 7))
    coarse = NEAR[:, None] + (np.arange(5) + 0.5) * (FAR - NEAR)[:, None] / 5
    samples = sampling.by_weight(NEAR, FAR, coarse, weights, 7, jitter)
    for n in range(2):
        probability = (weights[n] + sampling.FLOOR) / (weights[n] + sampling.FLOOR).sum()
        edges = np.linspace(NEAR[n], FAR[n], 6)
        drawn = np.interp((np.arange(7) + jitter[n]) / 7, np.concatenate([[0], np.cumsum(probability)]), edges)
        own = samples.distance_m[samples.ray == n]
        np.testing.assert_allclose(own, np.sort(np.concatenate([coarse[n], drawn])), atol=1e-6)
        assert (np.diff(own) >= 0).all()
        assert samples.step_m[samples.ray == n].sum() == pytest.approx(FAR[n] - NEAR[n], rel=1e-5)
        assert (samples.step_m[samples.ray == n] >= 0).all()


@pytest.mark.parametrize("weights", [np.zeros((1, 4)), np.array([[0, 0, 1.0, 0]]), np.array([[1e-30, 0, 0, 1e30]])])
def test_by_weight_of_degenerate_weights(weights: np.ndarray) -> None:
    samples = sampling.by_weight(NEAR[:1], FAR[:1], NEAR[:1, None] + np.arange(4) * 0.1 + 0.05, weights, 200, None)
    assert np.isfinite(samples.distance_m).all() and len(samples.ray) == 204
    assert samples.distance_m.min() >= NEAR[0] and samples.distance_m.max() <= FAR[0] + 1e-6
    if weights[0, 2] == 1:
        assert ((samples.distance_m > 0.5 - 1e-6) & (samples.distance_m < 0.6 + 1e-6)).sum() >= 200


def test_bounds_hold_every_vertex_and_never_lie_behind_the_camera() -> None:
    vertices = np.random.default_rng(0).normal(size=(50, 3)) * 0.05
    origins = np.array([[0, 0, -0.6], [0, 0, 0.0]])
    near, far = sampling.bounds(vertices, origins)
    for n in range(2):
        away = np.linalg.norm(vertices - origins[n], axis=1)
        assert near[n] <= away.min() and far[n] >= away.max() + sampling.MARGIN_M / 2 and near[n] >= 0


def test_points_of_several_heads_are_one_batch() -> None:
    rays = [Rays(np.zeros((2, 3), np.float32), np.eye(3, dtype=np.float32)[:2]) for _ in range(2)]
    parts = [sampling.pack(rays[i], sampling.uniform(NEAR, FAR, 3, None), i, 2 * i) for i in range(2)]
    packed = sampling.join(parts)
    assert packed.ray.tolist() == [0] * 3 + [1] * 3 + [2] * 3 + [3] * 3 and packed.head.tolist() == [0] * 6 + [1] * 6
    np.testing.assert_allclose(packed.points_m[4], [0, packed.distance_m[4], 0])


def test_places_outside_the_shell_fill_the_ball_around_the_head() -> None:
    random = np.random.default_rng(3)
    grid = shell.Grid(np.array([-0.02, 0, 0.01]), random.integers(0, 3, (26, 25, 27)).astype(np.uint8))
    vertices, numbers = random.normal(size=(40, 3)) * 0.02, random.random((3000, 3))
    found = sampling.outside(grid, vertices, numbers, 2)
    centre, radius = sampling.ball(vertices)
    far_grid = shell.Grid(centre + 9, np.zeros((1, 1, 1), np.uint8))
    far = np.linalg.norm(found.points_m - centre, axis=1) / radius
    even = np.linalg.norm(sampling.outside(far_grid, vertices, numbers).points_m[::2] - centre, axis=1) / radius
    assert far.max() <= 1 and abs((even < 0.5 ** (1 / 3)).mean() - 0.5) < 0.05  # half of the volume
    beside = sampling.outside(far_grid, vertices, numbers).points_m[1::2]
    away = np.linalg.norm(beside[:, None] - vertices, axis=-1).min(1)
    assert (
        away.max() <= sampling.BESIDE_M + 1e-6
        and len(np.unique(np.linalg.norm(beside[:, None] - vertices, axis=-1).argmin(1))) > 30
    )
    for point in found.points_m[:300]:
        voxel = np.floor((point - grid.origin) / shell.VOXEL_M).astype(int)
        within = (voxel >= 0).all() and (voxel < grid.labels.shape).all()
        assert not within or grid.labels[tuple(voxel)] == shell.EMPTY
    assert 1000 < len(found.ray) < 3000 and (found.slot == sampling.OUTSIDE_SLOT).all() and (found.head == 2).all()
    full = shell.Grid(centre - 0.5, np.full((250, 250, 250), shell.SHELL, np.uint8))
    assert not len(sampling.outside(full, vertices, numbers).ray) and not len(sampling.outside(grid, vertices, numbers[:0]).ray)


def test_whole_rays_end_where_they_meet_the_core() -> None:
    labels = np.zeros((5, 5, 10), np.uint8)
    labels[2, 2, 6:8], labels[2, 2, 3] = shell.CORE, shell.SHELL
    grid = shell.Grid(np.zeros(3), labels)
    origins = np.array([[0.01, 0.01, -0.1], [0.002, 0.01, -0.1], [0.01, 0.01, 0.2]], np.float32)
    rays = Rays(origins, np.array([[0, 0, 1], [0, 0, 1], [0, 0, -1]], np.float32))
    found = shell.core_distance(grid, *rays)
    assert found[[0, 2]] == pytest.approx([0.1 + 6 * shell.VOXEL_M, 0.2 - 8 * shell.VOXEL_M]) and np.isinf(found[1])
    samples = sampling.ended(grid, rays, sampling.uniform(np.zeros(3), np.full(3, 0.3), 50, None))
    assert (samples.closed == (samples.distance_m >= found[samples.ray])).all() and 0 < samples.closed.sum() < 100


def test_training_clears_what_lies_outside_the_shell() -> None:
    """The term alone takes the fog of a new network away where it looks; only a step's random numbers ask for it."""
    head = toy_head(24, 36)
    scene = Scene(head, toy_track(head, 2, 40), [0])
    rows, columns = np.mgrid[:40:2, :40:2]
    rays, random = scene.rays(0, columns.ravel(), rows.ravel()), np.random.default_rng(0)
    torch.manual_seed(0)
    avatar = build.build(build.settings_of(TrainConfig(**SMALL)), head)
    avatar.shape_shell(torch.full((head.vertex_count,), 0.008), torch.zeros(0, 3))
    posed, optimiser, terms = avatar.pose(*scene.heads([0], "cpu")), torch.optim.Adam(avatar.parameters(), 3e-3), []
    for _ in range(20):
        jitter = random.random((len(rays.origins_m), avatar.jitter_width), dtype=np.float32)
        outcome = avatar.render(posed, [rays], torch.float32, [jitter])
        terms.append(outcome.terms["outside"])
        optimiser.zero_grad()
        terms[-1].backward()
        optimiser.step()
    assert terms[0] > 5 and terms[-1] < 1
    within = sampling.in_shell(posed.grids[0], rays, avatar.step_m, avatar.max_samples, None)
    assert 0 < outcome.evaluations - len(within.ray) <= len(rays.origins_m) / 3
    assert not avatar.render(posed, [rays], torch.float32).terms


def test_nothing_is_cleared_beneath_the_shell() -> None:
    """Between shell and core lies the skull, which no ray of training may have asked for; a head without a core has none."""
    head = toy_head(24, 36)
    vertices = head.template.numpy().astype(np.float64)
    core = shell.core_points(vertices, vertex_normals(vertices, head.triangles.numpy()))
    grid, numbers = shell.occupancy(vertices, np.full(len(vertices), 0.008), core), np.random.default_rng(5).random((2000, 3))
    every, found = sampling.outside(grid, vertices, numbers), sampling.outside(grid, vertices, numbers, core=cKDTree(core))
    near = lambda points: np.linalg.norm(points[:, None] - core, axis=-1).min(1) <= shell.CORE_DEPTH_M  # noqa: E731
    beneath = near(every.points_m)
    assert beneath.sum() > 40 and not near(found.points_m).any()
    np.testing.assert_array_equal(found.points_m, every.points_m[~beneath])
    size = np.linalg.norm(found.points_m / (0.075, 0.105, 0.09), axis=1)  # of the toy's ellipsoid
    assert size.min() > 0.98  # all of them in the air, but for gaps between vertices


def test_median_samples_equal_a_loop() -> None:
    random = np.random.default_rng(2)
    ray = np.repeat([0, 2, 3, 7], [4, 1, 6, 3])
    weights = random.random(len(ray)).astype(np.float32)
    weights[5:11] = 0
    found = sampling.median_samples(weights, ray)
    for median, number in zip(found, (0, 2, 3, 7), strict=True):
        own = np.flatnonzero(ray == number)
        assert median in own
        if weights[own].sum():
            assert weights[own[own < median]].sum() <= weights[own].sum() / 2 <= weights[own[own <= median]].sum() + 1e-6
    assert len(sampling.median_samples(weights[:0], ray[:0])) == 0


HIERARCHICAL = {"sampling": "hierarchical", "coarse_samples": 12, "fine_samples": 12, "rays": 64}


def test_a_hierarchical_avatar_trains_both_networks_and_renders_the_fine_one(tmp_path: Path) -> None:
    inputs = write_subject(tmp_path, size=24)
    outputs = train_in(tmp_path / "run", inputs, steps=4, **HIERARCHICAL)
    stored = torch.load(outputs["avatar"], weights_only=True)
    head = toy_head(24, 36)
    avatar = build.restore(stored, head)
    torch.manual_seed(TrainConfig().seed)
    fresh = build.build(stored["settings"], head)
    assert any(name.startswith("coarse.") for name in stored["weights"])
    scene = Scene(head, dict(np.load(inputs["track"])), [6, 7])
    rows, columns = np.mgrid[:24, :24]
    rays = scene.rays(6, columns.ravel(), rows.ravel())
    posed = avatar.pose(*scene.heads([6], "cpu"))
    with torch.no_grad():
        outcome = avatar.render(posed, [rays], torch.float32)
    picture, evaluations = avatar.march(posed, rays, torch.float32)
    assert outcome.evaluations == evaluations == 24 * 24 * (12 + 12 + 12)
    torch.testing.assert_close(picture.colour, outcome.renders[1].colour, atol=1e-5, rtol=1e-4)
    assert (picture.colour - outcome.renders[0].colour).abs().max() > 1e-3
    assert torch.isfinite(picture.colour).all()
    for before, after in zip(fresh.parameters(), avatar.parameters(), strict=True):
        assert not torch.equal(before, after)  # the same start, so that what differs was learned
    assert len(avatar.march(posed, scene.rays(6, np.empty(0, int), np.empty(0, int)), torch.float32)[0].opacity) == 0


def test_a_hierarchical_avatar_does_not_end_in_white(tmp_path: Path) -> None:
    keys = {"coarse_samples": 16, "fine_samples": 16, "rays": 256, "mlp_width": 32, "learning_rate": 1e-3, "opacity_weight": 0.0}
    outputs = train_in(tmp_path, write_subject(tmp_path), steps=130, sampling="hierarchical", **keys)
    quality = [float(line.split("\t")[3]) for line in outputs["curve"].read_text().splitlines()[1:]]
    assert quality[-1] > 14  # white is 11.2 dB, and what an avatar without the squared steps at the start becomes


def test_both_networks_get_gradients_and_the_shell_needs_one() -> None:
    head = toy_head()
    settings = build.settings_of(TrainConfig(**(SMALL | HIERARCHICAL)))
    both, one = build.build(settings, head), build.build(settings | {"sampling": "shell"}, head)
    assert one.coarse is None and both.coarse is not None
    scene = Scene(head, toy_track(head, 2, 24), [0, 1])
    posed = both.pose(*scene.heads([0, 1], "cpu"))
    rays = [scene.rays(frame, np.array([12, 13]), np.array([12, 13])) for frame in (0, 1)]
    outcome = both.render(posed, rays, torch.float32)
    sum(rendered.colour.sum() for rendered in outcome.renders).backward()
    assert len(outcome.renders) == 2 and len(outcome.renders[0].opacity) == 4
    for field in (both.coarse, both.field):
        assert all(torch.isfinite(p.grad).all() for p in field.parameters()) and field.mlp1.layers[0].weight.grad.abs().sum() > 0


def test_the_warp_trains_with_its_terms_and_is_off_without_a_window() -> None:
    head = toy_head()
    avatar = build.build(build.settings_of(TrainConfig(**SMALL)), head)
    avatar.shape_shell(torch.full((head.vertex_count,), 0.01), torch.zeros(0, 3))
    avatar.correct_errors(2)
    scene = Scene(head, toy_track(head, 2, 24), [0, 1])
    rays = [scene.rays(frame, np.arange(8, 16), np.arange(8, 16)) for frame in (0, 1)]
    posed = avatar.pose(*scene.heads([1, 0], "cpu", training=True))
    assert avatar.render(posed, rays, torch.float32).terms == {}
    outcome = avatar.render(posed, rays, torch.float32, window=1.5)
    assert set(outcome.terms) == {"elastic", "magnitude"}
    (outcome.renders[0].colour.sum() + sum(outcome.terms.values())).backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in avatar.warp.parameters())
    assert avatar.warp.latents.grad.abs().sum(1).min() > 0  # both frames
    with pytest.raises(ValueError, match="no place in time"):
        avatar.render(avatar.pose(*scene.heads([0], "cpu")), rays[:1], torch.float32, window=1.5)
