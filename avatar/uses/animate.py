"""Step `animate`: a parameter file drives the avatar (see `avatar.uses.parameters`).

Input: head avatar frames track split index file. Output: video, report.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from avatar import provenance
from avatar.uses import motion, parameters, sequence, studio
from avatar.uses.config import AnimateConfig
from avatar.uses.motion import Motion
from fitting.video import write_video
from workflow import step

REPORTED = 8
"""Parameters named in the report that leave what training saw, farthest first."""
NOTABLE = 0.02
"""Of a code or in rad: less is no news."""


def run(job: step.Job) -> None:
    """Render every frame of the file."""
    room, config = studio.open_studio(job), job.config
    seen = room.motion(room.training_frames())
    rest = studio.frontal(room, Motion(**{name: np.zeros_like(getattr(seen, name)[:1]) for name in motion.PARTS}, fps=config.fps))
    try:
        given = parameters.read(job.input.file, room.head, rest, config.fps)
        moved = motion.smoothed(given.motion, config.smooth_s)
        scene = room.scene(moved)
        camera = sequence.framed(scene, config.size, room.clearance_m())
    except FileNotFoundError:
        raise step.StepError(f"{job.input.file}: there is no such file; look at animate in the config") from None
    except ValueError as error:
        raise step.StepError(f"{job.input.file}: {error}") from error
    if given.left_out:
        job.log.info("left out, as the head model has no code for them: %s", ", ".join(given.left_out))
    pictures = []

    def shown() -> Iterator[np.ndarray]:
        """Frames for the video; what the report counts is kept without the pictures."""
        for picture in room.render(job, scene, range(len(moved)), camera.size):
            pictures.append(picture._replace(image=np.empty((*camera.size, 0)), depth_m=None))
            yield picture.image[..., :3]

    count = write_video(job.output.video, shown(), config.fps, room.comment)
    job.write_json(
        job.output.report,
        room.report(pictures)
        | {
            "frames": count,
            "fps": config.fps,
            "smooth_s": config.smooth_s,
            "file_sha256": provenance.avatar_sha256(job.input.file),
            "columns": list(given.given),
            "left_out": list(given.left_out),
            "rest": "codes, rotations and gaze 0; translation the median of the training frames",
            "beyond_training": beyond(moved, seen, room.head.expression_names),
        },
    )
    job.log.info("%d frames from %d columns", count, len(given.given))


def beyond(moved: Motion, seen: Motion, names: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Codes and rotations that leave the range of the training frames: part of the frames that do, and the farthest value."""
    labels = parameters.column_names(names)[: len(names) + 3]
    values, known = (np.concatenate([part.expression, part.rotation], 1) for part in (moved, seen))
    low, high = known.min(0), known.max(0)
    outside = np.maximum(values - high, low - values)
    order = np.argsort(-outside.max(0), kind="stable")
    found = [place for place in order if outside[:, place].max() > NOTABLE][:REPORTED]
    return {
        labels[place]: {
            "frames": round(float((outside[:, place] > NOTABLE).mean()), 3),
            "farthest": round(float(values[outside[:, place].argmax(), place]), 4),
            "training_from": round(float(low[place]), 4),
            "training_to": round(float(high[place]), 4),
        }
        for place in found
    }


if __name__ == "__main__":
    step.main(run, AnimateConfig)
