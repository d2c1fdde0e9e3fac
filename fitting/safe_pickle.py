"""Reading weight files that are pickles: an allow-list that admits numbers in numpy arrays and nothing that runs code.

A pickle is a program: loading an untrusted one with `pickle.load` can run anything. Here every global that the file names is
looked up in a fixed table (nothing is imported by name), and what comes out must be dicts with text keys and numeric arrays.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

_RECONSTRUCT = np.ndarray.__reduce__(np.zeros(0))[0]
ALLOWED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,  # written by numpy 1
    ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,  # written by numpy 2
}


class _ArrayUnpickler(pickle.Unpickler):
    """An unpickler that knows numpy arrays only."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is not an array")
        return ALLOWED[module, name]


def load_arrays(path: Path | str) -> dict[str, Any]:
    """Nested dicts of numeric arrays from a pickle, without running anything that the file brings.

    Raises:
        ValueError: the file is not such a pickle; the message names the file and the first thing that is not allowed.
    """
    with open(path, "rb") as file:
        try:
            content = _read(file)
        except (
            pickle.UnpicklingError,
            EOFError,
            ValueError,
            TypeError,
            AttributeError,
            KeyError,
            IndexError,
            ImportError,
            MemoryError,
            OverflowError,
        ) as error:
            raise ValueError(f"{path}: refused, it must be a pickle of dicts and numeric arrays ({error})") from error
    return content


def _read(file: BinaryIO) -> dict[str, Any]:
    content = _ArrayUnpickler(file).load()
    if type(content) is not dict:
        raise ValueError(f"found a {type(content).__name__} at the top")
    _check(content, "")
    return content


def _check(content: dict[Any, Any], where: str) -> None:
    """Refuse anything but text keys, dicts and numeric arrays.."""
    if where.count("/") > 16:
        raise ValueError("nested more than 16 deep")
    for key, value in content.items():
        if type(key) is not str:
            raise ValueError(f"found a key of type {type(key).__name__}")
        if type(value) is dict:
            _check(value, f"{where}/{key}")
        elif type(value) is not np.ndarray or value.dtype.kind not in "biuf":
            kind = f"array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
            raise ValueError(f"found a {kind} at {where}/{key}")
