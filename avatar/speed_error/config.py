"""Typed config of `snakemake speed_error`: the first is part of `config.yaml`; the rules fill in the others. No torch."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from avatar.config import TrainConfig
from fitting.config import StepConfig


class SpeedErrorConfig(StepConfig):
    """`snakemake speed_error`."""

    subject: str | None = Field(None, description="Whose avatar is trained and timed; null takes the first one with a face.")


class TrainingConfig(StepConfig):
    """speed_training: one avatar, short."""

    train: TrainConfig = TrainConfig()


class RenderingConfig(StepConfig):
    """speed_rendering: test frames of one avatar by one way of sampling, with what they cost and how far they are off."""

    sampling: Literal["own", "dense", "dense_fine"] = Field(
        "own",
        description="How the avatar samples by itself; or uniformly on the whole ray, with the same weights; or so, and then as "
        "the paper's fine network does where these saw something.",
    )
    samples: int | None = Field(None, ge=1, le=1024, description="On a ray; null takes what `render` takes by default.")
    fine_samples: int = Field(0, ge=0, le=1024, description="dense_fine: samples that are added.")
    end: float | None = Field(None, ge=0, lt=1, description="Light behind which a ray ends; null is the default.")
    size: int = Field(512, ge=32, le=2048, description="Longer side of the frames in pixels; never upscaled.")
    frames: int = Field(4, ge=1, description="At most this many test frames, evenly spaced.")


class CostConfig(StepConfig):
    """speed_cost: seconds and memory of one amount of work."""

    kind: Literal["frames", "pixels", "vertices"] = Field("frames", description="What grows.")
    amount: int = Field(100, ge=1, description="Training frames, longer side of the picture in pixels, or vertices of the head.")
    steps: int = Field(30, ge=2, description="Training steps that are timed.")
    pictures: int = Field(3, ge=1, description="Pictures that are timed.")
    size: int = Field(256, ge=32, le=2048, description="vertices: longer side of the pictures.")
    train: TrainConfig = TrainConfig()


class RowPlan(StepConfig):
    """A row of the table."""

    group: str = Field("", description="Of `settings.GROUPS`.")
    what: str = Field("", description="What sets it apart in its group.")
    cell: str = Field("", description="The rendering behind it; rows that are the same rendering name the same one.")
    training: str = Field("", description="The training behind it.")
    of_steps: int | None = Field(None, description="Steps of the preset, where the training took fewer.")


class SpeedTableConfig(StepConfig):
    """speed_error: tables and plot."""

    rows: dict[str, RowPlan] = Field(default_factory=dict, description="Rows by name, in the order of the table.")
    left_out: dict[str, str] = Field(default_factory=dict, description="What was not run, and why.")
