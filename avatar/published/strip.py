"""Step `published_strip`: a few test frames as one picture: the driving panel, our avatars, the published renders.

Input: video (the comparison), png (one folder a variant), avatars (their files, in the same order). Output: picture (PNG).
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from avatar.frames import chosen_frames
from avatar.provenance import synthetic_comment
from avatar.published.config import PublishedStripConfig
from avatar.published.protocol import read_panels
from avatar.report.pictures import strip
from avatar.report.results import many
from avatar.uses.shading import captioned
from workflow import step

ROWS = 4


def read_picture(path: Path) -> np.ndarray:
    """A PNG as uint8 [h, w, 3] RGB; StepError where it is missing or damaged."""
    image = cv2.imread(str(path))
    if image is None:
        raise step.StepError(f"{path}: missing or damaged; delete its folder and run snakemake again")
    return np.ascontiguousarray(image[..., ::-1])


def run(job: step.Job) -> None:
    """Choose ROWS frames evenly and put every method's picture of them in a row."""
    config: PublishedStripConfig = job.config
    folders, avatars = many(job.input, "png"), many(job.input, "avatars")
    numbers = chosen_frames(sorted(int(path.stem) for path in folders[0].glob("*.png")), ROWS)
    published = [name for name in config.panels if name != config.driving]
    rows = []
    for number, (driving, *others) in read_panels(job.input.video, config.panels, [config.driving, *published], set(numbers)):
        ours = [read_picture(folder / f"{number:05d}.png") for folder in folders]
        titles = [f"{config.driving}, frame {number}", *(f"{name} (ours)" for name in config.variants)]
        titles += [f"{name} (published)" for name in published]
        rows.append(strip([captioned(*pair) for pair in zip([driving, *ours, *others], titles, strict=True)]))
    text = PngInfo()
    text.add_text("Comment", " ".join(dict.fromkeys(synthetic_comment(path) for path in avatars)))
    Image.fromarray(np.concatenate(rows)).save(job.output.picture, format="PNG", pnginfo=text)
    job.log.info("frames %s", ", ".join(map(str, numbers)))


if __name__ == "__main__":
    step.main(run, PublishedStripConfig)
