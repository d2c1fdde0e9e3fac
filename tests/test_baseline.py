"""The two trivial predictors on a tiny subject, and the choice of test frames."""

import json
from pathlib import Path

import av
import made_subject as made
import numpy as np
import pytest

from avatar import baseline
from avatar.config import BaselineConfig
from avatar.frames import chosen_frames
from workflow import step


def outputs(folder: Path) -> dict[str, Path]:
    return {"render": folder / "test.npy", "report": folder / "render.json", "video": folder / "test.mp4"}


def predict(tmp_path: Path, predictor: str, **config: object) -> tuple[np.ndarray, dict, Path]:
    files = made.make(tmp_path / "in")
    inputs = {name: files[name] for name in ("head", "frames", "index", "alpha", "track", "split")}
    out = outputs(tmp_path / predictor)
    step.main(baseline.run, BaselineConfig, made.arguments({"predictor": predictor, **config}, inputs, out))
    return np.load(out["render"]), json.loads(out["report"].read_text()), out["video"]


def test_mean_frame_equals_its_definition(tmp_path: Path) -> None:
    render, report, video = predict(tmp_path, "mean_frame")
    pairs = [made.picture(frame) for frame in made.TRAIN]
    alpha = np.stack([alpha for _, alpha in pairs]) / 255
    colour = np.stack([colour for colour, _ in pairs])
    expected = (colour * alpha[..., None] + 255 * (1 - alpha[..., None])).mean(0)  # mean of composites = composite of means
    assert render.dtype == np.uint8 and render.shape == (8, made.HEIGHT, made.WIDTH, 4)
    assert np.abs(render[3, ..., :3] - expected).max() <= 0.51
    assert np.abs(render[3, ..., 3] - 255 * alpha.mean(0)).max() <= 0.51
    assert report["predictor"] is True and report["frames"] == made.TEST and report["ms_per_frame"] > 0
    with av.open(str(video)) as container:
        shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(shown) == 8 and shown[0].shape == (made.HEIGHT, 2 * made.WIDTH, 3)
    assert np.abs(shown[3][:, made.WIDTH :].astype(float) - expected).mean() < 4


def test_nearest_frame_finds_the_like_pose(tmp_path: Path) -> None:
    render, report, _ = predict(tmp_path, "nearest_frame", max_frames=5)
    assert report["frames"] == chosen_frames(made.TEST, 5) and len(render) == 5
    for frame, nearest, image in zip(report["frames"], report["nearest"], render, strict=True):
        assert nearest in made.TRAIN
        centre, _ = made.pose(frame)
        centres = np.array([[made.pose(other)[0], made.pose(other)[1]] for other in made.TRAIN])
        assert abs(centres[made.TRAIN.index(nearest)][0] - centre) <= 2 * np.abs(centres[:, 0] - centre).min() + 1.0
        colour, alpha = made.picture(nearest)
        mask = alpha[..., None] / 255
        assert np.abs(image[..., :3] - (colour * mask + 255 * (1 - mask))).max() <= 0.51
        assert (image[..., 3] == alpha).all()


def test_nearest_equals_a_loop_over_all_pairs() -> None:
    pixels = np.random.default_rng(0).normal(size=(12, 7, 2))
    train, test = [0, 2, 3, 5, 7, 11], [1, 4, 6]
    chosen, distance = baseline.nearest_frames(pixels, train, test)
    for place, frame in enumerate(test):
        rms = [np.sqrt(((pixels[frame] - pixels[other]) ** 2).sum(-1).mean()) for other in train]
        assert chosen[place] == train[int(np.argmin(rms))]
        assert distance[place] == pytest.approx(min(rms))


def test_a_still_clip_has_no_division_by_zero() -> None:
    chosen, distance = baseline.nearest_frames(np.zeros((3, 4, 2)), [1, 0], [2])
    assert chosen == [1] and distance.tolist() == [0.0]


def test_no_usable_training_frame_is_one_sentence(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    files = made.make(tmp_path)
    with np.load(files["track"]) as file:
        track = dict(file)
    track["usable"][:] = False
    np.savez(files["track"], **track)
    inputs = {name: files[name] for name in ("head", "frames", "index", "alpha", "track", "split")}
    with pytest.raises(SystemExit) as stopped:
        step.main(baseline.run, BaselineConfig, made.arguments({}, inputs, outputs(tmp_path / "out")))
    assert stopped.value.code == 1 and "ann has no usable training frames" in caplog.text
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize("count", [1, 2, 3, 7, 99, 100])
@pytest.mark.parametrize("limit", [1, 2, 3, 5, 50, 100, None])
def test_chosen_frames_are_evenly_spaced(count: int, limit: int | None) -> None:
    test = list(range(200, 200 + count))
    chosen = chosen_frames(test, limit)
    assert len(chosen) == min(count, limit or count) and chosen == sorted(set(chosen)) and set(chosen) <= set(test)
    if limit != 1:
        assert (chosen[0], chosen[-1]) == (test[0], test[-1])
    gaps = np.diff(chosen)
    assert not len(gaps) or gaps.max() - gaps.min() <= 1


def test_chosen_frames_refuses_zero() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        chosen_frames([1, 2], 0)
