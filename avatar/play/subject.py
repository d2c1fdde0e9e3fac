"""What `play` opens: an avatar and all that belongs to it, found from its folder alone. The only place here that opens files."""

from __future__ import annotations

import logging
import pickle
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from zipfile import BadZipFile

import numpy as np
import torch

from avatar.play.rows import Row
from avatar.uses import parameters, studio
from avatar.uses.config import UseConfig
from avatar.uses.motion import Motion
from fitting import video
from workflow import step

LANDMARKER = Path("resources/assets/face_landmarker.task")
HEADS = Path("resources/heads")


@dataclass(frozen=True)
class Subject:
    """An avatar that is ready to play."""

    name: str
    variant: str
    room: studio.Studio
    representation: str
    clip: Motion
    """The subject's own track, frames that could be tracked."""
    clip_frames: list[int]
    """Their numbers in the video."""
    landmarker: bytes | None
    """Content of face_landmarker.task; None where it is missing."""

    @property
    def training(self) -> Motion:
        """The motion that training saw."""
        return self.room.motion(self.room.training_frames())


def find(folder: Path) -> dict[str, Path]:
    """Files of `results/SUBJECT/VARIANT` by name: avatar, track, index, split, frames, head; StepError names what is missing."""
    if not folder.is_dir():
        raise step.StepError(f"{folder}: there is no such folder; give that of a trained variant, results/SUBJECT/VARIANT")
    subject = folder.resolve().parent
    if not (folder / "avatar.pt").is_file():
        others = sorted(path.parent.name for path in [*subject.glob("*/avatar.pt"), *folder.glob("*/avatar.pt")])
        hint = f"trained here are {', '.join(others)}" if others else "train one first (snakemake)"
        raise step.StepError(f"{folder}: there is no avatar.pt in it; {hint}")
    found = {
        "avatar": folder / "avatar.pt",
        "track": subject / "fit" / "track.npz",
        "index": subject / "frames" / "frames.json",
        "frames": subject / "frames" / "frames.npy",
        "split": subject / "split.json",
    }
    for path in found.values():
        if not path.is_file():
            raise step.StepError(f"{path}: this file belongs to the avatar {folder} and is missing; run snakemake again")
    return found | {"head": find_head(found["avatar"], roots(folder))}


def roots(folder: Path) -> list[Path]:
    """Where `resources/` may lie: the project of the results, and the working directory."""
    return list(dict.fromkeys([folder.resolve().parent.parent.parent, Path.cwd()]))


def find_head(avatar: Path, places: list[Path]) -> Path:
    """The head model that an avatar was trained on, by its digest; StepError names what was found instead."""
    try:
        stored = torch.load(avatar, map_location="cpu", weights_only=True)
        digest, name = stored["head_digest"], stored["head_name"]
    except (RuntimeError, KeyError, TypeError, EOFError, OSError, ValueError, pickle.UnpicklingError) as error:
        raise step.StepError(f"{avatar}: not readable as an avatar ({str(error).splitlines()[0]}); train it again") from error
    seen = []
    for path in sorted({path for place in places for path in (place / HEADS).glob("*.npz")}):
        try:
            with np.load(path, allow_pickle=False) as file:
                found = str(file["digest"])
        except (OSError, ValueError, KeyError, BadZipFile):
            continue
        if found == digest:
            return path
        seen.append(f"{path.name} ({found})")
    where = f"found {', '.join(seen)}" if seen else "found none"
    raise step.StepError(
        f"{places[0] / HEADS}: no head model with digest {digest}, on which {avatar} was trained ({name}); {where}; "
        "bring its file back, or fit and train again"
    )


def open_subject(folder: Path, threads: int) -> Subject:
    """Open an avatar and what belongs to it; StepError with one sentence where something does not fit."""
    paths = find(folder)
    nothing = SimpleNamespace()
    name = folder.resolve().parent.name
    job = step.Job(
        UseConfig(), SimpleNamespace(**paths), nothing, nothing, name, threads, "cpu", "", logging.getLogger("play")
    )  # fmt: skip
    room = studio.open_studio(job)
    frames = room.usable(range(len(room.track["expression"])))
    if not frames:
        raise step.StepError(f"{paths['track']}: no frame of this clip could be tracked; use another clip")
    settings = torch.load(paths["avatar"], map_location="cpu", weights_only=True)["settings"]
    landmarker = next((root / LANDMARKER for root in roots(folder) if (root / LANDMARKER).is_file()), None)
    return Subject(
        name,
        folder.resolve().name,
        room,
        settings["representation"],
        room.motion(frames),
        frames,
        landmarker.read_bytes() if landmarker else None,
    )


def open_motion(path: Path, subject: Subject, rest: Row) -> Motion:
    """A parameter file's motion; what it does not name rests at `rest`. StepError names file and fault."""
    still = Motion(**{name: np.asarray(values)[None] for name, values in rest._asdict().items()}, fps=subject.room.fps)
    try:
        return parameters.read(path, subject.room.head, still, subject.room.fps).motion
    except FileNotFoundError:
        raise step.StepError(f"{path}: there is no such file") from None
    except ValueError as error:
        raise step.StepError(f"{path}: {error}") from error


def check_video(path: Path) -> None:
    """StepError where a file is no video."""
    try:
        video.inspect(path)
    except (video.VideoError, OSError) as error:
        raise step.StepError(f"{path}: {error}") from error
