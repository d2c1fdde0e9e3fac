"""Hard cases of a whole rendering: float32 against a float64 loop, wild expression codes, cameras inside, batches that miss.

The avatars here have not been trained: fog of an optical depth of about one a sample, so that every sample counts.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_hard_rays import cast, twin
from torch import Tensor
from toy_head import toy_head, toy_track
from toy_run import SMALL, marched_in_one_pass

from avatar import build, shell
from avatar.config import TrainConfig
from avatar.coverage import base_thickness
from avatar.dataset import Scene
from avatar.features import Condition
from avatar.features.ours_d import DisplacementFeatures
from avatar.radiance import RadianceAvatar
from avatar.volume import CLOSED, Rays
from fitting.head_model import HeadModel
from fitting.raster import vertex_normals


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return toy_head(24, 36)


def new_avatar(head: HeadModel, **keys: object) -> RadianceAvatar:
    torch.manual_seed(0)
    avatar = build.build(build.settings_of(TrainConfig(**(SMALL | keys))), head)
    neutral, triangles = head.template.double().numpy(), head.triangles.numpy()
    core = shell.core_points(neutral, vertex_normals(neutral, triangles))
    avatar.shape_shell(torch.from_numpy(base_thickness(head.region.numpy(), neutral, triangles)), torch.from_numpy(core))
    return avatar


def wild_scene(head: HeadModel, factor: float) -> Scene:
    track = toy_track(head, 3, 40)
    return Scene(head, track | {"expression": track["expression"] * np.float32(factor)}, range(3))


def slow_render(avatar: RadianceAvatar, scene: Scene, frame: int, rays: Rays) -> tuple[Tensor, Tensor]:
    """Colours [N, 3] and opacities [N] by a float64 avatar: brute-force neighbours, one sample and one ray after another."""
    vertices_m, condition = scene.heads([frame], "cpu")
    condition = type(condition)(*(None if value is None else value.double() for value in condition))
    vertices, features = vertices_m[0].double(), avatar.source(condition).values[0]
    terms = avatar.field.vertex_terms(features, torch.float64)
    grid, colours, opacities = avatar.grid(vertices_m[0].numpy()), [], []
    for origin, direction in zip(*(array.astype(np.float64) for array in rays), strict=True):
        found, met = cast(grid, origin, direction)
        length = (found[:, 1] - found[:, 0]).sum()
        number = int(np.clip(np.ceil(length / avatar.step_m), 1, avatar.max_samples)) if len(found) else 0
        depth, tint = [torch.zeros((), dtype=torch.float64)], [torch.ones(3, dtype=torch.float64)]
        for s in range(number):
            left, stretch = (s + 0.5) * length / number, 0
            while left > found[stretch, 1] - found[stretch, 0] and stretch + 1 < len(found):
                left, stretch = left - (found[stretch, 1] - found[stretch, 0]), stretch + 1
            point = origin + (found[stretch, 0] + left) * direction
            order = np.argsort(((vertices.numpy() - point) ** 2).sum(1), kind="stable")[: 3 * avatar.field.neighbours]
            if avatar.mates is not None:
                order = [v for v in order if avatar.mates[order[0], v]] + [order[0]] * avatar.field.neighbours
            chosen = torch.as_tensor(np.array(order[: avatar.field.neighbours]))[None]
            there, along = torch.from_numpy(point)[None], torch.from_numpy(direction)[None]
            density, colour = avatar.field(there, along, vertices, chosen, terms, torch.float64)
            depth.append(density[0] * length / number + CLOSED * (met and s == number - 1))
            tint.append(colour[0])
        _, shade, opacity = twin(torch.stack(depth), torch.stack(tint))
        colours.append(shade), opacities.append(opacity)
    return torch.stack(colours), torch.stack(opacities)


@pytest.mark.parametrize("factor", [1.0, 2.0, 10.0])
def test_float32_rendering_equals_float64_with_gradients(head: HeadModel, factor: float) -> None:
    """Shell, samples, neighbours, field and compositing together, on the codes as tracked, twice and ten times as large."""
    avatar, scene = new_avatar(head), wild_scene(head, factor)
    rows, columns = np.mgrid[4:40:5, 4:40:5]
    rays = scene.rays(1, columns.ravel(), rows.ravel())
    rendered = avatar.render(avatar.pose(*scene.heads([1], "cpu")), [rays], torch.float32).renders[-1]
    exact = new_avatar(head).double()
    colour, opacity = slow_render(exact, scene, 1, rays)
    assert ((rendered.opacity > 0.5).sum() > 10) and (rendered.opacity == 0).any() and torch.isfinite(rendered.depth).all()
    assert (rendered.colour.double() - colour).abs().max() < 1e-3 and (rendered.opacity.double() - opacity).abs().max() < 1e-3
    pull = torch.sin(torch.arange(colour.numel()).double()).view_as(colour)
    (rendered.colour * pull.float()).sum().backward()
    (colour * pull).sum().backward()
    for (name, mine), other in zip(avatar.named_parameters(), exact.parameters(), strict=True):
        if other.grad is not None:
            assert (mine.grad.double() - other.grad).norm() < 5e-3 * other.grad.norm() + 1e-6, name


@pytest.mark.parametrize("factor", [1.0, 10.0])
def test_marching_equals_rendering_on_wild_codes(head: HeadModel, factor: float) -> None:
    """Up to the END of the light that marching leaves out on purpose; the fog leaves no voxel empty."""
    avatar, scene = new_avatar(head), wild_scene(head, factor)
    rows, columns = np.mgrid[:40:2, :40:2]
    rays, posed = scene.rays(0, columns.ravel(), rows.ravel()), avatar.pose(*scene.heads([0], "cpu"))
    whole = marched_in_one_pass(avatar, posed, rays)
    blocks, _ = avatar.march(posed, rays, torch.float32)
    assert all(torch.isfinite(value).all() for value in blocks)
    assert (blocks.colour - whole.colour).abs().max() < 0.006 and (blocks.opacity - whole.opacity).abs().max() < 0.006


def test_a_batch_that_misses_everything_and_one_of_which_a_part_does(head: HeadModel) -> None:
    avatar, scene = new_avatar(head, representation="static"), wild_scene(head, 1.0)
    posed, beside = avatar.pose(*scene.heads([0, 1], "cpu")), scene.rays(0, np.arange(900, 905), np.zeros(5))
    through, none = scene.rays(1, np.array([20, 21]), np.array([20, 20])), scene.rays(1, np.zeros(0), np.zeros(0))
    for rays, hits in (([beside, beside], 0), ([none, none], 0), ([none, through], 2), ([beside, through], 2)):
        avatar.zero_grad()
        outcome = avatar.render(posed, rays, torch.float32)
        rendered = outcome.renders[-1]
        assert (outcome.evaluations > 0) == (hits > 0) and int((rendered.opacity > 0).sum()) == hits
        assert (rendered.colour[: len(rendered.colour) - hits] == 1).all()
        ((rendered.colour - 1).square().sum() + rendered.opacity.sum() + rendered.depth.sum()).backward()
        gradients = [parameter.grad for parameter in avatar.parameters() if parameter.grad is not None]
        assert all(torch.isfinite(gradient).all() for gradient in gradients)
        assert any(gradient.abs().sum() > 0 for gradient in gradients) == (hits > 0)


def test_a_camera_inside_the_shell_or_the_core(head: HeadModel) -> None:
    avatar, scene = new_avatar(head, representation="static"), wild_scene(head, 1.0)
    posed = avatar.pose(*scene.heads([0], "cpu"))
    vertex = posed.vertices_m[0, 100].numpy()
    directions = np.random.default_rng(0).normal(size=(64, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    for start in (vertex, np.zeros(3, np.float32)):  # exactly on a vertex, and in the middle of the head
        rays = Rays(np.tile(start, (64, 1)).astype(np.float32), directions)
        rendered = avatar.render(posed, [rays], torch.float32, [np.zeros((64, avatar.jitter_width), np.float32)]).renders[-1]
        assert all(torch.isfinite(value).all() for value in rendered)
        rendered.colour.sum().backward()
        assert all(torch.isfinite(p.grad).all() for p in avatar.parameters() if p.grad is not None)
        marched, _ = avatar.march(posed, rays, torch.float32)
        assert all(torch.isfinite(value).all() for value in marched)
        assert (rendered.opacity > 0).any() == bool(start.any())


@pytest.mark.parametrize("static", [False, True])
def test_features_of_codes_twice_and_ten_times_as_large(head: HeadModel, static: bool) -> None:
    """Finite with gradients, and no faster than the displacement: a network of piecewise linear parts grows linearly."""
    torch.manual_seed(0)
    source, sizes = DisplacementFeatures(head, 8, 64, static), []
    for factor in (1.0, 2.0, 10.0):
        code = torch.full((1, 3), factor)
        displacement = head.local(torch.zeros(2), code, torch.zeros(1, 3)) - head.template
        values = source(Condition(displacement, torch.cat([code, torch.zeros(1, 3)], 1), head.template)).values
        values.square().mean().backward()
        assert torch.isfinite(values).all() and all(torch.isfinite(p.grad).all() for p in source.parameters())
        sizes.append(float(values.detach().abs().max()))
    assert sizes[1] < 2.2 * sizes[0] and sizes[2] < 11 * sizes[0]


def test_grids_of_wild_codes_are_bounded_whatever_the_factor(head: HeadModel) -> None:
    thickness = np.full(head.vertex_count, 0.01)
    core = shell.core_points(
        head.template.double().numpy(), vertex_normals(head.template.double().numpy(), head.triangles.numpy())
    )
    limit = 2 * shell.REACH_M / shell.VOXEL_M + 2
    for factor in (2.0, 10.0, 1e3, 1e8):
        vertices = head.local(torch.zeros(2), torch.full((1, 3), factor), torch.zeros(1, 3))[0].numpy()
        grid = shell.occupancy(vertices, thickness, core)
        assert max(grid.labels.shape) <= limit and (grid.labels == shell.SHELL).any()
        found, count, _ = shell.intervals(grid, np.array([[0.0, 0, -2.0]]), np.array([[0.0, 0, 1.0]]))
        assert np.isfinite(found).all() and (count[0] >= 1 or factor > 10)
    far = shell.occupancy(np.full((4, 3), 50.0), np.full(4, 0.01), core)  # all of it out of reach: a grid of one voxel
    assert far.labels.size == 1
