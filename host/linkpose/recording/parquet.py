"""Parquet files as tables, in blocks of rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from linkpose.errors import FileFormatError, MissingLibrary
from linkpose.recording.textfile import Part, metadata_of
from linkpose.sensors.measurements import Floats

PARQUET_KEY = b"linkpose"  # of the metadata in a file's schema
_MAGIC = b"PAR1"
_ROWS = 65_536  # in memory at once; doubling it doubles the memory of a run
_INDEX = "__index_level_"  # pandas' row names


def is_parquet(path: Path) -> bool:
    """Whether the file begins as a Parquet file does."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return file.read(len(_MAGIC)) == _MAGIC
    except OSError:
        return False


class ParquetTable:
    """A Parquet file of linkpose, or of any program, with columns of numbers. Attributes as a TextTable's.

    Raises MissingLibrary without pyarrow, FileFormatError for a damaged file or for columns that are no numbers.
    """

    def __init__(self, path: Path) -> None:
        try:
            import pyarrow
            import pyarrow.parquet
        except ImportError as error:
            raise MissingLibrary("pyarrow", path) from error
        self._path, self._pyarrow = path, pyarrow
        self._failures = (pyarrow.ArrowException, OSError, UnicodeDecodeError)  # the last one for names of columns
        try:
            self._file = pyarrow.parquet.ParquetFile(path, memory_map=False)
            schema = self._file.schema_arrow
        except self._failures as error:
            raise self._unreadable(error) from error
        self.names = [name for name in schema.names if not name.startswith(_INDEX)]
        if not self.names or not self._file.metadata.num_rows:
            raise self._without_rows()
        if len(set(self.names)) < len(self.names):
            raise FileFormatError(path, f"{path} has two columns of one name")
        own = (schema.metadata or {}).get(PARQUET_KEY)
        content = metadata_of(path, own.decode("utf-8", "replace"), 1) if own else {}
        self.kind = str(content.get("kind", ""))
        self.metadata: dict[str, Any] = _object(content.get("metadata")) or {}
        self.closing: dict[str, Any] | None = _object(content.get("closing"))
        self.remarks: tuple[str, ...] = ()

    def parts(self, progress: Callable[[float], None] | None = None) -> Iterator[Part]:
        """The rows from the first to the last. `progress` is called with the share that was read."""
        line, total = 1, self._file.metadata.num_rows
        try:
            for batch in self._file.iter_batches(_ROWS, columns=self.names):
                if not batch.num_rows:
                    continue
                columns = dict(zip(batch.schema.names, map(self._numbers, batch.columns), strict=True))
                yield Part(columns, line)
                line += batch.num_rows
                if progress is not None:
                    progress(min(1.0, line / total))
        except self._failures as error:
            raise self._unreadable(error) from error
        if line == 1:  # a damaged file may state rows that it does not hold
            raise self._without_rows()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def _without_rows(self) -> FileFormatError:
        return FileFormatError(self._path, f"{self._path} has no row; nothing was recorded")

    def _numbers(self, column: Any) -> Floats:
        """The values (N,) of a column. A NaN of any bits becomes NumPy's own: a signalling one makes NumPy warn."""
        values = np.array(column.cast(self._pyarrow.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)
        values[np.isnan(values)] = np.nan
        return values

    def _unreadable(self, error: Exception) -> FileFormatError:
        return FileFormatError(self._path, f"{self._path} is no Parquet table of numbers: {error}")


def _object(value: Any) -> dict[str, Any] | None:
    return value if isinstance(value, dict) else None
