"""Typed config of the steps from tracked head to scores. No torch.

A variant is a preset (`config/presets/NAME.yaml`) plus overrides of *avatar* keys; data preparation has its own keys, shared
by all variants, and no preset touches it.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from fitting.config import StepConfig


def modules_of(representation: str, training: bool = False) -> tuple[str, ...]:
    """Dotted names of the modules that make an avatar of a representation and, with `training`, of the one that trains it."""
    made = f"avatar.features.{representation}"
    return (made, f"avatar.learning.{'images' if representation == 'layers' else 'rays'}") if training else (made,)


class TrainConfig(StepConfig):
    """train: fit the avatar to the training frames."""

    representation: Literal["ours_d", "ours_c", "displacement_mlp", "codes_mlp", "codes", "static", "layers"] = Field(
        "ours_d",
        description="Source of the vertex features of the paper's field, or `layers` for the stack of textured surfaces: a "
        "module of `avatar/features/`.",
    )
    sampling: Literal["shell", "hierarchical"] = Field(
        "shell", description="One network in a shell around the mesh, or the paper's coarse and fine ones on the whole ray."
    )
    steps: int = Field(2000, ge=1, description="Optimisation steps; the points of the paper's schedule scale with it.")
    budget: Literal["auto"] | float | None = Field(
        None,
        description="Minutes of training in the place of `steps`, above 0 and at most 10000; `auto`: until held-out frames no "
        "longer get better, 30 at most. null: as many steps as `steps` says.",
    )
    seed: int = Field(0, description="Seed of every random number in training.")
    rays: int = Field(1024, ge=1, le=65536, description="Rays a step, over all its frames.")
    frames_per_step: int = Field(2, ge=1, le=64, description="Frames from which a step draws its rays.")
    learning_rate: float = Field(1e-3, gt=0, le=0.1, description="Adam's rate at the start; it decays to a tenth.")
    opacity_weight: float = Field(0.1, ge=0, le=10, description="Weight of opacity's squared error against the matte.")
    feature_channels: int = Field(64, ge=4, le=256, description="Values per vertex that the U-Net predicts.")
    uv_size: int = Field(64, ge=64, le=512, multiple_of=64, description="Side of the UV maps in texels.")
    static_features: bool = Field(False, description="Add a learned constant to each vertex's predicted features.")
    mlp_width: int = Field(128, ge=16, le=512, description="Width of the MLPs before and after the sum over neighbours.")
    mlp_depth: int = Field(3, ge=1, le=8, description="Layers of each of these two MLPs.")
    colour_width: int = Field(64, ge=8, le=256, description="Width of the colour MLP.")
    neighbours: int = Field(4, ge=1, le=16, description="Vertices that a point reads.")
    bands: int = Field(10, ge=0, le=12, description="Octaves of the positional encoding of offsets to vertices.")
    view_bands: int = Field(4, ge=0, le=8, description="Octaves of the encoding of view directions.")
    # Closed lips of nerface.mp4: see README, "Neighbours".
    neighbourhood: Literal["surface", "free"] = Field(
        "surface",
        description="Which nearest vertices a point reads: those of one piece of surface (never both lips), or any.",
    )
    warp: bool = Field(False, description="Train with the error-correction warp of the paper's supplement A; off at test.")
    sample_step_m: float = Field(
        0.002, gt=0, le=0.05, description="Length of shell in metres that one sample of a ray stands for."
    )
    max_samples: int = Field(
        12, ge=1, le=512, description="Samples on a ray at most; a longer way through the shell takes longer steps."
    )
    # The paper's commented-out notes: "256 coarse 128 fine", read as samples.
    coarse_samples: int = Field(256, ge=2, le=1024, description="Hierarchical: uniform samples on a ray, for the first network.")
    fine_samples: int = Field(
        128, ge=1, le=1024, description="Hierarchical: samples added where the first network saw something, for the second."
    )
    layers: int = Field(8, ge=3, le=16, description="Layers: surfaces, the inner parts' included.")
    bases: int = Field(3, ge=0, le=8, description="Layers: textures that the network mixes into the static one.")
    texture_size: int = Field(512, ge=64, le=2048, description="Layers: texels a side of each surface's texture.")

    @field_validator("budget", mode="before")
    @classmethod
    def _minutes(cls, budget: object) -> object:
        if budget in (None, "auto"):
            return budget
        try:  # a command line gives text
            minutes = float("nan") if isinstance(budget, bool) else float(budget)
        except (TypeError, ValueError):
            minutes = float("nan")
        if not 0 < minutes <= 10000:
            raise ValueError("give minutes, above 0 and at most 10000, or auto")
        return minutes


class RenderConfig(StepConfig):
    """render: the test frames."""

    max_frames: int | None = Field(None, ge=1, description="At most this many test frames, evenly spaced; null renders all.")
    # nerface.mp4, two test frames of 512 px, one demo avatar (LPIPS, PSNR): x2 0.139, 27.64; x3 0.124, 27.72; x6 0.122, 27.73.
    sample_factor: float = Field(3.0, ge=0.25, le=16, description="Samples on a ray, as a multiple of what training takes.")


class BaselineConfig(StepConfig):
    """baseline: a trivial predictor that stands beside every avatar."""

    predictor: Literal["mean_frame", "nearest_frame"] = Field(
        "mean_frame", description="The mean training frame, or the training frame nearest in expression and pose."
    )
    max_frames: int | None = Field(None, ge=1, description="At most this many test frames, evenly spaced; null takes all.")


class EvaluateConfig(StepConfig):
    """evaluate: PSNR, SSIM, L1 and LPIPS of every rendered frame: whole head, face, mouth and eyes."""

    # VGG16 on 512 px frames: 8 s a frame on one core, AlexNet 0.3 s.
    lpips: tuple[Literal["alexnet", "vgg16"], ...] = Field(
        ("alexnet",),
        min_length=1,
        max_length=2,
        description="Networks of LPIPS; `alexnet` must be among them. `vgg16` adds `lpips_vgg`, in 25 times the time.",
    )

    @field_validator("lpips")
    @classmethod
    def _one_of_each(cls, networks: tuple[str, ...]) -> tuple[str, ...]:
        if "alexnet" not in networks or len(set(networks)) < len(networks):
            raise ValueError("name alexnet, which every table shows, and each network once: [alexnet] or [alexnet, vgg16]")
        return networks
