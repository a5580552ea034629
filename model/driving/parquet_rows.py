"""Rows into a Parquet file that is whole or not there, and out of one of a known version."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from looktwice.model.driving.whole_files import written_whole


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


def read_rows(
    path: Path, version_key: bytes, version: str, holds: str, error: type[ValueError]
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a file, group by group.

    Args:
        path: of the file.
        version_key: of its metadata.
        version: that must stand there.
        holds: what its rows are, in messages.
        error: raised where the file is missing, damaged, or of another version.
    """
    try:
        file = pq.ParquetFile(path, page_checksum_verification=True)
    except (pa.ArrowException, OSError) as problem:
        raise error(f"{path} is not a whole Parquet file: {problem}") from problem
    found = (file.schema_arrow.metadata or {}).get(version_key, b"").decode()
    if found != version:
        raise error(f"{path} holds no {holds} of version {version} (found {found or 'none'})")
    for group in range(file.num_row_groups):
        try:
            rows: list[dict[str, Any]] = file.read_row_group(group).to_pylist()
        except (pa.ArrowException, OSError) as problem:
            raise error(f"{path} is damaged: {problem}") from problem
        yield from rows
