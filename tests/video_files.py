"""Tiny videos for tests, written with PyAV."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

QUADRANTS = ((220, 40, 40), (40, 200, 40), (40, 40, 220), (230, 230, 230))


def quadrants(height: int = 48, width: int = 64) -> np.ndarray:
    """(height, width, 3) uint8: red, green / blue, white: every turn and mirroring looks different."""
    picture = np.empty((height, width, 3), np.uint8)
    picture[: height // 2, : width // 2], picture[: height // 2, width // 2 :] = QUADRANTS[:2]
    picture[height // 2 :, : width // 2], picture[height // 2 :, width // 2 :] = QUADRANTS[2:]
    return picture


def write(
    path: Path,
    pictures: list[np.ndarray],
    codec: str = "libx264",
    pixel_format: str = "yuv420p",
    stamps: list[int] | None = None,
    rate: int = 30,
    prepare: Callable[[av.VideoStream], None] | None = None,
    container_options: dict[str, str] | None = None,
) -> Path:
    """Write a video; `stamps` are presentation times in milliseconds; `prepare` may set what it likes on the stream."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        options = {"crf": "4", "preset": "ultrafast"} if codec == "libx264" else {}
        stream = container.add_stream(codec, rate=rate, options=options)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pixel_format
        stream.codec_context.time_base = Fraction(1, 1000) if stamps else Fraction(1, rate)
        if prepare is not None:
            prepare(stream)
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = (stamps[number] if stamps else number), stream.codec_context.time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_audio(path: Path) -> Path:
    """Half a second of a tone, no video."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=16000)
        stream.layout = "mono"
        tone = (0.2 * np.sin(np.arange(8000) * 0.1)).astype(np.float32)[None]
        frame = av.AudioFrame.from_ndarray(tone, format="fltp", layout="mono")
        frame.sample_rate, frame.pts = 16000, 0
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def write_no_frames(path: Path) -> Path:
    """A container whose video stream has no frame at all."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.start_encoding()
    return path
