"""Typed config of the steps from video to tracked head: one pydantic model a step, no torch, nothing imported of the project.

`config/README.md` and `workflow/schemas/config.schema.json` are generated from the field descriptions here.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator


class StepConfig(BaseModel):
    """Base of every step's config: unknown keys are errors, values are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class FetchConfig(StepConfig):
    """fetch: one asset into `resources/`, verified by sha256."""

    path: str | None = Field(None, description="Your own copy of the file; null fetches it.")


class HeadConfig(StepConfig):
    """head: bake the head model into one file."""

    model: Literal["anny", "flame"] = Field("anny", description="Head model: `anny`, which is open, or `flame`, your own file.")
    shape_components: int | None = Field(
        None, ge=10, le=300, description="Components of identity that are kept; null: 80 of anny, 100 of flame."
    )
    samples: int = Field(600, ge=100, le=5000, description="anny: random heads from which the identity space is computed.")
    renders: int = Field(
        800, ge=50, le=10000, description="Random heads that are rendered to learn how the detector's landmarks slide over them."
    )
    path: str | None = Field(
        None,
        validate_default=True,
        description="flame: your file of FLAME 2020, 2023 or 2023 Open (`.pkl` or `.npz`), from https://flame.is.tue.mpg.de.",
    )
    expression_components: int = Field(50, ge=10, le=100, description="flame: components of expression that are kept.")
    jaw: bool | None = Field(
        None, description="flame: whether the jaw moves by its joint; null: yes, but not for a file with `no_jaw` in its name."
    )
    mouth_cavity: bool = Field(False, description="flame: add a mouth cavity between the lips and a line behind them.")
    uv: str | None = Field(None, description="flame: your head_template_mesh.obj for its texture layout; null makes one.")
    masks: str | None = Field(None, description="flame: your FLAME_masks.pkl for the regions; null finds them by geometry.")
    landmark_embedding: str | None = Field(
        None, description="flame: your mediapipe_landmark_embedding.npz; landmarks that are not in it are placed by detection."
    )

    @field_validator("path", "uv", "masks", "landmark_embedding")
    @classmethod
    def _belongs_to_flame(cls, value: str | None, info: ValidationInfo) -> str | None:
        if info.data.get("model") == "flame" and info.field_name == "path" and not value:
            raise ValueError("FLAME is not shipped: get it at https://flame.is.tue.mpg.de (registration) and name your file here")
        if info.data.get("model") == "anny" and value:
            raise ValueError("this is read for head.model=flame only; set that too, or leave it out")
        return value

    @model_validator(mode="after")
    def _anny_has_fewer(self) -> HeadConfig:
        if self.model == "anny" and self.shape_components and 2 * self.shape_components > self.samples:
            raise ValueError("samples must be at least twice shape_components")
        return self


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


class TermWeights(StepConfig):
    """How much each term of the fit counts; 1 is the tuned value, 0 leaves the term out."""

    landmarks: float = Field(1.0, gt=0, le=100, description="Detected landmarks, brows, nose, lips and outline.")
    irises: float = Field(1.0, ge=0, le=100, description="Iris centres among the landmarks: the gaze.")
    eyelids: float = Field(1.0, ge=0, le=100, description="Gap between the lids: blinks.")
    photometric: float = Field(1.0, ge=0, le=100, description="Skin keeps its colour from frame to frame: lids, brows, wrinkles.")
    silhouette: float = Field(1.0, ge=0, le=100, description="Skull, ears and jaw against the edge of the matte.")
    priors: float = Field(1.0, ge=0, le=100, description="Expression near the detector's own scores.")
    temporal: float = Field(1.0, ge=0, le=100, description="Accelerations: closes the seams between blocks, calms jitter.")


class FitConfig(StepConfig):
    """fit: camera and head parameters of every frame."""

    keyframes: int = Field(
        40, ge=5, le=200, description="Training frames on which focal length, shape and landmark bias are solved together."
    )
    reinit_every: int = Field(
        200, ge=10, description="Frames between re-initialisations (pose by PnP, expression neutral), as in the paper."
    )
    solver: Literal["gauss_newton", "adam"] = Field(
        "gauss_newton", description="`adam` is Neural Head Avatars' recipe, to compare with: same terms, many more steps."
    )
    iterations: int = Field(4, ge=1, le=100, description="Gauss-Newton iterations a frame at most.")
    adam_steps: int = Field(50, ge=1, le=5000, description="Steps a frame of `solver: adam`.")
    weights: TermWeights = Field(TermWeights(), description="Weight of each term.")
    focal_px: float | None = Field(
        None, gt=0, description="Focal length in pixels of the source video where it is known; null estimates it from the clip."
    )


class TrimConfig(StepConfig):
    """trim: the matte without clothes below the neck."""

    neck_margin_m: float = Field(
        0.02, ge=0, le=0.1, description="How far (m) beside the mesh's neck skin is kept below the chin."
    )


class ExportConfig(StepConfig):
    """export: the track in formats that other FLAME programs open (made when asked for: `snakemake export_all`)."""

    pictures: Literal["all", "train", "test"] = Field(
        "all", description="Frames whose pictures and masks the folder for GaussianAvatars holds: of both splits or of one."
    )


class SimulationConfig(StepConfig):
    """simulate: selfie videos with a known head, camera and light, to measure a fit against (made when asked for)."""

    frames: int = Field(300, ge=1, le=5000, description="Frames of the video.")
    fps: float = Field(30.0, gt=0, le=240, description="Frames a second.")
    height: int = Field(512, ge=64, le=2160, multiple_of=2, description="Height of the video in pixels.")
    width: int = Field(512, ge=64, le=2160, multiple_of=2, description="Width of the video in pixels.")
    focal_px: float | None = Field(None, gt=0, description="Focal length in pixels; null is 1.3 x the longer side.")
    k1: float = Field(0.0, ge=-0.3, le=0.3, description="Radial distortion of the lens, on the normalised image plane.")
    distance_m: float = Field(0.5, ge=0.25, le=3, description="Mean distance of the head from the camera (m).")
    hair: Literal["bald", "short", "full"] = Field("bald", description="Hair; `full` stands off the skull by 1.5 cm.")
    exposure_stops: float = Field(0.0, ge=0, le=2, description="Drift of the exposure, in stops either way.")
    noise: float = Field(0.006, ge=0, le=0.1, description="Standard deviation of the sensor noise, part of full scale.")
    displacement_mm: float = Field(0.7, ge=0, le=5, description="Rms displacement (mm) of the skin that no identity basis holds.")
    bump_mm: float = Field(1.5, ge=0, le=5, description="Height (mm) of expression bumps that no expression basis holds.")


class SimulateConfig(SimulationConfig):
    """simulate: as above, with what the name of the video says: `{kind}_{seed}.mp4`."""

    kind: Literal["still", "slow", "fast", "jump", "profile", "blink", "talk"] = Field("slow", description="How the head moves.")
    seed: int = Field(0, ge=0, description="Who it is, and every other random choice.")


class BenchmarkConfig(StepConfig):
    """benchmark: one fit of one clip, timed and compared. The rule fills this in; it is no part of `config.yaml`."""

    fit: FitConfig = Field(FitConfig(), description="The fit.")
    frames: int | None = Field(None, ge=8, description="At most this many frames, about the split; null takes all.")
    simulated: bool = Field(False, description="Whether the clip is a simulated one.")
