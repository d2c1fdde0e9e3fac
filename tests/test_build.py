"""An avatar is built from config and read back from its file's content, with plain values only."""

from __future__ import annotations

import io

import pytest
import torch
from toy_head import toy_head

from avatar import build
from avatar.config import TrainConfig
from avatar.features import Condition
from fitting.head_model import HeadModel


def condition(head: HeadModel, displacement_m: torch.Tensor) -> Condition:
    """Neutral codes and a displacement [1, V, 3]."""
    return Condition(displacement_m, torch.zeros(1, len(head.expression_basis) + 3), head.template)


def test_content_loads_with_weights_only_and_restores_the_same_avatar() -> None:
    head, settings = toy_head(), build.settings_of(TrainConfig(mlp_width=32, static_features=True))
    torch.manual_seed(0)
    avatar = build.build(settings, head)
    avatar.shape_shell(torch.full((head.vertex_count,), 0.02), torch.rand(17, 3))
    file = io.BytesIO()
    torch.save(build.content(avatar, settings, head), file)
    file.seek(0)
    stored = torch.load(file, weights_only=True)
    restored = build.restore(stored, head)
    assert stored["settings"] == settings and restored.core_m.shape == (17, 3)
    there = condition(head, 0.01 * torch.randn(1, head.vertex_count, 3))
    assert torch.equal(restored.source(there).values, avatar.source(there).values)
    with pytest.raises(ValueError, match="trained on head model toy"):
        build.restore(stored, toy_head(seed=1))


def test_settings_are_the_model_part_of_the_config() -> None:
    settings = build.settings_of(TrainConfig(steps=7, seed=3))
    assert "steps" not in settings and "seed" not in settings and settings["representation"] == "ours_d"
    assert set(settings) <= set(TrainConfig.model_fields)


def test_features_depend_on_the_displacement_and_static_ones_are_added() -> None:
    head = toy_head()
    for static in (False, True):
        avatar = build.build(build.settings_of(TrainConfig(static_features=static)), head)
        assert (avatar.source.static is not None) == static
        still = avatar.source(condition(head, torch.zeros(1, head.vertex_count, 3))).values
        moved = avatar.source(condition(head, torch.full((1, head.vertex_count, 3), 0.01))).values
        assert (still - moved).abs().max() > 1e-4 and still.shape == (1, head.vertex_count, 64)


def test_the_warp_belongs_to_training_alone() -> None:
    head, settings = toy_head(), build.settings_of(TrainConfig(mlp_width=32, warp=True))
    avatar = build.build(settings, head)
    avatar.correct_errors(5)
    assert any(name.startswith("warp.") for name in avatar.state_dict()) and "warp" not in settings
    stored = build.content(avatar, settings, head)
    assert not any(name.startswith("warp.") for name in stored["weights"])
    assert build.restore(stored, head).warp is None
