"""`snakemake speed_error`: what is compared, the steps on the toy subject, the head model resampled."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from made_speed_error import PRESETS
from toy_head import toy_head
from toy_run import SMALL, job, write_subject

from avatar import build, marching, operations, sampling
from avatar.config import TrainConfig, modules_of
from avatar.dataset import Scene
from avatar.speed_error import cost, dense, rendering, resample, settings, training
from avatar.speed_error.config import CostConfig, RenderingConfig, TrainingConfig
from avatar.volume import Rays
from workflow import settings as checks

SHORT = SMALL | {"steps": 4}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The toy subject with landmarks, and an avatar of four steps."""
    folder = tmp_path_factory.mktemp("subject")
    paths = write_subject(folder) | {"landmarks": folder / "landmarks.npz", "lpips": folder / "lpips.ckpt"}
    track = dict(np.load(paths["track"]))
    np.savez(paths["track"], **track | {"usable": np.ones(8, bool)})
    np.savez(paths["landmarks"], points=np.zeros((8, 478, 3), np.float32), found=np.zeros(8, bool))
    outputs = {"avatar": folder / "avatar.pt", "curve": folder / "curve.tsv", "report": folder / "train.json"}
    training.run(job(TrainingConfig(train=TrainConfig(**SHORT)), paths, outputs))
    return paths | outputs


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean absolute error in the place of LPIPS, whose weights are a download; no cell changes the next one's early stop."""
    monkeypatch.setattr(rendering.lpips, "load", lambda path, device: lambda a, b: (a - b).abs().mean((1, 2, 3)))
    monkeypatch.setattr(marching, "END", marching.END)


def row_of(folder: Path, inputs: dict[str, Path], **keys: object) -> dict:
    """Run one rendering; its row."""
    outputs = {"row": folder / "row.json", "render": folder / "row.npy"}
    rendering.run(job(RenderingConfig(**keys), inputs, outputs))
    return json.loads(outputs["row"].read_text())


def test_everything_that_can_be_chosen_is_compared() -> None:
    made, rows, cells = settings.trainings(PRESETS), settings.renderings(PRESETS), settings.cells(PRESETS)
    kinds = settings.choices("representation")
    assert "layers" in kinds and {f"kind_{name}" for name in kinds} <= set(rows)
    assert {made[name].config.representation for name in kinds} == set(kinds)
    assert {made[f"neighbours_{name}"].config.neighbourhood for name in settings.choices("neighbourhood")[1:]}
    assert {row.training for row in rows.values()} == set(made), "no training without a row"
    assert {f"preset {name}" for name in PRESETS} == {f"preset {name[7:]}" for name in made if name[:7] == "preset_"} | set(
        settings.left_out(PRESETS)
    )
    assert all(find_spec(module) for name in kinds for module in modules_of(name, training=True))
    keys = [(row.training, row.config) for row in cells.values()]
    assert len(keys) == len({(name, config.model_dump_json()) for name, config in keys}) == len(cells) < len(rows)
    plans = settings.table_config(PRESETS).rows
    assert list(plans) == list(rows) and {plan.cell for plan in plans.values()} == set(cells)
    assert plans["shell_24"].cell == plans["end_0.004"].cell == plans["kind_ours_d"].cell
    assert {row.group for row in rows.values()} == set(settings.GROUPS)
    for name in settings.costs(PRESETS):
        assert name.split("_")[0] in ("frames", "pixels", "vertices")


def test_presets_that_are_one_training_when_cut_are_trained_once() -> None:
    short, long = (PRESETS["demo"].model_copy(update={"steps": steps}) for steps in (settings.PRESET_STEPS + 1, 9999))
    presets = {"long": long, "short": short, "other": PRESETS["demo"].model_copy(update={"steps": 3})}
    assert [settings.stands_for(presets, name) for name in presets] == ["long", "long", "other"]
    made = [name for name in settings.trainings(presets | {"demo": PRESETS["demo"]}) if name.startswith("preset_")]
    assert made == ["preset_long", "preset_other", "preset_demo"]
    assert settings.left_out(presets) == {"preset short": "cut to 1,200 steps it is the same training as preset long"}


def test_rows_that_stand_for_the_default_are_the_default() -> None:
    assert settings.DEFAULT_END == marching.END
    base = settings.base_of(PRESETS)
    assert base.max_samples * rendering.SAMPLE_FACTOR * marching.GUIDED == settings.DEFAULT_SAMPLES
    assert base.steps == settings.STEPS and base.model_copy(update={"steps": PRESETS["demo"].steps}) == PRESETS["demo"]


def test_a_row_counts_and_scores(inputs: dict[str, Path], tmp_path: Path) -> None:
    row = row_of(tmp_path, inputs, size=40, frames=2)
    assert row["frames"] == [6, 7] and row["size"] == [40, 40] and row["training"]["steps"] == 4
    assert row["ms_per_frame"] > 0 and len(row["ms"]) == 2 and row["memory_mb"] > 50
    assert 0 < row["evaluations_per_ray"] < row["evaluations_per_head_ray"]
    assert row["gflop_per_frame"] > row["gflop_of_head"] > 0
    assert 5 < row["scores"]["psnr"] < 60 and 0 < row["scores"]["iou"] <= 1 and "lpips_mouth" not in row["scores"]
    few, many = (row_of(tmp_path / str(n), inputs, size=40, frames=1, samples=n) for n in (2, 16))
    assert few["evaluations_per_head_ray"] < many["evaluations_per_head_ray"]


@pytest.mark.parametrize(("keys", "count"), [({"sampling": "dense", "samples": 8}, 8.0), ({"sampling": "dense_fine", "samples": 8,
                                              "fine_samples": 4}, 20.0)])  # fmt: skip
def test_whole_rays_cost_the_same_anywhere(inputs: dict[str, Path], tmp_path: Path, keys: dict, count: float) -> None:
    row = row_of(tmp_path, inputs, size=32, frames=1, **keys)
    assert row["evaluations_per_ray"] == row["evaluations_per_head_ray"] == count
    assert np.load(tmp_path / "row.npy").shape == (1, 32, 32, 4)


def test_the_early_stop_is_that_of_the_row(inputs: dict[str, Path], tmp_path: Path) -> None:
    all_of_it, little = (row_of(tmp_path / str(end), inputs, size=40, frames=1, end=end) for end in (0.0, 0.9))
    assert little["evaluations_per_ray"] < all_of_it["evaluations_per_ray"]


def test_operations_are_those_of_the_layers(inputs: dict[str, Path]) -> None:
    head = toy_head(24, 36)
    config = TrainConfig(**SMALL | {"representation": "static", "static_features": False})
    avatar = build.build(build.settings_of(config), head)
    sample, frame = operations.operations(avatar, head)
    field, neighbours, width = avatar.field, config.neighbours, config.mlp_width
    per_point = sum(layer.weight.numel() for layer in (*field.mlp1.layers, field.density, *field.mlp2.layers, field.colour))
    per_neighbour = field.from_offset.weight.numel() + sum(layer.weight.numel() for layer in field.mlp0.layers) + width
    assert sample == 2 * (per_point + neighbours * per_neighbour)
    assert frame == 2 * head.vertex_count * field.from_feature.weight.numel()
    assert operations.operations(torch.nn.Linear(2, 2), head) is None
    warped = build.build(build.settings_of(config), head)
    warped.correct_errors(3)
    assert operations.operations(warped, head)[0] > sample


def test_operations_of_layers_are_those_of_their_maps() -> None:
    head = toy_head(24, 36)
    settings_of_it = build.settings_of(TrainConfig(representation="layers", texture_size=64, layers=4, bases=2))
    avatar = build.build(settings_of_it, head)
    texel, frame = operations.operations(avatar, head)
    counted = []
    hooks = [
        module.register_forward_hook(
            lambda m, i, o: counted.append(2 * m.weight.numel() * (i[0] if "T" in type(m).__name__ else o)[0, 0].numel())
        )
        for module in avatar.modules()
        if isinstance(module, (torch.nn.Conv2d, torch.nn.ConvTranspose2d))
    ]
    with torch.no_grad():
        avatar.out(avatar.unet(torch.zeros(1, 9, 64, 64)))
    assert texel == 2 * 4 * 2 and frame == sum(counted) and hooks


def test_dense_rays_equal_their_plain_sum(inputs: dict[str, Path]) -> None:
    head, track = toy_head(24, 36), dict(np.load(inputs["track"]))
    avatar = build.restore(torch.load(inputs["avatar"], weights_only=True), head)
    scene = Scene(head, track, [6])
    posed = avatar.pose(*scene.heads([6], "cpu"))
    rays = Rays(*(array[760:800] for array in scene.view(6, (40, 40)).rays()))
    found, count = dense.march(avatar, posed, rays, torch.float32, 16)
    assert count == 16 * 40 and found.opacity.max() > 0.01
    terms = avatar.field.vertex_terms(avatar.source(posed.condition).values, torch.float32)[0].detach()
    near, far = sampling.bounds(posed.vertices_m[0].numpy(), rays.origins_m)
    for n in range(0, 40, 7):
        step = (far[n] - near[n]) / 16
        along = near[n] + (np.arange(16) + 0.5) * step
        points = torch.from_numpy(np.float32(rays.origins_m[n] + along[:, None] * rays.directions[n]))
        direction = torch.from_numpy(np.tile(rays.directions[n], (16, 1)))
        index = torch.from_numpy(avatar.nearest(posed, 0, points.numpy()))
        with torch.no_grad():
            density, colour = avatar.field(points, direction, posed.vertices_m[0], index, terms)
        alpha = 1 - np.exp(-density.double().numpy() * step)
        weight = alpha * np.cumprod(np.append(1.0, 1 - alpha))[:-1]
        expected = (weight[:, None] * colour.double().numpy()).sum(0) + 1 - weight.sum()
        assert np.abs(found.colour[n].numpy() - expected).max() < 2e-4
    fine, count = dense.march(avatar, posed, rays, torch.float32, 16, 8)
    assert count == (16 + 24) * 40 and (fine.opacity - found.opacity).abs().max() < 0.5


def test_a_training_that_fails_is_a_row(inputs: dict[str, Path], tmp_path: Path) -> None:
    track = dict(np.load(inputs["track"]))
    np.savez(tmp_path / "track.npz", **track | {"translation": track["translation"] + np.float32([0.2, 0, 0])})
    outputs = {"avatar": tmp_path / "avatar.pt", "curve": tmp_path / "curve.tsv", "report": tmp_path / "train.json"}
    training.run(job(TrainingConfig(train=TrainConfig(**SHORT)), inputs | {"track": tmp_path / "track.npz"}, outputs))
    assert "overlap of only" in row_of(tmp_path, inputs | outputs)["failed"] and np.load(tmp_path / "row.npy").shape[0] == 0
    assert "overlap" in cost_of(tmp_path, inputs | outputs, kind="pixels", amount=64)["failed"]


def cost_of(folder: Path, inputs: dict[str, Path], **keys: object) -> dict:
    """Run one amount of work; its row."""
    output = folder / "cost.json"
    cost.run(job(CostConfig(steps=2, pictures=1, train=TrainConfig(**SHORT), **keys), inputs, {"row": output}))
    assert not output.with_suffix("").exists()
    return json.loads(output.read_text())


def test_work_that_grows_is_timed(inputs: dict[str, Path], tmp_path: Path) -> None:
    frames = cost_of(tmp_path, inputs, kind="frames", amount=4)
    assert frames["amount"] == 4 and frames["step_s"] > 0 and frames["memory_mb"] > 50
    small, large = (cost_of(tmp_path, inputs, kind="pixels", amount=size) for size in (32, 96))
    assert large["evaluations_per_frame"] > small["evaluations_per_frame"] > 0
    finer = cost_of(tmp_path, inputs, kind="vertices", amount=1500, size=32)
    assert finer["amount"] == 1500 and finer["step_s"] > 0 and finer["ms_per_frame"] > 0


def surface(head) -> tuple[float, float]:  # noqa: ANN001
    """Area m2 and enclosed volume m3."""
    corners = head.template.double().numpy()[head.triangles.numpy()]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.linalg.norm(normals, axis=1).sum() / 2, (np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum() / 6


@pytest.mark.parametrize(("count", "area", "volume"), [(1300, 1e-6, 1e-6), (3000, 1e-6, 1e-6), (500, 0.03, 0.05)])
def test_a_head_resampled_is_still_that_head(count: int, area: float, volume: float) -> None:
    head = toy_head(24, 36)
    made = resample.resampled(head, count)
    assert made.vertex_count == count and made.digest != head.digest
    assert [len(part) for part in (made.region, made.skinning_weights)] == [count, count]
    assert made.expression_basis.shape == (3, count, 3) and made.pose_basis.shape == (0, count, 3)
    before, after = surface(head), surface(made)
    assert abs(after[0] / before[0] - 1) < area and abs(after[1] / before[1] - 1) < volume
    edges = np.sort(made.triangles.numpy()[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all(), "closed, as before"
    assert torch.allclose(made.skinning_weights.sum(1), torch.ones(count), atol=1e-6)
    corners = made.uvs[made.uv_triangles].double()
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area_uv = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    assert (area_uv.sign() == area_uv.sign()[0]).all() and abs(float(area_uv.abs().sum()) - 0.96**2) < 0.04, "no seam crossed"


def test_landmarks_move_to_the_nearest_vertex() -> None:
    from dataclasses import replace

    head = toy_head(24, 36)
    triangles = torch.full((478,), -1)
    triangles[7] = 500
    barycentric = torch.zeros(478, 3)
    barycentric[7] = torch.tensor([0.2, 0.3, 0.5])
    head = replace(head, landmark_triangles=triangles, landmark_barycentric=barycentric)
    made = resample.resampled(head, 2000)
    before, after = head.landmarks(head.template)[7], made.landmarks(made.template)[7]
    assert (before - after).norm() < 0.006 and (made.landmark_triangles >= 0).sum() == 1


def test_a_mesh_that_cannot_be_coarser_says_so() -> None:
    with pytest.raises(ValueError, match="has no 3 vertices"):
        resample.resampled(toy_head(6, 8), 3)


def test_its_folder_is_no_subject(tmp_path: Path) -> None:
    (tmp_path / "speed_error.mp4").touch()
    with pytest.raises(checks.SettingsError, match="cannot be used for a subject"):
        checks.discover(tmp_path)
