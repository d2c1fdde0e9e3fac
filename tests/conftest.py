"""What the tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent

# Several test files run beside each other's steps on few cores: one BLAS thread each unless a test asks for more. numba's too:
# its parallel loops would set OpenMP's count, and so PyTorch's, for whatever test comes next.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")


@pytest.fixture(scope="session")
def assets() -> Path:
    """Folder of the fetched files; `make test` fetches them before."""
    folder = REPOSITORY / "resources" / "assets"
    needed = ("face_landmarker.task", "selfie_segmentation.tflite", "lpips_alexnet.ckpt", "carphone.mp4")
    missing = [name for name in needed if not (folder / name).exists()]
    if missing:
        pytest.skip(f"not fetched: {', '.join(missing)} (make test fetches them)")
    return folder
