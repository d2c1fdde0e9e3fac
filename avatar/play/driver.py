"""A filmed face drives the avatar: detector, one-frame solver, carrying over and smoothing, in a thread that keeps the latest.

A picture that comes while another is worked on takes the place of the one that waits: nothing queues up.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from avatar.play.carry import Carrier
from avatar.play.drawing import read_jpeg
from avatar.play.rows import Row
from avatar.play.smoothing import SmoothRow
from avatar.play.solver import FaceSolver
from fitting.detection import Face, FaceTrack

MAX_FACES = 2
"""With one, MediaPipe smooths its points and they lag; with two it does not (see `fitting.detection.FaceFinder`)."""
LONGEST_PX = 960
"""Larger pictures are made smaller: the detector sees 256 px of a face."""
LARGEST_PX = 4096
PREVIEW_PX = 240
POINT_COLOUR = (90, 220, 140)


class Finder(Protocol):
    """`fitting.detection.FaceFinder` in video mode."""

    def find(self, rgb: np.ndarray, time_ms: int = 0) -> list[Face]:
        """Faces of one image."""
        ...


class Driven(NamedTuple):
    """What one picture of the driver led to."""

    number: int
    row: Row | None  # None until a face was found
    found: bool
    note: str
    milliseconds: dict[str, float]  # detect, solve
    preview: np.ndarray  # uint8 [h, w, 3], the driver small with his landmarks


class Driver:
    """Works on the latest picture in a thread of its own."""

    def __init__(
        self,
        open_finder: Callable[[], AbstractContextManager[Finder]],
        new_solver: Callable[[tuple[int, int]], FaceSolver],
        carrier: Carrier,
        expressions: int,
        tell: Callable[[], None],
    ) -> None:
        """
        Args:
            open_finder: opens the detector, in the thread that uses it; new_solver: for pictures of a size (H, W).
            expressions: number of codes; tell: called when there is a new result.
        """
        self._open_finder, self._new_solver, self._carrier, self._tell = open_finder, new_solver, carrier, tell
        self._smooth, self.smoothing = SmoothRow(expressions), True
        self._changed = threading.Condition()
        self._waiting: tuple[np.ndarray | bytes, float] | None = None
        self._orders: set[str] = set()
        self._stopped = False
        self._result: Driven | None = None
        self._solver: FaceSolver | None = None
        self._track = FaceTrack()
        self._begun_s = time.monotonic()
        self._stamp_ms = 0
        self._thread = threading.Thread(target=self._work, name="driver", daemon=True)
        self._thread.start()

    @property
    def result(self) -> Driven | None:
        """Of the last picture."""
        with self._changed:
            return self._result

    def put(self, picture: np.ndarray | bytes, patience_s: float = 0.0) -> None:
        """Give the next picture, uint8 [H, W, 3] RGB or a JPEG, in the place of one that still waits.

        patience_s: at most this long until the picture is taken up, so that a camera does not send more than is looked at.
        """
        with self._changed:
            self._waiting = mine = (picture, time.monotonic())
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._waiting is not mine or self._stopped, patience_s)

    def order(self, what: str) -> None:
        """`neutral`: the present face and pose are; `forget`: another driver, known from nothing."""
        with self._changed:
            self._orders.add(what)

    def stop(self) -> None:
        """End the thread."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join(5)

    def _pictures(self) -> Iterator[tuple[np.ndarray | bytes, float]]:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None or self._stopped)
                if self._stopped:
                    return
                picture, self._waiting = self._waiting, None
                self._changed.notify_all()
            yield picture

    def _work(self) -> None:
        """The thread: a picture that is none is told of and passed over."""
        finder = None
        try:
            for picture, time_s in self._pictures():
                try:
                    if finder is None:
                        finder = self._open_finder()
                        finder.__enter__()
                    done = self._one(finder, picture, time_s)
                except Exception as error:  # noqa: BLE001 - whatever it is, the page must be told and the thread go on
                    why = (str(error).splitlines() or [type(error).__name__])[0][:200]
                    done = self._kept(f"the picture cannot be used: {why}")
                with self._changed:
                    self._result = done
                self._tell()
        finally:
            if finder is not None:
                finder.__exit__(None, None, None)

    def _kept(self, note: str, preview: np.ndarray | None = None, times: dict[str, float] | None = None) -> Driven:
        """The last row once more."""
        last = self._result
        number, row = (last.number + 1, last.row) if last else (1, None)
        preview = preview if preview is not None else np.zeros((16, 16, 3), np.uint8)
        return Driven(number, row, False, note, times or {}, preview)

    def _one(self, finder: Finder, picture: np.ndarray | bytes, time_s: float) -> Driven:
        """One picture from pixels to a row."""
        with self._changed:
            orders, self._orders = self._orders, set()
        image = small(read_jpeg(picture, LARGEST_PX) if isinstance(picture, bytes) else picture, LONGEST_PX)
        another = self._solver is None or self._solver.size != image.shape[:2]
        if another or "forget" in orders:
            self._solver = self._new_solver(image.shape[:2]) if another else self._solver
            self._solver.forget()
            self._begin(np.zeros_like(self._solver.shared.shape))
            self._track = FaceTrack()
        started = time.perf_counter()
        self._stamp_ms = max(self._stamp_ms + 1, round(1e3 * (time_s - self._begun_s)))
        faces = finder.find(image, self._stamp_ms)
        chosen, switched = self._track.update(faces, time_s)
        found_at = time.perf_counter()
        face = None if chosen is None else faces[chosen]
        known = self._solver.calibrated
        pose = self._solver.solve(face.points, face.blendshapes) if face is not None else self._solver.solve(None, None)
        times = {"detect": 1e3 * (found_at - started), "solve": 1e3 * (time.perf_counter() - found_at)}
        preview = _preview(image, None if face is None else face.points)
        if pose is None:
            return self._kept("no face in the picture" if face is None else "the face cannot be followed", preview, times)
        row = self._carrier.carried(pose)
        if self._solver.calibrated and not known:
            self._begin(self._solver.shared.shape)  # from the next picture on with the new head
        if "neutral" in orders:
            self._carrier.set_neutral()
            self._smooth.reset()
            row = self._carrier.carried(pose)
        row = self._smooth(row, time_s) if self.smoothing else row
        number = self._result.number + 1 if self._result else 1
        note = "" if self._solver.calibrated else "getting to know the face"
        return Driven(number, row, True, "another face may have taken over" if switched else note, times, preview)

    def _begin(self, shape: np.ndarray) -> None:
        """A driver of another identity [S]."""
        self._carrier.begin(shape)
        self._smooth.reset()


def small(image: np.ndarray, longest_px: int) -> np.ndarray:
    """The picture with at most so many pixels on its longer side."""
    scale = longest_px / max(image.shape[:2])
    if scale >= 1:
        return image
    size = tuple(max(1, round(side * scale)) for side in image.shape[1::-1])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _preview(image: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """The driver small, with every third of his landmarks [478, 3] px."""
    preview = small(image, PREVIEW_PX)
    preview = preview.copy() if preview is image else preview
    if points is not None:
        pixels = (points[::3, :2] * (preview.shape[1] / image.shape[1])).astype(int)
        kept = ((pixels >= 0) & (pixels < preview.shape[1::-1])).all(1)
        preview[pixels[kept, 1], pixels[kept, 0]] = POINT_COLOUR
    return preview
