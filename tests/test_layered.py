"""The layered avatar's parts: layout, shells, first textures, file, and the picture that they make together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage
from toy_head import toy_head, toy_images, toy_track

from avatar import build
from avatar.config import TrainConfig
from avatar.dataset import Scene, on_white
from avatar.layered import initial, packing, shells
from avatar.layered.layout import layout, magnified, stretched
from avatar.layered.model import FADE, LayeredAvatar
from fitting.head_model import REGIONS, HeadModel
from fitting.raster import vertex_normals

SIZE = 48
SETTINGS = build.settings_of(TrainConfig(representation="layers", layers=5, bases=2, texture_size=64, uv_size=64))


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return toy_head(24, 36)


@pytest.fixture(scope="module")
def scene(head: HeadModel) -> Scene:
    return Scene(head, toy_track(head, 6, SIZE), range(6))


def made(head: HeadModel, thickness_m: float = 0.01) -> LayeredAvatar:
    torch.manual_seed(0)
    avatar = build.build(SETTINGS, head)
    avatar.shape_shell(torch.full((head.vertex_count,), thickness_m))
    return avatar.eval()


def area(corners: np.ndarray) -> np.ndarray:
    a, b, c = (corners[:, i] for i in range(3))
    return ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])) / 2


def test_the_layout_keeps_charts_whole_and_gives_the_face_more(head: HeadModel) -> None:
    found = layout(head)
    assert found.shape == (len(head.triangles), 3, 2) and found.min() >= 0 and found.max() <= 1
    before, after = area(head.uvs.numpy()[head.uv_triangles.numpy()]), area(found.astype(np.float64))
    assert (np.sign(before) == np.sign(after)).all() and np.abs(after).min() > 0
    corners = head.template.double().numpy()[head.triangles.numpy()]
    surface = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face = (head.region == REGIONS.index("face")).numpy()[head.triangles[:, 0]]
    growth = np.abs(after) / np.abs(before)
    assert growth[face].sum() > growth[~face].sum() * face.mean() / (~face).mean() and (np.abs(after) / surface).min() > 0


def test_magnification_keeps_order_and_leaves_what_is_far() -> None:
    line = np.stack([np.linspace(0, 1, 400), np.full(400, 0.5)], -1)
    moved = magnified(line, np.array([0.5, 0.5]), np.array([0.1, 0.1]), 1.6)
    steps = np.diff(moved[:, 0]) * 399
    assert steps.min() > 0 and steps.max() == pytest.approx(2.6, abs=0.05) and np.abs(moved - line)[[0, -1]].max() < 1e-6


def test_a_small_part_that_wants_detail_gets_it() -> None:
    """A strip of 10 squares of equal size, the 4th of which wants four times the texels along the strip."""
    left = np.repeat(np.arange(10) / 10, 2)
    lower, upper = [[0, 0], [0.1, 0], [0, 1]], [[0.1, 0], [0.1, 1], [0, 1]]
    corners = np.array([lower, upper] * 10) + np.stack([left, 0 * left], -1)[:, None]
    points = np.concatenate([corners * [1.0, 0.1], np.zeros((20, 3, 1))], -1)
    wanted = np.where(np.arange(20) // 2 == 3, 4.0, 1.0)
    wide = np.ptp(stretched(corners, points, wanted)[..., 0], axis=1)
    assert wide[6] > 2 * np.median(wide) and wide.min() > 0
    even = stretched(corners, points, np.ones(20))
    assert np.allclose(even, corners, atol=0.02)


def test_shells_lie_in_order_from_outside_to_beneath(head: HeadModel) -> None:
    offsets = shells.offsets(head, np.full(head.vertex_count, 0.03), 6)
    assert offsets.shape == (6, head.vertex_count) and offsets.dtype == np.float32
    assert (np.diff(offsets[:-1], axis=0) < 0).all() and (offsets[-2] == -np.float32(shells.BENEATH_M)).all()
    assert np.allclose(offsets[0], 0.03) and not offsets[-1].any()
    bare = shells.offsets(head, np.full(head.vertex_count, 0.009), 6)
    face = (head.region == REGIONS.index("face")).numpy()
    assert bare[0][face].min() == pytest.approx(shells.SKIN_M, abs=1e-3)
    with pytest.raises(ValueError, match="at least 3"):
        shells.offsets(head, np.full(head.vertex_count, 0.03), 2)


def test_shells_come_close_to_a_surface_that_is_known(head: HeadModel) -> None:
    before = shells.offsets(head, np.full(head.vertex_count, 0.03), 8)
    surface = np.where(head.template[:, 1].numpy() < -0.04, 0.02, np.nan)
    after = shells.around(head, before, surface)
    assert np.array_equal(after[[0, -3, -2, -1]], before[[0, -3, -2, -1]]) and (np.diff(after[:-1], axis=0) <= 1e-6).all()
    inside = head.template[:, 1].numpy() < -0.08
    assert np.abs(after[1:-3, inside] - 0.02).max() < 0.0045 and np.abs(before[1:-3, inside] - 0.02).max() > 0.009
    nowhere = shells.around(head, before, np.full(head.vertex_count, np.nan))
    assert np.allclose(nowhere, before, atol=1e-6)


def test_a_plane_sweep_finds_where_the_surface_is(head: HeadModel) -> None:
    """A textured ellipsoid 9 mm larger than the mesh, seen from several sides: the shells settle on it."""
    size, count = 128, 8
    track = toy_track(head, count, size)
    track["rotation"] = np.stack(
        [np.linspace(-0.3, 0.3, count) * 0.6, np.linspace(-0.35, 0.35, count), np.zeros(count)], 1
    ).astype(np.float32)
    track["expression"] *= 0
    normals = vertex_normals(head.template.double().numpy(), head.triangles.numpy())
    larger = replace(head, template=head.template + 0.009 * torch.from_numpy(normals).float())
    frames, alpha = toy_images(larger, track, size)
    scene, avatar = Scene(head, track, range(count)), build.build(SETTINGS | {"layers": 12, "texture_size": 128}, head)
    avatar.shape_shell(torch.full((head.vertex_count,), 0.018))
    wide = avatar.offsets_m.clone()
    initial.settle(avatar, scene, frames, alpha, range(count))
    front = (head.template[:, 2] < -0.06).numpy()
    middle = avatar.offsets_m[1:-3].mean(0).numpy()[front]
    assert abs(np.median(middle) - 0.009) < 0.003 and np.ptp(wide[1:-3, front].numpy(), axis=0).mean() > 0.012


def test_packed_textures_come_back_to_half_a_level() -> None:
    textures = torch.randn(3, 16, 16, 8) * torch.rand(8) * 5
    stored = packing.packed_textures(textures)
    found = packing.unpacked_textures(stored, tuple(textures.shape))
    assert ((found - textures).abs() <= stored["step"][:, None, None] * 0.501).all()
    constant = torch.full((1, 4, 4, 4), 2.5)
    assert torch.equal(packing.unpacked_textures(packing.packed_textures(constant), (1, 4, 4, 4)), constant)
    with pytest.raises(ValueError, match="expected"):
        packing.unpacked_textures(stored, (3, 16, 8, 8))
    with pytest.raises(ValueError, match="cannot be read"):
        packing.unpacked_textures(stored | {"bytes": stored["bytes"][:10]}, tuple(textures.shape))


def test_projected_textures_already_show_the_subject(head: HeadModel, scene: Scene) -> None:
    track = toy_track(head, 6, SIZE)
    frames, alpha = toy_images(head, track, SIZE)
    avatar = made(head)
    initial.project(avatar, scene, frames, alpha, range(0, 6, 2))
    assert torch.isfinite(avatar.textures).all()
    posed = avatar.pose(*scene.heads([1], "cpu"))
    rendered, evaluations = avatar.picture(posed, scene.view(1, (SIZE, SIZE)), torch.float32)
    error = rendered.colour.numpy() - on_white(frames[1], alpha[1]).reshape(-1, 3)
    assert -10 * np.log10(np.mean(error**2)) > 18  # white alone: 6 to 9 dB
    assert evaluations > 0 and rendered.opacity.shape == (SIZE * SIZE,)


def test_depth_is_the_ellipsoids_where_it_is_opaque(head: HeadModel, scene: Scene) -> None:
    avatar = made(head, 0.002)
    avatar.textures[..., 3] = 12.0
    view = scene.view(2, (SIZE, SIZE))
    posed = avatar.pose(*scene.heads([2], "cpu"))
    rendered, _ = avatar.picture(posed, view, torch.float32)
    rays, solid = view.rays(), rendered.opacity.numpy() > 0.99
    ends = (rays.origins_m + rendered.depth.numpy()[:, None] * rays.directions)[solid]
    away = np.linalg.norm(ends[:, None] - posed.layers_m[0][None], axis=-1).min(1)
    assert solid.sum() > 200 and np.quantile(away, 0.95) < 0.012  # edges of the toy mesh are 2 cm long


def test_a_file_draws_what_was_trained(head: HeadModel, scene: Scene) -> None:
    avatar = made(head)
    avatar.textures[...] += torch.randn(avatar.textures.shape)
    avatar.fading.data += 0.1 * torch.randn(avatar.fading.shape)
    stored = build.content(avatar, SETTINGS, head)
    again = build.restore(stored, head)
    assert torch.equal(again.offsets_m, avatar.offsets_m) and torch.equal(again.fading, avatar.fading.bfloat16().float())
    pictures = [
        one.picture(one.pose(*scene.heads([0], "cpu")), scene.view(0, (SIZE, SIZE)), torch.float32)[0].colour
        for one in (avatar, again)
    ]
    assert (pictures[0] - pictures[1]).abs().mean() < 0.004
    with pytest.raises(ValueError, match="another head|was trained on"):
        build.restore(stored | {"head_digest": "other"}, head)


def test_left_out_pixels_are_not_seen_by_the_others(head: HeadModel, scene: Scene) -> None:
    """The picture of every third pixel is every third pixel of the picture, two samples and all."""
    avatar = made(head)
    avatar.textures[...] += torch.randn(avatar.textures.shape)
    posed, view = avatar.pose(*scene.heads([0], "cpu")), scene.view(0, (SIZE, SIZE))
    assert view.every(2).every(3).stride == 6 == view.every(2).every(3).window(1, 1, (2, 2)).stride
    whole, part = (avatar.picture(posed, seen, torch.float32)[0] for seen in (view, view.every(3)))
    chosen = whole.colour.unflatten(0, (SIZE, SIZE))[::3, ::3].reshape(-1, 3)
    assert chosen.shape == part.colour.shape and chosen.std() > 0.05
    assert (chosen - part.colour).abs().amax(1).quantile(0.98) < 1e-3  # but where float32 moves an edge over a sample


@pytest.mark.parametrize("factor", [0.0, 2.0, 1e3])
def test_any_expression_gives_a_finite_picture(head: HeadModel, factor: float) -> None:
    track = toy_track(head, 2, SIZE)
    scene = Scene(head, track | {"expression": track["expression"] * np.float32(factor)}, range(2))
    rendered, _ = made(head).picture(made(head).pose(*scene.heads([0], "cpu")), scene.view(0, (SIZE, SIZE)), torch.float32)
    assert torch.isfinite(rendered.colour).all() and torch.isfinite(rendered.depth).all()


def test_a_head_out_of_the_picture_is_white(head: HeadModel) -> None:
    track = toy_track(head, 2, SIZE)
    scene = Scene(head, track | {"translation": track["translation"] + np.array([9, 0, 0], np.float32)}, range(2))
    avatar = made(head)
    rendered, evaluations = avatar.picture(avatar.pose(*scene.heads([0], "cpu")), scene.view(0, (SIZE, SIZE)), torch.float32)
    assert (rendered.colour == 1).all() and not rendered.opacity.any() and evaluations == 0


def test_the_maps_see_how_the_head_is_turned_and_shells_fade_at_their_rim(head: HeadModel, scene: Scene) -> None:
    avatar = made(head)
    posed, view = avatar.pose(*scene.heads([0], "cpu")), scene.view(0, (SIZE, SIZE))
    front = avatar.maps(posed, view)
    behind = avatar.maps(posed, view._replace(rotation=np.diag([-1.0, 1.0, -1.0]) @ view.rotation))
    assert front.shape == (5, 64, 64, 2 + 4 + 2) and (front - behind)[..., :5].abs().max() > 1e-5
    opacity = front[..., 5].detach()
    assert opacity[0].min() < -FADE * 0.9 and opacity[0].max() > -1 and opacity[-2:].min() > -4
    with torch.no_grad():
        avatar.fading[0, :, :32] = -1  # places of the outermost shell that have learned to stay
    stays = avatar.maps(posed, view)[0, ..., 5].detach()
    assert stays[:, :32].min() > -4 and torch.equal(stays[:, 32:], opacity[0, :, 32:]) and opacity[0, :, :32].min() < -4
    avatar.fading.grad = None
    avatar.maps(posed, view)[..., 5].sum().backward()
    assert avatar.fading.grad[1:].abs().max() > 0  # and all others may learn it


def test_over_the_face_another_shell_must_be_clearly_better_to_be_the_surface(head: HeadModel) -> None:
    avatar = made(head)
    skin, side = len(avatar.textures) - 3, avatar.textures.shape[1]
    face = initial._map_of(avatar, (head.region == REGIONS.index("face")).double().numpy(), "skin", side) > 0.5
    assert face.any() and not face.all()
    for better, taken in ((0.9, skin), (0.5, 0)):
        disagreement = np.ones((skin + 1, side, side))
        disagreement[0] = better
        nearest = initial._nearest(avatar, disagreement)
        inner = ndimage.binary_erosion(face, iterations=initial.MEDIAN)
        assert (nearest[inner] == taken).all() and (nearest[ndimage.binary_erosion(~face, iterations=initial.MEDIAN)] == 0).all()
    unknown = np.full((skin + 1, side, side), np.inf)  # that no frame saw
    assert (initial._nearest(avatar, unknown) == skin).all()
