"""Output of the commands: lines, tables, files and folders, and errors that name options."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Literal, TypeVar

import typer

from vehicle_detection.cli import common
from vehicle_detection.errors import DatasetError, InvalidInputError, VehicleDetectionError

# Printed where distances are shown although nothing is known of the lens.
UNKNOWN_LENS = (
    "warning: distances assume a lens of 58 degrees, and may be wrong by a factor of 2 or more; "
    "pass --fov or --camera"
)
DAMAGED = 3  # exit code of a command that left out what it could not decode

Result = TypeVar("Result")

# Name of a thread that `run_interruptible` has abandoned, and seconds that it waits at a time.
_ABANDONED, _WAIT = "abandoned", 0.2

# Width of tables that are not printed to a terminal; fits a fingerprint in one line.
_PIPE_WIDTH = 120


def replace_unprintable() -> None:
    """Print ``?`` for what standard output cannot encode, such as a file name that is not UTF-8."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="replace")


# Characters that move the cursor, change colors or reverse the order of others.
_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    r"""Return text that does nothing in a terminal: control characters become ``\x1b`` and the like."""
    return _CONTROLS.sub(lambda found: ascii(found[0])[1:-1], text)


def print_line(text: str, *, err: bool = False, bold: bool = False) -> None:
    """Print a text; in a terminal, above progress bars."""
    stream = sys.stderr if err else sys.stdout
    tqdm = sys.modules.get("tqdm")  # unless it is imported, there is no bar
    bars = tqdm is not None and stream is not None and stream.isatty()  # None: closed
    with tqdm.tqdm.external_write_mode(stream) if bars else contextlib.nullcontext():  # type: ignore[union-attr]
        typer.echo(typer.style(printable(text), bold=True) if bold else printable(text), err=err)


def print_error(message: str) -> None:
    """Print one line to standard error, without the line breaks of the message."""
    print_line(" ".join(message.split()), err=True)


class _LogPrinter(logging.Handler):
    """Prints the library's warnings, and notes of less importance, each text once."""

    def __init__(self) -> None:
        super().__init__()
        self._printed: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        message, kind = record.getMessage(), "warning" if record.levelno >= logging.WARNING else "note"
        if message not in self._printed:
            self._printed.add(message)
            with contextlib.suppress(OSError, ValueError):  # what cannot be printed does not end the work
                print_error(f"{kind}: {message}")


@contextlib.contextmanager
def print_warnings() -> Iterator[None]:
    """Print the warnings that the library logs in the block, one line each."""
    logger = logging.getLogger("vehicle_detection")
    # A terminal also shows that kernels are compiled, because that takes long; elsewhere, the progress of a
    # video is printed once a minute in place of a bar.
    notes = logger.getChild("_kernels" if sys.stderr.isatty() else "video.engine")
    printer, level = _LogPrinter(), notes.level
    logger.addHandler(printer)
    notes.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(printer)
        notes.setLevel(level)


def rename_argument(message: str, options: Mapping[str, str]) -> str:
    """Replace the library's argument at the start of an error message by the command's option."""
    argument, space, rest = message.partition(" ")
    return f"{options.get(argument, argument)}{space}{rest}"


@contextlib.contextmanager
def option_names(**options: str) -> Iterator[None]:
    """Name the options of arguments in errors; for options named differently from the library's arguments."""
    try:
        yield
    except (InvalidInputError, DatasetError) as error:
        raise type(error)(rename_argument(str(error), options)) from None


def print_table(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table, with columns of numbers aligned to the right."""
    from rich import box
    from rich.cells import cell_len
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH, highlight=False, markup=False)
    rows = [[printable(cell) for cell in row] for row in rows]
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    columns = list(zip(heads, *rows))
    # Lines break at spaces only, if the longest words fit beside each other.
    words = [
        max((cell_len(word) for cell in column for word in cell.split()), default=0) for column in columns
    ]
    fit = sum(words) + 3 * len(words) < console.width
    for (head, *cells), longest in zip(columns, words):
        numeric = all(cell.replace(",", "").rstrip("%").replace(".", "").isdigit() for cell in cells)
        justify: Literal["left", "right"] = "right" if numeric and rows else "left"
        table.add_column(head, justify=justify, overflow="fold", min_width=longest if fit else None)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def print_facts(title: str, facts: Mapping[str, Any]) -> None:
    """Print a title, and below it names and values in two columns."""
    print_line(title, bold=True)
    width = max(map(len, facts), default=0)
    for name, value in facts.items():
        nested = isinstance(value, Mapping)
        text = ", ".join(f"{key} {entry}" for key, entry in value.items()) if nested else str(value)
        print_line(f"  {name:<{width}}  {text}")


def refuse_if(wrong: object, message: str) -> None:
    """Refuse options that do not fit each other."""
    if wrong:
        raise InvalidInputError(message)


def check_targets(targets: Mapping[str, Path | None], sources: Mapping[str, Path]) -> list[Path]:
    """Refuse targets that cannot be written or are also a source or another target; return those named."""
    named = {name: common.check_target(path, name) for name, path in targets.items() if path is not None}
    check_distinct_paths(named, sources)
    return list(named.values())


def check_distinct_paths(targets: Mapping[str, Path | None], sources: Mapping[str, Path]) -> None:
    """Refuse a target that is also a source or another target."""
    seen = {_file_key(path): f"{name} {path}" for name, path in sources.items()}
    for name, path in targets.items():
        if path is None:
            continue
        other = seen.setdefault(_file_key(path), f"{name} {path}")
        if other != f"{name} {path}":
            raise InvalidInputError(f"{name} {path} is also {other}; choose another name")


def _file_key(path: Path) -> tuple[int, int] | str:
    """Return a key that all names of a file have, such as ``A.csv`` and ``a.csv`` on some disks."""
    with contextlib.suppress(OSError):  # it is missing, or a loop of links
        status = path.stat()
        if status.st_ino:
            return status.st_dev, status.st_ino
    # Not Path.resolve, which raises RuntimeError for a loop of links.
    return os.path.normcase(os.path.realpath(path))


def announce_replaced(targets: Iterable[Path | None]) -> None:
    """Print which targets exist, before the work starts: there is time to interrupt it."""
    existing = [str(path) for path in targets if path is not None and path.is_file()]
    if existing:
        print_error(f"note: {' and '.join(existing)} will be replaced when the new file is complete")


@contextlib.contextmanager
def name_kept_files(outputs: Iterable[Path | None]) -> Iterator[None]:
    """Add to an error or interrupt in the block which of the output files the block has completed."""
    before = {path: _identity(path) for path in outputs if path is not None}
    try:
        yield
    except (VehicleDetectionError, KeyboardInterrupt) as error:
        kept = [str(path) for path, identity in before.items() if _identity(path) not in (None, identity)]
        if not kept:
            raise
        *others, last = kept
        note = f"{', '.join(others)} and {last} are" if others else f"{last} is"
        message = f"{error}; {note} complete and kept"
        if isinstance(error, KeyboardInterrupt):
            error.args = (message,)  # it has an exit code, which a new one would lack
            raise
        raise type(error)(message) from error


def _identity(path: Path) -> tuple[int, int] | None:
    """Values that differ after a file was replaced; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_ino, status.st_mtime_ns) if path.is_file() else None


@contextlib.contextmanager
def capture_stderr() -> Iterator[list[str]]:
    """Collect the lines that C libraries, such as image codecs, write to standard error in the block."""
    lines: list[str] = []
    sys.stderr.flush()
    original = os.dup(2)
    try:
        with tempfile.TemporaryFile() as file:
            os.dup2(file.fileno(), 2)
            try:
                yield lines
            finally:
                os.dup2(original, 2)
            file.seek(0)
            lines += file.read().decode("utf-8", "replace").splitlines()
    finally:
        os.close(original)


@contextlib.contextmanager
def output_folder(folder: Path | None, option: str) -> Iterator[None]:
    """Create a folder for results; after an error or an interrupt, remove it again if it is empty."""
    if folder is None:
        yield
        return
    common.check.path(folder, option, kind="a folder")
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    common.make_folder(folder, option)
    try:
        if not os.access(folder, os.W_OK | os.X_OK):
            problem = f"{folder} is read-only; choose another"
            raise InvalidInputError(f"{option} needs a writable folder, {problem}")
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for path in created:
                path.rmdir()
        raise


def run_interruptible(function: Callable[[], Result]) -> Result:
    """Call a function that computes for seconds without returning to Python, so that Ctrl-C acts at once.

    After an interrupt its thread is abandoned, so `function` must not need any cleanup.
    """
    outcome: Future[Result] = Future()

    def work() -> None:
        try:
            outcome.set_result(function())
        except BaseException as error:
            outcome.set_exception(error)

    thread = threading.Thread(target=work, daemon=True)
    try:
        thread.start()
        while thread.is_alive():  # a signal that arrives right before the wait does not end it
            thread.join(_WAIT)
        return outcome.result()
    except BaseException:
        if not outcome.done():
            thread.name = _ABANDONED
        raise


def exit_if_abandoned(code: int) -> None:
    """End Python at once if `run_interruptible` has abandoned its thread.

    Otherwise Python would wait for the threads that it has started, or abort when it ends them.
    """
    if any(thread.name == _ABANDONED for thread in threading.enumerate()):
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)
