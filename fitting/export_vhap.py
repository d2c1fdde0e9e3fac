"""The track as VHAP writes it, and the NeRF folder that its exporter makes for GaussianAvatars; layout as read in their code.

Their conventions (vhap/model/tracker.py, vhap/export_as_nerf_dataset.py of ShenhanQian/VHAP; scene/dataset_readers.py and
scene/flame_gaussian_model.py of ShenhanQian/GaussianAvatars):
- world axes are OpenGL's (x right, y up, z back), the camera stands at (0, 0, 1), a frontal head is the identity;
- vertices are FLAME's as they are, turned about the root joint, plus the translation; joints are plain axis-angle;
- the principal point is the middle of the picture: VHAP puts it there and GaussianAvatars reads the angles of view alone.  So
  the pictures are padded until it is, to a quarter of a pixel (no resampling), and cx, cy of the folder say it exactly;
- in the folder the mean translation is taken off the heads and off the camera's place alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fitting.camera import log_rotation
from fitting.export_pose import FLIP, FlamePose

CAMERA_M = np.array([0.0, 0.0, 1.0])
CANONICAL_JAW_RAD = 0.3  # GaussianAvatars' canonical head opens its mouth
VERTICES = 5023 + 120  # FLAME's and the teeth that VHAP and GaussianAvatars append
TEXTURE_SIDE = 2048
UNIFORM_LIGHT = np.sqrt(4 * np.pi)  # the constant harmonic alone, shading 1
PER_FRAME = ("translation", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "expr")


@dataclass(frozen=True)
class Canvas:
    """A picture's place in the padded one whose middle is the principal point; whole pixels."""

    top: int
    left: int
    height: int  # of the padded picture
    width: int

    @staticmethod
    def around(size: tuple[int, int], centre_px: np.ndarray) -> Canvas:
        """The smallest canvas.

        Args:
            size: (height, width) of the frames.
            centre_px: [2] principal point (x, y) in the frames' pixels.
        """
        left, width = _padding(size[1], float(centre_px[0]))
        top, height = _padding(size[0], float(centre_px[1]))
        return Canvas(top, left, height, width)

    def centre_px(self, centre_px: np.ndarray) -> np.ndarray:
        """The principal point [2] (x, y) in the padded picture's pixels."""
        return np.asarray(centre_px, np.float64) + [self.left, self.top]

    def place(self, picture: np.ndarray, value: int) -> np.ndarray:
        """A picture [H, W, ...] on the canvas, the rest filled with a value."""
        out = np.full((self.height, self.width, *picture.shape[2:]), value, picture.dtype)
        out[self.top : self.top + picture.shape[0], self.left : self.left + picture.shape[1]] = picture
        return out


def _padding(side: int, centre: float) -> tuple[int, int]:
    """Pixels before a side and the padded length, such that the centre comes to lie in the middle."""
    length = max(side, round(2 * max(centre, side - centre)))
    return (0 if centre >= side / 2 else length - side), length


def arrays(pose: FlamePose, focal_px: float, canvas: Canvas, source_frames: list[int]) -> dict[str, np.ndarray]:
    """Content of `tracked_flame_params_0.npz`.

    Args:
        pose: T frames.
        focal_px: focal length of the frames.
        canvas: of the pictures, so that the principal point is their middle.
        source_frames: T numbers of the frames in the video, which name the time steps.

    Returns:
        arrays by VHAP's keys; float32, ids text.
    """
    frames = len(pose.expression)
    rotation = FLIP @ pose.rotation @ FLIP
    root = pose.root @ FLIP
    turned = np.einsum("tij,tj->ti", rotation, root)
    lights = np.zeros((9, 3))
    lights[0] = UNIFORM_LIGHT
    real = {
        "rotation": log_rotation(rotation),
        "translation": pose.offset @ FLIP + CAMERA_M + turned - root,
        "neck_pose": pose.neck,
        "jaw_pose": pose.jaw,
        "eyes_pose": pose.eyes.reshape(frames, 6),
        "shape": pose.shape,
        "expr": pose.expression,
        "focal_length": np.array([focal_px / max(canvas.height, canvas.width)]),
        "lights": lights,
        "tex_extra": np.zeros((3, TEXTURE_SIDE, TEXTURE_SIDE), np.float32),  # VHAP's start: nothing added to its base texture
        "static_offset": np.zeros((1, VERTICES, 3)),  # GaussianAvatars asks for it
    }
    return {name: value.astype(np.float32) for name, value in real.items()} | {
        "timestep_id": np.array([f"{number:05d}" for number in source_frames]),
        "n_processed_frames": np.array(frames),
        "image_size": np.array([canvas.height, canvas.width]),
    }


def mean_translation(tracked: dict[str, np.ndarray]) -> np.ndarray:
    """What the folder takes off heads and cameras [3] m: the mean over all tracked frames."""
    return tracked["translation"].astype(np.float64).mean(0)


def flame_param(tracked: dict[str, np.ndarray], row: int) -> dict[str, np.ndarray]:
    """Content of `flame_param/{t:05d}.npz`: one row of what `arrays` gave, the mean translation taken off."""
    params = {name: tracked[name][row : row + 1] for name in PER_FRAME}
    params["translation"] = (params["translation"] - mean_translation(tracked)).astype(np.float32)
    return params | {name: tracked[name] for name in ("shape", "static_offset")}


def canonical_flame_param(tracked: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Content of `canonical_flame_param.npz`: the subject's shape, neutral, mouth open."""
    params = {name: np.zeros_like(tracked[name][:1]) for name in PER_FRAME}
    params["jaw_pose"][0, 0] = CANONICAL_JAW_RAD
    return params | {name: tracked[name] for name in ("shape", "static_offset")}


def transforms(
    tracked: dict[str, np.ndarray], parts: dict[str, list[int]], focal_px: float, centre_px: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Content of the folder's JSON files by name.

    Args:
        tracked: what `arrays` gave.
        parts: rows of the track for "train" and "test"; a time step is a row's place in both, train first.
        focal_px: focal length of the pictures.
        centre_px: [2] principal point (x, y) in the padded pictures' pixels.
    """
    height, width = (int(side) for side in tracked["image_size"])
    lens = {
        "cx": float(centre_px[0]),
        "cy": float(centre_px[1]),
        "fl_x": float(focal_px),
        "fl_y": float(focal_px),
        "h": height,
        "w": width,
        "camera_angle_x": 2 * math.atan(width / (2 * focal_px)),
        "camera_angle_y": 2 * math.atan(height / (2 * focal_px)),
    }
    camera, moved = np.eye(4), np.eye(4)
    camera[:3, 3] = CAMERA_M
    moved[:3, 3] = CAMERA_M - mean_translation(tracked)
    rows = [*parts["train"], *parts["test"]]
    plain = [_frame(step, row, str(tracked["timestep_id"][row]), lens, camera) for step, row in enumerate(rows)]
    frames = [
        frame | {"transform_matrix": moved.tolist(), "flame_param_path": f"flame_param/{frame['timestep_index']:05d}.npz"}
        for frame in plain
    ]
    trained = len(parts["train"])
    steps = list(range(len(rows)))

    def database(chosen: list[dict[str, Any]], indices: list[int], cameras: list[int]) -> dict[str, Any]:
        return {"frames": chosen, **lens, "timestep_indices": indices, "camera_indices": cameras}

    complete = database(frames, steps, [0])
    return {
        "transforms.json": complete,
        "transforms_backup.json": database(plain, steps, [0]),
        "transforms_backup_flame.json": complete,
        "transforms_train.json": database(frames[:trained], steps[:trained], [0]),
        "transforms_val.json": database([], steps[:trained], []),  # one camera leaves none to validate with
        "transforms_test.json": database(frames[trained:], steps[trained:], [0]),
    }


def _frame(step: int, row: int, name: str, lens: dict[str, Any], camera: np.ndarray) -> dict[str, Any]:
    return {
        "timestep_index": step,
        "timestep_index_original": row,
        "timestep_id": name,
        "camera_index": 0,
        "camera_id": "0",
        **lens,
        "transform_matrix": camera.tolist(),
        "file_path": f"images/{step:05d}_00.png",
        "fg_mask_path": f"fg_masks/{step:05d}_00.png",
    }
