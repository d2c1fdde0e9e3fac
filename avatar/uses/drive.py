"""Step `drive`: an avatar moved by another video of the same person.

Input: head, avatar, track, split, index (the subject's), driver_track, driver_frames, driver_index. Output: video, report, strip.
The video shows, side by side, the driver as filmed, the avatar through the subject's own camera, and the avatar from a viewpoint
that swings around it, with its depth. What is carried over, and how, stands in `avatar.uses.retarget`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from avatar.frames import chosen_frames
from avatar.uses import choose, identity, motion, retarget, sequence
from avatar.uses.config import DriveStepConfig
from avatar.uses.drive_picture import rows_of
from avatar.uses.studio import Studio, open_studio
from fitting.head_model import HeadModel
from fitting.video import write_video
from workflow import step

STRIP_ROWS = 6
SWINGS = 2  # of the moving viewpoint over the video


@dataclass(frozen=True)
class Fit:
    """A fitted clip as a driver or as a subject."""

    shape: np.ndarray  # [S]
    motion: motion.Motion  # all frames, those that are not usable bridged
    usable: np.ndarray  # [T] bool


def fit_of(track: dict[str, np.ndarray], fps: float) -> Fit:
    """A track as a driver or as a subject; ValueError where no frame is usable or one is not finite."""
    usable = track["usable"].astype(bool)
    whole = motion.of_track(track, range(len(usable)), fps)
    return Fit(track["shape"].astype(np.float64), retarget.bridged(whole, usable), usable)


def read_driver(track: Path, index: Path, head: HeadModel) -> Fit:
    """The driver's fit; StepError where it belongs to another head model or cannot be used."""
    with np.load(track, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    if (digest := str(arrays.get("head_digest", head.digest))) != head.digest:
        what = f"the track belongs to head model {digest}, the avatar to {head.name} {head.digest}"
        raise step.StepError(f"{track}: {what}; fit the driving video again with the avatar's head model")
    try:
        return fit_of(arrays, float(step.read_json(index)["fps"]))
    except ValueError as error:
        raise step.StepError(f"{track}: {error}; use another driving video") from error


def check_identity(job: step.Job, head: HeadModel, driver: Fit, subject: Fit) -> dict[str, Any]:
    """What the distance of the two fitted heads says, for the report; StepError where another person may not drive."""
    found = identity.verdict(head, driver.shape, subject.shape, job.config.identity_limit)
    sentence = (
        f"the fitted heads of driver {job.config.driver} and subject {job.subject} differ by {found.distance:.2f} standard "
        f"deviations; from {found.refused_from:.2f} on they count as two people, from {found.doubtful_from:.2f} on it is doubtful"
    )
    if found.word == "other" and not job.config.allow_other_identity:
        way = f"set drivers.{job.config.driver}.allow_other_identity: true if it is the same person, or if both people agree"
        raise step.StepError(f"{job.input.driver_track}: {sentence}; {way}")
    if found.word != "same":
        job.log.warning("%s", sentence)
    if job.config.identity_limit is None and head.name != identity.CALIBRATED_ON:
        how = "set drive.identity_limit, as `snakemake identity_calibration` finds it"
        job.log.warning("the limit is that of head model %s, not of %s: %s", identity.CALIBRATED_ON, head.name, how)
    return {
        "verdict": found.word,
        "distance": round(found.distance, 4),
        "doubtful_from": round(found.doubtful_from, 4),
        "refused_from": round(found.refused_from, 4),
        "used": identity.CHOSEN,
        "distances": {name: round(by(head, driver.shape, subject.shape), 4) for name, by in identity.DISTANCES.items()},
        "allow_other_identity": job.config.allow_other_identity,
    }


def driven(
    head: HeadModel, driver: Fit, subject: Fit, train: list[int], same: bool, config: DriveStepConfig
) -> tuple[motion.Motion, list[int], tuple[retarget.Rest, list[int]], tuple[retarget.Rest, list[int]]]:
    """The subject's motion for the driver's chosen frames, these, and the rests of driver and subject with their frames.

    same: whether both are one person.
    """
    good = np.flatnonzero(driver.usable).tolist()
    chosen, stride = stretch_of(head, driver, good, config.max_frames)
    source = retarget.rest_of(head, driver.shape, driver.motion.take(good))
    target = retarget.rest_of(head, subject.shape, subject.motion.take(train))
    moved = motion.smoothed(driver.motion, config.smooth_s)
    moved = moved.take(chosen, moved.fps / stride)
    centres = retarget.face_centres(head, driver.shape, moved)
    offset = retarget.same_face(head, driver.shape, subject.shape) if same else None
    carried = retarget.transferred(head, subject.shape, moved, source, target, centres, config.use, offset)
    return carried, chosen, (source, [good[k] for k in source.frames]), (target, [train[k] for k in target.frames])


def stretch_of(head: HeadModel, driver: Fit, good: list[int], most: int | None) -> tuple[list[int], int]:
    """The driver's frames to show and the distance between them: all usable ones, or where the face moves most.

    good: usable frames; most: how many, None for all.
    """
    if most is None:
        return good, 1
    stride = max(1, round(driver.motion.fps / choose.SHOWN_FPS))
    moved = driver.motion.take(good)
    camera = sequence.Camera(1.0, np.zeros(2), (1, 1))  # no picture is taken: looks are measured on the mesh
    looks = choose.looks_of(sequence.scene_of(head, driver.shape, camera, moved), moved.eyes)
    return [good[place] for place in choose.liveliest(looks, good, most, stride)], stride


def swing(count: int, degrees: float) -> np.ndarray:
    """Yaw [T] rad of the moving viewpoint: from ahead to one side and the other, SWINGS times, and back."""
    return np.radians(degrees) * np.sin(2 * np.pi * SWINGS * np.arange(count) / max(count - 1, 1))


def run(job: step.Job) -> None:
    """Check who drives whom, carry the motion over, render it twice, and show it beside the driver."""
    studio = open_studio(job)
    head = studio.head
    driver = read_driver(job.input.driver_track, job.input.driver_index, head)
    try:
        subject = fit_of(studio.track, studio.fps)
    except ValueError as error:
        raise step.StepError(f"{job.input.track}: {error}; fit the clip again") from error
    found = check_identity(job, head, driver, subject)
    same = found["verdict"] != "other"
    moved, chosen, source, target = driven(head, driver, subject, studio.training_frames(), same, job.config)
    yaw = swing(len(chosen), job.config.view_degrees)
    ahead, aside = pictures(studio, moved, yaw, job)
    frames = np.load(job.input.driver_frames, mmap_mode="r")
    rows = rows_of([frames[frame] for frame in chosen], ahead, aside, np.degrees(yaw), job.config.use)
    strip, on_strip = [], chosen_frames(chosen, STRIP_ROWS)

    def shown() -> Iterator[np.ndarray]:
        """Rows for the video; those of the strip are kept."""
        for frame, row in zip(chosen, rows, strict=True):
            if frame in on_strip:
                strip.append(row)
            yield row

    write_video(job.output.video, shown(), moved.fps, studio.comment)
    cv2.imwrite(str(job.output.strip), np.concatenate(strip)[..., ::-1])
    job.write_json(
        job.output.report,
        {
            "driver": job.config.driver,
            "subject": job.subject,
            "use": job.config.use,
            "identity": found,
            "frames": chosen,
            "left_out": {"count": int((~driver.usable).sum()), "reason": "the fit could not track them (track.npz: usable)"},
            "fps": round(moved.fps, 3),
            "viewpoint_yaw_degrees": np.degrees(yaw).round(2).tolist(),
            "rest_of_driver": rest_report(head, *source),
            "rest_of_subject": rest_report(head, *target),
        }
        | studio.report([*ahead, *aside]),
    )


def pictures(
    studio: Studio, moved: motion.Motion, yaw: np.ndarray, job: step.Job
) -> tuple[list[sequence.Picture], list[sequence.Picture]]:
    """Every frame through the subject's camera, and every frame from the moving viewpoint, yaw [T] rad."""
    camera = studio.camera.resized(job.config.size)
    ahead, aside = (studio.scene(moved, camera) for _ in range(2))
    sequence.turn(aside, sequence.viewpoint(yaw, np.zeros_like(yaw)), sequence.head_centre_m(aside))
    first, second = (list(studio.render(job, scene, range(len(moved)), camera.size)) for scene in (ahead, aside))
    return first, second


def rest_report(head: HeadModel, rest: retarget.Rest, frames: list[int]) -> dict[str, Any]:
    """A rest in words: the frames that it was found on, its strongest codes, gaze and place."""
    strongest = np.argsort(-np.abs(rest.expression))[:8]
    return {
        "frames": frames,
        "expression": {head.expression_names[k]: round(float(rest.expression[k]), 3) for k in strongest},
        "gaze_degrees": np.degrees(rest.eyes[:, :2]).round(2).tolist(),
        "face_centre_m": rest.centre_m.round(4).tolist(),
        "face_size_m": round(rest.size_m, 5),
    }


if __name__ == "__main__":
    step.main(run, DriveStepConfig)
