"""Step `extrapolate`: test frames with their expression codes times 1, 1.5 and 2 beside the input (the paper's section 4.5).

Input: head avatar frames alpha track split index. Output: video, sheet (the most expressive frames), report.
The paper doubles the code, so zero stays where it is: with the default head that is the neutral face as it was fitted.
Pose and gaze are the frame's own; codes are not clipped to the head model's range.
"""

from __future__ import annotations

import numpy as np

from avatar.report.pictures import on_white, png
from avatar.uses import choose, motion, shading, studio
from avatar.uses.config import ExtrapolateConfig
from avatar.uses.sequence import Picture
from fitting import extract
from fitting.video import write_video
from workflow import step

FACTORS = (1.0, 1.5, 2.0)
ROWS = 4
"""Frames on the sheet."""
APART_S = 0.5
MARGIN = 0.12
"""Of the head's box in the input, around it: a chin drops further with doubled codes."""


def run(job: step.Job) -> None:
    """Render the stretch and the sheet's frames with every factor; write video, sheet and report."""
    room, config = studio.open_studio(job), job.config
    frames, alpha = (np.load(path, mmap_mode="r") for path in (job.input.frames, job.input.alpha))
    test = room.test_frames()
    moved = room.motion(test)
    looks = choose.looks_of(room.scene(moved), moved.eyes)
    stride = max(1, round(room.fps / choose.SHOWN_FPS))
    stretch = choose.liveliest(looks, test, config.frames, stride)
    strongest = choose.most_expressive(looks, ROWS, max(1, round(APART_S * room.fps)))
    wanted = sorted({*stretch, *strongest})
    box, size, _ = extract.fit_crop(head_box(alpha, [test[place] for place in wanted]), config.size)
    camera, own = room.camera.window(box, size), moved.take(wanted)
    scenes = {factor: room.scene(motion.scaled(own, factor), camera) for factor in FACTORS}
    rendered = {f: list(room.render(job, scene, range(len(wanted)), size)) for f, scene in scenes.items()}

    def row(place: int) -> list[np.ndarray]:
        """Input and renders [H, W, 3] of one frame."""
        frame, at = test[place], wanted.index(place)
        given = on_white(frames[frame], alpha[frame])
        return [extract.cut(given, box, size), *(rendered[factor][at].image[..., :3] for factor in FACTORS)]

    names = ["input", *(f"codes x{factor:g}" for factor in FACTORS)]
    shown = (np.concatenate([shading.captioned(*pair) for pair in zip(row(place), names, strict=True)], 1) for place in stretch)
    write_video(job.output.video, shown, room.fps / stride, room.comment)
    captions = [[f"input, frame {test[place]}", *names[1:]] for place in strongest]
    sheet = [
        [shading.captioned(*pair) for pair in zip(row(at), words, strict=True)]
        for at, words in zip(strongest, captions, strict=True)
    ]
    job.output.sheet.write_bytes(png(shading.grid(sheet)))
    numbers = {"stretch": stretch, "sheet": strongest}
    job.write_json(
        job.output.report,
        room.report([picture for part in rendered.values() for picture in part])
        | {name: [test[place] for place in places] for name, places in numbers.items()}
        | {
            "factors": list(FACTORS),
            "zero": "the zero code, as the paper doubles the code; with actions (default head) the fitted neutral face",
            "scaled": "expression codes and jaw; not head pose, neck and gaze; not clipped",
            "fps": round(room.fps / stride, 3),
            "by_factor": {f"x{factor:g}": facts(rendered[factor], scenes[factor]) for factor in FACTORS},
        },
    )
    job.log.info("%d frames x %d factors at %dx%d", len(wanted), len(FACTORS), size[1], size[0])


def facts(pictures: list[Picture], scene: studio.Scene) -> dict[str, float]:
    """How far the mesh goes (mm, rms over the face, mean over frames) and what it takes to render it."""
    strength = choose.looks_of(scene, np.zeros((len(pictures), 2, 3))).strength_mm
    median = float(np.median([picture.milliseconds for picture in pictures]))
    return {"face_moves_mm": round(float(strength.mean()), 2), "ms_per_frame": round(median, 1)}


def head_box(alpha: np.ndarray, frames: list[int]) -> dict[str, int]:
    """The box around the head over some frames with a margin, in whole pixels; the whole picture where every matte is empty.

    alpha: [T, H, W] uint8.
    """
    covered = np.zeros(alpha.shape[1:], bool)
    for frame in frames:
        covered |= alpha[frame] > 127
    if not covered.any():
        covered[:] = True
    ends = []
    for axis, size in ((1, covered.shape[0]), (0, covered.shape[1])):
        places = np.flatnonzero(covered.any(axis))
        margin = round(MARGIN * (places[-1] + 1 - places[0]))
        ends.append((max(0, int(places[0]) - margin), min(size, int(places[-1]) + 1 + margin)))
    (top, bottom), (left, right) = ends
    return {"x": left, "y": top, "width": right - left, "height": bottom - top}


if __name__ == "__main__":
    step.main(run, ExtrapolateConfig)
