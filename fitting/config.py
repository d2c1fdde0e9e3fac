"""Typed config of the steps from video to tracked head: one pydantic model a step, no torch, nothing imported of the project.

`config/README.md` and `workflow/schemas/config.schema.json` are generated from the field descriptions here.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class StepConfig(BaseModel):
    """Base of every step's config: unknown keys are errors, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class FetchConfig(StepConfig):
    """fetch: one asset into `resources/`, verified by sha256."""

    path: str | None = Field(None, description="Your own copy of the file; null fetches it.")


class HeadConfig(StepConfig):
    """head: bake the head model into one file."""

    model: Literal["anny"] = Field("anny", description="Head model: `anny`, the open default.")
    shape_components: int = Field(80, ge=10, le=200, description="Principal components of identity that are kept.")
    samples: int = Field(600, ge=100, le=5000, description="Random heads from which the identity space is computed.")


class ProbeConfig(StepConfig):
    """probe: is it a readable video with one face in most frames; where to crop."""


class ExtractConfig(StepConfig):
    """extract: frames of the head's crop as one memory-mapped array."""

    size: int = Field(512, ge=64, le=2048, description="Longer side of the frames in pixels; a crop is never upscaled.")
    max_frames: int = Field(2000, ge=8, le=20000, description="Frames kept from the start of the video.")


class MatteConfig(StepConfig):
    """matte: soft mask of the whole person."""


class DetectConfig(StepConfig):
    """detect: 478 landmarks, 51 blendshape scores and the head matrix of every frame."""


class SplitConfig(StepConfig):
    """split: training frames first, a contiguous test tail last."""

    train_fraction: float = Field(0.75, gt=0, lt=1, description="Part of the frames, from the start, that trains.")
    max_train_frames: int = Field(1500, ge=1, description="Upper bound of the training frames.")
    test_frames: int | None = Field(
        None, ge=1, description="Exactly this many last frames test; null: all after the training part."
    )


class FitConfig(StepConfig):
    """fit: camera and head parameters of every frame."""

    keyframes: int = Field(
        40, ge=5, le=200, description="Training frames on which focal length, shape and landmark bias are solved together."
    )
    reinit_every: int = Field(
        200, ge=10, description="Frames between re-initialisations (pose by PnP, expression neutral), as in the paper."
    )
    iterations: int = Field(6, ge=1, le=100, description="Gauss-Newton iterations a frame at most.")
    focal_px: float | None = Field(
        None, gt=0, description="Focal length in pixels of the source video where it is known; null estimates it from the clip."
    )


class TrimConfig(StepConfig):
    """trim: the matte without clothes below the neck."""

    neck_margin_m: float = Field(
        0.02, ge=0, le=0.1, description="How far (m) beside the mesh's neck skin is kept below the chin."
    )
