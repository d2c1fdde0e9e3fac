"""MediaPipe's face landmarker, and the association that keeps one face over time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import mediapipe
import numpy as np
from mediapipe.tasks.python.core.base_options import BaseOptions
from mediapipe.tasks.python.vision import FaceLandmarker, FaceLandmarkerOptions, RunningMode

POINTS = 478
BLENDSHAPE_NAMES = (
    "browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "cheekPuff", "cheekSquintLeft",
    "cheekSquintRight", "eyeBlinkLeft", "eyeBlinkRight", "eyeLookDownLeft", "eyeLookDownRight", "eyeLookInLeft",
    "eyeLookInRight", "eyeLookOutLeft", "eyeLookOutRight", "eyeLookUpLeft", "eyeLookUpRight", "eyeSquintLeft",
    "eyeSquintRight", "eyeWideLeft", "eyeWideRight", "jawForward", "jawLeft", "jawOpen", "jawRight", "mouthClose",
    "mouthDimpleLeft", "mouthDimpleRight", "mouthFrownLeft", "mouthFrownRight", "mouthFunnel", "mouthLeft",
    "mouthLowerDownLeft", "mouthLowerDownRight", "mouthPressLeft", "mouthPressRight", "mouthPucker", "mouthRight",
    "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthSmileLeft", "mouthSmileRight",
    "mouthStretchLeft", "mouthStretchRight", "mouthUpperUpLeft", "mouthUpperUpRight", "noseSneerLeft", "noseSneerRight",
)  # fmt: skip
RIGID = np.array([10, 67, 297, 151, 9, 168, 6, 197, 195, 33, 133, 362, 263, 127, 356, 234, 454, 116, 345, 50, 280, 98, 327])
"""Points that expressions hardly move: forehead, temples, cheekbones, eye corners, nose."""


@dataclass(frozen=True)
class Face:
    """One detected face in one image."""

    points: np.ndarray
    """(478, 3) float32 px; x, y with pixel centres at +0.5; z in px too, towards the camera negative."""
    blendshapes: np.ndarray
    """(51,) float32 in the order of BLENDSHAPE_NAMES."""
    head_pose: np.ndarray
    """(4, 4) float32: MediaPipe's canonical face (cm, y up) -> its camera (cm, y up)."""

    @property
    def centre(self) -> np.ndarray:
        """(2,) px, middle of the face's bounding box."""
        return (self.points[:, :2].min(axis=0) + self.points[:, :2].max(axis=0)) / 2.0

    @property
    def size_px(self) -> float:
        """Longer side of the face's bounding box: steady under yaw, where the width shrinks."""
        return float((self.points[:, :2].max(axis=0) - self.points[:, :2].min(axis=0)).max())

    @property
    def yaw_rad(self) -> float:
        """Turn of the head about the vertical, from the head matrix; sign as MediaPipe's."""
        return math.atan2(float(self.head_pose[0, 2]), float(self.head_pose[2, 2]))


class FaceFinder:
    """The FaceLandmarker task on one thread of its own; use as a context manager."""

    def __init__(self, model: bytes, video: bool, max_faces: int) -> None:
        """Open the task.

        Args:
            model: content of face_landmarker.task.
            video: track from frame to frame (times must grow) instead of detecting anew in each image.
            max_faces: with more than one, MediaPipe leaves its points unsmoothed, so they do not lag.

        Raises:
            RuntimeError, ValueError: the model is not one that MediaPipe reads.
        """
        self._video = video
        self._task = FaceLandmarker.create_from_options(
            FaceLandmarkerOptions(
                base_options=BaseOptions(model_asset_buffer=model),
                running_mode=RunningMode.VIDEO if video else RunningMode.IMAGE,
                num_faces=max_faces,
                output_face_blendshapes=True,
                output_facial_transformation_matrixes=True,
            )
        )

    def __enter__(self) -> FaceFinder:
        return self

    def __exit__(self, *_: object) -> None:
        self._task.close()

    def find(self, rgb: np.ndarray, time_ms: int = 0) -> list[Face]:
        """Faces of one image.

        Args:
            rgb: (h, w, 3) uint8, C-contiguous.
            time_ms: strictly growing in video mode, ignored otherwise.
        """
        height, width = rgb.shape[:2]
        image = mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=np.ascontiguousarray(rgb))
        found = self._task.detect_for_video(image, time_ms) if self._video else self._task.detect(image)
        scale = np.array([width, height, width], dtype=np.float32)
        # MediaPipe's normalised places count from the centre of the first pixel, not from its edge (measured: a picture and
        # its exact enlargement by 4 differ by -1.44 +- 0.05 px of the larger where -1.5 is that convention's and 0 the other's).
        offset = np.array([0.5, 0.5, 0.0], dtype=np.float32)
        faces = []
        for points, scores, matrix in zip(
            found.face_landmarks, found.face_blendshapes, found.facial_transformation_matrixes, strict=True
        ):
            named = {score.category_name: score.score for score in scores}
            faces.append(
                Face(
                    np.array([(point.x, point.y, point.z) for point in points], dtype=np.float32) * scale + offset,
                    np.array([named[name] for name in BLENDSHAPE_NAMES], dtype=np.float32),
                    np.asarray(matrix, dtype=np.float32),
                )
            )
        return faces


def find_small(finder: FaceFinder, rgb: np.ndarray, thorough: bool) -> list[Face]:
    """Faces of one image, looked for again in overlapping squares.

    The detector sees 128 px of whatever it is given: in a wide picture a face of a tenth of its width is lost to it.

    Args:
        finder: in image mode.
        rgb: (h, w, 3) uint8.
        thorough: look into the squares even where the whole picture shows a face.
    """
    faces = finder.find(rgb)
    height, width = rgb.shape[:2]
    side = min(height, width)
    if (faces and not thorough) or max(height, width) < 1.2 * side:
        return faces
    count = math.ceil(2.0 * (max(height, width) - side) / side) + 1
    for start in np.linspace(0, max(height, width) - side, count).astype(int).tolist():
        x, y = (start, 0) if width > height else (0, start)
        for face in finder.find(rgb[y : y + side, x : x + side]):
            moved = Face(face.points + np.float32([x, y, 0]), face.blendshapes, face.head_pose)
            if all(np.linalg.norm(moved.centre - other.centre) > 0.5 * other.size_px for other in faces):
                faces.append(moved)
    return faces


def shape_difference(points: np.ndarray, other: np.ndarray) -> float:
    """Residual between two faces' rigid points after the best similarity transform, as a part of the face's size.

    Args:
        points, other: (478, 3) px.
    """
    a, b = (face[RIGID].astype(np.float64) for face in (points, other))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    singular = np.linalg.svd(a.T @ b, compute_uv=False)
    sign = np.sign(np.linalg.det(a.T @ b)) or 1.0
    return math.sqrt(max(0.0, 1.0 - (singular[0] + singular[1] + sign * singular[2]) ** 2))


@dataclass
class FaceTrack:
    """Keeps the first face: each frame's candidates are compared with where and how large it should be, and with its shape.

    A bigger or better-lit face that enters never takes over while the kept one is seen. A candidate that fits neither place
    nor size is refused; it is taken, and flagged, only if it may be the same person after a cut (same shape), or when the
    kept face has been gone for `forget_s`.
    """

    forget_s: float = 2.0
    reach: float = 0.6
    """Distance from the prediction, in face sizes, that is still the same face; grows with the time since the last sight."""
    growth: float = 0.5
    """Allowed |log(size / last size)|."""
    same_shape: float = 0.12
    """Largest `shape_difference` of one person's faces (its own varies with pose and expression)."""
    _last: Face | None = None
    _time_s: float = 0.0
    _velocity: np.ndarray = field(default_factory=lambda: np.zeros(2))
    """px per second, centre of the face."""

    def update(self, faces: list[Face], time_s: float) -> tuple[int | None, bool]:
        """Choose the kept face among one frame's candidates.

        Args:
            faces: candidates in any order.
            time_s: time of the frame, growing.

        Returns:
            Index of the kept face or None, and whether the identity may have switched.
        """
        if not faces:
            return None, False
        if self._last is None:
            chosen = max(range(len(faces)), key=lambda i: faces[i].size_px)
            self._keep(faces[chosen], time_s, moved=False)
            return chosen, False
        gap_s = time_s - self._time_s
        costs = [self._cost(face, gap_s) for face in faces]
        best = min(range(len(faces)), key=lambda i: costs[i][1])
        if costs[best][0]:
            self._keep(faces[best], time_s, moved=True)
            return best, False
        resized = abs(math.log(faces[best].size_px / self._last.size_px))
        same_person = (
            len(faces) == 1
            and resized < self.growth
            and shape_difference(faces[best].points, self._last.points) < self.same_shape
        )
        if same_person or gap_s > self.forget_s:
            self._keep(faces[best], time_s, moved=False)
            return best, True
        return None, False

    def _cost(self, face: Face, gap_s: float) -> tuple[bool, float]:
        """Whether a candidate is inside the gate, and its cost."""
        assert self._last is not None
        size = self._last.size_px
        predicted = self._last.centre + self._velocity * min(gap_s, 0.2)
        distance = float(np.linalg.norm(face.centre - predicted)) / size
        resized = abs(math.log(face.size_px / size))
        shape = shape_difference(face.points, self._last.points)
        inside = distance < self.reach + gap_s and resized < self.growth
        return inside, (distance / 0.3) ** 2 + (resized / 0.2) ** 2 + (shape / 0.06) ** 2

    def _keep(self, face: Face, time_s: float, moved: bool) -> None:
        if moved and self._last is not None:
            speed = (face.centre - self._last.centre) / max(time_s - self._time_s, 1e-3)
            self._velocity = 0.5 * self._velocity + 0.5 * speed
        else:
            self._velocity = np.zeros(2)
        self._last, self._time_s = face, time_s
