"""Puts session, server and page together for one avatar's folder."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba

from avatar.live import Live
from avatar.play import drawing, page, subject
from avatar.play.carry import Carrier
from avatar.play.config import PlayConfig
from avatar.play.driver import MAX_FACES, Driver
from avatar.play.filming import play_video
from avatar.play.rows import Body, Row, rest_row
from avatar.play.server import Server
from avatar.play.session import Session
from avatar.play.sliders import Panel
from avatar.play.solver import FaceSolver
from fitting.video import read_frames
from workflow import step

SIZES = (64, 96, 128, 160, 192, 256, 384, 512, 768, 1024)
"""Pixels on the longer side that the page offers, as far as the frames go."""
LIVE_SAMPLES = 1
"""Of a pixel of a layered avatar; two are for pictures that are kept (nerface.mp4, 512 px, 2 threads: 36 ms a frame, two 50)."""


def server_of(folder: Path, config: PlayConfig) -> tuple[Server, Callable[[], None]]:
    """The server of an avatar, bound but not serving, and what ends its threads.

    Raises:
        StepError: something is missing or does not fit. OSError: the port is taken.
    """
    step.set_threads(config.threads)
    opened = subject.open_subject(folder, config.threads)
    room = opened.room
    head, shape = room.head, room.track["shape"]
    row, rest = rest_row(head, shape, opened.training)
    panel = Panel.of(head, row, Body.of(head, shape), opened.training)
    motions = {"clip": opened.clip}
    if config.file:
        motions["file"] = subject.open_motion(Path(config.file), opened, row)
    if config.video:
        subject.check_video(Path(config.video))

    def new_drawer(size: int) -> drawing.Drawer:
        # Called by the thread that draws: numba keeps the number of threads for each thread apart.
        numba.set_num_threads(min(config.threads, numba.config.NUMBA_NUM_THREADS))
        return Live(room.avatar, head, shape, room.camera.resized(size), room.precision, room.device, LIVE_SAMPLES)

    size = min(config.size or drawing.first_size(opened.representation), max(room.camera.size))
    filmed = ("video", "camera") if config.video else ("camera",)
    new_driver = partial(_driver, opened, panel.body, row, rest) if opened.landmarker else None
    session = Session(panel, motions, new_drawer, size, new_driver, filmed, config.jpeg_quality)
    facts = page_facts(opened, panel, config, new_driver is not None)
    try:
        server = Server(session, partial(page.html, facts, session.state), partial(_offered, session, opened, row), config.port)
    except OSError as error:
        session.stop()
        raise step.StepError(
            f"port {config.port} cannot be used ({error.strerror}); leave --port out to take a free one"
        ) from error
    if config.video and new_driver:
        play_video(session, lambda: read_frames(Path(config.video)))
    return server, session.stop


def _driver(opened: subject.Subject, body: Body, row: Row, rest: Any, tell: Callable[[], None]) -> Driver:
    """A driver of this subject; the detector is opened by the thread that uses it."""
    from fitting.detection import FaceFinder  # MediaPipe takes a second to load

    head = opened.room.head
    carrier = Carrier(head, body, row, rest)
    open_finder = partial(FaceFinder, opened.landmarker, True, MAX_FACES)
    return Driver(open_finder, partial(FaceSolver, head), carrier, len(head.expression_names), tell)


def page_facts(opened: subject.Subject, panel: Panel, config: PlayConfig, detector: bool) -> dict[str, Any]:
    """What the page is made of, besides the session's state."""
    sizes = [size for size in SIZES if size < max(opened.room.camera.size)]
    parts = {frame: name for name in ("train", "test") for frame in opened.room.split[name]}
    return {
        "subject": opened.name,
        "variant": opened.variant,
        "representation": opened.representation,
        "live": opened.representation == drawing.LAYERS,
        "sha256": opened.room.sha256,
        "sliders": list(panel.sliders.values()),
        "sizes": [*sizes, max(opened.room.camera.size)],
        "aspect": opened.room.camera.size[1] / opened.room.camera.size[0],
        "clip_frames": opened.clip_frames,
        "clip_parts": [parts.get(frame, "") for frame in opened.clip_frames],
        "file": Path(config.file).name if config.file else None,
        "video": Path(config.video).name if config.video else None,
        "detector": detector,
    }


def _offered(session: Session, opened: subject.Subject, rest: Row, name: str, data: bytes) -> dict[str, Any]:
    """Read a parameter file that the page sends, and play it."""
    suffix = Path(name).suffix.lower()
    if suffix not in (".csv", ".npz"):
        raise ValueError("a parameter file ends in .csv or .npz")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"parameters{suffix}"
        path.write_bytes(data)
        try:
            motion = subject.open_motion(path, opened, rest)
        except step.StepError as error:
            raise ValueError(str(error).replace(str(path), Path(name).name[:100])) from error
    session.offer("file", motion)
    return {"frames": len(motion), "seconds": len(motion) / motion.fps}
