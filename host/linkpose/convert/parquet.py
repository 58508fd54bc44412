"""Parquet, the columnar format of pandas and polars, by `pyarrow`. linkpose's metadata travel in the file's schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import BinaryIO

from linkpose.convert import libraries
from linkpose.recording.parquet import PARQUET_KEY
from linkpose.recording.table import Table


def write(file: BinaryIO, path: Path, table: Table) -> None:
    """All columns as float64; missing values are null."""
    pa = libraries.load("pyarrow", path)
    pq = libraries.load("pyarrow.parquet", path)
    arrays = {name: pa.array(values, from_pandas=True) for name, values in table.columns.items()}
    content = {"kind": table.kind, "metadata": table.metadata, "closing": table.closing}
    found = pa.table(arrays).replace_schema_metadata({PARQUET_KEY: json.dumps(content).encode()})
    pq.write_table(found, file, compression="zstd")
