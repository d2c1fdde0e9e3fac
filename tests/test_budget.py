"""`train.budget`: how many steps fit, when training ends, and that an interrupted run goes on with what was planned."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from toy_run import SMALL, job, write_subject

from avatar import budget, train
from avatar.checkpoint import State
from avatar.config import TrainConfig
from avatar.report import page

CONFIG = TrainConfig(**SMALL | {"steps": 40, "budget": 1.0, "representation": "static", "rays": 64})


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_subject(tmp_path_factory.mktemp("subject"))


def outputs(folder: Path) -> dict[str, Path]:
    return {"avatar": folder / "avatar.pt", "curve": folder / "curve.tsv", "report": folder / "train.json"}


@pytest.mark.parametrize("wrong", [0, -1.0, 20000, "much", "0", [8], True, float("nan"), float("inf")])
def test_a_budget_is_minutes_or_auto(wrong: object) -> None:
    assert (
        TrainConfig(budget="auto").budget == "auto"
        and TrainConfig(budget=8).budget == TrainConfig(budget="8").budget == 8.0
        and TrainConfig().budget is None
    )
    assert budget.minutes_of("auto") == budget.AUTO_MINUTES and budget.minutes_of(8) == 8.0
    with pytest.raises(ValueError, match="give minutes, above 0"):
        TrainConfig(budget=wrong)


@pytest.mark.parametrize(("seconds", "step_s", "count"), [(480, 0.25, 1900), (100, 1, 100), (10, 3, 3), (1, 9, 1), (-5, 0, 1)])
def test_steps_have_two_digits(seconds: float, step_s: float, count: int) -> None:
    assert budget.steps_in(seconds, step_s) == count


def curve(values: list[float], every: int = 50) -> list[list[float]]:
    return [[every * (n + 1), 1.0 * n, 0.1, value] for n, value in enumerate(values)]


def test_training_ends_on_a_plateau_alone() -> None:
    rising, flat = [20 + n * 0.2 for n in range(20)], [20 + n for n in range(6)] + [25.0] * 14
    assert not budget.plateau(curve(rising), 1000) and budget.plateau(curve(flat), 1000)
    assert not budget.plateau(curve(flat[:9]), 1000), "before half of the steps that fit"
    noisy = [20 + n * 0.05 + 0.3 * (-1) ** n for n in range(20)]
    assert not budget.plateau(curve(noisy), 1000) and budget.plateau(curve(noisy[:10] + noisy[:10][::-1]), 1000)
    assert not budget.plateau([], 1000) and not budget.plateau(curve([25.0, 25.0]), 100)


def test_a_thinner_shell_misses_more(inputs: dict[str, Path], tmp_path: Path) -> None:
    data = train.load(job(CONFIG, inputs, outputs(tmp_path)))
    thick, thin = (budget.missed_share(data, np.full(data.head.vertex_count, reach)) for reach in (0.03, 0.001))
    assert 0 <= thick < thin <= 1
    found = budget.shell_found(data)
    assert "mm, median" in found["taken"] and found["missed"]["measured"] <= found["missed"]["base"] + 1e-9


def test_steps_are_counted_again_when_later_ones_take_longer(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock of its own: a step takes 1 s, from the 19th on 2 s. By the first ones 60 fit into a minute, 39 do."""
    now = [0.0]
    original = train.optimise

    def slow(learner: object, state: State) -> float:
        now[0] += 1.0 if state.step < 18 else 2.0
        return original(learner, state)

    monkeypatch.setattr(train.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(train, "optimise", slow)
    monkeypatch.setattr(budget, "TIMED_SHARE", 1.0)
    train.run(job(CONFIG, inputs, outputs(tmp_path)))
    report = json.loads(outputs(tmp_path)["report"].read_text())
    rows = {row["decision"]: row for row in report["budget"]["decisions"]}
    assert list(rows) == ["shell from mattes", "steps", "steps again"]
    assert all(row["reason"] for row in rows.values())
    assert rows["steps"]["taken"] == 60 and rows["steps"]["step_s"] == 1.0
    assert rows["steps again"]["step_s"] == 2.0 and report["steps"] == rows["steps again"]["taken"] == 39
    assert 55 <= now[0] <= 65


def test_auto_ends_on_a_plateau_and_stays_ended(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "steps_in", lambda seconds, step_s: 40)
    monkeypatch.setattr(train.learning, "probe_psnr", lambda learner, data: 25.0)
    auto, calls, original = CONFIG.model_copy(update={"budget": "auto"}), [], train.optimise

    def counted(learner: object, state: State) -> float:
        calls.append(state.step)
        return original(learner, state)

    monkeypatch.setattr(train, "optimise", counted)
    train.run(job(auto, inputs, outputs(tmp_path)))
    first = json.loads(outputs(tmp_path)["report"].read_text())
    end = first["budget"]["decisions"][-1]
    assert end["decision"] == "end" and end["taken"] == first["steps"] == len(calls) < 56
    train.run(job(auto, inputs, outputs(tmp_path)))
    second = json.loads(outputs(tmp_path)["report"].read_text())
    assert len(calls) == first["steps"] and second["budget"] == first["budget"] and second["steps"] == first["steps"]


def test_training_within_a_budget_goes_on_after_a_kill(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(budget, "steps_in", lambda seconds, step_s: 60)
    original, calls = train.optimise, []

    def killed(learner: object, state: State) -> float:
        calls.append(state.step)
        if len(calls) == 25:
            os.kill(os.getpid(), signal.SIGINT)
        return original(learner, state)

    with monkeypatch.context() as patch:
        patch.setattr(train, "optimise", killed)
        with pytest.raises(KeyboardInterrupt):
            train.run(job(CONFIG, inputs, outputs(tmp_path)))
    monkeypatch.setattr(budget, "_first", None)  # not planned anew
    with caplog.at_level("INFO"):
        train.run(job(CONFIG, inputs, outputs(tmp_path)))
    assert "continuing at step 25" in caplog.text
    report = json.loads(outputs(tmp_path)["report"].read_text())
    rows = {row["decision"]: row["taken"] for row in report["budget"]["decisions"]}
    assert rows["steps"] == 16 + 60 and report["steps"] == rows["steps again"] == round(budget.LATE[1] * 76) + 60


def test_the_shortest_budget_takes_a_step(inputs: dict[str, Path], tmp_path: Path) -> None:
    train.run(job(CONFIG.model_copy(update={"budget": 1e-9}), inputs, outputs(tmp_path)))
    assert json.loads(outputs(tmp_path)["report"].read_text())["steps"] == 2


def test_steps_are_counted_again_after_a_hard_kill_at_that_place(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checkpoint at 40 % is written before they are counted: a run that dies between the two counts them all the same."""
    monkeypatch.setattr(budget, "steps_in", lambda seconds, step_s: 60)
    with monkeypatch.context() as patch:
        patch.setattr(budget, "answered", killed_at("steps again", budget.answered))
        with pytest.raises(MemoryError):
            train.run(job(CONFIG, inputs, outputs(tmp_path)))
    train.run(job(CONFIG, inputs, outputs(tmp_path)))
    rows = json.loads(outputs(tmp_path)["report"].read_text())["budget"]["decisions"]
    assert [row["decision"] for row in rows] == ["shell from mattes", "steps", "steps again"]


def killed_at(name: str, original: Callable[..., dict]) -> Callable[..., dict]:
    """`answered`, but for one decision."""

    def answered(decision: str, *rest: object, **more: object) -> dict:
        if decision == name:
            raise MemoryError
        return original(decision, *rest, **more)

    return answered


def test_the_page_tells_what_was_decided() -> None:
    rows = [budget.answered("steps", 1900, "0.250 s each", step_s=0.25), budget.answered("end", 1500, "no longer better")]
    told = [("steps", "1900: 0.250 s each"), ("end", "1500: no longer better")]
    assert page.decisions_of({"budget": {"decisions": rows}}) == told and page.decisions_of({"steps": 3}) == []


def test_without_a_budget_nothing_is_decided(inputs: dict[str, Path], tmp_path: Path) -> None:
    train.run(job(CONFIG.model_copy(update={"budget": None, "steps": 3}), inputs, outputs(tmp_path)))
    report = json.loads(outputs(tmp_path)["report"].read_text())
    assert report["steps"] == 3 and "budget" not in report
