"""Streaming equal arrays into one .npy file."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import numpy as np


class StackWriter:
    """Streams equal arrays into one .npy file whose first axis is known only at the end.

    Plain writes, not a memory map: a full disk raises OSError here, where a page of a map would kill the process.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = open(path, "wb")  # noqa: SIM115 - closed by __exit__
        self._shape: tuple[int, ...] | None = None
        self._dtype = np.dtype(np.uint8)
        self._header = 0
        self.count = 0

    def append(self, item: np.ndarray) -> None:
        """Add one array of the same shape and dtype as the first.

        Raises:
            ValueError: shape or dtype differ from the first item's.
        """
        if self._shape is None:
            self._shape, self._dtype = item.shape, item.dtype
            self._write_header()
            self._header = self._file.tell()
        if item.shape != self._shape or item.dtype != self._dtype:
            raise ValueError(f"item {self.count} is {item.dtype}{item.shape}, expected {self._dtype}{self._shape}")
        self._file.write(np.ascontiguousarray(item).data)
        self.count += 1

    def _write_header(self) -> None:
        header = {"descr": np.lib.format.dtype_to_descr(self._dtype), "fortran_order": False, "shape": (self.count, *self._shape)}
        np.lib.format.write_array_header_1_0(self._file, header)

    def __enter__(self) -> StackWriter:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if kind is None and self._shape is not None:
                self._file.seek(0)
                self._write_header()  # numpy pads the header for a growing first axis, so its length stays
                if self._file.tell() != self._header:
                    raise RuntimeError(f"{self._path}: the .npy header changed its length")
        finally:
            self._file.close()
