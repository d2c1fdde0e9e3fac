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


class FitConfig(StepConfig):
    """fit: camera and head parameters of every frame."""


class TrimConfig(StepConfig):
    """trim: the matte without clothes below the neck."""
