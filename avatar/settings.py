"""The whole of `config/config.yaml` as one typed model. No torch."""

from __future__ import annotations

import re

from pydantic import BaseModel, ConfigDict, Field, field_validator

from avatar.config import EvaluateConfig
from avatar.published.config import ComparisonConfig
from avatar.report.config import PageConfig, PlotConfig
from avatar.speed_error.config import SpeedErrorConfig
from avatar.uses.config import (
    AnimateConfig,
    DriveConfig,
    DriverConfig,
    ExtrapolateConfig,
    FlickerConfig,
    OrbitConfig,
    SheetConfig,
)
from fitting import config as fitting
from fitting.config import StepConfig


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
    assets: dict[str, str] = Field(
        default_factory=dict, description="Your own copies of assets by name (see `fitting.fetch`); the rest is fetched."
    )
    head: fitting.HeadConfig = fitting.HeadConfig()
    probe: fitting.ProbeConfig = fitting.ProbeConfig()
    extract: fitting.ExtractConfig = fitting.ExtractConfig()
    matte: fitting.MatteConfig = fitting.MatteConfig()
    detect: fitting.DetectConfig = fitting.DetectConfig()
    split: fitting.SplitConfig = fitting.SplitConfig()
    fit: fitting.FitConfig = fitting.FitConfig()
    trim: fitting.TrimConfig = fitting.TrimConfig()
    export: fitting.ExportConfig = fitting.ExportConfig()
    simulate: fitting.SimulationConfig = fitting.SimulationConfig()
    variants: dict[str, VariantConfig] = Field({"demo": VariantConfig()}, description="Avatars to train per subject, by name.")
    comparisons: dict[str, ComparisonConfig] = Field(
        default_factory=dict,
        description="Comparison videos of published methods by name (see `snakemake compare_published`).",
    )
    orbit: OrbitConfig = OrbitConfig()
    extrapolate: ExtrapolateConfig = ExtrapolateConfig()
    sheet: SheetConfig = SheetConfig()
    animate: dict[str, AnimateConfig] = Field(default_factory=dict, description="Files that drive every avatar, by name.")
    evaluate: EvaluateConfig = EvaluateConfig()
    flicker: FlickerConfig = FlickerConfig()
    drive: DriveConfig = DriveConfig()
    drivers: dict[str, DriverConfig] = Field(default_factory=dict, description="Driving videos by name, for `snakemake drive`.")
    speed_error: SpeedErrorConfig = SpeedErrorConfig()
    plot: PlotConfig = PlotConfig()
    page: PageConfig = PageConfig()

    @field_validator("comparisons", "animate")
    @classmethod
    def _names_of_folders(cls, value: dict[str, StepConfig]) -> dict[str, StepConfig]:
        for name in value:
            if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
                raise ValueError(f"{name!r} must be of letters, digits, _ and -, for it becomes a folder's name")
        return value
