"""Typed config of comparisons with published renders. No torch."""

from __future__ import annotations

import re
from typing import Literal, Self

from pydantic import Field, model_validator

from avatar.config import RenderConfig
from fitting.config import StepConfig


class PanelsConfig(StepConfig):
    """Panels of a comparison video."""

    panels: tuple[str, ...] = Field(min_length=2, description="Names of the video's equal panels, left to right.")
    driving: str = Field("driving", description="Which of the panels shows the filmed person.")

    @model_validator(mode="after")
    def _panels_are_told_apart(self) -> Self:
        for name in self.panels:
            if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
                raise ValueError(f"panel {name!r} must be of letters, digits, _ and -, for it becomes a folder's name")
        if len({name.lower() for name in self.panels}) < len(self.panels):
            raise ValueError(f"panels {', '.join(self.panels)} are not told apart by their names")
        if self.driving not in self.panels:
            raise ValueError(f"driving is {self.driving}, but the panels are {', '.join(self.panels)}")
        return self


class ComparisonConfig(PanelsConfig):
    """comparisons: a comparison video of published methods, and which of its frames test. One entry a video."""

    video: str = Field(description="The comparison video.")
    test_frames: int = Field(150, ge=1, description="Exactly this many last frames test; all before them may train.")
    stride: int = Field(5, ge=1, description="Every so many-th test frame is rendered and scored.")


class PublishedPanelConfig(PanelsConfig):
    """published_panel: the driving panel as a video. The rule fills this in, as in those below; no part of `config.yaml`."""

    test_frames: int = Field(ge=1, description="As in ComparisonConfig.")
    max_frames: int = Field(ge=1, description="As in ExtractConfig: the panel must not be longer.")


class PublishedRenderConfig(RenderConfig):
    """published_render: test frames of an avatar in the panel's pixels."""

    stride: int = Field(5, ge=1, description="As in ComparisonConfig.")


class PublishedPlaceConfig(StepConfig):
    """published_place: test frames of a predictor in the panel's pixels."""

    stride: int = Field(5, ge=1, description="As in ComparisonConfig.")


class PublishedScoreConfig(PanelsConfig):
    """published_score: one method on the test frames, a panel of the video or a folder of pictures."""

    stride: int = Field(5, ge=1, description="As in ComparisonConfig.")
    method: str = Field(description="A panel, a variant or a predictor.")
    kind: Literal["published", "avatar", "predictor"] = Field(description="Which of these the method is.")


class PublishedTableConfig(StepConfig):
    """published_table: the table of one comparison. Nothing to set."""


class PublishedStripConfig(PanelsConfig):
    """published_strip: a few test frames of all methods beside each other."""

    variants: tuple[str, ...] = Field((), description="Avatars in order; their folders come in the same order.")
