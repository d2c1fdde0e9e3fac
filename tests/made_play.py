"""A session whose drawer paints what it was asked for, so that a picture tells the row that it shows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import cv2
import numpy as np

from avatar.play import page
from avatar.play.carry import Carrier
from avatar.play.driver import Driver
from avatar.play.rows import Body, Row, rest_row
from avatar.play.session import Session
from avatar.play.sliders import Panel
from avatar.play.solver import FaceSolver
from avatar.uses.motion import Motion
from fitting.detection import Face
from tests.small_face import true_head

SIZE = 64
FRAMES = 12


class Painter:
    """Left half as grey as the jaw is open, right half as red as the left eye is shut; `size` pixels wide."""

    def __init__(self, size: int) -> None:
        self.size, self.milliseconds, self.drawn = size, {"frame": 1.5, "raster": 1.0}, 0
        self.names = true_head().expression_names

    def frame(self, row: Row) -> np.ndarray:
        if not np.isfinite(row.expression).all():
            raise ValueError("a row is not finite")
        self.drawn += 1
        values = (row.expression[self.names.index(name)] for name in ("jawOpen", "eyeBlinkLeft"))
        jaw, blink = (int(np.clip(255 * value, 0, 255)) for value in values)
        image = np.zeros((self.size, self.size, 3), np.uint8)
        image[:, : self.size // 2], image[:, self.size // 2 :, 0] = jaw, blink
        return image


def read_back(jpeg: bytes) -> tuple[float, float]:
    """Jaw and blink of a painted picture."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    half = image.shape[1] // 2
    return float(image[:, : half - 8].mean()) / 255, float(image[:, half + 8 :, 0].mean()) / 255


class MadeFinder:
    """Finds the face that the picture's first pixel stands for; none where it is black."""

    def __init__(self, faces: Callable[[int], Face]) -> None:
        self.faces, self.times = faces, []

    def __enter__(self) -> MadeFinder:
        return self

    def __exit__(self, *_: object) -> None:
        self.closed = True

    def find(self, rgb: np.ndarray, time_ms: int = 0) -> list[Face]:
        self.times.append(time_ms)
        return [self.faces(int(rgb[0, 0, 0]))] if rgb[0, 0, 0] else []


def clip() -> Motion:
    """The jaw opens frame by frame, from 0 to 1."""
    head = true_head()
    codes = np.zeros((FRAMES, len(head.expression_names)))
    codes[:, head.expression_names.index("jawOpen")] = np.linspace(0, 1, FRAMES)
    zero = np.zeros((FRAMES, 3))
    return Motion(codes, zero, zero, zero, np.zeros((FRAMES, 2, 3)), zero + [0, 0, 0.5], 25.0)


def subject() -> tuple[Panel, Row, Any]:
    """Panel, rest row and rest of the made subject."""
    head = true_head()
    shape = np.zeros(len(head.shape_basis))
    row, rest = rest_row(head, shape, clip())
    return Panel.of(head, row, Body.of(head, shape), clip()), row, rest


@contextmanager
def session(finder: MadeFinder | None = None, make: Callable[[int], Any] = Painter) -> Iterator[Session]:
    """A running session; with a finder it can be filmed."""
    panel, row, rest = subject()
    head = true_head()

    def new_driver(tell: Callable[[], None]) -> Driver:
        carrier = Carrier(head, panel.body, row, rest)
        return Driver(lambda: finder, partial(FaceSolver, head), carrier, len(head.expression_names), tell)

    running = Session(panel, {"clip": clip()}, make, SIZE, new_driver if finder else None, ("video", "camera"), 95)
    try:
        yield running
    finally:
        running.stop()


def html(running: Session) -> Callable[[str], str]:
    """The page of a session."""
    facts = {"subject": "ann <b>", "variant": "fast", "representation": "made", "live": False, "sha256": "ab" * 32,
             "sliders": list(running.panel.sliders.values()), "sizes": [48, 64, 96], "aspect": 1.0,
             "clip_frames": list(range(FRAMES)), "clip_parts": ["train"] * 8 + ["test"] * 4, "file": None, "video": "driver.mp4",
             "detector": True}  # fmt: skip
    return partial(page.html, facts, running.state)
