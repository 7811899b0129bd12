"""Tables of results: reading and writing, the Pareto front, and a row store that survives a killed run."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    atomic_write,
    check_path,
    check_target,
    describe,
    import_pyarrow,
    write_text,
)
from vehicle_detection.errors import DatasetError, InvalidInputError

if TYPE_CHECKING:
    from pandas import DataFrame

# Text columns: a cell "0012" is not a number.
_TEXT_COLUMNS = frozenset(
    {"status", "message", "stage", "configuration", "color_space", "split", "frame_f1_by_set", "trial"}
)

_NUMBER_COLUMNS = ("C", "accuracy", "train_accuracy", "search_ms", "fit_seconds", "seed", "train_size")

_CONSTANTS: dict[str, Any] = {"": None, "True": True, "False": False}


def make_table(rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> DataFrame:
    """Build a table; None becomes NaN, and a column without any value is float64 unless it holds text."""
    import pandas as pd

    table = pd.DataFrame([dict(row) for row in rows], columns=columns)
    empty = [name for name in table if name not in _TEXT_COLUMNS and table[name].isna().all()]
    return table.astype(dict.fromkeys(empty, np.float64))


def check_column(table: DataFrame, name: object) -> None:
    """Raise unless `table` is a pandas table with the column."""
    import pandas as pd

    if not isinstance(table, pd.DataFrame):
        raise InvalidInputError(
            f"table must be a pandas DataFrame, got {describe(table)}; "
            "pass what compare_configurations, search_parameters or read_results returns"
        )
    if not isinstance(name, str) or name not in table.columns:
        listed = ", ".join(map(str, table.columns))
        raise InvalidInputError(f"table has no column {name!r}; its columns are {listed or 'none'}")


def numeric_column(table: DataFrame, name: str) -> NDArray[np.float64]:
    """Return a column as float64; NaN where the value is missing."""
    check_column(table, name)
    try:
        return np.asarray(table[name].to_numpy(np.float64, na_value=np.nan), np.float64)
    except (TypeError, ValueError):
        raise InvalidInputError(f"column {name!r} must hold numbers only; choose a measurement") from None


def pareto_front(table: DataFrame, quality: str = "accuracy", cost: str = "search_ms") -> DataFrame:
    """Select the rows that no other row beats in quality or cost without being worse in the other.

    Returns the selected rows, cheapest first, with their index. The columns are numeric: a higher `quality`
    and a lower `cost` are better. Rows without either are left out; of equal rows the first one is kept.

    >>> import pandas as pd
    >>> table = pd.DataFrame({"accuracy": [0.9, 0.8, 0.95], "search_ms": [5, 9, 12]})
    >>> pareto_front(table)
       accuracy  search_ms
    0      0.90          5
    2      0.95         12
    """
    qualities, costs = numeric_column(table, quality), numeric_column(table, cost)
    best, selected = -math.inf, []
    for row in np.lexsort((-qualities, costs)).tolist():
        if qualities[row] > best and not math.isnan(costs[row]):
            best = qualities[row]
            selected.append(row)
    return table.iloc[selected]


def write_results(table: DataFrame, path: str | os.PathLike[str]) -> None:
    """Write a table atomically as ``.csv``, ``.jsonl`` or ``.parquet`` (needs pyarrow)."""
    suffix = _check_suffix(path, (".csv", ".jsonl", ".parquet"), "path")
    if suffix == ".parquet":
        # A Parquet column has one type, but hog_channel is 0 or "ALL": write mixed columns as text.
        mixed = [name for name in table if table[name].dropna().map(type).nunique() > 1]
        table = table.assign(**{name: table[name].map(str, na_action="ignore") for name in mixed})
        pyarrow = import_pyarrow()
        with atomic_write(path, "path") as part:
            pyarrow.parquet.write_table(pyarrow.table(table.reset_index(drop=True)), part)
        return
    lines = [_csv_line(table.columns)] if suffix == ".csv" else []
    lines += [_format_row(row, table.columns, suffix) for row in table.to_dict("records")]
    write_text(path, "".join(lines), "path")


def read_results(path: str | os.PathLike[str]) -> DataFrame:
    """Read the table of a finished or interrupted run: the ``store`` of a search, or a written table.

    Returns one row per line of the ``.csv`` or ``.jsonl`` file; see `compare_configurations` for the columns.
    NaN marks a missing value. An incomplete last line is left out, and so is the second row of a trial that
    two runs have measured at the same time; another damaged line raises a `DatasetError`.

    >>> import tempfile
    >>> import pandas as pd
    >>> table = pd.DataFrame({"configuration": ["a"], "accuracy": [0.98]})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     table.to_csv(f"{folder}/table.csv", index=False)
    ...     read_results(f"{folder}/table.csv")
      configuration  accuracy
    0             a      0.98
    """
    file = check_path(path)
    suffix = _check_suffix(path, (".csv", ".jsonl"), "path")
    if not file.is_file():
        raise DatasetError(f"results file {file} does not exist; check the path")
    columns, rows = _parse(_complete_lines(file), file, suffix)
    seen: dict[Any, dict[str, Any]] = {}
    for number, row in enumerate(rows):
        trial = row.get("trial")
        seen.setdefault((trial, row.get("stage"), row.get("configuration")) if trial else number, row)
    return make_table(seen.values(), columns)


class RowStore(dict[str, Mapping[str, Any]]):
    """Rows by their ``trial``; each new one is appended to a file and synced to disk at once.

    `path` is a ``.csv`` or ``.jsonl`` file, read first if it exists; None keeps the rows in memory only.
    """

    def __init__(self, path: str | os.PathLike[str] | None, columns: Sequence[str]) -> None:
        super().__init__()
        self._columns = tuple(columns)
        self._suffix = "" if path is None else _check_suffix(path, (".csv", ".jsonl"), "store")
        self._path = None if path is None else check_target(path, "store")
        if self._path is None or not self._path.exists():
            return
        text = _complete_lines(self._path)
        header, rows = _parse(text, self._path, self._suffix)
        start = (
            _csv_line(self._columns) if self._suffix == ".csv" else json.dumps({self._columns[0]: ""})[:-3]
        )
        head = self._path.read_bytes()[: len(start)].removeprefix(b"\xef\xbb\xbf")
        if not start.encode().startswith(head) or (header and tuple(header) != self._columns):
            raise DatasetError(
                f"store {self._path} is not a table of trials, or of another release; choose another file"
            )
        # Remove an incomplete last line: the next row would be appended to it.
        os.truncate(self._path, len(text.encode("utf-8")))
        self.update({str(row["trial"]): row for row in rows if row.get("trial")})

    def add(self, row: Mapping[str, Any]) -> None:
        """Store a finished row."""
        self[row["trial"]] = row
        if self._path is None:
            return
        line = _format_row(row, self._columns, self._suffix)
        with self._path.open("a+b") as file:
            file.seek(0)
            # Another run may have measured it at the same time; `read_results` drops what it still writes.
            if str(row["trial"]).encode() in file.read():
                return
            if file.tell() == 0 and self._suffix == ".csv":
                line = _csv_line(self._columns) + line
            file.write(line.encode("utf-8"))
            file.flush()
            os.fsync(file.fileno())


def _check_suffix(path: str | os.PathLike[str], allowed: tuple[str, ...], name: str) -> str:
    suffix = check_path(path, name).suffix.lower()
    if suffix not in allowed:
        raise InvalidInputError(f"{name} must end in {' or '.join(allowed)}; got {Path(path).name!r}")
    return suffix


def _csv_line(values: Iterable[Any]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(values)
    return text.getvalue()


def _format_row(row: Mapping[str, Any], columns: Iterable[str], suffix: str) -> str:
    """Format a row as one line of a file; NaN becomes None, and a line break in text a space."""
    values: dict[str, Any] = {}
    for name in columns:
        value = row.get(name)
        value = value.item() if isinstance(value, np.generic) else value
        missing = isinstance(value, float) and not math.isfinite(value)
        values[name] = " ".join(value.split()) if isinstance(value, str) else None if missing else value
    if suffix == ".csv":
        return _csv_line(values.values())
    return json.dumps(values, ensure_ascii=False, allow_nan=False) + "\n"


def _complete_lines(file: Path) -> str:
    """Text of a file up to its last line break; a killed writer may have left an incomplete line."""
    data = file.read_bytes()
    try:
        return data[: data.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError as error:
        raise DatasetError(
            f"results file {file} is not UTF-8 text ({error.reason}); check the path"
        ) from error


def _parse(text: str, file: Path, suffix: str) -> tuple[list[str], list[dict[str, Any]]]:
    """Column names and rows of a file's text."""
    rows: list[dict[str, Any]] = []
    text = text.removeprefix("\ufeff")  # the mark that programs on Windows add
    if suffix == ".jsonl":
        for number, line in enumerate(text.splitlines(), start=1):
            try:
                row = json.loads(line)
            except (ValueError, RecursionError):
                row = None
            if not isinstance(row, dict):
                raise _damaged_line(file, number)
            rows.append(row)
        return list(dict.fromkeys(name for row in rows for name in row)), rows
    header, *lines = csv.reader(io.StringIO(text)) if text else [[]]
    for number, cells in enumerate(lines, start=2):
        if len(cells) != len(header):
            raise _damaged_line(file, number)
        rows.append({name: _parse_cell(name, cell) for name, cell in zip(header, cells)})
        if any(isinstance(rows[-1].get(name), str) for name in _NUMBER_COLUMNS):
            raise _damaged_line(file, number)
    return header, rows


def _damaged_line(file: Path, number: int) -> DatasetError:
    return DatasetError(f"results file {file} is damaged in line {number}; delete that line or the file")


def _parse_cell(name: str, cell: str) -> Any:
    if name in _TEXT_COLUMNS:
        return cell or None
    return _CONSTANTS[cell] if cell in _CONSTANTS else number_or_text(cell)


def number_or_text(text: str) -> int | float | str:
    """Parse a text as an integer, else as a float, else return it unchanged."""
    for kind in (int, float):
        with contextlib.suppress(ValueError):
            return kind(text)
    return text
