"""Atomic output files: complete, or not written at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vehicle_detection.errors import InvalidInputError


def check_target(target: str | os.PathLike[str], name: str = "target") -> Path:
    """Return the path of a file to write, after checking that its folder exists and is writable."""
    path = Path(target)
    if path.is_dir():
        raise InvalidInputError(f"{name} must be a file, got the folder {path}; add a file name to it")
    if not path.parent.is_dir():
        raise InvalidInputError(f"{name} needs an existing folder, {path.parent} is not one; create it first")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InvalidInputError(f"{name} needs a writable folder, {path.parent} is read-only; choose another")
    return path


@contextlib.contextmanager
def atomic_write(target: str | os.PathLike[str], name: str = "target") -> Iterator[Path]:
    """Yield a temporary path beside `target`, renamed to `target` if the block succeeds.

    After an error or an interrupt, the temporary file is removed and an existing `target` is unchanged. The
    temporary name has the suffix of `target`, which determines the format that many libraries write.
    """
    path = check_target(target, name)
    # The stem is shortened: with additions, it may exceed the limit for file names.
    handle, temporary = tempfile.mkstemp(prefix=f".{path.stem[:32]}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    part = Path(temporary)
    try:
        yield part
        # mkstemp creates private files; give the output the permissions of any new file.
        umask = os.umask(0)
        os.umask(umask)
        part.chmod(0o666 & ~umask)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_parquet(
    path: str | os.PathLike[str], table: Any, *, types: Mapping[str, str] | None = None
) -> None:
    """Write a pandas table, or a mapping of column names to lists of values, as a Parquet file.

    `types` names the Arrow type of each column, such as ``"int64"``; None infers them from the values.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise InvalidInputError(
            "a .parquet file needs pyarrow; pip install 'vehicle-detection[parquet]', or write .csv"
        ) from None
    schema = None if types is None else pyarrow.schema(list(types.items()))
    with atomic_write(path, "path") as part:
        pyarrow.parquet.write_table(pyarrow.table(table, schema=schema), part)
