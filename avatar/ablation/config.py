"""Typed config of the ablation's steps; none of it is part of `config.yaml`. No torch."""

from __future__ import annotations

from pydantic import Field

from avatar.config import TrainConfig
from fitting import config as fitting
from fitting.config import StepConfig


class AblationDataConfig(StepConfig):
    """ablation_data, ablation_truth: small frames to compare feature sources on. The rule fills this in, as in the next two."""

    size: int = Field(128, ge=32, le=2048, description="Longer side of the frames in pixels.")
    test_frames: int = Field(24, ge=1, description="At most this many test frames, evenly spaced.")
    factor: float = Field(2.0, gt=0, description="By what the codes of the second set of test frames are multiplied.")
    trim: fitting.TrimConfig = fitting.TrimConfig()
    simulate: fitting.SimulateConfig | None = Field(None, description="What a simulated clip was made from.")


class AblationConfig(StepConfig):
    """ablation: one cell, that is one training with its scores."""

    train: TrainConfig = TrainConfig()
    sample_factor: float = Field(2.0, ge=0.25, le=16, description="Samples on a ray of the render, as in `render`.")
    factor: float = Field(2.0, gt=0, description="As in AblationDataConfig.")


class AblationTableConfig(StepConfig):
    """ablation_table: the table and the plot of all cells."""
