"""Arrays that grow on disk: the log of a day must not fill the memory."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eskf_ros.compiled import COMPILED


def as_records(rows: NDArray[Any]) -> NDArray[Any]:
    """Return the same rows so that kernels can read their fields, compiled or plain (see `state.memory.allocate`)."""
    return rows if COMPILED or rows.dtype.names is None else rows.view(np.recarray)


class Spill:
    """Rows of one type in a temporary file, which goes with this object; they can be read and replaced in blocks."""

    def __init__(self, dtype: Any, width: int = 0, folder: Path | None = None) -> None:
        """Open the file in ``folder`` (None: that of the system); a row has ``width`` numbers, or one record for 0."""
        self._arguments = dtype, width, folder
        self._dtype = np.dtype(dtype)
        self._shape = (width,) if width else ()
        self._row_bytes = self._dtype.itemsize * max(1, width)
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - it is closed with the object
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def copied(self) -> Spill:
        """Return a copy in a file of its own."""
        other = Spill(*self._arguments)
        self._file.seek(0)
        shutil.copyfileobj(self._file, other._file)
        other._count = self._count
        return other

    def append(self, rows: NDArray[Any]) -> None:
        """Write rows (n,) or (n, width) behind the others."""
        self.replace(self._count, rows)
        self._count += len(rows)

    def replace(self, first: int, rows: NDArray[Any]) -> None:
        """Write rows from index ``first`` on."""
        self._file.seek(first * self._row_bytes)
        self._file.write(np.ascontiguousarray(rows, self._dtype).tobytes())

    def read(self, first: int, end: int) -> NDArray[Any]:
        """Return the rows from ``first`` up to ``end``, as a copy."""
        self._file.seek(first * self._row_bytes)
        content = bytearray(self._file.read((end - first) * self._row_bytes))
        return as_records(np.frombuffer(content, self._dtype).reshape(-1, *self._shape))
