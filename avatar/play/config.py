"""Typed settings of `play`, and of the messages that its page sends. No torch."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from fitting.config import StepConfig

Source = Literal["sliders", "clip", "file", "video", "camera"]
"""What moves the head, besides the sliders: nothing, the subject's own track, a parameter file, a video, a webcam."""
SMALLEST_PX, LARGEST_PX = 48, 2048
STRONGEST = 2.0
"""Factor of the expression that the page offers (paper, section 4.5)."""


class PlayConfig(StepConfig):
    """play: the avatar live on a local page (a command, not a step: it ends with Ctrl-C)."""

    port: int = Field(0, ge=0, le=65535, description="Port on 127.0.0.1; 0 takes a free one.")
    size: int | None = Field(
        None,
        ge=SMALLEST_PX,
        le=LARGEST_PX,
        description="Longer side of the picture in pixels, never larger than the frames; "
        "None: 512, and 96 for a field avatar, which is slow.",
    )
    threads: int = Field(2, ge=1, le=64, description="Threads that draw.")
    browser: bool = Field(True, description="Open the page in the browser.")
    file: str | None = Field(None, description="Parameter file (CSV or NPZ) that the page offers.")
    video: str | None = Field(None, description="Video file that the page offers as a driver.")
    jpeg_quality: int = Field(90, ge=10, le=100, description="Quality of the pictures that the page gets.")


class Change(BaseModel):
    """What the page may ask for; what is left out stays as it is."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    source: Source | None = None
    playing: bool | None = None
    smooth: bool | None = None
    size: int | None = Field(None, ge=SMALLEST_PX, le=LARGEST_PX)
    strength: float | None = Field(None, ge=0, le=STRONGEST, allow_inf_nan=False)
    place: int | None = Field(None, ge=0)
    """Frame of the clip or file to go to."""
    sliders: dict[str, float] | None = Field(None, max_length=1000)
    """By name (see `avatar.play.sliders`); finite and inside their ranges."""
    reset: bool = False
    """All sliders and the strength back to where they were, before the rest of this message."""
    neutral: bool = False
    """The driver's present face and pose become its neutral ones."""
    calibrate: bool = False
    """Forget the driver: another person sits down."""
