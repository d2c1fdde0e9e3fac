"""The only place where an avatar is put together from config, and read back from a file's content.

`python -m avatar.build --describe VARIANT` prints what a preset or variant is made of: layers, parameters, operations.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import torch
from torch import nn

from avatar.config import TrainConfig, modules_of
from fitting.head_model import HeadModel

# Fields of TrainConfig that the network and its sampling are made of; the rest only concerns training.
MODEL_FIELDS = (
    "representation",
    "sampling",
    "feature_channels",
    "uv_size",
    "static_features",
    "mlp_width",
    "mlp_depth",
    "colour_width",
    "neighbours",
    "bands",
    "view_bands",
    "neighbourhood",
    "sample_step_m",
    "max_samples",
    "coarse_samples",
    "fine_samples",
    "layers",
    "bases",
    "texture_size",
)


TRAINING_ONLY = "warp."  # parameters that no file of an avatar holds: the error-correction warp is off at test


def settings_of(config: TrainConfig) -> dict[str, Any]:
    """The part of the training config that an avatar file must carry."""
    return {name: getattr(config, name) for name in MODEL_FIELDS}


def build(settings: dict[str, Any], head: HeadModel) -> nn.Module:
    """A new avatar of the representation that `settings` names.

    The module is named as a string and imported here, so that one representation's code is not part of another's digest.
    """
    return import_module(modules_of(settings["representation"])[0]).create(settings, head)


def content(avatar: nn.Module, settings: dict[str, Any], head: HeadModel, **more: Any) -> dict[str, Any]:
    """What an avatar file holds: tensors and plain values only, so that it loads with weights_only."""
    if hasattr(avatar, "packed"):
        weights = avatar.packed()
    else:
        weights = {name: value for name, value in avatar.state_dict().items() if not name.startswith(TRAINING_ONLY)}
    return {"settings": settings, "head_digest": head.digest, "head_name": head.name, "weights": weights, **more}


def restore(stored: dict[str, Any], head: HeadModel) -> nn.Module:
    """The avatar of a file's content.

    Raises ValueError when it was trained on another head model.
    """
    if stored["head_digest"] != head.digest:
        raise ValueError(
            f"the avatar was trained on head model {stored['head_name']} {stored['head_digest']}, found {head.name} {head.digest}"
        )
    avatar = build(stored["settings"], head)
    if hasattr(avatar, "unpack"):
        avatar.unpack(stored["weights"])
        return avatar.eval()
    for name in ("thickness_m", "core_m"):  # buffers whose size comes from the data
        if name in stored["weights"] and hasattr(avatar, name):
            setattr(avatar, name, torch.empty_like(stored["weights"][name]))
    avatar.load_state_dict(stored["weights"])
    return avatar.eval()


if __name__ == "__main__":
    import_module("avatar.describe").main()  # by name: what prints is no part of the digest of what is built
