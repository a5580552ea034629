"""Rows into a Parquet file that is whole or not there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from model.driving.whole_files import written_whole


def write_rows(path: Path, rows: Iterable[Mapping[str, Any]], schema: pa.Schema, group: int) -> int:
    """Write rows to a temporary name beside ``path`` and rename it; returns how many there were.

    Args:
        path: of the file; its folder is made.
        rows: as ``schema`` describes them.
        schema: with the file's metadata.
        group: rows in a row group.
    """
    count, remaining = 0, iter(rows)
    with (
        written_whole(path) as temporary,
        pq.ParquetWriter(temporary, schema, compression="zstd", write_page_checksum=True) as writer,
    ):
        while some := list(islice(remaining, group)):
            writer.write_table(pa.Table.from_pylist(some, schema=schema))
            count += len(some)
    return count
