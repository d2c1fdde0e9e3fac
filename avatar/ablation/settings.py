"""What the ablation compares, on which clips and at what budget. No torch: the workflow plans with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from avatar.ablation.config import AblationConfig, AblationDataConfig
from avatar.config import TrainConfig
from fitting.benchmark_settings import PREFIX
from fitting.config import SimulateConfig, TrimConfig

SUBJECT = PREFIX + "talk_0_360_bald"
"""The simulated one, tracked by the pipeline's own rules: 270 training frames, wrinkles, true pictures of doubled codes."""
SEEDS = (0, 1, 2)
"""Of the training, on the simulated subject; real ones have the first alone."""
SIZE_PX, TEST_FRAMES, FACTOR = 128, 24, 2.0
TRAIN = TrainConfig(
    steps=2000, rays=256, frames_per_step=1, feature_channels=64, uv_size=64, static_features=False, mlp_width=64,
    colour_width=32, sample_step_m=0.004, max_samples=8,
)  # fmt: skip
"""The same for every cell but for the source of the features. Small: one core has 2,000 steps in two to six minutes."""
SAMPLE_FACTOR = 2.0


@dataclass(frozen=True)
class Cell:
    """One column of the table."""

    representation: str
    what: str
    """One phrase for the table."""
    group: str = "full"
    """`full`, `table`, `half` (the first half of the training frames), `warp`, `true`, or `overfit` (four frames, the truth)."""

    @property
    def simulated_only(self) -> bool:
        """Whether real subjects have no such cell: nobody knows their true parameters, and the warp is asked of one subject."""
        return self.group in ("warp", "true", "overfit")


SOURCES = {
    "static": "Static features",
    "codes": "3DMM Codes",
    "codes_mlp": "3DMM Codes MLP",
    "ours_c": "Ours-C",
    "ours_d": "Ours-D",
    "displacement_mlp": "Displacement MLP",
}
"""Features on full data in the paper's order and words; the last one is a control that the authors drafted."""
TABLE = "_table"
"""Ending of the cells in which a learned constant of each vertex is added to what the source makes of the frame."""
HALVED = ("ours_c", "ours_d", "ours_c_table", "ours_d_table")
CELLS = {
    **{name: Cell(name, what) for name, what in SOURCES.items()},
    **{
        name + TABLE: Cell(name, f"{what} on a learned constant", "table")
        for name, what in SOURCES.items()
        if name not in ("static", "codes")  # they are, or have, that constant
    },
}
CELLS |= {
    **{f"{name}_half": Cell(CELLS[name].representation, f"{CELLS[name].what}, first half", "half") for name in HALVED},
    "ours_d_table_warp": Cell("ours_d", "Ours-D on a learned constant, error-correction warp in training", "warp"),
    "ours_d_table_true": Cell("ours_d", "Ours-D on a learned constant, true head and parameters", "true"),
    "ours_d_table_overfit": Cell("ours_d", "the same on four frames, scored on these", "overfit"),
}
OVERFIT_KEYS = {
    "steps": 1500,
    "rays": 1024,
    "frames_per_step": 2,
    "mlp_width": 128,
    "colour_width": 64,
    "sample_step_m": 0.002,
    "max_samples": 12,
}
"""Keys of the cell that shows what the full-size field can hold, all but `steps` as in the preset `demo`. 2,000 steps gave 41.0
dB inside the head in eleven minutes; 1,500 stay under ten."""


def cell_of(source: str, table: bool) -> str:
    """The cell of a source on all frames, with a learned constant or without; `static` and `codes` are the same in both."""
    return source + TABLE if table and source + TABLE in CELLS else source


def data_config(trim: TrimConfig, simulated: str | None) -> AblationDataConfig:
    """The config of a subject's data. simulated: config of the simulated clip as JSON."""
    made = SimulateConfig.model_validate_json(simulated) if simulated else None
    return AblationDataConfig(size=SIZE_PX, test_frames=TEST_FRAMES, factor=FACTOR, trim=trim, simulate=made)


def config_of(cell: str, seed: int) -> AblationConfig:
    """The config of one cell."""
    keys = {"representation": CELLS[cell].representation, "seed": seed, "warp": CELLS[cell].group == "warp"}
    keys |= {"static_features": TABLE in cell} | (OVERFIT_KEYS if CELLS[cell].group == "overfit" else {})
    return AblationConfig(train=TRAIN.model_copy(update=keys), sample_factor=SAMPLE_FACTOR, factor=FACTOR)


def seeds_of(cell: str) -> tuple[int, ...]:
    """The seeds of a cell on the simulated subject: all for the claims on a learned constant, the first for the rest.

    `static` and `codes` are part of those claims: they are, or have, the constant.
    """
    first_alone = CELLS[cell].simulated_only or (TABLE not in cell and cell not in ("static", "codes"))
    return SEEDS[:1] if first_alone else SEEDS


def planned(real: Sequence[str]) -> list[tuple[str, str, int]]:
    """Subject, cell and seed of every row: the first seed's first. real: subjects of the user's own, with all seeds' cells."""
    rows = [(SUBJECT, cell, seed) for seed in SEEDS for cell in CELLS if seed in seeds_of(cell)]
    own = [cell for cell, kind in CELLS.items() if not kind.simulated_only and seeds_of(cell) == SEEDS]
    return rows + [(subject, cell, SEEDS[0]) for subject in real for cell in own]
