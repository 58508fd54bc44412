"""Parquet, the columnar format of pandas and polars, by `pyarrow`. linkpose's metadata travel in the file's schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import BinaryIO

from linkpose.convert import libraries
from linkpose.convert.source import Source
from linkpose.recording.parquet import PARQUET_KEY


def write(file: BinaryIO, path: Path, source: Source) -> None:
    """All columns as float64; missing values are null."""
    pa = libraries.load("pyarrow", path)
    pq = libraries.load("pyarrow.parquet", path)
    content = {"kind": source.kind, "metadata": source.metadata, "closing": source.closing}
    schema = pa.schema([(name, pa.float64()) for name in source.names], {PARQUET_KEY: json.dumps(content).encode()})
    with pq.ParquetWriter(file, schema, compression="zstd") as writer:
        for block in source.blocks():
            arrays = [pa.array(values, from_pandas=True) for values in block.values()]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
