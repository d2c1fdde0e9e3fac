"""Step: a simulated selfie video with everything known about it.

    python -m fitting.simulate --config '{"kind": "blink", "seed": 3}' --input head=resources/heads/anny_rich.npz \\
        --output video=simulated/videos/blink_3.mp4 truth=simulated/truth/blink_3.npz alpha=simulated/truth/blink_3_alpha.npy
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fitting import synthetic
from fitting.config import SimulateConfig
from fitting.head_model import HeadModel
from fitting.synthetic_render import Renderer
from fitting.video import write_video
from workflow import step

QUALITY = 10  # x264's rate factor: errors of the codec stay below the sensor noise


def run(job: step.Job) -> None:
    """Write the video, its truth and its matte; frames of the video and rows of the truth are the same."""
    config = job.config
    try:
        head = HeadModel.load(job.input.head)
    except ValueError as error:
        raise step.StepError(str(error)) from None
    clip = clip_of(config, head)
    renderer = Renderer(clip, config.hair, config.noise)
    alpha = np.empty((config.frames, config.height, config.width), np.uint8)

    def pictures() -> Iterator[np.ndarray]:
        for row in job.progress(range(config.frames), "simulate"):
            picture, alpha[row] = renderer.frame(row)
            yield picture

    write_video(job.output.video, pictures(), config.fps, f"simulated: {config.kind}, seed {config.seed}", QUALITY)
    with open(job.output.truth, "wb") as file:
        np.savez_compressed(file, **clip.arrays())
    with open(job.output.alpha, "wb") as file:
        np.save(file, alpha)
    job.log.info("%d frames, %.0f ms each", config.frames, 1e3 * job.seconds() / config.frames)


def clip_of(config: SimulateConfig, rich: HeadModel) -> synthetic.Clip:
    """The clip that a config stands for, with a head model of more components than the one that is fitted."""
    return synthetic.make(
        rich,
        config.kind,
        config.frames,
        synthetic.Camera.of((config.height, config.width), config.focal_px, config.k1),
        config.seed,
        config.fps,
        config.distance_m,
        config.displacement_mm / 1e3,
        config.bump_mm / 1e3,
        exposure_stops=config.exposure_stops,
    )


if __name__ == "__main__":
    step.main(run, SimulateConfig)
