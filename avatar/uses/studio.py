"""What the steps that use an avatar open alike: the avatar, its track and camera, and what their reports have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from avatar import build, provenance
from avatar.config import RenderConfig
from avatar.dataset import Scene
from avatar.networks import best_precision
from avatar.uses import sequence
from avatar.uses.motion import Motion, of_track
from avatar.uses.sequence import Camera, Picture
from fitting.files import load_head
from fitting.head_model import HeadModel
from workflow import step

COUNTED = "geometry around the posed mesh, networks, rendering; not: posing the mesh, reading, making pictures and writing files"


@dataclass
class Studio:
    """An avatar that is ready to be rendered, and the clip that it was made from."""

    avatar: torch.nn.Module
    head: HeadModel
    track: dict[str, np.ndarray]
    split: dict[str, list[int]]
    camera: Camera
    """The frames' own pixels."""
    fps: float
    device: str
    precision: torch.dtype
    sha256: str
    comment: str
    """For every video."""
    sample_factor: float
    track_path: Path

    def motion(self, frames: Sequence[int]) -> Motion:
        """The clip's own motion in some frames."""
        return of_track(self.track, frames, self.fps)

    def scene(self, motion: Motion, camera: Camera | None = None) -> Scene:
        """This head in a motion; StepError names the track or motion that does not fit."""
        try:
            return sequence.scene_of(self.head, self.track["shape"], camera or self.camera, motion)
        except ValueError as error:
            raise step.StepError(f"{self.track_path}: {error}") from error

    def clearance_m(self) -> np.ndarray:
        """How far the avatar reaches off each vertex [V] m."""
        return self.avatar.thickness_m.cpu().numpy()

    def render(self, job: step.Job, scene: Scene, frames: Sequence[int], size: tuple[int, int]) -> Iterator[Picture]:
        """Pictures of the scene's frames with progress; StepError where one is not finite."""
        pictures = sequence.render_all(self.avatar, scene, frames, size, self.precision, self.device)
        try:
            yield from job.progress(pictures, "rendering", len(frames))
        except ValueError as error:
            raise step.StepError(f"{job.input.avatar}: {error}") from error

    def report(self, pictures: Sequence[Picture]) -> dict:
        """What every report says of its renders."""
        times = [picture.milliseconds for picture in pictures]
        return {
            "synthetic": True,
            "avatar_sha256": self.sha256,
            "renders": len(pictures),
            "size": list(pictures[0].image.shape[:2]),
            "ms_per_frame": round(float(np.median(times)), 1),
            "render_seconds": round(sum(times) / 1000, 2),
            "counted": COUNTED,
            "evaluations_per_frame": sum(picture.evaluations for picture in pictures) // len(pictures),
            "sample_factor": self.sample_factor,
            "precision": str(getattr(self.avatar, "precision", self.precision)).split(".")[1],
        }

    def usable(self, frames: Sequence[int]) -> list[int]:
        """Those that the fit could track."""
        return [frame for frame in frames if self.track["usable"][frame]]

    def test_frames(self) -> list[int]:
        """Test frames that could be tracked; StepError where there is none."""
        found = self.usable(self.split["test"])
        if not found:
            raise step.StepError(f"{self.track_path}: no test frame could be tracked; keep the face in view to the video's end")
        return found

    def training_frames(self) -> list[int]:
        """Training frames that could be tracked; all of them where none could."""
        return self.usable(self.split["train"]) or list(self.split["train"])


def open_studio(job: step.Job) -> Studio:
    """Read the inputs head avatar frames track split index; StepError names what does not fit together."""
    head = load_head(job.input.head)
    try:
        avatar = build.restore(torch.load(job.input.avatar, map_location=job.device, weights_only=True), head)
    except (ValueError, RuntimeError, KeyError) as error:
        raise step.StepError(f"{job.input.avatar}: {error}; train the avatar again") from error
    factor = job.config.sample_factor or RenderConfig().sample_factor
    avatar.sharpen(factor)
    with np.load(job.input.track, allow_pickle=False) as file:
        track = {name: file[name] for name in file.files}
    if (digest := str(track.get("head_digest", head.digest))) != head.digest:
        raise step.StepError(f"{job.input.track}: belongs to head model {digest}, found {head.digest}; fit the clip again")
    index, split = step.read_json(job.input.index), step.read_json(job.input.split)
    size = np.load(job.input.frames, mmap_mode="r").shape[1:3]
    camera = Camera(float(track["focal_px"]), np.asarray(track["centre_px"], np.float64), size)
    return Studio(
        avatar.to(job.device),
        head,
        track,
        split,
        camera,
        float(index["fps"]),
        job.device,
        best_precision(job.device),
        provenance.avatar_sha256(job.input.avatar),
        provenance.synthetic_comment(job.input.avatar),
        factor,
        job.input.track,
    )


def frontal(studio: Studio, motion: Motion) -> Motion:
    """The motion with the head held straight before the camera, where the training frames have it on the median."""
    where = np.median(studio.track["translation"][studio.training_frames()], 0).astype(np.float64)
    still = np.zeros((len(motion), 3))
    return Motion(motion.expression, still, still, motion.jaw, motion.eyes, np.tile(where, (len(motion), 1)), motion.fps)


def training_angles(studio: Studio) -> dict[str, list[float]]:
    """From where training saw the head: ends of yaw and pitch in degrees (see `sequence.camera_angles`)."""
    angles = sequence.camera_angles(studio.scene(studio.motion(studio.training_frames())))
    ends = [[round(float(np.degrees(end)), 1) for end in (values.min(), values.max())] for values in angles]
    return dict(zip(("yaw_degrees", "pitch_degrees"), ends, strict=True))
