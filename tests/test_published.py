"""Comparison videos: panels cut exactly, renders on the panel's grid, every method scored on the same pixels."""

from __future__ import annotations

import json
from pathlib import Path

import av
import cv2
import made_subject as made
import numpy as np
import pytest
import video_files
from made_comparison import CHOSEN, CORNER, PANELS, SCORED, make, placed, score, whole
from PIL import Image
from toy_run import job, train_in, write_subject

from avatar import render
from avatar.config import RenderConfig
from avatar.published import panel as published_panel
from avatar.published import protocol as published
from avatar.published import render as published_render
from avatar.published.config import PublishedPanelConfig, PublishedRenderConfig
from avatar.report.pictures import on_white
from fitting import video
from fitting.camera import project
from workflow.step import StepError


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    return make(tmp_path)


# ---- cutting the panel


def test_the_cut_panel_has_every_frame_and_every_byte(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    pictures = [noise.integers(0, 256, (50, 3 * 32, 3), dtype=np.uint8) for _ in range(7)]
    clip = video_files.write(tmp_path / "clip.mp4", pictures)  # chroma at half size: the panels' seams bleed in RGB
    config = PublishedPanelConfig(panels=("A", "driving", "B"), test_frames=3, max_frames=7)
    outputs = {"video": tmp_path / "driving.mp4"}
    published_panel.run(job(config, {"video": clip}, outputs))
    with av.open(str(clip)) as container:
        expected = [frame.to_ndarray(format="rgb24")[:, 32:64] for frame in container.decode(video=0)]
    found = [frame.rgb() for frame in video.read_frames(outputs["video"])]
    assert len(found) == len(expected) == 7
    assert all(np.array_equal(first, second) for first, second in zip(found, expected, strict=True))
    assert video.inspect(outputs["video"]).fps == pytest.approx(30, rel=1e-3)


@pytest.mark.parametrize(
    ("panels", "keys", "message"),
    [
        (("driving", "A", "B", "C", "D"), {}, "5 panels .* do not divide the width of 96 px.*comparisons: panels"),
        (PANELS, {"test_frames": 4}, "4 frames leave none for training before 4 test frames; lower comparisons: test_frames"),
        (PANELS, {"max_frames": 3}, "4 frames are more than extract.max_frames: 3.*raise it to 4"),
    ],
)
def test_clips_that_cannot_be_compared(tmp_path: Path, panels: tuple[str, ...], keys: dict[str, int], message: str) -> None:
    clip = video_files.write(tmp_path / "clip.mp4", [np.zeros((48, 96, 3), np.uint8)] * 4)
    config = PublishedPanelConfig(**{"panels": panels, "test_frames": 2, "max_frames": 100} | keys)
    with pytest.raises(StepError, match=message):
        published_panel.run(job(config, {"video": clip}, {"video": tmp_path / "driving.mp4"}))


def test_a_file_that_is_no_video(tmp_path: Path) -> None:
    clip = tmp_path / "clip.mp4"
    clip.write_text("nothing")
    config = PublishedPanelConfig(panels=PANELS, test_frames=2, max_frames=9)
    with pytest.raises(StepError, match=r"clip.mp4: not readable as a video"):
        published_panel.run(job(config, {"video": clip}, {"video": tmp_path / "driving.mp4"}))


# ---- the panel's own pixels


def test_camera_of_a_shrunk_crop_sees_the_same_in_the_panels_pixels() -> None:
    crop = {"x": 7, "y": 3, "width": 300, "height": 200}
    grid = published.Grid({"crop": crop, "source_size": [240, 320], "size": [100, 150]})
    points = np.random.default_rng(1).normal(size=(20, 3)) * 0.1 + [0, 0, 0.8]
    in_frames = project(points, 200.0, np.array([70.0, 52.0]))
    in_crop = project(points, *grid.camera(200.0, np.array([70.0, 52.0])))
    np.testing.assert_allclose(grid.points(in_frames), in_crop + [7, 3], atol=1e-9)


def test_placing_keeps_pixels_and_enlarges_only_what_was_shrunk() -> None:
    random = np.random.default_rng(2)
    grid = published.Grid({"crop": {"x": 5, "y": 2, "width": 20, "height": 16}, "source_size": [30, 40], "size": [8, 10]})
    image = random.integers(0, 256, (16, 20, 3), dtype=np.uint8)
    panel = grid.place(image, 255)
    assert panel.shape == (30, 40, 3) and np.array_equal(panel[2:18, 5:25], image)
    panel[2:18, 5:25] = 255
    assert (panel == 255).all()
    y, x = np.mgrid[:8, :10] + 0.5
    large = grid.place((20 * x).round().astype(np.uint8), 0)[2:18, 5:25]
    inside = (np.mgrid[:16, :20][1] + 0.5) / 2 * 20  # a ramp stays a ramp, pixel centres at +0.5
    assert np.abs(large.astype(float) - inside)[:, 1:-1].max() <= 1
    assert grid.place(np.zeros((8, 10), np.uint8), 7).shape == (30, 40)


def test_an_avatar_is_rendered_on_the_panels_grid(tmp_path: Path) -> None:
    inputs = write_subject(tmp_path / "in") if (tmp_path / "in").mkdir() is None else {}
    inputs["avatar"] = train_in(tmp_path / "in", inputs, steps=12)["avatar"]
    index = {"crop": {"x": 6, "y": 10, "width": 80, "height": 80}, "source_size": [100, 90], "size": [40, 40], "fps": 25}
    index["source_frame"] = [0, 1, 2, 3, 4, 5, 7, 8]  # frame 6 of the video did not decode
    inputs["index"].write_text(json.dumps(index))
    outputs = {"png": tmp_path / "png", "opacity": tmp_path / "opacity.npy", "report": tmp_path / "render.json"}
    published_render.run(job(PublishedRenderConfig(stride=1), inputs, outputs))
    assert [path.name for path in sorted(outputs["png"].iterdir())] == ["00007.png", "00008.png"]
    report = json.loads(outputs["report"].read_text())
    assert (report["frames"], report["source_frames"]) == ([6, 7], [7, 8])
    small = {name: tmp_path / "small" / name for name in ("render", "report", "video.mp4")}
    small["video"] = small.pop("video.mp4")
    render.run(job(RenderConfig(), inputs, small))
    opacity, expected = np.load(outputs["opacity"]), np.load(small["render"])
    for place, number in enumerate((7, 8)):
        large = cv2.imread(str(outputs["png"] / f"{number:05d}.png"))[..., ::-1]
        assert large.shape == (100, 90, 3) and opacity[place].shape == (100, 90)
        crop = np.dstack([large, opacity[place]])[10:90, 6:86].astype(float)
        shrunk = crop.reshape(40, 2, 40, 2, 4).mean((1, 3))
        error = np.abs(shrunk - expected[place])
        assert error.mean() < 6 and np.abs(np.roll(shrunk, 2, 1) - expected[place]).mean() > 2 * error.mean()
        large[10:90, 6:86] = 255
        assert (large == 255).all()
    assert "avatar sha256:" in Image.open(outputs["png"] / "00007.png").text["Comment"]


# ---- scores


def test_the_panel_that_shows_the_truth_scores_best(files: dict[str, Path], tmp_path: Path) -> None:
    good, facts = score(files, tmp_path, "Good", "published")
    shifted, _ = score(files, tmp_path, "Shifted", "published")
    assert good["frame"].tolist() == SCORED
    assert (good["psnr"] > 70).all() and (good["lpips"] < 1e-4).all() and (good["psnr_face"] > 70).all()  # 8-bit rounding
    assert (shifted["psnr"] < 40).all() and (shifted["lpips"] > good["lpips"]).all()
    assert good["iou"].isna().all()  # a published picture has no opacity
    assert facts["excluded"]["frames"] == [frame for frame in CHOSEN if frame not in SCORED] and facts["scored_frames"] == len(
        SCORED
    )
    assert facts["on_white"] and facts["note"] == "" and facts["train_frames"] == len(made.TRAIN)
    assert facts["training_seconds"] is None and facts["ms_per_frame"] is None


def test_the_same_pixels_as_pictures_and_as_a_panel_score_alike(files: dict[str, Path], tmp_path: Path) -> None:
    renders = []
    for frame in made.TEST:
        colour, alpha = made.picture(frame)
        renders.append(np.dstack([on_white(colour, alpha), alpha]))
    out = placed(files, tmp_path / "nearest", np.stack(renders), made.TEST)
    assert [path.stem for path in sorted(out["png"].iterdir())] == [f"{frame:05d}" for frame in CHOSEN]
    table, facts = score(files, tmp_path, "nearest_frame", "predictor", **out)
    assert (table["psnr"] > 70).all() and (table["iou"] == 1).all() and facts["ms_per_frame"] == 3.0
    (out["png"] / f"{SCORED[0]:05d}.png").unlink()
    with pytest.raises(StepError, match=rf"{SCORED[0]:05d}.png: missing or damaged, expected 96x84"):
        score(files, tmp_path, "nearest_frame", "predictor", **out)


def test_renders_of_other_frames_are_refused(files: dict[str, Path], tmp_path: Path) -> None:
    renders = np.zeros((len(made.TEST), made.HEIGHT, made.WIDTH, 4), np.uint8)
    out = placed(files, tmp_path / "nearest", renders, made.TEST)
    out["report"].write_text(json.dumps({"frames": CHOSEN[:-1]}))
    with pytest.raises(StepError, match="other frames"):
        score(files, tmp_path, "nearest_frame", "predictor", **out)
    with pytest.raises(StepError, match=f"test frame {made.TEST[-2]} is missing"):
        placed(files, tmp_path / "few", renders[:3], made.TEST[:3] + made.TEST[4:6])


def test_shoulders_count_for_nobody(files: dict[str, Path], tmp_path: Path) -> None:
    published_panel.write_lossless(files["video"], (whole(frame, shoulders=True) for frame in range(made.FRAMES)), 25.0)
    matte = np.load(files["alpha"]).copy()
    matte[:, 40 - CORNER[0] :, : 12 - CORNER[1]] = 255
    files["matte"] = tmp_path / "matte.npy"
    np.save(files["matte"], matte)
    table, facts = score(files, tmp_path, "Good", "published")
    assert facts["on_white"] and (table["psnr"] > 70).all()
    bare, body = np.full((1, 2, 3), 90, np.uint8), np.array([[0, 255]], np.uint8)
    assert published.comparable(bare, body, np.zeros_like(body), True)[0].tolist() == [[90] * 3, [255] * 3]  # background counts


def test_a_render_that_is_not_on_white_is_cut_out_and_said(files: dict[str, Path], tmp_path: Path) -> None:
    published_panel.write_lossless(files["video"], (whole(frame, background=120) for frame in range(made.FRAMES)), 25.0)
    table, facts = score(files, tmp_path, "Good", "published")
    assert not facts["on_white"] and "outline is not scored" in facts["note"]
    assert (table["psnr"] > 25).all()


def test_no_head_in_any_frame(files: dict[str, Path], tmp_path: Path) -> None:
    landmarks = dict(np.load(files["landmarks"]))
    np.savez(files["landmarks"], **landmarks | {"found": np.zeros(made.FRAMES, bool)})
    with pytest.raises(StepError, match="found in none of the 4 test frames of panel driving; is it the driving panel"):
        score(files, tmp_path, "Good", "published")
