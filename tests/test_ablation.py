"""The ablation: one tiny cell on the toy subject, its data, its settings and when it is planned."""

from __future__ import annotations

import json
import os
import signal
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pipeline import Pipeline
from toy_run import SMALL, job, write_subject

from avatar import train
from avatar.ablation import cell as ablation
from avatar.ablation import data as ablation_data
from avatar.ablation import settings as ablation_settings
from avatar.ablation import truth as ablation_truth
from avatar.ablation.config import AblationConfig, AblationDataConfig
from avatar.config import TrainConfig
from avatar.dataset import Scene
from avatar.learning import rays
from fitting import simulate, synthetic
from fitting.config import SimulateConfig
from fitting.head_model import HeadModel
from fitting.synthetic_motion import exaggerated
from tests.small_face import true_head
from workflow import settings
from workflow.step import StepError

SUBJECT = ablation_settings.SUBJECT


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The toy subject, with doubled test frames that are its plain ones."""
    folder = tmp_path_factory.mktemp("subject")
    paths = write_subject(folder)
    test = json.loads(paths["split"].read_text())["test"]
    np.savez(
        folder / "doubled.npz",
        frames=np.load(paths["frames"])[test],
        alpha=np.load(paths["alpha"])[test],
        numbers=np.array(test),
    )
    return paths | {"doubled": folder / "doubled.npz", "lpips": folder / "lpips.ckpt"}


@pytest.fixture(autouse=True)
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Full precision, and the mean absolute error in the place of LPIPS, whose weights are a download."""
    monkeypatch.setattr(rays, "best_precision", lambda device: torch.float32)
    monkeypatch.setattr(ablation, "best_precision", lambda device: torch.float32)
    monkeypatch.setattr(ablation.lpips, "load", lambda path, device: lambda a, b: (a - b).abs().mean((1, 2, 3)))


def cell(folder: Path, inputs: dict[str, Path], **keys: object) -> dict:
    """Run one cell; the content of its row."""
    config = AblationConfig(train=TrainConfig(**(SMALL | {"steps": 4} | keys)))
    outputs = {"row": folder / "ann" / "ours_d" / "0.json", "picture": folder / "ann" / "ours_d" / "0.png"}
    ablation.run(job(config, inputs, outputs))
    return json.loads(outputs["row"].read_text())


def test_a_cell_is_trained_rendered_and_scored(inputs: dict[str, Path], tmp_path: Path) -> None:
    row = cell(tmp_path, inputs)
    assert row["steps"] == 4 and row["training_frames"] + 1 >= 5 and row["train_seconds"] > 0
    assert set(row["scores"]) == {"test", "doubled"} and row["scores"]["test"]["frames"] == 2
    plain, doubled = row["scores"]["test"], row["scores"]["doubled"]
    assert 0 < plain["lpips"] < 1 and 5 < plain["psnr"] < 60 and plain["ssim"] <= 1
    assert plain["psnr"] != doubled["psnr"], "the same pictures, but other codes"
    picture = cv2.imread(str(tmp_path / "ann" / "ours_d" / "0.png"))
    assert picture.shape[0] == 4 * 40  # truth and render of both sets
    assert not (tmp_path / "ann" / "ours_d" / "0").exists()
    without = {name: path for name, path in inputs.items() if name != "doubled"}
    assert set(cell(tmp_path / "real", without)["scores"]) == {"test"}


@pytest.mark.parametrize("representation", ["static", "codes", "ours_c"])
def test_other_sources_are_cells_too(inputs: dict[str, Path], tmp_path: Path, representation: str) -> None:
    assert cell(tmp_path, inputs, representation=representation, static_features=False)["scores"]["test"]["frames"] == 2


def test_an_interrupted_cell_goes_on(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    original, done = train.optimise, []

    def interrupted(*arguments: object) -> float:
        done.append(1)
        if len(done) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return original(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(train, "optimise", interrupted)
        with pytest.raises(KeyboardInterrupt):
            cell(tmp_path, inputs)
    with caplog.at_level("INFO"):
        resumed = cell(tmp_path, inputs)
    assert "continuing at step 2 of 4" in caplog.text
    assert resumed["scores"] == cell(tmp_path / "whole", inputs)["scores"]


def test_a_training_that_fails_is_a_row(inputs: dict[str, Path], tmp_path: Path) -> None:
    track = dict(np.load(inputs["track"]))
    np.savez(tmp_path / "track.npz", **track | {"translation": track["translation"] + np.float32([0.2, 0, 0])})
    row = cell(tmp_path, inputs | {"track": tmp_path / "track.npz"})
    assert "overlap of only" in row["failed"] and "scores" not in row


def test_doubled_frames_of_another_split_are_refused(inputs: dict[str, Path], tmp_path: Path) -> None:
    with np.load(inputs["doubled"]) as file:
        np.savez(tmp_path / "doubled.npz", **dict(file) | {"numbers": np.array([0, 1])})
    with pytest.raises(StepError, match="not of the frames"):
        cell(tmp_path, inputs | {"doubled": tmp_path / "doubled.npz"})


def test_lids_are_not_closed_twice() -> None:
    names = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "bump0")
    found = exaggerated(np.full((2, 4), 0.4, np.float32), names, 2.0)
    assert found.dtype == np.float32 and np.allclose(found, [0.8, 0.4, 0.4, 0.8])


def shrunk(folder: Path, inputs: dict[str, Path], size: int, **more: Path) -> dict[str, Path]:
    """Run the step `ablation_data`; its outputs."""
    outputs = {name: folder / name for name in ("frames", "alpha", "track", "split", "half", "four")}
    ablation_data.run(job(AblationDataConfig(size=size, test_frames=2), inputs | more, outputs))
    return outputs


def test_small_frames_and_their_camera_agree(inputs: dict[str, Path], tmp_path: Path) -> None:
    index = tmp_path / "frames.json"
    index.write_text(json.dumps({"source_frame": list(range(8))}))
    made = shrunk(tmp_path, inputs, 32, index=index)
    frames, alpha, split = np.load(made["frames"]), np.load(made["alpha"]), json.loads(made["split"].read_text())
    assert frames.shape == (*alpha.shape, 3) and max(alpha.shape[1:]) == 32 and frames.dtype == alpha.dtype == np.uint8
    assert split["test"] == [6, 7] and split["train"] == list(range(6))
    assert json.loads(made["half"].read_text())["train"] == [0, 1, 2]
    four = json.loads(made["four"].read_text())
    assert four["train"] == four["test"] == [0, 2, 3, 5]
    assert (alpha.max((0, 1)) > 0).mean() > 0.8 and (alpha.max((0, 2)) > 0).mean() > 0.8, "cut to the head"
    with np.load(made["track"], allow_pickle=False) as file:
        track = dict(file)
    head = HeadModel.load(inputs["head"])
    scene = Scene(head, track, [3])
    pixel = np.floor(scene.pixels_of(3, scene.vertices_m[0].numpy().astype(np.float64))).astype(int)
    inside = ((pixel >= 0) & (pixel < alpha.shape[2:0:-1])).all(1)
    assert inside.all() and (alpha[3][pixel[:, 1], pixel[:, 0]] > 0).mean() > 0.9
    rows, columns = np.nonzero(alpha[3] > 127)
    found = np.array([columns.min(), columns.max() + 1, rows.min(), rows.max() + 1])
    exact = scene.pixels_of(3, scene.vertices_m[0].numpy().astype(np.float64))
    assert np.abs(found - [exact[:, 0].min(), exact[:, 0].max(), exact[:, 1].min(), exact[:, 1].max()]).max() < 1.0


def test_no_tracked_test_frame() -> None:
    with pytest.raises(StepError, match="none of the test frames"):
        ablation_data.small_split({"train": [0], "test": [1]}, np.array([True, False]), 3)
    with pytest.raises(StepError, match="mattes are empty"):
        ablation_data.head_box(np.zeros((2, 4, 4), np.uint8), np.ones(2, bool))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Path], AblationDataConfig, synthetic.Clip]:
    """A clip of the small face whose track is the true one but for the bumps, with every second frame left out."""
    folder = tmp_path_factory.mktemp("simulated")
    config = SimulateConfig(kind="talk", seed=1, frames=12, height=160, width=192)
    head = true_head()
    clip = simulate.clip_of(config, head)
    index = {"source_frame": list(range(0, 12, 2)), "crop": {"x": 30, "y": 10, "width": 140, "height": 150}, "scale": 0.8}
    index |= {"size": [120, 112]}
    track = ablation_truth.true_track(clip, index) | {"head_digest": np.array(head.digest), "usable": np.ones(6, bool)}
    track["expression"] = track["expression"][:, : len(head.expression_names)]
    paths = {name: folder / f"{name}.npz" for name in ("head", "rich", "track", "truth")} | {"index": folder / "i.json"}
    head.save(paths["head"]), head.save(paths["rich"])
    np.savez(paths["track"], **track)
    np.savez(paths["truth"], **clip.arrays())
    paths["index"].write_text(json.dumps(index))
    paths["split"] = folder / "split.json"
    crop = {"x": 0, "y": 0, "width": 112, "height": 120}
    paths["split"].write_text(json.dumps({"train": [0, 1, 2, 3], "test": [4, 5], "crop": [crop, [60, 56], 0.5]}))
    return paths, AblationDataConfig(simulate=config), clip


def true_of(folder: Path, inputs: dict[str, Path], config: AblationDataConfig) -> dict[str, Path]:
    """Run the step `ablation_truth`; its outputs."""
    outputs = {"head": folder / "h.npz", "track": folder / "t.npz", "doubled": folder / "d.npz"}
    ablation_truth.run(job(config, inputs, outputs))
    return outputs


def test_the_true_head_and_track_are_exact(simulated: tuple, tmp_path: Path) -> None:
    inputs, config, clip = simulated
    made = true_of(tmp_path, inputs, config)
    with np.load(made["track"], allow_pickle=False) as file:
        track = dict(file)
    scene = Scene(HeadModel.load(made["head"]), track, [5])  # the digests agree
    found = scene.pixels_of(5, scene.vertices_m[0].numpy().astype(np.float64))
    expected = (clip.camera.project(clip.vertices[10].astype(np.float64)) - [30, 10]) * 0.8 * 0.5
    assert np.abs(found - expected).max() < 0.01


def test_doubled_frames_move_further(simulated: tuple, tmp_path: Path) -> None:
    inputs, config, clip = simulated
    with np.load(true_of(tmp_path, inputs, config)["doubled"]) as file:
        doubled = dict(file)
    same = true_of(tmp_path / "same", inputs, config.model_copy(update={"factor": 1.0}))["doubled"]
    with np.load(same) as file:
        plain = dict(file)
    assert doubled["numbers"].tolist() == [4, 5] and doubled["frames"].shape == (2, 60, 56, 3)
    difference = np.abs(doubled["frames"].astype(int) - plain["frames"]).mean(-1)
    assert difference.max() > 20 and (difference > 15).mean() < 0.2, "the face alone"
    stronger = synthetic.exaggerated(clip, 2.0)
    blink = clip.head.expression_names.index("eyeBlinkLeft")
    assert np.array_equal(stronger.motion.expression[:, blink], clip.motion.expression[:, blink])
    assert np.array_equal(stronger.motion.bumps, 2 * clip.motion.bumps)


@pytest.mark.parametrize(("change", "reason"), [({"seed": 2}, "not the clip of this config"), ({"k1": 0.1}, "distortion")])
def test_another_clip_is_refused(simulated: tuple, tmp_path: Path, change: dict, reason: str) -> None:
    inputs, config, _ = simulated
    other = config.model_copy(update={"simulate": config.simulate.model_copy(update=change)})
    with pytest.raises(StepError, match=reason):
        true_of(tmp_path, inputs, other)


def test_settings_are_equal_but_for_what_is_compared() -> None:
    cells = ablation_settings.CELLS
    configs = {name: ablation_settings.config_of(name, 0) for name in cells}
    alike = {"representation": "ours_d", "warp": False, "static_features": False}
    small = [config for name, config in configs.items() if cells[name].group != "overfit"]
    assert len({config.model_copy(update={"train": config.train.model_copy(update=alike)}) for config in small}) == 1
    assert ablation_settings.TRAIN.steps >= 2000 and not ablation_settings.TRAIN.static_features
    assert [name for name, config in configs.items() if config.train.warp] == ["ours_d_table_warp"]
    assert all(config.train.static_features == ("table" in name) for name, config in configs.items())
    assert ablation_settings.cell_of("ours_c", True) == "ours_c_table" and ablation_settings.cell_of("codes", True) == "codes"
    assert all(find_spec(f"avatar.features.{cell.representation}") for cell in cells.values())
    for config in configs.values():
        assert AblationConfig.model_validate_json(config.model_dump_json()) == config
    rows = ablation_settings.planned(["ann"])
    assert len(rows) == len(set(rows)) == 17 + 2 * 8 + 8 and ("ann", "ours_d_table_true", 0) not in rows
    assert {cell for _, cell, seed in rows if seed == 2} == {cell for subject, cell, _ in rows if subject == "ann"}
    assert {seed for subject, _, seed in rows if subject == "ann"} == {0}


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Pipeline:
    return Pipeline.create(tmp_path_factory.mktemp("ablation") / "run", ("ann", "bob"))


def test_runs_when_asked_for_and_is_then_done(pipeline: Pipeline) -> None:
    assert not [line for line in pipeline.plan() if "ablation" in line or "simulat" in line]
    pipeline.set_fate(ann="reject")
    result = pipeline.run("ablation")
    assert result.code == 0, result.text
    ran = pipeline.ran()
    rows = [line for line in ran if line.startswith("avatar.ablation.cell ")]
    assert len(rows) == len(ablation_settings.planned(["bob"])) and "avatar.ablation.cell bob" in rows
    assert ran.count("avatar.ablation.truth simulated") == 1 and not [line for line in ran if line.startswith("avatar.train")]
    assert pipeline.plan("ablation") == set()

    def made(path: str) -> list[str]:
        return json.loads((pipeline.folder / "results/ablation" / path).read_text())

    data = f"results/ablation/data/{SUBJECT}"
    names = (f"{SUBJECT}/ours_d_table_true", f"{SUBJECT}/ours_c_half", "bob/codes")
    true, half, real = (made(f"rows/{name}/0.json") for name in names)
    assert {f"head={data}/true_head.npz", f"track={data}/true_track.npz", f"split={data}/split.json"} <= set(true)
    assert {f"track={data}/track.npz", f"split={data}/half.json", f"doubled={data}/doubled.npz"} <= set(half)
    assert not [word for word in real if word.startswith("doubled=")] and real[real.index("--threads") + 1] == "1"
    config = AblationConfig.model_validate_json(half[half.index("--config") + 1])
    assert config == ablation_settings.config_of("ours_c_half", 0)
    frames = made(f"data/{SUBJECT}/frames.npy")
    config = AblationDataConfig.model_validate_json(frames[frames.index("--config") + 1])
    assert (config.simulate.kind, config.simulate.frames, config.simulate.hair) == ("talk", 360, "bald")
    assert f"matte=simulated/truth/{SUBJECT.removeprefix('simulated.')}_alpha.npy" in frames
    for name in (f"rows/{SUBJECT}/codes/1.json", "ablation.md"):  # as after an interruption
        (pipeline.folder / "results/ablation" / name).unlink()
    pipeline.forget()
    assert pipeline.run("ablation").code == 0
    assert pipeline.ran() == [f"avatar.ablation.cell {SUBJECT}", "avatar.ablation.table ablation"]


def test_a_source_is_trained_again_alone_when_its_code_changes(pipeline: Pipeline) -> None:
    pipeline.append("avatar/features/ours_c.py", "\nEDITED = True\n")
    pipeline.forget()
    assert pipeline.run("ablation").code == 0
    # On a constant, all or half of the data, with every seed; without it with the first.
    cells = [*(2 * 3 + 2) * [f"avatar.ablation.cell {SUBJECT}"], *2 * ["avatar.ablation.cell bob"]]
    assert sorted(pipeline.ran()) == sorted([*cells, "avatar.ablation.table ablation"])


def test_its_folder_is_no_subject(tmp_path: Path) -> None:
    (tmp_path / "ablation.mp4").touch()
    with pytest.raises(settings.SettingsError, match="cannot be used for a subject"):
        settings.discover(tmp_path)
