"""478 landmarks, 51 named blendshape scores and the head matrix of every frame, for the one face that is kept."""

from __future__ import annotations

import numpy as np

from fitting.config import DetectConfig
from fitting.detection import BLENDSHAPE_NAMES, POINTS, Face, FaceFinder, FaceTrack
from workflow import step

MAX_FACES = 3
"""More than one so that a second face is seen beside the kept one; MediaPipe then leaves the points unsmoothed."""


def growing_ms(times_s: list[float]) -> list[int]:
    """Frame times in whole milliseconds, strictly growing as MediaPipe's video mode demands."""
    stamps: list[int] = []
    for time_s in times_s:
        stamps.append(max(round(1e3 * time_s), stamps[-1] + 1 if stamps else 0))
    return stamps


def run(job: step.Job) -> None:
    """Write landmarks.npz and landmarks.json."""
    frames = np.load(job.input.frames, mmap_mode="r")
    times = step.read_json(job.input.index)["time_s"]
    if len(times) != len(frames):
        raise step.StepError(
            f"{job.input.frames}: {len(frames)} frames but {len(times)} times in {job.input.index}; delete both "
            f"and run snakemake again"
        )
    kept: list[Face | None] = []
    switched = np.zeros(len(frames), dtype=bool)
    most, recovered, track = 0, 0, FaceTrack()
    model = job.input.landmarker.read_bytes()
    with FaceFinder(model, True, MAX_FACES) as tracker, FaceFinder(model, False, MAX_FACES) as still:
        for t, stamp in enumerate(job.progress(growing_ms(times), "detect")):
            faces = tracker.find(frames[t], stamp)
            chosen, switched[t] = track.update(faces, times[t])
            if chosen is None:
                faces = still.find(frames[t])
                chosen, switched[t] = track.update(faces, times[t])
                recovered += chosen is not None
            most = max(most, len(faces))
            kept.append(None if chosen is None else faces[chosen])
    found = np.array([face is not None for face in kept])
    if not found.any():
        raise step.StepError(f"{job.input.frames}: no face in any of {len(frames)} frames; check the crop in probe.json")
    nothing = Face(
        np.full((POINTS, 3), np.nan, np.float32),
        np.full(len(BLENDSHAPE_NAMES), np.nan, np.float32),
        np.full((4, 4), np.nan, np.float32),
    )
    rows = [face or nothing for face in kept]
    with open(job.output.landmarks, "wb") as file:
        np.savez(
            file,
            points=np.stack([row.points for row in rows]),
            found=found,
            blendshapes=np.stack([row.blendshapes for row in rows]),
            blendshape_names=np.array(BLENDSHAPE_NAMES),
            head_pose=np.stack([row.head_pose for row in rows]),
            switched=switched,
        )
    milliseconds = 1e3 * job.seconds() / len(frames)
    job.write_json(
        job.output.report,
        {
            "frames": len(frames),
            "found": int(found.sum()),
            "found_fraction": float(found.mean()),
            "lost_frames": np.flatnonzero(~found).tolist(),
            "switched_frames": np.flatnonzero(switched).tolist(),
            "found_again_by_still_detection": recovered,
            "faces_max": most,
            "ms_per_frame": round(milliseconds, 2),
        },
    )
    job.log.info("a face in %d of %d frames, %d switches, %.1f ms each", found.sum(), len(frames), switched.sum(), milliseconds)


if __name__ == "__main__":
    step.main(run, DetectConfig)
