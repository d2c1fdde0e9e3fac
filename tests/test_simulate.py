"""The rendered truth: files of the step, pictures that agree with the geometry, and the real detector on them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from made_subject import arguments

from fitting import anny_head, correspondence, simulate, synthetic, synthetic_errors, synthetic_render
from fitting.config import SimulateConfig
from fitting.detection import BLENDSHAPE_NAMES, FaceFinder
from fitting.head_model import REGIONS, HeadModel
from fitting.synthetic_landmarks import Faults, landmark_track
from fitting.video import read_frames
from workflow import step

SIDE = 128


@pytest.fixture(scope="module")
def rich(assets: Path) -> HeadModel:
    """A head as the step `head` bakes it, with few components."""
    head = anny_head.bake(30, 100)
    with FaceFinder((assets / "face_landmarker.task").read_bytes(), False, 1) as finder:
        placed = correspondence.place(head, lambda image: next((face.points for face in finder.find(image)), None))
    return dataclasses.replace(
        head,
        landmark_triangles=torch.from_numpy(placed.triangles),
        landmark_barycentric=torch.from_numpy(placed.barycentric.astype(np.float32)),
        digest="rich",
    )


def test_step_writes_a_video_its_truth_and_its_matte(rich: HeadModel, tmp_path: Path) -> None:
    rich.save(tmp_path / "head.npz")
    config = {"kind": "blink", "seed": 2, "frames": 14, "height": SIDE, "width": SIDE + 32, "k1": -0.05, "hair": "full"}
    outputs = {"video": tmp_path / "v.mp4", "truth": tmp_path / "t.npz", "alpha": tmp_path / "a.npy"}
    step.main(simulate.run, SimulateConfig, arguments(config, {"head": tmp_path / "head.npz"}, outputs))
    pictures = np.stack([frame.rgb() for frame in read_frames(outputs["video"])])
    alpha = np.load(outputs["alpha"])
    with np.load(outputs["truth"], allow_pickle=False) as file:
        truth = dict(file)
    assert pictures.shape == (14, SIDE, SIDE + 32, 3) and alpha.shape == pictures.shape[:3] and alpha.dtype == np.uint8
    assert truth["vertices"].shape == (14, rich.vertex_count, 3) and str(truth["head_digest"]) == "rich"
    renderer = synthetic_render.Renderer(
        synthetic.make(rich, "blink", 14, synthetic.Camera.of((SIDE, SIDE + 32), k1=-0.05), 2), "full"
    )
    for row in (0, 11):
        expected, matte = renderer.frame(row)
        assert np.array_equal(matte, alpha[row])
        assert np.abs(pictures[row].astype(int) - expected).mean() < 4  # what the codec does to chroma and noise


def test_step_names_a_file_that_is_no_head(tmp_path: Path) -> None:
    (tmp_path / "head.npz").write_text("no head")
    outputs = {"video": tmp_path / "v.mp4", "truth": tmp_path / "t.npz", "alpha": tmp_path / "a.npy"}
    with pytest.raises(SystemExit) as stopped:
        step.main(simulate.run, SimulateConfig, arguments({}, {"head": tmp_path / "head.npz"}, outputs))
    assert stopped.value.code == 1 and not list(tmp_path.glob("*.mp4"))


def test_matte_is_the_projected_head_and_more(rich: HeadModel) -> None:
    lens = synthetic.Camera.of((SIDE, SIDE), k1=-0.1)
    clip = synthetic.make(rich, "slow", 30, lens, 4)
    bald, hairy = (synthetic_render.Renderer(clip, hair).frame(20)[1] for hair in ("bald", "full"))
    pixel = np.floor(lens.project(clip.vertices[20].astype(np.float64))).astype(int)
    inside = ((pixel >= 1) & (pixel < SIDE - 1)).all(1)
    assert inside.mean() > 0.95 and (bald[pixel[inside, 1], pixel[inside, 0]] > 0).mean() > 0.995
    above = np.arange(SIDE)[:, None] < pixel[:, 1].min() - 1
    assert (bald * above).max() == 0 and (hairy * above).max() == 255  # hair stands off the skull
    assert (hairy >= bald).all() and set(np.unique(bald[:5])) == {0}


def test_paint_sticks_to_the_surface(rich: HeadModel) -> None:
    """Lips are redder than cheeks and pupils darker than the white beside them, wherever the head is."""
    lens = synthetic.Camera.of((256, 256))
    clip = synthetic.make(rich, "slow", 40, lens, 1)
    renderer = synthetic_render.Renderer(clip, noise=0.0)
    track = landmark_track(rich, clip.vertices, lens.project, Faults(), clip.motion.expression, clip.motion.eyes)
    for row in (0, 12, 33):
        picture = renderer.frame(row)[0].astype(float)
        at = lambda landmark: picture[tuple(np.floor(track.exact[row, landmark, ::-1]).astype(int))]  # noqa: B023, E731
        redness = lambda colour: colour[0] / colour[1]  # noqa: E731
        assert redness(at(16)) > 1.1 * redness(at(151))
        assert at(468).max() < 100 and at(473).max() < 100


def test_eyes_stay_in_their_sockets_and_turn_as_told(rich: HeadModel) -> None:
    clip = synthetic.make(rich, "still", 3, synthetic.Camera.of((64, 64)), 5)
    ball = (rich.region == REGIONS.index("eyeballs")).numpy() & (rich.skinning_weights[:, 3] > 0.5).numpy()
    moved = clip.neutral[ball] - rich.shaped(torch.from_numpy(clip.shape.astype(np.float32))).numpy()[ball]
    assert np.ptp(moved, axis=0).max() < 1e-6 < np.abs(moved).max()  # one displacement for the whole ball
    down = dataclasses.replace(clip.motion, eyes=clip.motion.eyes + [0.2, 0, 0])
    lowered = synthetic._pose(dataclasses.replace(clip, motion=down))
    cosine = (synthetic_errors.gaze(rich, clip.vertices) * synthetic_errors.gaze(rich, lowered)).sum(-1)
    assert np.allclose(np.degrees(np.arccos(cosine)), np.degrees(0.2), atol=0.5)


def test_lids_meet_and_do_not_cross(rich: HeadModel) -> None:
    for seed in range(4):
        clip = synthetic.make(rich, "blink", 40, synthetic.Camera.of((64, 64)), seed)
        blinking = clip.motion.expression[:, rich.expression_names.index("eyeBlinkLeft")]
        opening = 1e3 * synthetic_errors.aperture(rich, clip.vertices)[:, 0]
        assert opening[blinking == 0].min() > 4 and -1 < opening[blinking == blinking.max()].min() < 4


def test_exposure_and_speed_of_light(rich: HeadModel) -> None:
    clip = synthetic.make(rich, "still", 2, synthetic.Camera.of((SIDE, SIDE)), 1)
    assert np.array_equal(clip.exposure, [1, 1])
    dark = dataclasses.replace(clip, exposure=np.array([0.5, 1.0]))
    whole, half = (synthetic_render.Renderer(each, noise=0.0).frame(0)[0].astype(float) for each in (clip, dark))
    linear = (half[whole < 250] / whole[whole < 250].clip(1)) ** 2.2
    assert np.median(linear) == pytest.approx(0.5, abs=0.02)
    swinging = synthetic.make(rich, "still", 90, synthetic.Camera.of((64, 64)), 1, exposure_stops=1.0).exposure
    assert 0.5 <= swinging.min() < 0.9 and 1.1 < swinging.max() <= 2


def test_the_detector_sees_a_face_that_blinks_and_speaks(rich: HeadModel, assets: Path) -> None:
    """Seen by MediaPipe itself: places within 4 % of the eyes' distance, lids and mouth in its scores."""
    lens = synthetic.Camera.of((320, 320))
    score = BLENDSHAPE_NAMES.index
    with FaceFinder((assets / "face_landmarker.task").read_bytes(), False, 1) as finder:
        for kind in ("blink", "talk"):
            clip = synthetic.make(rich, kind, 60, lens, 1)
            renderer = synthetic_render.Renderer(clip)
            track = landmark_track(rich, clip.vertices, lens.project, Faults(), clip.motion.expression, clip.motion.eyes)
            name = {"blink": "eyeBlinkLeft", "talk": "jawOpen"}[kind]
            action = clip.motion.expression[:, rich.expression_names.index(name)]
            scores = []
            for row in (int(action.argmin()), int(action.argmax()) + (kind == "blink")):
                faces = finder.find(renderer.frame(row)[0])
                assert faces, f"{kind}: no face in frame {row}"
                away = np.linalg.norm(faces[0].points[:, :2] - track.exact[row], axis=1)
                between = np.linalg.norm(faces[0].points[33] - faces[0].points[263])
                assert np.nanmedian(away) < 0.04 * between
                scores.append(faces[0].blendshapes[score(name)])
            assert scores[1] > scores[0] + {"blink": 0.3, "talk": 0.1}[kind], (kind, scores)
