"""Typed config of the steps from tracked head to numbers, and the whole `config.yaml`. No torch.

A variant is a preset (`config/presets/NAME.yaml`) plus overrides of *avatar* keys; data preparation has its own keys, shared
by all variants, and no preset touches it.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from fitting import config as fitting
from fitting.config import StepConfig


class TrainConfig(StepConfig):
    """train: fit the avatar to the training frames."""

    representation: Literal["ours_d"] = Field("ours_d", description="Source of the vertex features; a module of `avatar/features/`.")
    steps: int = Field(2000, ge=1, description="Optimisation steps; every schedule point scales with it.")
    seed: int = Field(0, description="Seed of every random number in training.")


class RenderConfig(StepConfig):
    """render: the test frames."""

    max_frames: int | None = Field(None, ge=1, description="At most this many test frames, evenly spaced; null renders all.")


class EvaluateConfig(StepConfig):
    """evaluate: PSNR, SSIM and LPIPS of every rendered frame."""


class PlotConfig(StepConfig):
    """plot: curves and comparisons as SVG."""


class PageConfig(StepConfig):
    """page: one HTML page a subject and variant."""


class VariantConfig(StepConfig):
    """One avatar per subject: a preset and what differs from it."""

    preset: str = Field("demo", description="Name of a file in `config/presets/`.")
    train: dict = Field(default_factory=dict, description="Overrides of the preset's `train` keys.")
    render: dict = Field(default_factory=dict, description="Overrides of the preset's `render` keys.")


class Settings(BaseModel):
    """The whole of `config/config.yaml`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    videos: str = Field("videos", description="Folder of videos, one subject each; the file's stem is the subject's name.")
    device: str = Field("auto", description="Where training and rendering run: `cpu`, `cuda`, `cuda:N`, or `auto`.")
    assets: dict[str, str] = Field(default_factory=dict, description="Your own copies of assets by name (see `fitting.fetch`); the rest is fetched.")
    head: fitting.HeadConfig = fitting.HeadConfig()
    probe: fitting.ProbeConfig = fitting.ProbeConfig()
    extract: fitting.ExtractConfig = fitting.ExtractConfig()
    matte: fitting.MatteConfig = fitting.MatteConfig()
    detect: fitting.DetectConfig = fitting.DetectConfig()
    split: fitting.SplitConfig = fitting.SplitConfig()
    fit: fitting.FitConfig = fitting.FitConfig()
    trim: fitting.TrimConfig = fitting.TrimConfig()
    variants: dict[str, VariantConfig] = Field({"demo": VariantConfig()}, description="Avatars to train per subject, by name.")
    evaluate: EvaluateConfig = EvaluateConfig()
    plot: PlotConfig = PlotConfig()
    page: PageConfig = PageConfig()
