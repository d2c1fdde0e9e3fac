"""Step `identity_parts`: identity of one clip from disjoint parts of it, to learn how far one person is from himself.

Input: head, frames, index, landmarks, alpha, split. Output: row (json). Parts are neighbouring stretches of one recording, under
one light and one lens: two recordings of one person lie further apart, so what is learned from parts is optimistic.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatar.uses.config import IdentityPartsConfig
from avatar.uses.drive_split import driver_split
from fitting import tracking
from fitting.files import load_head
from fitting.fit import read_clip
from workflow import step


def part_of(clip: tracking.Clip, rows: np.ndarray) -> tracking.Clip:
    """A clip of some consecutive frames, split as a driving video is: nearly all of them determine the identity.

    Raises:
        ValueError: there are too few frames with a face.
    """
    seen = clip.observed
    per_frame = ("points", "found", "scale_px", "expression_mean", "inside", "open_eyes")
    observed = replace(seen, **{name: getattr(seen, name)[rows] for name in per_frame})
    train, test = (np.array(frames, int) for frames in driver_split(observed.found))
    window = slice(rows[0], rows[-1] + 1)
    return replace(
        clip,
        observed=observed,
        frames=clip.frames[window],
        alpha=clip.alpha[window],
        time_s=clip.time_s[rows],
        train=train,
        test=test,
    )


def run(job: step.Job) -> None:
    """Fit every part on its own; a part that cannot be fitted is left out, with its reason."""
    head = load_head(job.input.head)
    config = job.config.fit
    clip = read_clip(replace(job, config=config), head)  # as the step `fit` reads it
    parts, left_out = [], []
    for rows in job.progress(np.array_split(np.arange(len(clip.frames)), job.config.parts), "parts"):
        span = [int(rows[0]), int(rows[-1])]
        try:
            fitted = tracking.fit_clip(part_of(clip, rows), config, held_out=False)
        except (ValueError, tracking.LostFace) as error:
            left_out.append({"frames": span, "reason": str(error)})
            continue
        state = fitted.state
        usable = int(fitted.usable.sum())
        parts.append({"frames": span, "usable": usable, "focal_px": state.focal_px, "shape": state.shape.tolist()})
    job.write_json(job.output.row, {"subject": job.subject, "head_digest": head.digest, "parts": parts, "left_out": left_out})
    job.log.info("%d of %d parts of %s fitted", len(parts), job.config.parts, job.subject)


if __name__ == "__main__":
    step.main(run, IdentityPartsConfig)
