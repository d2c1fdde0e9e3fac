"""A video file as a driver, at its own speed and in a loop: frames whose time has passed are left out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

from avatar.play.session import Session
from fitting.video import DecodedFrame

REST_S = 0.1
LATE_S = 0.05  # a frame this much too late is not looked at


def play_video(session: Session, read: Callable[[], Iterator[DecodedFrame]]) -> threading.Thread:
    """Start the thread that films `video` for a session while it is watched; read: begins the video anew."""

    def work() -> None:
        while not session.stopped:
            if not session.filming("video"):
                time.sleep(REST_S)
                continue
            _once(session, read())

    thread = threading.Thread(target=work, name="video", daemon=True)
    thread.start()
    return thread


def _once(session: Session, frames: Iterator[DecodedFrame]) -> None:
    """The video once, or until another source is chosen; while it rests, its clock rests too."""
    begun = time.monotonic()
    for frame in frames:
        while not session.filming("video"):
            if session.stopped or session.state()["source"] != "video":
                return
            time.sleep(REST_S)
            begun = time.monotonic() - frame.time_s
        ahead = begun + frame.time_s - time.monotonic()
        if ahead > 0:
            time.sleep(ahead)
        if ahead > -LATE_S:
            session.film(frame.rgb(), "video")
    last = time.monotonic() - begun
    time.sleep(0 if last > REST_S else REST_S)  # a video without frames must not spin
