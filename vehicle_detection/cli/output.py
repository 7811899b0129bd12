"""What the command line writes: lines, tables, folders that go again if nothing came of them."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

import typer

from vehicle_detection.errors import InvalidInputError

Result = TypeVar("Result")

# Wide enough for a fingerprint: a table in a file or pipe is not to be folded.
_PIPE_WIDTH = 120


def print_error(message: str) -> None:
    """Write one line to standard error, whatever line breaks the message has."""
    typer.echo(" ".join(message.split()), err=True)


def print_table(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table; columns of numbers stand to the right."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for column, head in enumerate(heads):
        numeric = all(row[column].replace(",", "").rstrip("%").replace(".", "").isdigit() for row in rows)
        table.add_column(head, justify="right" if numeric and rows else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH, highlight=False, markup=False).print(table)


def print_facts(title: str, facts: Mapping[str, Any]) -> None:
    """Print a title, and under it names and values in two columns."""
    typer.secho(title, bold=True)
    width = max(map(len, facts), default=0)
    for name, value in facts.items():
        nested = isinstance(value, Mapping)
        text = ", ".join(f"{key} {entry}" for key, entry in value.items()) if nested else str(value)
        typer.echo(f"  {name:<{width}}  {text}")


def check_distinct_paths(targets: Mapping[str, Path], sources: Mapping[str, Path]) -> None:
    """Refuse a target that is a source, or another target."""
    seen = {path.resolve(): f"{name} {path}" for name, path in sources.items()}
    for name, path in targets.items():
        other = seen.setdefault(path.resolve(), f"{name} {path}")
        if other != f"{name} {path}":
            raise InvalidInputError(f"{name} {path} is {other} as well; choose another name")


@contextlib.contextmanager
def capture_stderr() -> Iterator[list[str]]:
    """Collect what image codecs, being no Python, write to standard error; the list is filled at the end."""
    lines: list[str] = []
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with tempfile.TemporaryFile() as file:
            os.dup2(file.fileno(), 2)
            try:
                yield lines
            finally:
                os.dup2(kept, 2)
            file.seek(0)
            lines += file.read().decode("utf-8", "replace").splitlines()
    finally:
        os.close(kept)


@contextlib.contextmanager
def output_folder(folder: Path | None, option: str) -> Iterator[None]:
    """Make a folder for results; after an error or an interrupt it goes again, unless something is in it."""
    if folder is None:
        yield
        return
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"{option} must be a folder, {folder} cannot be made: {error.strerror}; choose another"
        ) from error
    try:
        yield
    except BaseException:
        for path in made:
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def interruptible(function: Callable[[], Result]) -> Result:
    """Call a function that computes for long without listening, so that Ctrl-C takes effect at once.

    The solver of the SVM does not return to Python for seconds. It runs in a thread that the process does not
    wait for: nothing that must be tidied up belongs in `function`.
    """
    outcome: Future[Result] = Future()

    def work() -> None:
        try:
            outcome.set_result(function())
        except BaseException as error:
            outcome.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    return outcome.result()
