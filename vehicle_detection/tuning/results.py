"""Measurements as rows: a table, its files, and a store that loses nothing when a run is killed."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import atomic_write, check_target, describe
from vehicle_detection.errors import DatasetError, InvalidInputError

Cell = str | int | float | bool | None

# Columns of text, in which "0012" is no number.
_TEXT = frozenset(
    {"status", "message", "stage", "configuration", "color_space", "split", "frame_f1_each", "trial"}
)

_WORDS: dict[str, Cell] = {"": None, "True": True, "False": False}


@dataclass(frozen=True, eq=False, repr=False)
class ResultTable:
    """Rows of measurements, each a mapping from column to value; None is "not measured".

    Attributes
    ----------
    rows
        The rows, read-only.

    Examples
    --------
    >>> table = ResultTable([{"name": "a", "score": 0.9, "ms": 5}, {"name": "b", "score": 0.8, "ms": 9}])
    >>> table.front("score", "ms").column("name")
    ['a']
    """

    rows: Sequence[Mapping[str, Any]]

    def __post_init__(self) -> None:
        given: object = self.rows
        if isinstance(given, (str, bytes, Mapping)) or not isinstance(given, Iterable):
            raise InvalidInputError(f"rows must be a list of mappings, got {describe(given)}")
        rows = list(given)
        for number, row in enumerate(rows):
            if not isinstance(row, Mapping):
                raise InvalidInputError(f"rows must be mappings, got {describe(row)} as row {number}")
        object.__setattr__(self, "rows", tuple(MappingProxyType(dict(row)) for row in rows))

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Mapping[str, Any]]:
        return iter(self.rows)

    def __repr__(self) -> str:
        return f"ResultTable({len(self)} rows of {len(self.columns)} columns)"

    def __getitem__(self, index: int) -> Mapping[str, Any]:
        """Take one row."""
        return self.rows[index]

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns, in the order in which they first occur."""
        return tuple(dict.fromkeys(name for row in self.rows for name in row))

    def column(self, name: str) -> list[Any]:
        """Return the values of one column, None where a row lacks it."""
        self._check_column(name)
        return [row.get(name) for row in self.rows]

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Return one column as float64, NaN where nothing was measured."""
        values = [math.nan if value is None else value for value in self.column(name)]
        if not all(isinstance(value, (int, float)) for value in values):
            raise InvalidInputError(f"column {name!r} holds more than numbers; choose one of measurements")
        return np.array(values, np.float64)

    def where(self, **equal: Any) -> ResultTable:
        """Keep the rows with these values: ``table.where(split="random", C=1.0)``."""
        for name in equal:
            self._check_column(name)
        return ResultTable(
            [row for row in self if all(row.get(name) == value for name, value in equal.items())]
        )

    def sort(self, name: str, *, descending: bool = True) -> ResultTable:
        """Order the rows by a column of numbers; those without a value come last."""
        values = self.numbers(name)
        return self._take(np.argsort(-values if descending else values, kind="stable"))

    def front(self, quality: str = "accuracy", cost: str = "search_ms") -> ResultTable:
        """Keep the rows that no other beats in one of the two without losing in the other, cheapest first.

        Parameters
        ----------
        quality, cost
            Columns of numbers: more is better, and less is better. Rows that lack one are left out.
        """
        gains, costs = self.numbers(quality), self.numbers(cost)
        order = np.lexsort((-gains, costs))
        best, chosen = -math.inf, []
        for index in order[~np.isnan(gains[order]) & ~np.isnan(costs[order])].tolist():
            if gains[index] > best:
                best = gains[index]
                chosen.append(index)
        return self._take(chosen)

    def summarize(
        self,
        by: Sequence[str] = ("configuration", "C", "split"),
        values: Sequence[str] = ("accuracy",),
    ) -> ResultTable:
        """Mean and spread over the rows that agree in the columns `by`, in the order they first occur.

        Returns
        -------
        ResultTable
            The columns `by`, ``runs``, and for each of `values` its mean under its own name and its standard
            deviation (of the sample; None for a single run) under the name with ``_std``. Rows without a
            value do not count; a group without any is left out.
        """
        for name in by:
            self._check_column(name)
        columns = {name: self.numbers(name) for name in values}
        groups: dict[tuple[Any, ...], list[int]] = {}
        for index, row in enumerate(self.rows):
            if not any(np.isnan(column[index]) for column in columns.values()):
                groups.setdefault(tuple(row.get(name) for name in by), []).append(index)
        summary = []
        for key, members in groups.items():
            cells: dict[str, Any] = {**dict(zip(by, key)), "runs": len(members)}
            for name, column in columns.items():
                runs = column[members].tolist()
                cells[name] = statistics.fmean(runs)
                cells[f"{name}_std"] = statistics.stdev(runs) if len(runs) > 1 else None
            summary.append(cells)
        return ResultTable(summary)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the table; it appears whole or not at all.

        Parameters
        ----------
        path
            A ``.csv``, ``.jsonl`` or ``.parquet`` file; the last needs pyarrow.

        Raises
        ------
        InvalidInputError
            If the suffix is another, the folder is missing or read-only, or pyarrow is.
        """
        suffix = _check_suffix(path, (".csv", ".jsonl", ".parquet"), "path")
        if suffix == ".parquet":
            _write_parquet(self, path)
            return
        lines = [_csv_line(self.columns)] if suffix == ".csv" else []
        lines += [_line_of(row, self.columns, suffix) for row in self]
        with atomic_write(path, "path") as part:
            part.write_text("".join(lines), encoding="utf-8", newline="")

    def to_pandas(self) -> Any:
        """Return the table as a ``pandas.DataFrame``; needs pandas."""
        try:
            import pandas as pd
        except ImportError:
            raise InvalidInputError("to_pandas needs pandas; pip install pandas, or use rows") from None
        return pd.DataFrame([dict(row) for row in self], columns=list(self.columns))

    def _check_column(self, name: str) -> None:
        if self.rows and name not in self.columns:
            raise InvalidInputError(f"column {name!r} is none of the table's: {', '.join(self.columns)}")

    def _take(self, indices: Iterable[int]) -> ResultTable:
        return ResultTable([self.rows[index] for index in indices])


def read_results(path: str | os.PathLike[str]) -> ResultTable:
    """Read a table that `ResultTable.write` wrote, or the store of a search, finished or not.

    Parameters
    ----------
    path
        A ``.csv`` or ``.jsonl`` file. A last line that was cut while it was written is left out.

    Raises
    ------
    DatasetError
        If the file is missing, or a line in it is damaged.
    InvalidInputError
        If the suffix is another.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     ResultTable([{"configuration": "a", "accuracy": 0.98}]).write(f"{folder}/table.csv")
    ...     read_results(f"{folder}/table.csv").column("accuracy")
    [0.98]
    """
    suffix = _check_suffix(path, (".csv", ".jsonl"), "path")
    file = Path(path)
    if not file.is_file():
        raise DatasetError(f"results {file} do not exist; check the path")
    return ResultTable(_parse(_whole_lines(file), file, suffix)[1])


class RowStore:
    """Rows by their `trial`, each appended to a file and flushed to the disk as soon as it is measured.

    Parameters
    ----------
    path
        A ``.csv`` or ``.jsonl`` file, read first if it exists; None keeps the rows in memory alone.
    columns
        Columns of a row, ``"trial"`` among them.
    """

    def __init__(self, path: str | os.PathLike[str] | None, columns: Sequence[str]) -> None:
        self._columns = tuple(columns)
        self._path: Path | None = None
        self._rows: dict[str, Mapping[str, Any]] = {}
        if path is None:
            return
        self._suffix = _check_suffix(path, (".csv", ".jsonl"), "store")
        self._path = check_target(path, "store")
        if not self._path.exists():
            return
        text = _whole_lines(self._path)
        header, rows = _parse(text, self._path, self._suffix)
        if header and tuple(header) != self._columns:
            raise DatasetError(
                f"store {self._path} has other columns than this release writes; choose another file"
            )
        # The rest of a line that was cut off would spoil the next one.
        os.truncate(self._path, len(text.encode("utf-8")))
        self._rows = {str(row["trial"]): row for row in rows if row.get("trial")}

    def __contains__(self, trial: str) -> bool:
        return trial in self._rows

    def __getitem__(self, trial: str) -> Mapping[str, Any]:
        return self._rows[trial]

    def add(self, row: Mapping[str, Any]) -> None:
        """Keep a finished row."""
        self._rows[row["trial"]] = row
        if self._path is None:
            return
        line = _line_of(row, self._columns, self._suffix)
        with self._path.open("ab") as file:
            if file.tell() == 0 and self._suffix == ".csv":
                line = _csv_line(self._columns) + line
            file.write(line.encode("utf-8"))
            file.flush()
            os.fsync(file.fileno())


def _check_suffix(path: str | os.PathLike[str], allowed: tuple[str, ...], name: str) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in allowed:
        raise InvalidInputError(f"{name} must end in {' or '.join(allowed)}; got {Path(path).name!r}")
    return suffix


def _csv_line(values: Iterable[Any]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(["" if value is None else value for value in values])
    return text.getvalue()


def _line_of(row: Mapping[str, Any], columns: Sequence[str], suffix: str) -> str:
    """One row as one line; a NaN is a value that was not measured."""
    values = {name: _plain(row.get(name)) for name in columns}
    if suffix == ".csv":
        return _csv_line(values.values())
    return json.dumps(values, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(value: Any) -> Cell:
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, str):
        return " ".join(value.split())  # A line of the file is a row.
    return value  # type: ignore[no-any-return]


def _whole_lines(file: Path) -> str:
    """Text of a file up to its last line break: what follows was cut while it was written."""
    data = file.read_bytes()
    try:
        return data[: data.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError as error:
        raise DatasetError(f"results {file} are no UTF-8 text ({error.reason}); check the path") from error


def _parse(text: str, file: Path, suffix: str) -> tuple[list[str], list[dict[str, Any]]]:
    """Columns and rows of a file's text."""
    rows: list[dict[str, Any]] = []
    if suffix == ".jsonl":
        for number, line in enumerate(text.splitlines(), start=1):
            try:
                row = json.loads(line)
            except ValueError:
                row = None
            if not isinstance(row, dict):
                raise _damaged(file, number)
            rows.append(row)
        return list(rows[0]) if rows else [], rows
    lines = list(csv.reader(io.StringIO(text)))
    for number, cells in enumerate(lines[1:], start=2):
        if len(cells) != len(lines[0]):
            raise _damaged(file, number)
        rows.append({name: _parse_cell(name, cell) for name, cell in zip(lines[0], cells)})
    return lines[0] if lines else [], rows


def _damaged(file: Path, number: int) -> DatasetError:
    return DatasetError(f"results {file} are damaged in line {number}; delete that line or the file")


def _parse_cell(name: str, cell: str) -> Cell:
    if name in _TEXT:
        return cell or None
    if cell in _WORDS:
        return _WORDS[cell]
    return number_or_text(cell)


def number_or_text(text: str) -> int | float | str:
    """Read a text as a whole number, else as a number, else leave it as it is."""
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return text


def _write_parquet(table: ResultTable, path: str | os.PathLike[str]) -> None:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InvalidInputError(
            "a .parquet table needs pyarrow; pip install 'vehicle-detection[parquet]', or write .csv"
        ) from None
    columns = {}
    for name in table.columns:
        values = [_plain(value) for value in table.column(name)]
        kinds = {type(value) for value in values if value is not None}
        if len(kinds) > 1:  # A column of Parquet has one type: hog_channel is 0 or "ALL".
            numeric = kinds <= {int, float}
            values = [None if value is None else float(value) if numeric else str(value) for value in values]
        columns[name] = values
    with atomic_write(path, "path") as part:
        pyarrow.parquet.write_table(pyarrow.table(columns), part)
