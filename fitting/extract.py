"""Frames of the head's crop as one array: upright, cropped once for the whole video, shrunk but never enlarged."""

from __future__ import annotations

import cv2
import numpy as np

from fitting import video
from fitting.config import ExtractConfig
from fitting.stack import StackWriter
from workflow import step

MISSING_FRACTION = 0.02
SHORTER_BY_PX = 8
ROUNDING_PX = 0.03


def fit_crop(crop: dict[str, int], size_px: int) -> tuple[dict[str, int], tuple[int, int], float]:
    """Choose the output size; the crop loses up to SHORTER_BY_PX rows and columns so that one scale serves both axes.

    Args:
        crop: x, y, width, height in source px.
        size_px: largest longer side of the output.

    Returns:
        The crop that is read, (H, W) of the output, and output px per source px (<= 1).
    """
    long_side, short_side = ("width", "height") if crop["width"] >= crop["height"] else ("height", "width")
    if crop[long_side] <= size_px:
        return dict(crop), (crop["height"], crop["width"]), 1.0
    longer = np.arange(max(size_px, crop[long_side] - SHORTER_BY_PX), crop[long_side] + 1)[:, None]
    shorter = np.arange(max(1, crop[short_side] - SHORTER_BY_PX), crop[short_side] + 1)[None, :]
    # Rounding the shorter side alone would stretch the picture by up to a thousandth; of what hardly rounds, take the largest.
    exact = shorter * (size_px / longer)
    error = np.abs(exact - np.round(exact))
    area = np.where(error < max(ROUNDING_PX, error.min() + 1e-9), longer * shorter, 0)
    i, j = np.unravel_index(int(area.argmax()), area.shape)
    kept = crop | {long_side: int(longer[i, 0]), short_side: int(shorter[0, j])}
    scale = size_px / kept[long_side]
    return kept, (max(1, round(kept["height"] * scale)), max(1, round(kept["width"] * scale))), scale


def cut(rgb: np.ndarray, crop: dict[str, int], size: tuple[int, int]) -> np.ndarray:
    """Crop one picture and shrink it by area averaging; source pixels exactly where the sizes agree.

    Args:
        rgb: (h, w, 3) uint8.
        crop: x, y, width, height in px of `rgb`.
        size: (H, W) of the result.

    Returns:
        (H, W, 3) uint8.
    """
    patch = rgb[crop["y"] : crop["y"] + crop["height"], crop["x"] : crop["x"] + crop["width"]]
    if patch.shape[:2] == size:
        return patch
    return cv2.resize(patch, (size[1], size[0]), interpolation=cv2.INTER_AREA)


def run(job: step.Job) -> None:
    """Write frames.npy and frames.json."""
    path, probe = job.input.video, step.read_json(job.input.probe)
    if not probe["accepted"]:
        raise step.StepError(f"{path}: was rejected by probe ({probe['reason']}); replace the video")
    crop, size, scale = fit_crop(probe["crop"], job.config.size)
    wanted = min(probe["frames"], job.config.max_frames)
    source_size, times, numbers = tuple(probe["source_size"]), [], []
    with StackWriter(job.output.frames) as frames:
        for frame in job.progress(video.read_frames(path, job.threads), "extract", wanted):
            rgb = frame.rgb()
            if rgb.shape[:2] != source_size:
                raise step.StepError(
                    f"{path}: frame {frame.index} is {rgb.shape[1]}x{rgb.shape[0]} but probe saw "
                    f"{source_size[1]}x{source_size[0]}; the file has changed, run snakemake again"
                )
            frames.append(cut(rgb, crop, size))
            times.append(round(frame.time_s, 6))
            numbers.append(frame.index)
            if len(times) == wanted:
                break
    if len(times) < (1.0 - MISSING_FRACTION) * wanted:
        raise step.StepError(
            f"{path}: {len(times)} frames decode but probe counted {wanted}; the file has changed or is "
            f"damaged, copy it anew and run snakemake again"
        )
    job.write_json(
        job.output.index,
        {
            "fps": probe["fps"],
            "time_s": times,
            "source_frame": numbers,
            "crop": crop,
            "scale": scale,
            "size": list(size),
            "source_size": list(source_size),
        },
    )
    job.log.info(
        "%d frames of %dx%d at scale %.3f, %.1f ms each", len(times), size[1], size[0], scale, 1e3 * job.seconds() / len(times)
    )


if __name__ == "__main__":
    step.main(run, ExtractConfig)
