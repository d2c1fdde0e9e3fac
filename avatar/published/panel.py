"""Step `published_panel`: the driving panel of a comparison video as a video of its own, every pixel and frame kept.

    python -m avatar.published.panel --config '{"panels": ["driving", "NerFACE"], "driving": "driving", "test_frames": 150}' \\
        --input video=comparison.mp4 --output video=results/published/nerface/driving.mp4
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from avatar.published.config import PublishedPanelConfig
from avatar.published.protocol import panel_width, read_panels
from fitting import video
from workflow import step


def facts(path: Path, config: PublishedPanelConfig) -> video.StreamFacts:
    """The stream's facts; StepError where its panels cannot be what the config says."""
    try:
        found = video.inspect(path)
        panel_width(found.size[1], config.panels)
    except video.VideoError as error:
        raise step.StepError(f"{path}: {error}") from None
    except ValueError as error:
        raise step.StepError(f"{path}: {error}; name every panel, left to right, under comparisons: panels") from None
    if found.rotation_degrees or found.mirrored:
        raise step.StepError(f"{path}: is to be turned by {found.rotation_degrees} degrees for showing; export it upright")
    return found


def write_lossless(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    """Write H.264 without any loss, as RGB; returns the number of frames uint8 [h, w, 3]. Every decoder gives the same bytes."""
    count, stream, rate = 0, None, Fraction(fps).limit_denominator(1001)
    with av.open(str(path), "w", format="mp4") as container:
        for frame in frames:
            if stream is None:
                stream = container.add_stream("libx264rgb", rate=rate, options={"qp": "0", "preset": "veryfast"})
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "rgb24"
                stream.codec_context.time_base = 1 / rate
            native = av.VideoFrame.from_ndarray(frame, format="rgb24")
            native.pts, native.time_base = count, 1 / rate
            container.mux(stream.encode(native))
            count += 1
        if stream is not None:
            container.mux(stream.encode())
    return count


def changed(path: Path, job: step.Job) -> int | None:
    """The first frame that does not come back as it was cut; None where all do."""
    cut = read_panels(job.input.video, job.config.panels, [job.config.driving])
    back = (frame.rgb() for frame in video.read_frames(path))
    for (number, (panel,)), again in zip(cut, back, strict=True):
        if not np.array_equal(panel, again):
            return number
    return None


def run(job: step.Job) -> None:
    """Cut, write, and read back."""
    config: PublishedPanelConfig = job.config
    path, found = job.input.video, facts(job.input.video, job.config)
    panels = (panel for _, (panel,) in job.progress(read_panels(path, config.panels, [config.driving]), "cutting", found.packets))
    count = write_lossless(job.output.video, panels, found.fps)
    if count <= config.test_frames:
        what = f"{count} frames leave none for training before {config.test_frames} test frames"
        raise step.StepError(f"{path}: {what}; lower comparisons: test_frames")
    if count > config.max_frames:
        what = f"{count} frames are more than extract.max_frames: {config.max_frames}, so the last would be missing"
        raise step.StepError(f"{path}: {what}; raise it to {count}")
    if (number := changed(job.output.video, job)) is not None:
        raise step.StepError(f"{path}: frame {number} did not come back from the codec as it was; convert the video to H.264")
    job.log.info("%d frames of panel %s, bit for bit", count, config.driving)


if __name__ == "__main__":
    step.main(run, PublishedPanelConfig)
