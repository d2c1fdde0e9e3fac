"""Reading files that are pickles: allow-lists that admit numbers in arrays and nothing that runs code.

A pickle is a program: loading an untrusted one with `pickle.load` can run anything. Here every global that the file names is
looked up in a fixed table (nothing is imported by name), and what comes out must be dicts with text keys and numeric arrays.

`load_arrays` reads weight files. `load_model` also reads the body models of the SMPL family, Python 2 pickles that hold scipy's
sparse matrices and chumpy's expressions: both become inert records of their state, which are then turned into plain arrays.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import scipy.sparse

_RECONSTRUCT = np.ndarray.__reduce__(np.zeros(0))[0]
_SCALAR = np.float64(0).__reduce__()[0]
MOST_ENTRIES = 1e8  # of a dense matrix: a few bytes of pickle may ask for any size
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


# What damaged or hostile bytes can make an unpickler raise.
_DAMAGE = (
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
    RecursionError,
)


def load_arrays(path: Path | str) -> dict[str, Any]:
    """Nested dicts of numeric arrays from a pickle, without running anything that the file brings.

    Raises:
        ValueError: the file is not such a pickle; the message names the file and the first thing that is not allowed.
    """
    return _guarded(path, _read)


def load_model(path: Path | str) -> dict[str, Any]:
    """Content of a body model's pickle: dense numeric arrays, text and numbers by key, in nested dicts, tuples and lists.

    Raises:
        ValueError: as `load_arrays`.
    """
    return _guarded(path, _read_model)


def _guarded(path: Path | str, read: Callable[[BinaryIO], dict[str, Any]]) -> dict[str, Any]:
    with open(path, "rb") as file:
        try:
            return read(file)
        except _DAMAGE as error:
            raise ValueError(f"{path}: refused, it must be a pickle of dicts and numeric arrays ({error})") from error


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


class _Inert:
    """A record in the place of an object of a foreign class: it keeps the state that the file gives it and does nothing."""

    def __new__(cls, *arguments: Any) -> _Inert:
        return object.__new__(cls)

    def __init__(self, *arguments: Any) -> None:
        self.state: dict[str, Any] = {}

    def __setstate__(self, state: Any) -> None:
        if type(state) is not dict:
            raise pickle.UnpicklingError(f"it gives a {type(self).__name__} a {type(state).__name__} for a state")
        self.state = state


class _ModelUnpickler(pickle.Unpickler):
    """An unpickler for numpy arrays, scipy's sparse matrices and chumpy's arrays, of Python 2 or 3.

    What it hands out is made for this one file or cannot be changed: a pickle may also set attributes.
    """

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file, encoding="latin1")
        self.sparse = {name: type(name, (_Inert,), {}) for name in ("csc_matrix", "csr_matrix")}
        self.chumpy = type("chumpy", (_Inert,), {})
        self.base = type("base", (), {})

    def find_class(self, module: str, name: str) -> Any:
        known = {
            ("numpy", "ndarray"): np.ndarray,
            ("numpy", "dtype"): self.dtype,
            ("_codecs", "encode"): self.encode,
            ("collections", "OrderedDict"): dict,
        }
        for module_name, built_in in (("copyreg", "builtins"), ("copy_reg", "__builtin__")):  # as Python 3 and 2 call them
            known[module_name, "_reconstructor"] = self.reconstruct  # how protocols 0 and 1 make an object
            known[built_in, "object"] = self.base
        for package in ("numpy.core.multiarray", "numpy._core.multiarray"):
            known[package, "_reconstruct"] = _RECONSTRUCT
            known[package, "scalar"] = _SCALAR
        for module_name in ("scipy.sparse.csc", "scipy.sparse._csc"):
            known[module_name, "csc_matrix"] = self.sparse["csc_matrix"]
        for module_name in ("scipy.sparse.csr", "scipy.sparse._csr"):
            known[module_name, "csr_matrix"] = self.sparse["csr_matrix"]
        if (module, name) in known:
            return known[module, name]
        if module.split(".")[0] == "chumpy":
            return self.chumpy
        raise pickle.UnpicklingError(f"it names {module}.{name}, which is not an array")

    def dtype(self, kind: Any, *flags: Any) -> np.dtype:
        found = np.dtype(kind) if type(kind) is str else np.dtype("O")
        if found.kind not in "biuf":
            raise pickle.UnpicklingError(f"it holds an array of {found}")
        return found

    def encode(self, text: Any, encoding: Any = "latin1") -> bytes:
        if type(text) is not str or encoding != "latin1":
            raise pickle.UnpicklingError(f"it asks for an encoding in {encoding!r}")
        return text.encode("latin1")

    def reconstruct(self, kind: Any, base: Any, state: Any) -> _Inert:
        if not (isinstance(kind, type) and issubclass(kind, _Inert)) or base is not self.base or state is not None:
            raise pickle.UnpicklingError("it rebuilds an object that is no array")
        return kind()

    def plain(self, value: Any, where: str = "") -> Any:
        """The value with every record replaced by its array.

        Raises:
            ValueError: something that is neither array, text nor number.
        """
        if where.count("/") > 16:
            raise ValueError("nested more than 16 deep")
        if isinstance(value, self.chumpy):
            return self._of_chumpy(value, where)
        if isinstance(value, tuple(self.sparse.values())):
            return self._of_sparse(value, where)
        if type(value) is dict:
            return {self._key(key): self.plain(item, f"{where}/{key}") for key, item in value.items()}
        if type(value) in (list, tuple):
            return [self.plain(item, f"{where}/{index}") for index, item in enumerate(value)]
        numeric = isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf"
        if numeric or value is None or type(value) in (str, bytes, int, float, bool):
            return value
        raise ValueError(f"found a {type(value).__name__} at {where or 'the top'}")

    @staticmethod
    def _key(key: Any) -> str:
        if type(key) is not str:
            raise ValueError(f"found a key of type {type(key).__name__}")
        return key

    def _of_chumpy(self, value: _Inert, where: str) -> np.ndarray:
        """A leaf holds its array as `x`; a slice holds its parent `a`, flat indices `idxs` and the shape it had."""
        state = value.state
        if "x" in state:
            return np.asarray(self.plain(state["x"], f"{where}/x"))
        if not {"a", "idxs", "preferred_shape"} <= set(state):
            raise ValueError(f"found a chumpy expression at {where} that is neither an array nor a slice of one")
        parent = np.asarray(self.plain(state["a"], f"{where}/a"))
        index = np.asarray(self.plain(state["idxs"], f"{where}/idxs")).astype(np.int64)
        return parent.ravel()[index].reshape([int(side) for side in state["preferred_shape"]])

    def _of_sparse(self, value: _Inert, where: str) -> np.ndarray:
        """A dense array; indices are checked, for scipy's own code trusts them."""
        state = {name: self.plain(item, f"{where}/{name}") for name, item in value.state.items()}
        kind = scipy.sparse.csc_matrix if isinstance(value, self.sparse["csc_matrix"]) else scipy.sparse.csr_matrix
        shape = [int(side) for side in state.get("_shape", state.get("shape", ()))]
        if len(shape) != 2 or not 0 < np.prod([float(side) for side in shape]) < MOST_ENTRIES:
            raise ValueError(f"found a sparse matrix of shape {shape} at {where}")
        matrix = kind((state["data"], state["indices"], state["indptr"]), shape=tuple(shape))
        matrix.check_format(full_check=True)
        return matrix.toarray()


def _read_model(file: BinaryIO) -> dict[str, Any]:
    reader = _ModelUnpickler(file)
    content = reader.load()
    if type(content) is not dict:
        raise ValueError(f"found a {type(content).__name__} at the top")
    return reader.plain(content)
