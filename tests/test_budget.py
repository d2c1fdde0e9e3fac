"""`train.budget`: questions, answers, and trials that leave no trace when the alternative is not taken."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_run import SMALL, job, write_subject

from avatar import build, train
from avatar.budget import decide, questions, trials
from avatar.budget.questions import Question
from avatar.checkpoint import State
from avatar.config import TrainConfig
from avatar.learning import rays
from avatar.operations import operations
from fitting.head_model import HeadModel

CONFIG = TrainConfig(**SMALL | {"steps": 40, "budget": 1.0, "representation": "static", "rays": 64})
MAPPED = CONFIG.model_copy(update={"representation": "ours_d"})
ALL = questions.asked(MAPPED, 500)[0]
TIMES = ("seconds", "reason", "step_s", "step_s_before")
BRANCHES = [question for question in ALL if not question.fresh]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_subject(tmp_path_factory.mktemp("subject"))


@pytest.fixture(autouse=True)
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rays, "best_precision", lambda device: torch.float32)


def started(inputs: dict[str, Path], tmp_path: Path, steps: int = 3) -> tuple[trials.Trials, trials.Run]:
    """A run that is some steps old."""
    work = job(CONFIG, inputs, {"avatar": tmp_path / "avatar.pt"})
    data = train.load(work)
    make = lambda config: rays.learner(job(config, inputs, {}), data)  # noqa: E731
    found = trials.Trials(data, "cpu", make, train.optimise, work.log)
    run = trials.Run(make(CONFIG), State(), CONFIG)
    cost = operations(run.learner.avatar, data.head)
    for _ in range(steps):
        found.one(run, cost)
    return found, run


def weights(run: trials.Run) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in run.learner.avatar.state_dict().items()}


def test_questions_fit_the_subject() -> None:
    names = [question.name for question in ALL]
    assert names[:2] == ["uv_size", "second network"] and all(question.fresh for question in ALL[:2])
    assert {"samples a ray", "shell thickness", "view direction", "warp"} == set(names[2:])
    for question in ALL:
        TrainConfig(**CONFIG.model_dump() | question.keys)
    small, decided = questions.asked(MAPPED, 100)
    assert "uv_size" not in [question.name for question in questions.asked(CONFIG, 500)[0]]
    assert "uv_size" not in [question.name for question in small] and "100 px high" in decided[-1]["reason"]
    plain = CONFIG.model_copy(update={"warp": True, "view_bands": 0})
    assert {question.name for question in questions.asked(plain, 100)[0]} == {
        "second network",
        "samples a ray",
        "shell thickness",
    }
    assert questions.asked(CONFIG.model_copy(update={"representation": "layers"}), 500)[0] == []
    assert questions.minutes_of("auto") == questions.AUTO_MINUTES and questions.minutes_of(8) == 8.0


@pytest.mark.parametrize("wrong", [0, -1.0, 20000, "much"])
def test_a_budget_is_minutes_or_auto(wrong: object) -> None:
    assert TrainConfig(budget="auto").budget == "auto" and TrainConfig(budget=8).budget == 8.0 and TrainConfig().budget is None
    with pytest.raises(ValueError, match="budget"):
        TrainConfig(budget=wrong)


def test_an_alternative_must_be_clearly_better() -> None:
    question = Question("warp", "the warp", "no warp")
    taken, found = questions.answer(question, 25.0, 25.0 + questions.CLEAR_DB + 1e-9, 1.5)
    assert taken and found["taken"] == "the warp" and "25.30 dB" in found["reason"] and found["teraflop"] == 1.5
    taken, found = questions.answer(question, 25.0, 25.2, 1.5)
    assert not taken and found["taken"] == "no warp" and "no warp 25.00 dB" in found["reason"]


@pytest.mark.parametrize(("seconds", "step_s", "count"), [(480, 0.25, 1900), (100, 1, 100), (10, 3, 3), (1, 9, 1), (0, 0, 1)])
def test_steps_have_two_digits(seconds: float, step_s: float, count: int) -> None:
    assert questions.steps_in(seconds, step_s) == count


def curve(values: list[float], every: int = 50) -> list[list[float]]:
    return [[every * (n + 1), 1.0 * n, 0.1, value] for n, value in enumerate(values)]


def test_training_ends_on_a_plateau_alone() -> None:
    rising, flat = [20 + n * 0.2 for n in range(20)], [20 + n for n in range(6)] + [25.0] * 14
    assert not questions.plateau(curve(rising), 1000) and questions.plateau(curve(flat), 1000)
    assert not questions.plateau(curve(flat[:9]), 1000), "before half of the steps that fit"
    noisy = [20 + n * 0.05 + 0.3 * (-1) ** n for n in range(20)]
    assert not questions.plateau(curve(noisy), 1000) and questions.plateau(curve(noisy[:10] + noisy[:10][::-1]), 1000)
    assert not questions.plateau([], 1000) and not questions.plateau(curve([25.0, 25.0]), 100)


@pytest.mark.parametrize("question", BRANCHES, ids=lambda question: question.what)
def test_an_alternative_that_is_not_taken_leaves_no_trace(
    question: Question, inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "CLEAR_DB", np.inf)
    asked, run = started(inputs, tmp_path)
    _, plain = started(inputs, tmp_path)
    flop = 2.5 * run.work / 3
    kept, found = asked.branch(run, question, flop)
    spent = asked.on(plain, flop)
    assert kept is run and found["taken"] == question.instead and asked.wasted_s > 0 and spent > 0
    for one in (run, plain):
        asked.advance(one, flop)
    assert run.state.step == plain.state.step >= 8 and run.work == plain.work and run.config == plain.config
    expected = weights(plain)
    assert set(weights(run)) == set(expected)
    assert all(torch.equal(value, expected[name]) for name, value in weights(run).items())
    groups = run.learner.optimiser.param_groups, plain.learner.optimiser.param_groups
    assert [len(group["params"]) for group in groups[0]] == [len(group["params"]) for group in groups[1]]


@pytest.mark.parametrize("question", BRANCHES, ids=lambda question: question.what)
def test_an_alternative_that_is_taken_is_what_the_file_builds(
    question: Question, inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(questions, "CLEAR_DB", -np.inf)
    asked, run = started(inputs, tmp_path)
    before = asked.probe(run)
    other, found = asked.branch(run, question, run.work)
    assert other is run and found["taken"] == question.what
    asked.advance(run, run.work / 4)
    assert all(getattr(run.learner.config, name) == value for name, value in question.keys.items())
    stored = build.content(run.learner.avatar, build.settings_of(run.config), asked.data.head)
    again = build.restore(stored, HeadModel.load(inputs["head"]))
    view = asked.data.scene.view(0, (40, 40))
    pictures = []
    for avatar in (run.learner.avatar, again):
        posed = avatar.pose(*asked.data.scene.heads([0], "cpu"))
        pictures.append(avatar.picture(posed, view, torch.float32)[0].colour)
    assert torch.allclose(*pictures, atol=1e-5), float((pictures[0] - pictures[1]).abs().max())
    assert asked.probe(run) != before
    moved = [value for group in run.learner.optimiser.param_groups for value in group["params"]]
    own = {id(value) for value in run.learner.avatar.parameters()}
    assert {id(value) for value in moved} == own, "all that is learned, and nothing else, is optimised"


def test_a_fresh_alternative_gets_as_much_work(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, run = started(inputs, tmp_path)
    before = weights(run)
    for clear, taken in ((np.inf, False), (-np.inf, True)):
        monkeypatch.setattr(questions, "CLEAR_DB", clear)
        other, found = asked.fresh(run, ALL[0])
        assert (other is not run) == taken and found["probe_psnr"] == round(asked.probe(run), 3)
        assert all(torch.equal(value, before[name]) for name, value in weights(run).items())
    assert run.work <= other.work < 2 * run.work and other.learner.config.uv_size == 128 and other.state.step <= run.state.step


def test_work_is_that_of_the_products(inputs: dict[str, Path], tmp_path: Path) -> None:
    asked, run = started(inputs, tmp_path, steps=0)
    avatar, (sample, frame) = run.learner.avatar, operations(run.learner.avatar, asked.data.head)
    neighbours, width, encoded = CONFIG.neighbours, CONFIG.mlp_width, 3 * (1 + 2 * CONFIG.bands)
    each = encoded * width + (CONFIG.mlp_depth - 1) * width * width
    view = 3 * (1 + 2 * CONFIG.view_bands)
    rest = CONFIG.mlp_depth * width * width + width + (width + view) * CONFIG.colour_width + 3 * CONFIG.colour_width
    assert sample == 2 * (neighbours * (each + width) + rest)
    assert frame == 2 * avatar.field.from_feature.weight.numel() * asked.data.head.vertex_count
    asked.one(run, (sample, frame))
    assert run.work == 3 * (run.state.evaluations * sample + CONFIG.frames_per_step * frame)


def test_a_thinner_shell_misses_more(inputs: dict[str, Path], tmp_path: Path) -> None:
    data = started(inputs, tmp_path, steps=0)[0].data
    thick, thin = (decide.missed_share(data, np.full(data.head.vertex_count, reach)) for reach in (0.03, 0.001))
    assert 0 <= thick < thin <= 1
    assert 20 < decide.head_height_px(data) <= 40
    found = decide.shell_found(data)
    assert "mm, median" in found["taken"] and found["missed"]["measured"] <= found["missed"]["base"] + 1e-9


def decided(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[trials.Run, dict]:
    """All decisions, on a clock that says 60 steps whatever a step took."""
    monkeypatch.setattr(questions, "steps_in", lambda seconds, step_s: 60)
    monkeypatch.setattr(questions, "LEAST_STEPS", 10)
    monkeypatch.setattr(questions, "TRIALS_SHARE", 100)
    work = job(CONFIG, inputs, {"avatar": tmp_path / "avatar.pt"})
    data = train.load(work)
    return decide.decide(work, data, lambda config: rays.learner(job(config, inputs, {}), data), train.optimise)


def test_the_same_data_give_the_same_decisions(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (decided(inputs, tmp_path, monkeypatch) for _ in range(2))
    plain = lambda found: [{k: v for k, v in row.items() if k not in TIMES} for row in found["decisions"]]  # noqa: E731
    assert plain(first[1]) == plain(second[1]) and first[0].config == second[0].config
    names = [row["decision"] for row in first[1]["decisions"]]
    assert {"resolution", "shell from mattes", "second network", "samples a ray", "warp", "steps"} <= set(names)
    assert all(row["reason"] for row in first[1]["decisions"])
    assert first[0].state.seconds > 0 and first[0].config.steps == first[0].state.step + 60


def test_trials_end_with_their_share(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(questions, "TRIALS_SHARE", 0.0)
    asked, run = started(inputs, tmp_path)
    run, found = decide.answers(run, asked, ALL, 60, 1.0)
    assert [row["taken"] for row in found] == [question.instead for question in ALL]
    assert all("not tried" in row["reason"] for row in found) and asked.wasted_s == 0


def test_what_is_remembered_is_of_the_same_run(tmp_path: Path) -> None:
    assert decide.remembered(tmp_path, "mark") is None
    decide.remember(tmp_path, "mark", CONFIG, {"minutes": 1.0})
    assert decide.remembered(tmp_path, "mark") == (CONFIG, {"minutes": 1.0}) and decide.remembered(tmp_path, "other") is None
    (tmp_path / decide.KEPT).write_text("{")
    assert decide.remembered(tmp_path, "mark") is None


def test_training_within_a_budget_goes_on_after_a_kill(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(questions, "steps_in", lambda seconds, step_s: 20)
    outputs = {"avatar": tmp_path / "avatar.pt", "curve": tmp_path / "curve.tsv", "report": tmp_path / "train.json"}
    original, calls = train.optimise, []

    def killed(learner: object, state: State) -> float:
        calls.append(state.step)
        if len(calls) == 40:
            os.kill(os.getpid(), signal.SIGINT)
        return original(learner, state)

    with monkeypatch.context() as patch:
        patch.setattr(train, "optimise", killed)
        with pytest.raises(KeyboardInterrupt):
            train.run(job(CONFIG, inputs, outputs))
    with caplog.at_level("INFO"):
        train.run(job(CONFIG, inputs, outputs))
    assert "continuing at step 40 of 52" in caplog.text and "trials thrown away" not in caplog.text
    report = json.loads(outputs["report"].read_text())
    rows = report["budget"]["decisions"]
    assert report["steps"] == 52 and [row["decision"] for row in rows][-2:] == ["trials", "steps"] and rows[-1]["taken"] == 52
