"""The synchronised player's parts: one video that holds the input and every render, and what its script must know.

All panels are tiles of one video, so that no browser can show two of them at different times; the page draws each tile on a
canvas of its own and lays these out as the screen allows. The video has a constant rate, no B-frames and a key frame every
`KEY_FRAMES`: frame i is shown after a seek to (i + 0.5) / fps, and a step back costs little.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pandas as pd
from av.video.reformatter import ColorRange, Colorspace, Interpolation

from avatar.report.page_scores import COLUMNS, REGIONS, metric_key
from avatar.report.pictures import on_white

LARGEST_PX = 4096
"""Decoders of phones end here."""
BLOCK_PX = 16
"""H.264 codes blocks of this size: tiles that begin on its multiples do not bleed into each other."""
KEY_FRAMES = 12
QUALITY = 18
DASHES = ("", "7 3", "7 3 2 3", "2 2")
"""Of the curves, so that colour is not the only sign; predictors are grey."""
MISSING = 225
"""Grey of a frame that a variant did not render."""


@dataclass(frozen=True)
class Tiling:
    """Where the tiles of one frame lie."""

    columns: int
    rows: int
    height: int
    """Of the picture in a tile, px."""
    width: int
    stride: tuple[int, int]
    """Rows and columns of pixels from one tile to the next."""

    @classmethod
    def of(cls, count: int, size: tuple[int, int]) -> Tiling:
        """A nearly square grid of `count` pictures of [H, W], made smaller where a decoder could not take it."""
        columns = math.ceil(math.sqrt(count))
        rows = math.ceil(count / columns)
        room = LARGEST_PX // rows // BLOCK_PX * BLOCK_PX, LARGEST_PX // columns // BLOCK_PX * BLOCK_PX
        scale = min(1.0, room[0] / size[0], room[1] / size[1])
        height, width = max(1, int(size[0] * scale)), max(1, int(size[1] * scale))
        return cls(columns, rows, height, width, tuple(-(-length // BLOCK_PX) * BLOCK_PX for length in (height, width)))

    def corner(self, place: int) -> tuple[int, int]:
        """Top and left of a tile, px."""
        return place // self.columns * self.stride[0], place % self.columns * self.stride[1]

    def empty(self) -> np.ndarray:
        """A white frame."""
        return np.full((self.rows * self.stride[0], self.columns * self.stride[1], 3), 255, np.uint8)


def shown_frames(reports: Mapping[str, Mapping[str, Any]]) -> list[int]:
    """Every frame that some variant rendered, in order."""
    return sorted({frame for report in reports.values() for frame in report["frames"]})


def rate(frames: Sequence[int], fps: float) -> Fraction:
    """Frames a second of the player's video: frames left out must not speed it up."""
    spacing = (frames[-1] - frames[0]) / (len(frames) - 1) if len(frames) > 1 else 1
    return max(Fraction(fps / spacing).limit_denominator(1001), Fraction(1, 2))


def tiled(
    frames: np.ndarray,
    alpha: np.ndarray,
    renders: Mapping[str, np.ndarray],
    reports: Mapping[str, Mapping[str, Any]],
    tiling: Tiling,
) -> Iterator[np.ndarray]:
    """Frames of the player's video: input on white, then each render, as uint8 [H', W', 3].

    Args:
        frames: uint8 [T, H, W, 3] RGB.
        alpha: uint8 [T, H, W].
        renders: uint8 [T', H, W, 4] of each variant.
        reports: content of render.json of each variant.
        tiling: where the pictures go.
    """
    where = {name: {frame: place for place, frame in enumerate(report["frames"])} for name, report in reports.items()}
    grey = np.full((tiling.height, tiling.width, 3), MISSING, np.uint8)
    for frame in shown_frames(reports):
        images = [on_white(frames[frame], alpha[frame])]
        images += [render[where[name][frame], ..., :3] if frame in where[name] else grey for name, render in renders.items()]
        whole = tiling.empty()
        for place, image in enumerate(images):
            top, left = tiling.corner(place)
            if image.shape[:2] != (tiling.height, tiling.width):
                image = cv2.resize(image, (tiling.width, tiling.height), interpolation=cv2.INTER_AREA)
            whole[top : top + tiling.height, left : left + tiling.width] = image
        yield whole


def write_video(path: Path, frames: Iterator[np.ndarray], fps: Fraction, comment: str, threads: int = 1) -> int:
    """Write H.264 made for seeking; `fitting.video` writes for size. Returns the number of bytes.

    Args:
        path: ends in .mp4.
        frames: uint8 [H, W, 3] RGB, sides even.
        fps: frames a second.
        comment: the container's `comment`.
        threads: threads of the encoder.
    """
    stream = None
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        container.metadata["comment"] = comment
        for count, frame in enumerate(frames):
            if stream is None:
                options = {"crf": str(QUALITY), "preset": "veryfast", "bf": "0", "g": str(KEY_FRAMES), "threads": str(threads)}
                stream = container.add_stream("libx264", rate=fps, options=options)
                stream.height, stream.width, stream.pix_fmt = *frame.shape[:2], "yuv420p"
                stream.codec_context.time_base = 1 / fps
                stream.codec_context.colorspace, stream.codec_context.color_range = Colorspace.ITU709, ColorRange.MPEG
                stream.codec_context.color_primaries, stream.codec_context.color_trc = 1, 1
            native = av.VideoFrame.from_ndarray(frame, format="rgb24").reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG,
                interpolation=Interpolation.BICUBIC | Interpolation.ACCURATE_RND, threads=1,
            )  # fmt: skip
            native.pts, native.time_base = count, stream.codec_context.time_base
            container.mux(stream.encode(native))
        container.mux(stream.encode())
    return path.stat().st_size


def scored_metrics(tables: Mapping[str, pd.DataFrame]) -> list[dict[str, Any]]:
    """Metrics that some variant has a figure of: key, title, unit, digits and which way is better."""
    found = []
    for region, place in {"": "", **REGIONS}.items():
        for name, title, digits, end in COLUMNS:
            key = metric_key(name, region)
            if any(key in table and table[key].notna().any() for table in tables.values()):
                title, _, unit = title.partition(" dB") if title.endswith(" dB") else (title, "", "")
                unit = "dB" if name == "psnr" else unit
                better = "lower is better" if end is min else "higher is better"
                label = f"{title}, {place}" if place else title
                found.append({"key": key, "title": label, "unit": unit, "digits": digits, "better": better})
    return found


def _look(name: str, variants: list[str], predictors: Sequence[str]) -> dict[str, Any]:
    """Colour and dash of a panel's curve, and whether it is shown at first: predictors are where nothing was trained."""
    trained = [variant for variant in variants if variant not in predictors]
    if name in predictors:
        return {"colour": "--p", "dash": ("1 3", "5 4")[list(predictors).index(name) % 2], "shown": not trained}
    place = trained.index(name) if name else 0
    return {"colour": f"--s{place % 6}", "dash": DASHES[place % len(DASHES)], "shown": True}


def data(
    tiling: Tiling, fps: Fraction, time_s: Sequence[float], reports: Mapping[str, Mapping[str, Any]],
    predictors: Sequence[str], tables: Mapping[str, pd.DataFrame],
) -> dict[str, Any]:  # fmt: skip
    """What the player's script reads: rate, frames, tiles, and every metric of every frame (null where not scored).

    Args:
        tiling: of the video; the input is its first tile, then come the variants in the order of `reports`.
        fps: the video's frames a second.
        time_s: of every frame of the clip.
        reports: content of render.json of each variant.
        predictors: which variants are trivial predictors.
        tables: per_frame.csv of each variant.
    """
    frames, metrics = shown_frames(reports), scored_metrics(tables)
    panels, scores = [], {}
    for place, name in enumerate(["", *reports]):
        top, left = tiling.corner(place)
        kind = ("predictor" if name in predictors else "avatar") if name else "input"
        rendered = set(reports[name]["frames"]) if name else set(frames)
        lost = [index for index, frame in enumerate(frames) if frame not in rendered]
        panels.append(
            {"name": name or "input", "kind": kind, "top": top, "left": left, "lost": lost}
            | _look(name, list(reports), predictors)
        )
    for name, table in tables.items():
        rows = table.set_index("frame").reindex(frames)
        known = {
            item["key"]: rows[item["key"]] if item["key"] in rows else pd.Series(index=frames, dtype=float) for item in metrics
        }
        scores[name] = {
            key: [None if pd.isna(value) else round(float(value), 5) for value in column] for key, column in known.items()
        }
    return {
        "fps": float(fps), "frames": frames, "time_s": [round(float(time_s[frame]), 4) for frame in frames],
        "width": tiling.width, "height": tiling.height, "panels": panels, "metrics": metrics, "scores": scores,
    }  # fmt: skip
