"""Tables of results: reading and writing, the Pareto front, and a row store that survives a killed run."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import atomic_write, check, check_suffix, import_pyarrow
from vehicle_detection.errors import DatasetError, InvalidInputError

if TYPE_CHECKING:
    from pandas import DataFrame


def make_table(rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> DataFrame:
    """Build a table; None becomes NaN, and a column without any value is float64."""
    import pandas as pd

    table = pd.DataFrame([dict(row) for row in rows], columns=columns)
    return table.astype({name: np.float64 for name in table if table[name].isna().all()})


def check_column(table: DataFrame, name: object) -> None:
    """Raise unless `table` is a pandas table with the column."""
    import pandas as pd

    remedy = "pass what compare_configurations or read_results returns"
    check.instance(table, "table", pd.DataFrame, remedy)
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
    suffix = check_suffix(path, "path", (".csv", ".jsonl", ".parquet")).suffix.lower()
    if suffix == ".parquet":
        import_pyarrow()
        # A Parquet column has one type, but hog_channel is 0 or "ALL": write mixed columns as text.
        mixed = [name for name in table if table[name].dropna().map(type).nunique() > 1]
        table = table.assign(**{name: table[name].map(str, na_action="ignore") for name in mixed})
    with atomic_write(path, "path") as part:
        if suffix == ".csv":
            table.to_csv(part, index=False, lineterminator="\n")
        elif suffix == ".parquet":
            table.to_parquet(part, index=False)
        else:
            text = "".join(map(_format_row, table.to_dict("records")))
            part.write_text(text, encoding="utf-8", newline="\n")


def check_replaceable(path: str | os.PathLike[str], name: str) -> None:
    """Raise if a table cannot be written there: without pyarrow, or in place of a file of another kind."""
    file = Path(path)
    pyarrow = import_pyarrow() if file.suffix.lower() == ".parquet" else None
    if not file.is_file() or not file.stat().st_size:
        return
    try:
        columns = set(read_results(file) if pyarrow is None else pyarrow.parquet.read_schema(file).names)
    except (DatasetError, OSError, ValueError):
        columns = set()
    if not any(own <= columns for own in ({"configuration", "accuracy"}, {"scales", "f1"})):
        raise InvalidInputError(f"{name} {file} exists and is no table of tune; choose another file")


def read_results(path: str | os.PathLike[str]) -> DataFrame:
    """Read the table of a finished or interrupted run: the ``store`` of a comparison, or a written table.

    Returns one row per line of the ``.csv`` or ``.jsonl`` file; see `compare_configurations` for the columns.
    NaN marks a missing value. An incomplete last line of ``.jsonl`` is left out, and so is the second row of
    a trial that two runs have measured at the same time; another damaged line raises a `DatasetError`.

    >>> import tempfile
    >>> import pandas as pd
    >>> table = pd.DataFrame({"configuration": ["a"], "accuracy": [0.98]})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     table.to_csv(f"{folder}/table.csv", index=False)
    ...     read_results(f"{folder}/table.csv")
      configuration  accuracy
    0             a      0.98
    """
    import pandas as pd

    file = check.path(path)
    if file.suffix.lower() not in (".csv", ".jsonl"):
        raise InvalidInputError(f"path must end in .csv or .jsonl; got {file.name!r}")
    if not file.is_file():
        raise DatasetError(f"results file {file} does not exist; check the path")
    if file.suffix.lower() == ".csv":
        try:
            return pd.read_csv(file, dtype={"trial": str})
        except ValueError as error:  # also of the parser, and of bytes that are not UTF-8
            raise DatasetError(f"results file {file} is not a table: {error}") from error
    table = make_table(_read_lines(file)[1])
    return table.drop_duplicates("trial", ignore_index=True) if "trial" in table else table


class RowStore(dict[str, Mapping[str, Any]]):
    """Rows by their ``trial``; each new one is appended to a file and synced to disk at once.

    `path` is a ``.jsonl`` file, read first if it exists; None keeps the rows in memory only.
    """

    def __init__(self, path: str | os.PathLike[str] | None, columns: Sequence[str]) -> None:
        super().__init__()
        self._columns = tuple(columns)
        self._path = None if path is None else check_suffix(path, "store", (".jsonl",))
        if self._path is None or not self._path.exists():
            return
        start = json.dumps({self._columns[0]: ""})[:-3].encode()
        is_own = start.startswith(self._path.read_bytes()[: len(start)])
        text, rows = _read_lines(self._path) if is_own else (b"", [])
        if not is_own or any(tuple(row) != self._columns for row in rows):
            raise DatasetError(
                f"store {self._path} is not a table of trials, or of another release; choose another file"
            )
        # Remove an incomplete last line: the next row would be appended to it.
        os.truncate(self._path, len(text))
        self.update({str(row["trial"]): row for row in rows})

    def add(self, row: Mapping[str, Any]) -> None:
        """Store a finished row."""
        self[row["trial"]] = row
        if self._path is not None:
            with self._path.open("ab") as file:
                file.write(_format_row({name: row.get(name) for name in self._columns}).encode())
                file.flush()
                os.fsync(file.fileno())


def _format_row(row: Mapping[Any, Any]) -> str:
    """Format a row as a line of JSON, in which NaN is null."""
    values = {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in row.items()
    }
    return json.dumps(values, ensure_ascii=False, default=np.generic.item) + "\n"


def _read_lines(file: Path) -> tuple[bytes, list[dict[str, Any]]]:
    """Bytes and rows of a file up to its last line break: a killed writer leaves an incomplete line."""
    data = file.read_bytes()
    text, rows = data[: data.rfind(b"\n") + 1], []
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            row = None
        if not isinstance(row, dict):
            raise DatasetError(
                f"results file {file} is damaged in line {number}; delete that line or the file"
            )
        rows.append(row)
    return text, rows
