"""Comparison videos of published methods: their panels, the driving panel's pixels, and where a frame is scored. No steps here.

A comparison video shows equal panels beside each other: the driving video and one published render a method. A frame's number
is its place among the frames that decode; panels are cut from the frame as FFmpeg converts it to RGB.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from fitting import video

MARGIN = 0.6  # of the face's width, on either side of the face: shoulders stay out
BODY = 0.02  # alpha that trimming took away from which a pixel counts as clothes or shoulders
WHITE = 245  # darkest channel of a pixel that counts as white: codecs and renderers leave 253 to 255
NOT_WHITE = 0.01  # part of the pixels far from the person that may be darker in a picture rendered on white
FAR = 0.05  # of the panel's width: pixels at least this far from the person are background for certain


def panel_width(width: int, panels: Sequence[str]) -> int:
    """Width in px of one of the equal panels of a frame; ValueError where they do not divide its width."""
    if width % len(panels):
        raise ValueError(f"{len(panels)} panels ({', '.join(panels)}) do not divide the width of {width} px")
    return width // len(panels)


def read_panels(
    path: Path, panels: Sequence[str], wanted: Sequence[str], frames: Collection[int] | None = None
) -> Iterator[tuple[int, list[np.ndarray]]]:
    """Frame numbers with the wanted panels' pixels, uint8 [h, w, 3] RGB each.

    Args:
        path: the comparison video.
        panels: names of all panels, left to right.
        wanted: names of those to cut.
        frames: numbers of the frames to convert; None takes all.

    Raises:
        ValueError: the panels do not divide the width.
        fitting.video.VideoError: nothing decodes.
    """
    last = max(frames, default=-1) if frames is not None else None
    for frame in video.read_frames(path):
        if last is not None and frame.index > last:
            return
        if frames is None or frame.index in frames:
            whole = frame.native.to_ndarray(format="rgb24")
            width = panel_width(whole.shape[1], panels)
            starts = (panels.index(name) * width for name in wanted)
            yield frame.index, [np.ascontiguousarray(whole[:, start : start + width]) for start in starts]


class Grid:
    """The driving panel's own pixels and the place of the pipeline's crop in them."""

    def __init__(self, index: Mapping[str, Any]) -> None:
        """index: the content of frames.json."""
        crop = index["crop"]
        self.size: tuple[int, int] = tuple(index["source_size"])
        """(h, w) of the panel in px."""
        self.crop_size = crop["height"], crop["width"]
        self.box = np.s_[crop["y"] : crop["y"] + crop["height"], crop["x"] : crop["x"] + crop["width"]]
        self.corner_px = np.array([crop["x"], crop["y"]], np.float64)
        self.scale = np.array([index["size"][1] / crop["width"], index["size"][0] / crop["height"]])
        """Frame px per panel px along x and y; below 1 where the crop was shrunk."""

    def camera(self, focal_px: float, centre_px: np.ndarray) -> tuple[float, np.ndarray]:
        """Focal length and principal point of the track in pixels of the crop as filmed, not shrunk."""
        return focal_px / float(np.sqrt(self.scale.prod())), centre_px / self.scale

    def points(self, points_px: np.ndarray) -> np.ndarray:
        """Points [N, 2] px of the frames -> px of the panel; pixel centres at +0.5 in both."""
        return points_px / self.scale + self.corner_px

    def place(self, image: np.ndarray, outside: int) -> np.ndarray:
        """An image of the crop, uint8 [H, W] or [H, W, C] at the frames' size or as filmed, in a panel filled with `outside`.

        At the frames' size a shrunk image is enlarged; what is as large as the crop keeps its pixels exactly.
        """
        if image.shape[:2] != self.crop_size:
            image = cv2.resize(image, self.crop_size[::-1], interpolation=cv2.INTER_LINEAR)
        placed = np.full((*self.size, *image.shape[2:]), outside, np.uint8)
        placed[self.box] = image
        return placed


def head_box(hull: np.ndarray, crop: tuple[slice, slice]) -> tuple[slice, slice]:
    """Rows of the crop down to the chin, and its columns within MARGIN face widths of a face hull bool [h, w] that is not empty.

    Outside of the crop nothing is known of the person's matte.
    """
    rows, columns = np.flatnonzero(hull.any(1)), np.flatnonzero(hull.any(0))
    margin = int(MARGIN * (columns[-1] - columns[0]))
    left, right = max(int(columns[0]) - margin, crop[1].start), min(int(columns[-1]) + 1 + margin, crop[1].stop)
    return slice(crop[0].start, min(int(rows[-1]) + 1, crop[0].stop)), slice(left, right)


def on_white_background(picture: np.ndarray, matte: np.ndarray, crop: tuple[slice, slice]) -> bool:
    """Whether a picture is white where it is far from the person of the driving frame, inside the crop.

    Args:
        picture: uint8 [h, w, 3].
        matte: uint8 [h, w], the whole person; known inside the crop only.
        crop: rows and columns.
    """
    reach = 2 * max(1, round(FAR * picture.shape[1])) + 1
    far = cv2.dilate((matte[crop] > 8).astype(np.uint8), np.ones((reach, reach), np.uint8)) == 0
    return not far.any() or float((picture[crop][far].min(1) < WHITE).mean()) <= NOT_WHITE


def comparable(picture: np.ndarray, matte: np.ndarray, trimmed: np.ndarray, on_white: bool) -> np.ndarray:
    """What of a render is compared: clothes and shoulders of the driving frame are white in every method's picture.

    A render that is not on white is composited by the trimmed alpha instead, so that its outline is not scored.

    Args:
        picture: uint8 [h, w, 3].
        matte: uint8 [h, w], the whole person of the driving frame.
        trimmed: uint8 [h, w], head and neck only.
        on_white: whether the method rendered on white.

    Returns:
        uint8 [h, w, 3].
    """
    if not on_white:
        alpha = trimmed[..., None].astype(np.float32) / 255
        return (picture * alpha + 255 * (1 - alpha)).round().astype(np.uint8)
    return np.where(body(matte, trimmed)[..., None], np.uint8(255), picture)


def body(matte: np.ndarray, trimmed: np.ndarray) -> np.ndarray:
    """Pixels bool [h, w] of clothes and shoulders: of the person's matte, but not of head and neck (uint8 [h, w] both)."""
    return matte.astype(np.float32) - trimmed > 255 * BODY


def write_pictures(folder: Path, images: Mapping[int, np.ndarray], comment: str | None = None) -> None:
    """Images uint8 [h, w, 3] by the video's frame number as NNNNN.png, with a comment inside where there is one."""
    folder.mkdir()
    for number, image in images.items():
        text = PngInfo()
        if comment:
            text.add_text("Comment", comment)
        Image.fromarray(image).save(folder / f"{number:05d}.png", pnginfo=text)
