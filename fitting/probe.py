"""Is it a readable video with one face in most frames, what the stream is, and the one crop box.

A rejected video is a result, not a failure: `accepted` is false, `reason` is one sentence, and the exit status is 0.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fitting import video
from fitting.config import ProbeConfig
from fitting.detection import Face, FaceFinder, FaceTrack, find_small
from workflow import step

KEYS = (
    "accepted",
    "reason",
    "file",
    "codec",
    "pixel_format",
    "fps",
    "variable_frame_rate",
    "frames",
    "duration_s",
    "rotation_degrees",
    "mirrored",
    "source_size",
    "crop",
    "face_found_fraction",
    "faces_max",
    "head_size_px",
    "warnings",
)
"""Of probe.json, always all of them; null where a rejected video did not get that far."""
SAMPLES = 48
MIN_FRAMES = 30
SMALL = 0.2
"""Of the longer side: a smaller face may be missed beside a larger one, so both are looked for."""
MIN_FACE_FRACTION = 0.5
MARGIN_ABOVE, MARGIN_BESIDE, MARGIN_BELOW = 0.55, 0.5, 0.55
"""Added to the landmarks' box, in face sizes: hair above, ears and the back of a turned head beside, neck below."""
HEAD_PER_FACE = 1.3
"""Crown to chin over the size of the landmarks' box, which ends at the hairline."""
CLOSE_TO_BORDER = 0.05
PROTOCOL_HEAD_PX, PROTOCOL_SECONDS, PROTOCOL_YAW_DEG = 500.0, 60.0, 30.0
"""The paper's capture protocol (supplement B)."""
DARK, BRIGHT, CLIPPED = 50.0, 215.0, 0.1


@dataclass
class Samples:
    """What was seen in frames spread over the whole video."""

    looked: int = 0
    decoded: int = 0
    seconds: float = 0.0
    kept: list[Face] | None = None
    faces_max: int = 0
    several: int = 0
    luminance: list[float] | None = None
    clipped: list[float] | None = None


def look(path: Path, packets: int, model: bytes, job: step.Job) -> Samples:
    """Decode the whole video and run the landmarker on about SAMPLES frames of it."""
    stride, thorough = max(1, packets // SAMPLES), False
    samples, track = Samples(kept=[], luminance=[], clipped=[]), FaceTrack(reach=1.5)
    with FaceFinder(model, video=False, max_faces=3) as finder:
        for frame in job.progress(video.read_frames(path, job.threads), "probe", packets):
            samples.decoded, samples.seconds = frame.index + 1, frame.time_s
            if frame.index % stride != stride // 2:
                continue
            rgb = frame.rgb()
            faces = find_small(finder, rgb, thorough)
            chosen, _ = track.update(faces, frame.time_s)
            samples.looked += 1
            samples.faces_max = max(samples.faces_max, len(faces))
            samples.several += len(faces) > 1
            if chosen is not None:
                thorough = faces[chosen].size_px < SMALL * max(rgb.shape)
                samples.kept.append(faces[chosen])
                mean, clipped = exposure(rgb, faces[chosen])
                samples.luminance.append(mean)
                samples.clipped.append(clipped)
    return samples


def exposure(rgb: np.ndarray, face: Face) -> tuple[float, float]:
    """Mean luminance (0-255) and part of clipped pixels inside the face's box."""
    height, width = rgb.shape[:2]
    low, high = face.points[:, :2].min(axis=0), face.points[:, :2].max(axis=0)
    x0, y0 = np.clip(low, 0, [width - 1, height - 1]).astype(int)
    x1, y1 = np.clip(high, [x0 + 1, y0 + 1], [width, height]).astype(int)
    patch = rgb[y0:y1, x0:x1].astype(np.float32)
    return float((patch @ [0.2126, 0.7152, 0.0722]).mean()), float((patch.max(axis=2) >= 254).mean())


def crop_box(faces: list[Face], size: tuple[int, int]) -> dict[str, int]:
    """One box for the whole video: the union of the heads over the sampled frames, clipped to the frame.

    Args:
        faces: the kept face of each sampled frame that has one.
        size: (h, w) of the upright source, px.

    Returns:
        x, y, width, height in whole px.
    """
    low = np.array([face.points[:, :2].min(axis=0) for face in faces])
    high = np.array([face.points[:, :2].max(axis=0) for face in faces])
    sizes = np.array([face.size_px for face in faces])[:, None]
    low = low - sizes * [MARGIN_BESIDE, MARGIN_ABOVE]
    high = high + sizes * [MARGIN_BESIDE, MARGIN_BELOW]
    height, width = size
    x0, y0 = np.floor(np.clip(low.min(axis=0), 0, [width, height])).astype(int).tolist()
    x1, y1 = np.ceil(np.clip(high.max(axis=0), 0, [width, height])).astype(int).tolist()
    return {"x": x0, "y": y0, "width": x1 - x0, "height": y1 - y0}


def capture_warnings(facts: video.StreamFacts, samples: Samples, head_px: float) -> list[str]:
    """Sentences that say where the video departs from the capture protocol and what to do about it."""
    found = []
    if samples.decoded < facts.packets:
        found.append(f"only {samples.decoded} of {facts.packets} frames could be read: the file is damaged, copy it anew")
    if head_px < PROTOCOL_HEAD_PX:
        found.append(f"the head is about {head_px:.0f} px high: over {PROTOCOL_HEAD_PX:.0f} px gives sharper avatars")
    if samples.seconds < PROTOCOL_SECONDS:
        found.append(f"{samples.seconds:.0f} s of video: 1-2 minutes show more poses and expressions")
    yaw = np.degrees([face.yaw_rad for face in samples.kept])
    reach = float(np.percentile(yaw, 95) - np.percentile(yaw, 5))
    if reach < PROTOCOL_YAW_DEG:
        found.append(f"the head turns only {reach:.0f} degrees in all: begin with a neutral face and turn it to both sides")
    if samples.several:
        found.append(f"a second face is seen in {samples.several} of {samples.looked} sampled frames: film one person alone")
    missing = samples.looked - len(samples.kept)
    if missing > 0.02 * samples.looked:
        found.append(f"no face in {missing} of {samples.looked} sampled frames: keep the face towards the camera")
    height, width = facts.size
    edges = [
        face
        for face in samples.kept
        if (face.points[:, :2].min(axis=0) < 0.0).any() or (face.points[:, :2].max(axis=0) > [width, height]).any()
    ]
    if len(edges) > CLOSE_TO_BORDER * len(samples.kept):
        found.append(f"the face is cut by the frame's border in {len(edges)} of {samples.looked} sampled frames: keep it inside")
    if np.median(samples.luminance) < DARK:
        found.append("the face is dark: add light from the front")
    if np.median(samples.luminance) > BRIGHT or np.median(samples.clipped) > CLIPPED:
        found.append("the face is over-exposed: lower the exposure")
    if facts.hdr:
        found.append(f"{facts.hdr} high-dynamic-range video is read without tone mapping: film with HDR off for true colours")
    return found


def rejection(samples: Samples, packets: int) -> str | None:
    """Why a decodable video cannot be used, or None."""
    if samples.decoded < MIN_FRAMES:
        return f"{samples.decoded} frames could be read of {packets}, at least {MIN_FRAMES} are needed; film 1-2 minutes"
    if not samples.kept:
        return f"no face in any of {samples.looked} sampled frames; film one face, upright and well lit"
    if len(samples.kept) < MIN_FACE_FRACTION * samples.looked:
        return (
            f"a face in only {len(samples.kept)} of {samples.looked} sampled frames, at least half is needed; keep the face "
            f"in view of the camera"
        )
    return None


def measure(job: step.Job) -> dict[str, Any]:
    """Content of probe.json."""
    path = job.input.video
    report: dict[str, Any] = dict.fromkeys(KEYS) | {"accepted": False, "file": path.name, "warnings": []}
    try:
        facts = video.inspect(path)
    except video.VideoError as error:
        return report | {"reason": f"{path.name}: {error}"}
    stream = asdict(facts)
    report |= {key: stream[key] for key in ("codec", "pixel_format", "fps", "variable_frame_rate")}
    samples = look(path, facts.packets, job.input.landmarker.read_bytes(), job)
    report |= {
        "frames": samples.decoded,
        "duration_s": samples.seconds + 1.0 / facts.fps,
        "rotation_degrees": facts.rotation_degrees,
        "mirrored": facts.mirrored,
        "source_size": list(facts.size),
    }
    report["face_found_fraction"] = len(samples.kept) / samples.looked if samples.looked else 0.0
    report["faces_max"] = samples.faces_max
    reason = rejection(samples, facts.packets)
    if reason is not None:
        return report | {"reason": f"{path.name}: {reason}"}
    head_px = HEAD_PER_FACE * float(np.median([face.size_px for face in samples.kept]))
    return report | {
        "accepted": True,
        "crop": crop_box(samples.kept, facts.size),
        "head_size_px": head_px,
        "warnings": capture_warnings(facts, samples, head_px),
    }


def run(job: step.Job) -> None:
    """Write probe.json."""
    report = measure(job)
    if report["accepted"]:
        crop = report["crop"]
        job.log.info("%d frames, %s, crop %dx%d", report["frames"], report["codec"], crop["width"], crop["height"])
    else:
        job.log.warning("rejected: %s", report["reason"])
    for warning in report["warnings"]:
        job.log.warning("%s: %s", report["file"], warning)
    job.write_json(job.output.probe, report)


if __name__ == "__main__":
    step.main(run, ProbeConfig)
