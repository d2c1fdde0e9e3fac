"""Typed config of what people do with a trained avatar. No torch."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from fitting.config import FitConfig, StepConfig


class FlickerConfig(StepConfig):
    """flicker: how much a render flickers over a still stretch of the test frames, beside the video's own flicker."""

    frames: int = Field(24, ge=5, le=1000, description="Consecutive frames of the stretch; fewer where there are no more.")
    size: int = Field(256, ge=64, le=2048, description="Longer side of the render in pixels; never larger than the frames.")
    smooth_s: float = Field(
        0.1, gt=0, le=2, description="Standard deviation (s) of the Gaussian that smooths the motion for the second render."
    )
    sample_factor: float | None = Field(
        None, ge=0.25, le=16, description="Samples on a ray, as in `render`; null takes the variant's own `render.sample_factor`."
    )


class UseConfig(StepConfig):
    """What orbit, extrapolate, sheet, animate and drive have in common."""

    sample_factor: float | None = Field(
        None, ge=0.25, le=16, description="Samples on a ray, as in `render`; null takes the variant's own `render.sample_factor`."
    )


class OrbitConfig(UseConfig):
    """orbit: the camera on an arc around the head."""

    size: int = Field(256, ge=16, le=2048, description="Longer side of the picture in pixels; the head fills it.")
    views: int = Field(25, ge=8, le=2000, description="Views to render; with a frozen expression the video shows most twice.")
    yaw_degrees: float = Field(35.0, ge=0, le=180, description="How far the camera goes to either side of the face.")
    pitch_degrees: float = Field(15.0, ge=0, le=80, description="How far it goes up and down.")
    frame: int | None = Field(None, ge=0, description="Frame of the frozen expression; null chooses a calm test frame.")
    playing: bool = Field(False, description="Play the test frames' expressions, `views` of them, instead of freezing one.")


class ExtrapolateConfig(UseConfig):
    """extrapolate: test frames with expression codes times 1, 1.5 and 2 (the paper's section 4.5)."""

    size: int = Field(192, ge=16, le=2048, description="Longer side of each picture in pixels, cut to the head; never enlarged.")
    frames: int = Field(16, ge=1, le=2000, description="Frames of the video, at about 15 a second, where the face moves most.")


class SheetConfig(UseConfig):
    """sheet: input, render, error, depth, normals, tracked mesh and opacity of some frames."""

    size: int | None = Field(None, ge=16, le=4096, description="Longer side of each picture; null keeps the frames' own pixels.")
    frames: tuple[int, ...] = Field(
        (), max_length=100, description="Frames; none chooses test frames: calm, expressive, turned, mouth open, eyes shut."
    )


class AnimateConfig(UseConfig):
    """animate: a file of expressions and poses drives every avatar. One entry a file."""

    file: str = Field(description="CSV or NPZ of named columns, one row a frame (see README); a fit/track.npz will do.")
    fps: float = Field(30.0, gt=0, le=240, description="Frames a second of the video, and of a file without `time_s`.")
    smooth_s: float = Field(0.0, ge=0, le=2, description="Standard deviation (s) of a Gaussian over all parameters; 0 is off.")
    size: int = Field(256, ge=16, le=2048, description="Longer side of the picture in pixels; the head fills it.")


class HalfDataConfig(StepConfig):
    """half_data: the split with the first half of the training frames. Nothing to set; it is no part of `config.yaml`."""


class DriverConfig(StepConfig):
    """drivers: a video whose motion moves the avatars of a subject; it is tracked and never trains. One entry a video."""

    video: str = Field(description="The driving video's file.")
    subject: str = Field(description="Subject whose avatars it drives: the same person, filmed at another time or place.")
    use: Literal["both", "pose", "expression"] = Field(
        "both", description="What is taken from the video: head pose, expression with gaze, or both."
    )
    smooth_s: float = Field(0.0, ge=0, le=2, description="Standard deviation (s) of a Gaussian over all parameters; 0 is off.")
    allow_other_identity: bool = Field(
        False, description="Drive also where the driving video shows another person; only with the consent of both."
    )


class DriveConfig(UseConfig):
    """drive: avatars moved by other videos (made when asked for: `snakemake drive`)."""

    size: int = Field(256, ge=16, le=2048, description="Longer side of each picture in pixels; never larger than the frames.")
    max_frames: int | None = Field(
        20,
        ge=1,
        description="Frames, about 15 a second, where the driver's face moves most; null: all of the driving video.",
    )
    view_degrees: float = Field(25.0, ge=0, le=90, description="How far the moving viewpoint swings to either side.")
    identity_limit: float | None = Field(
        None,
        gt=0,
        description="Difference of fitted heads from which a driver counts as another person; null: calibrated (see README).",
    )


class DriveStepConfig(DriveConfig):
    """drive: as above, with what the config says of the driver. The rule fills this in."""

    driver: str = Field("driver", description="Name of the driver.")
    use: Literal["both", "pose", "expression"] = "both"
    smooth_s: float = Field(0.0, ge=0, le=2)
    allow_other_identity: bool = False


class DriveSplitConfig(StepConfig):
    """drive_split: which frames of a driving video determine the identity. Nothing to set; it is no part of `config.yaml`."""


class IdentityPartsConfig(StepConfig):
    """identity_parts: identity from disjoint parts of one clip. No part of `config.yaml`, as the next."""

    parts: int = Field(3, ge=2, le=20, description="Consecutive parts into which the clip is cut.")
    fit: FitConfig = Field(FitConfig(), description="The config's own `fit`, as drivers and subjects are fitted with it.")


class IdentityCalibrationConfig(StepConfig):
    """identity_calibration: how far fitted heads of one person, and of two, lie apart. Nothing to set."""
