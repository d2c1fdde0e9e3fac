"""Files that several steps read, with the sentence a user needs when one is damaged."""

from __future__ import annotations

from pathlib import Path

import torch

from fitting.head_model import HeadModel
from workflow import step


def load_head(path: Path, dtype: torch.dtype = torch.float32) -> HeadModel:
    """The baked head model; StepError names a file that is none."""
    try:
        return HeadModel.load(path, dtype)
    except ValueError as error:
        raise step.StepError(str(error)) from error
