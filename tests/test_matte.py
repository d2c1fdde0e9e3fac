"""Mattes: on the image's edges, steady without lag, one solid person; on pictures of known opacity and on the demo clip."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from made_subject import arguments

from fitting import matte, matting, video
from fitting.config import MatteConfig
from workflow import step

SIZE = 192


def disc(x: float, y: float, radius: float = 50.0) -> np.ndarray:
    """(SIZE, SIZE) float32 opacity of a disc with a one-pixel edge."""
    columns, rows = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    return np.clip(radius - np.hypot(columns - x, rows - y) + 0.5, 0.0, 1.0).astype(np.float32)


def scene(alpha: np.ndarray, noise: int = 0) -> np.ndarray:
    """(SIZE, SIZE, 3) uint8: a brown person with that opacity before a blue wall, with sensor noise."""
    picture = alpha[..., None] * [120.0, 80.0, 60.0] + (1.0 - alpha[..., None]) * [90.0, 140.0, 200.0]
    return np.clip(picture + np.random.default_rng(noise).normal(size=picture.shape) * 1.5, 0, 255).astype(np.uint8)


def coarse(alpha: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """What a small network would say: blurred and displaced."""
    moved = cv2.warpAffine(alpha, np.float32([[1, 0, dx], [0, 1, dy]]), (SIZE, SIZE))
    return cv2.GaussianBlur(moved, (0, 0), 2.0)


def test_refining_moves_the_outline_onto_the_edge() -> None:
    truth = disc(96, 100)
    rough = coarse(truth, 2.0, -1.5)
    fine = matting.refine(scene(truth), rough)
    assert np.abs(fine - truth).mean() < 0.35 * np.abs(rough - truth).mean()
    assert fine[100, 96] == 1.0 and fine[5, 5] == 0.0


def test_strands_of_hair_are_found_between_the_colours() -> None:
    truth = disc(96, 110)
    for angle in np.linspace(-2.6, -0.6, 9):
        end = (int(96 + 60 * np.cos(angle)), int(110 + 60 * np.sin(angle)))
        cv2.line(truth, (96, 110), end, 1.0, 1, cv2.LINE_AA)
    rough = cv2.GaussianBlur(truth, (0, 0), 2.0)
    fine = matting.refine(scene(truth), rough)
    ring = (disc(96, 110, 54) > 0.5) & (disc(96, 110, 52) < 0.5)
    assert np.corrcoef(fine[ring], truth[ring])[0, 1] > 0.8
    assert np.corrcoef(fine[ring], truth[ring])[0, 1] > np.corrcoef(rough[ring], truth[ring])[0, 1] + 0.2


def plates(centres: list[tuple[float, float]], jitter: float) -> tuple[list[matting.Plate], list[np.ndarray]]:
    """Frames of a disc at those places with mattes that flicker by `jitter` px."""
    generator = np.random.default_rng(5)
    made, truths = [], []
    texture = cv2.GaussianBlur(generator.normal(size=(SIZE, SIZE, 1)).astype(np.float32), (0, 0), 3.0)[..., None] * 150.0
    for number, (x, y) in enumerate(centres):
        truth = disc(x, y)
        moved = cv2.warpAffine(texture[..., 0], np.float32([[1, 0, x - 96], [0, 1, y - 96]]), (SIZE, SIZE))[..., None]
        picture = np.clip(scene(truth, number) + truth[..., None] * moved, 0, 255).astype(np.uint8)
        made.append(matting.Plate.of(picture, coarse(truth, *generator.normal(size=2) * jitter)))
        truths.append(truth)
    return made, truths


def test_a_still_person_flickers_less() -> None:
    made, _ = plates([(96.0, 96.0)] * 9, jitter=1.0)
    steadier = matting.Steadier()
    steady = [steadier.steady(made[t], [made[k] for k in (t - 2, t - 1, t + 1, t + 2)]) for t in range(2, 7)]
    before = np.mean([np.abs(made[t].matte - made[t + 1].matte).mean() for t in range(2, 6)])
    after = np.mean([np.abs(a - b).mean() for a, b in zip(steady, steady[1:], strict=False)])
    assert after < 0.5 * before


@pytest.mark.parametrize("speed", [3.0, 8.0, 25.0])
def test_a_moving_person_does_not_lag(speed: float) -> None:
    made, truths = plates([(60.0 + speed * t * 0.8, 96.0 + speed * t * 0.2) for t in range(5)], jitter=0.0)
    steady = matting.Steadier().steady(made[2], [made[k] for k in (0, 1, 3, 4)])
    own = np.abs(made[2].matte - truths[2]).mean()
    assert np.abs(steady - truths[2]).mean() < 1.15 * own + 1e-4


def test_no_neighbours_and_an_empty_matte_are_left_alone() -> None:
    made, _ = plates([(96.0, 96.0)] * 2, jitter=0.5)
    assert np.array_equal(matting.Steadier().steady(made[0], []), made[0].matte)
    empty = matting.Plate.of(scene(disc(96, 96)), np.zeros((SIZE, SIZE), np.float32))
    assert not matting.Steadier().steady(empty, [made[1]]).any()


def test_one_person_without_holes_and_ghosts() -> None:
    alpha = disc(90, 110, 50)
    alpha[100:106, 80:90] = 0.2  # a hole in the glasses
    alpha = np.maximum(alpha, disc(175, 20, 12))  # somebody behind
    alpha[108:112, 138:190] = np.maximum(alpha[108:112, 138:190], 0.3)  # a veil that leads away from the outline
    kept = matting.one_person(alpha)
    assert kept[103, 85] == 1.0
    assert kept[20, 175] == 0.0
    assert kept[110, 185] == 0.0 and kept[110, 143] > 0.2
    assert not matting.one_person(np.zeros((SIZE, SIZE), np.float32)).any()


def test_an_arm_that_encloses_a_large_gap_keeps_it() -> None:
    alpha = np.clip(disc(96, 96, 80) - disc(96, 96, 40), 0, 1)
    assert matting.one_person(alpha)[96, 96] == 0.0


def test_the_mask_is_not_displaced(assets: Path) -> None:
    """Mirroring the picture mirrors the mask: handed over whole, MediaPipe displaces it by (W / 256 - 1) / 2 px."""
    frame = next(video.read_frames(assets / "carphone.mp4")).rgb()
    large = cv2.resize(frame, None, fx=6, fy=6, interpolation=cv2.INTER_LINEAR)  # 1056 wide: 1.6 px
    with matting.PersonSegmenter((assets / "selfie_segmentation.tflite").read_bytes()) as segmenter:
        one = segmenter.confidence(large)
        other = segmenter.confidence(np.ascontiguousarray(large[:, ::-1]))[:, ::-1]
    assert one.shape == large.shape[:2] and one.dtype == np.float32
    slope = cv2.Sobel((one + other) / 2, cv2.CV_32F, 1, 0, scale=1 / 8)
    shift_px = -(slope * (one - other)).sum() / (slope * slope).sum() / 2
    assert abs(shift_px) < 0.5


def test_the_step_on_the_demo_clip(tmp_path: Path, assets: Path) -> None:
    frames = np.stack([frame.rgb() for frame, _ in zip(video.read_frames(assets / "carphone.mp4"), range(8), strict=False)])
    np.save(tmp_path / "frames.npy", frames)
    inputs = {"frames": tmp_path / "frames.npy", "segmenter": assets / "selfie_segmentation.tflite"}
    step.main(matte.run, MatteConfig, arguments({}, inputs, {"alpha": tmp_path / "alpha.npy"}))
    alpha = np.load(tmp_path / "alpha.npy")
    assert alpha.dtype == np.uint8 and alpha.shape == frames.shape[:3]
    assert 0.2 < alpha.mean() / 255 < 0.7
    assert (alpha[:, 60:80, 75:95] == 255).all(), "the face is solid"


def test_no_person_is_a_sentence(tmp_path: Path, assets: Path, caplog: pytest.LogCaptureFixture) -> None:
    np.save(tmp_path / "frames.npy", np.full((3, 64, 80, 3), 127, np.uint8))
    inputs = {"frames": tmp_path / "frames.npy", "segmenter": assets / "selfie_segmentation.tflite"}
    with pytest.raises(SystemExit):
        step.main(matte.run, MatteConfig, arguments({}, inputs, {"alpha": tmp_path / "alpha.npy"}))
    assert "no person found" in caplog.records[-1].getMessage()
