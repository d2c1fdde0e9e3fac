"""Typed config of the steps that make tables, plots and pages. No torch."""

from __future__ import annotations

from pydantic import Field

from fitting.config import StepConfig


class TabulateConfig(StepConfig):
    """tabulate: the table of every subject and variant. The rule fills this in; it is no part of `config.yaml`."""

    subjects: tuple[str, ...] = Field((), description="Subjects that must have a row; those without files are rows as well.")
    variants: tuple[str, ...] = Field((), description="Variants that must have a column, in order; others found follow.")


class PlotConfig(StepConfig):
    """plot: curves and comparisons as SVG."""


class CompareConfig(StepConfig):
    """compare: the table and the plot of the tracking benchmark. Nothing to set; it is no part of `config.yaml`."""


class PageConfig(StepConfig):
    """page: one HTML page a subject."""


class IndexConfig(StepConfig):
    """index_page: the page over all subjects. Nothing to set; it is no part of `config.yaml`, nor is the next."""


class UsesConfig(StepConfig):
    """uses_page: the page of what an avatar was used for. Nothing to set."""
