"""When `snakemake speed_error` runs what."""

from __future__ import annotations

import json
from pathlib import Path

from made_speed_error import PRESETS
from pipeline import Pipeline

from avatar.speed_error import settings
from avatar.speed_error.config import RenderingConfig


def test_runs_when_asked_for_and_is_then_done(tmp_path: Path) -> None:
    pipeline = Pipeline.create(tmp_path / "run", ("ann", "bob"))
    assert not [line for line in pipeline.plan() if "speed_" in line]
    pipeline.set_fate(ann="reject")
    result = pipeline.run("speed_error")
    assert result.code == 0, result.text
    ran = pipeline.ran()
    wanted = {"training": settings.trainings, "rendering": settings.cells, "cost": settings.costs}
    assert {name: ran.count(f"avatar.speed_error.{name} bob") for name in wanted} == {
        name: len(made(PRESETS)) for name, made in wanted.items()
    }
    assert pipeline.plan("speed_error") == set() and not [line for line in ran if line.startswith("avatar.train")]

    def made(path: str) -> list[str]:
        return json.loads((pipeline.folder / "results/speed_error/bob" / path).read_text())

    row = made("rows/uv_128.json")
    assert "avatar=results/speed_error/bob/trainings/uv_128/avatar.pt" in row
    assert RenderingConfig.model_validate_json(row[row.index("--config") + 1]) == settings.cells(PRESETS)["uv_128"].config
    words = made("trainings/layers/train.json")
    assert [word for word in words if word.startswith("vgg=")]
    assert json.loads(words[words.index("--config") + 1])["train"]["representation"] == "layers"
    (pipeline.folder / "results/speed_error/bob/rows/shell_8.json").unlink()  # as after an interruption
    pipeline.append("avatar/features/ours_c.py", "\nEDITED = True\n")
    pipeline.forget()
    assert pipeline.run("speed_error").code == 0
    again = ["speed_error.rendering bob", "speed_error.rendering bob", "speed_error.table bob", "speed_error.training bob"]
    assert sorted(pipeline.ran()) == [f"avatar.{line}" for line in again]
