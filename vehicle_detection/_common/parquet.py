"""Parquet files, written at once or in groups of rows."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from vehicle_detection._common.files import atomic_write
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


def write_parquet(
    path: str | os.PathLike[str], table: Any, *, types: Mapping[str, str] | None = None
) -> None:
    """Write a pandas table, or a mapping of column names to lists of values, as a Parquet file.

    `types` names the Arrow type of each column, such as ``"int64"``; None infers them from the values.
    """
    pyarrow = import_pyarrow()
    schema = None if types is None else pyarrow.schema(list(types.items()))
    with atomic_write(path, "path") as part:
        pyarrow.parquet.write_table(pyarrow.table(table, schema=schema), part)


class ParquetRows:
    """Writer of a Parquet file, row by row in constant memory; `types` maps column names to Arrow types."""

    def __init__(self, path: Path, types: Mapping[str, str]) -> None:
        self._path = path
        self._waiting: dict[str, list[Any]] = {name: [] for name in types}
        self._pyarrow = import_pyarrow()
        self._schema = self._pyarrow.schema(list(types.items()))

    def __enter__(self) -> Self:
        self._writer = self._pyarrow.parquet.ParquetWriter(self._path, self._schema)
        return self

    def write(self, values: Sequence[Any]) -> None:
        """Add a row, with None where a value is unknown."""
        columns = list(self._waiting.values())
        for column, value in zip(columns, values, strict=True):
            column.append(value)
        if len(columns[0]) >= _ROWS_PER_GROUP:
            self._flush()

    def _flush(self) -> None:
        self._writer.write_table(self._pyarrow.table(self._waiting, schema=self._schema))
        for column in self._waiting.values():
            column.clear()

    def __exit__(self, *error: Any) -> None:
        try:
            if error[0] is None:
                self._flush()
        finally:
            self._writer.close()
