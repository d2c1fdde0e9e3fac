"""Reading videos (the only place that decodes) and writing H.264."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import av.error
import numpy as np
from av.sidedata.sidedata import Type as SideDataType
from av.video.reformatter import ColorRange, Colorspace, Interpolation

HD_HEIGHT_PX = 720
CONVERSION = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
"""Chroma is interpolated, not repeated, and rounded exactly: both show at lips and hair rims."""
UNSPECIFIED_COLORSPACE = 2
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
UNSTEADY_INTERVAL = 0.25
"""A frame interval that differs from the median by this part of it makes the frame rate variable."""


class VideoError(Exception):
    """The file holds no decodable video; the message says what was found and what to do, without naming the file."""


@dataclass(frozen=True)
class StreamFacts:
    """What the container says of its first video stream, without decoding more than one frame."""

    codec: str
    pixel_format: str
    fps: float
    """Median rate of the packets' timestamps; the container's own rate where it has none."""
    variable_frame_rate: bool
    packets: int
    duration_s: float
    rotation_degrees: int
    """Counter-clockwise turn that shows the frame upright, one of 0, 90, 180, 270."""
    mirrored: bool
    size: tuple[int, int]
    """(h, w) in upright pixels."""
    hdr: str | None
    """PQ or HLG transfer of high-dynamic-range video, else None."""


@dataclass(frozen=True)
class DecodedFrame:
    """One frame, converted to RGB only when asked."""

    index: int
    """Number of the frame among those that decode, in order of presentation."""
    time_s: float
    """Presentation time since the first frame."""
    native: av.VideoFrame
    pixel_aspect: Fraction | None = None
    """Width of a coded pixel over its height; None or 1 for square pixels."""

    def rgb(self) -> np.ndarray:
        """Upright sRGB picture.

        Returns:
            (h, w, 3) uint8, C-contiguous.
        """
        width, height = square_pixel_size(self.native.width, self.native.height, self.pixel_aspect)
        space = self.native.colorspace
        if space == UNSPECIFIED_COLORSPACE:
            # Nothing in the file says which; players take the HD matrix for HD sizes, and so did the camera's maker.
            space = Colorspace.ITU709 if self.native.height >= HD_HEIGHT_PX else Colorspace.ITU601
        picture = self.native.reformat(
            width=width,
            height=height,
            format="rgb24",
            src_colorspace=space,
            interpolation=CONVERSION,
            dst_color_range=ColorRange.JPEG,
            threads=1,
        ).to_ndarray()
        return upright(picture, display_matrix(self.native))


def square_pixel_size(width: int, height: int, aspect: Fraction | None) -> tuple[int, int]:
    """(width, height) of a frame once its pixels are square; an anamorphic one is shrunk along one axis, never stretched."""
    if not aspect or aspect == 1:
        return width, height
    return (max(1, round(width * aspect)), height) if aspect < 1 else (width, max(1, round(height / aspect)))


def display_matrix(frame: av.VideoFrame) -> np.ndarray:
    """Linear part of the container's display matrix: (p, q) of the coded frame -> (p, q) @ matrix on the screen, y down.

    Returns:
        (2, 2) float64; identity where the file has none.
    """
    try:
        data = np.frombuffer(bytes(frame.side_data[SideDataType.DISPLAYMATRIX])[:36], dtype=np.int32)
    except KeyError:
        return np.eye(2)
    return np.array([[data[0], data[1]], [data[3], data[4]]], dtype=np.float64) / 65536.0


def upright(picture: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Apply a display matrix, rounded to the nearest of the eight quarter turns and mirrorings.

    Args:
        picture: (h, w, C) as coded.
        matrix: (2, 2) from `display_matrix`.

    Returns:
        (h', w', C) C-contiguous.
    """
    (a, b), (c, d) = matrix
    if abs(b) + abs(c) > abs(a) + abs(d):
        picture = np.swapaxes(picture, 0, 1)
        flip_x, flip_y = c < 0, b < 0
    else:
        flip_x, flip_y = a < 0, d < 0
    return np.ascontiguousarray(picture[:: -1 if flip_y else 1, :: -1 if flip_x else 1])


def _turn(matrix: np.ndarray) -> tuple[int, bool]:
    """Display matrix -> (counter-clockwise degrees, mirrored)."""
    degrees = round(np.degrees(np.arctan2(-matrix[0, 1], matrix[0, 0])) / 90.0) * 90 % 360
    return int(degrees), bool(np.linalg.det(matrix) < 0)


def _open(path: Path) -> tuple[av.container.InputContainer, av.VideoStream]:
    try:
        container = av.open(str(path), metadata_errors="replace")
    except (av.error.FFmpegError, ValueError) as error:
        raise VideoError(
            f"not readable as a video ({error.strerror or error}); export it again as MP4"
            if isinstance(error, av.error.FFmpegError)
            else f"not readable as a video ({error})"
        ) from None
    streams = [stream for stream in container.streams.video if not _is_cover_picture(stream)]
    if not streams:
        kinds = sorted({stream.type for stream in container.streams}) or ["nothing"]
        container.close()
        raise VideoError(f"no video stream, only {' and '.join(kinds)}; record with the camera on")
    return container, streams[0]


def _is_cover_picture(stream: av.VideoStream) -> bool:
    return bool(stream.disposition & type(stream.disposition).attached_pic)


def _intervals(times: list[float]) -> tuple[float, bool]:
    """Presentation times -> (median rate, whether intervals vary)."""
    times = sorted(set(times))
    gaps = [later - earlier for earlier, later in zip(times, times[1:], strict=False)]
    median = statistics.median(gaps)
    unsteady = sum(abs(gap - median) > UNSTEADY_INTERVAL * median for gap in gaps)
    return 1.0 / median, unsteady > 0.01 * len(gaps)


def inspect(path: Path) -> StreamFacts:
    """Read the stream's facts from all packet headers and one decoded frame.

    Raises:
        VideoError: nothing can be decoded; says what was found.
    """
    container, stream = _open(path)
    with container:
        times, packets = [], 0
        try:
            for packet in container.demux(stream):
                if packet.size == 0:
                    continue
                packets += 1
                if packet.pts is not None:
                    times.append(float(packet.pts * packet.time_base))
        except av.error.FFmpegError:
            pass  # a damaged tail: what came before it counts
        codec = stream.codec_context.name
        rate = stream.average_rate or stream.guessed_rate or stream.base_rate or Fraction(30)
    first = next(read_frames(path), None)
    if first is None:
        raise VideoError(
            f"a {codec} stream of {packets} packets from which no frame decodes; the file is empty or damaged, copy it anew"
        )
    fps, variable = _intervals(times) if len(set(times)) > 2 else (float(rate), False)
    matrix = display_matrix(first.native)
    rotation, mirrored = _turn(matrix)
    height, width = first.rgb().shape[:2]
    duration = max(times) - min(times) + 1.0 / fps if times else packets / fps
    return StreamFacts(
        codec,
        first.native.format.name,
        fps,
        variable,
        packets,
        duration,
        rotation,
        mirrored,
        (height, width),
        HDR_TRANSFERS.get(first.native.color_trc),
    )


def read_frames(path: Path, threads: int = 1) -> Iterator[DecodedFrame]:
    """Decode the first video stream in order of presentation; damaged packets are passed over.

    Args:
        path: any container and codec that FFmpeg reads.
        threads: threads of the decoder.

    Raises:
        VideoError: the file cannot be opened or has no video stream.
    """
    container, stream = _open(path)
    with container:
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        step_s = 1.0 / float(stream.average_rate or stream.guessed_rate or 30)
        aspect = stream.sample_aspect_ratio
        start, last, index, size = None, -1.0, 0, None
        for frame in _decoded(container, stream):
            size = size or (frame.width, frame.height)
            if (frame.width, frame.height) != size:
                continue  # a stream that changes its size: frames of another size cannot share one crop
            time = frame.time
            start = time if start is None and time is not None else start
            since = last + step_s if time is None else time - start
            if index == 0:
                since = 0.0
            elif since <= last:
                since = last + 1e-3  # equal or backward stamps: keep the order, stay strictly increasing
            yield DecodedFrame(index, since, frame, aspect)
            last, index = since, index + 1


def _decoded(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[av.VideoFrame]:
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
            yield from packet.decode()
        except av.error.InvalidDataError:
            continue
        except (StopIteration, av.error.FFmpegError):  # the end, as the file or as FFmpeg says it
            return


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float, comment: str | None = None, quality: int = 18) -> int:
    """Write H.264 in yuv420p that any browser plays; odd sizes are padded by repeating the last row or column.

    Args:
        path: ends in .mp4.
        frames: (H, W, 3) uint8 RGB each, all of one size.
        fps: frames a second.
        comment: written into the container's `comment` field.
        quality: x264's constant rate factor, lower is better.

    Returns:
        Number of frames written.

    Raises:
        ValueError: there is no frame, or their sizes or types differ.
    """
    count, size, stream = 0, None, None
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        if comment is not None:
            container.metadata["comment"] = comment
        for frame in frames:
            if stream is None:
                size = frame.shape
                stream = _h264_stream(container, size, fps, quality)
            if frame.shape != size or frame.dtype != np.uint8:
                raise ValueError(f"frame {count} is {frame.dtype}{frame.shape}, expected uint8{size}")
            picture = np.pad(frame, ((0, size[0] % 2), (0, size[1] % 2), (0, 0)), mode="edge")
            native = av.VideoFrame.from_ndarray(picture, format="rgb24")
            native = native.reformat(
                format="yuv420p",
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG,
                interpolation=Interpolation.BICUBIC | Interpolation.ACCURATE_RND,
                threads=1,
            )
            native.pts, native.time_base = count, stream.codec_context.time_base
            container.mux(stream.encode(native))
            count += 1
        if stream is None:
            raise ValueError("no frames to write")
        container.mux(stream.encode())
    return count


def _h264_stream(container: av.container.OutputContainer, size: tuple[int, ...], fps: float, quality: int) -> av.VideoStream:
    rate = Fraction(fps).limit_denominator(1001)
    stream = container.add_stream("libx264", rate=rate, options={"crf": str(quality), "preset": "veryfast"})
    stream.width, stream.height, stream.pix_fmt = size[1] + size[1] % 2, size[0] + size[0] % 2, "yuv420p"
    context = stream.codec_context
    context.time_base = 1 / rate
    context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
    context.color_primaries, context.color_trc = 1, 1
    return stream
