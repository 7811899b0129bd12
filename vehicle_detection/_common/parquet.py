"""Parquet files, written in groups of rows."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from vehicle_detection.errors import InvalidInputError

# Rows per group, which bounds the memory.
_ROWS_PER_GROUP = 50_000


def import_pyarrow() -> Any:
    """Return the package pyarrow; raise an error with the remedy if it is missing."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InvalidInputError(".parquet files need pyarrow; pip install pyarrow") from None
    return pyarrow


@contextlib.contextmanager
def open_parquet(
    path: Path, types: Mapping[str, str]
) -> Iterator[Callable[[Iterable[Mapping[str, Any]]], None]]:
    """Yield a function that adds rows, by the names of their columns, to a file, in constant memory.

    `types` maps the names of the columns to Arrow types, such as ``"int64"``.
    """
    pyarrow = import_pyarrow()
    schema = pyarrow.schema(list(types.items()))
    waiting: list[Mapping[str, Any]] = []

    def flush() -> None:
        writer.write_table(pyarrow.Table.from_pylist(waiting, schema=schema))
        waiting.clear()

    def write(rows: Iterable[Mapping[str, Any]]) -> None:
        waiting.extend(rows)
        if len(waiting) >= _ROWS_PER_GROUP:
            flush()

    with pyarrow.parquet.ParquetWriter(path, schema) as writer:
        yield write
        flush()
