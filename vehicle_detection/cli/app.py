"""The command line ``vehicle-detection``: its commands, and errors as one line with an exit code.

Commands import heavy libraries when they run, so that ``--help`` is fast.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer
from typer import Option
from typer.core import TyperArgument, TyperCommand, TyperGroup

from vehicle_detection import __version__
from vehicle_detection.cli.batch import batch
from vehicle_detection.cli.demo import demo
from vehicle_detection.cli.detect import detect
from vehicle_detection.cli.evaluate import evaluate
from vehicle_detection.cli.hints import hint_command, hint_option, hint_value
from vehicle_detection.cli.info import info
from vehicle_detection.cli.output import (
    exit_if_abandoned,
    print_error,
    print_warnings,
    rename_argument,
    replace_unprintable,
)
from vehicle_detection.cli.signals import raise_on_signals
from vehicle_detection.cli.train import fetch, train
from vehicle_detection.cli.train_frames import train_frames
from vehicle_detection.cli.tune import tune
from vehicle_detection.cli.video import video
from vehicle_detection.errors import DatasetError, InvalidInputError, VehicleDetectionError

BAD_INPUT, INTERRUPTED = 2, 130  # exit codes
_MAX_LISTED = 120  # characters of a message that lists surplus arguments

# Raised for an unknown command or option, or a value of another type; typer has no public name for it.
_UsageError: type[Any] = typer.BadParameter.__bases__[0]


@contextlib.contextmanager
def _print_usage_error() -> Iterator[None]:
    """Print an error in how a command is called as one line, instead of a box, and exit."""
    try:
        yield
    except _UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            raise
        message = " ".join(error.format_message().split()).rstrip(".").partition(", unable to parse")[0]
        hint = _find_hint(error)
        if hint:  # a better one
            message = re.sub(r" \(Possible options:.*?\)| Did you mean .*", "", message).rstrip(".")
        command = "vehicle-detection" if error.ctx is None else error.ctx.command_path
        if "unexpected extra argument" in message and command.endswith(" video"):
            # Such as the files of a pattern that the shell has expanded, of which there may be thousands.
            message = textwrap.shorten(message, _MAX_LISTED, placeholder=" ...)")
            message += (
                "; SOURCE is one argument: for several files, pass their folder or a quoted pattern, such as "
                "'CARD/*.MP4'"
            )
        print_error(f"error: {'; '.join(filter(None, (message, hint)))}; see {command} --help")
        raise typer.Exit(BAD_INPUT) from None


def _find_hint(error: Any) -> str:
    """Return what to write instead of the wrong command, option or value."""
    context, param = error.ctx, getattr(error, "param", None)
    if context is None:
        return ""
    if param is not None:
        return hint_value(param)
    if hasattr(error, "option_name"):
        return hint_option(error.option_name, context.command.params)
    found = re.match(r"No such command '(.*?)'", error.format_message())
    return hint_command(found[1], context.command.list_commands(context)) if found else ""


def _is_folder_gone() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


@contextlib.contextmanager
def _print_system_errors() -> Iterator[None]:
    """Print an error of the system as one line, and exit."""
    try:
        yield
    except OSError as error:  # such as a full disk
        if error.errno == errno.EPIPE:
            raise
        reason = error.strerror or str(error)
        if error.errno == errno.ENOENT and error.filename is None and _is_folder_gone():
            reason = "the current folder has been removed; change to another one"
        print_error(f"error: {error.filename}: {reason}" if error.filename else f"error: {reason}")
    except MemoryError:
        print_error("error: memory ran out; close other programs, or use fewer --jobs and smaller files")
    except RuntimeError as error:
        if "can't start new thread" not in str(error):
            raise
        print_error(
            "error: the system refuses to start another thread; close other programs, or raise the limit of "
            "processes (ulimit -u)"
        )
    else:
        return
    raise typer.Exit(BAD_INPUT)


# What typer does by pydantic, whose import takes a tenth of a second, a sixth of `detect` of an image.
_CONVERTERS: dict[Any, Callable[[Any], Any]] = {str: str, int: int, float: float, Path: Path}
_CONVERTERS |= {kind | None: convert for kind, convert in _CONVERTERS.items()} | {list[str]: list}


def _process_value(
    param: Any, convert: Callable[[Any], Any] | None, by_typer: Callable[..., Any], ctx: Any, value: Any
) -> Any:
    """Convert the value of a parameter; typer does it where the conversion fails, to report that."""
    if value is None and not param.required:
        converted: Any = () if param.multiple or param.nargs == -1 else None
    elif convert is None or (param.required and not value):
        return by_typer(ctx, value)
    else:
        try:
            converted = convert(value)
        except (TypeError, ValueError):
            return by_typer(ctx, value)
    return converted if param.callback is None else param.callback(ctx, param, converted)


def _convert_quickly(command: Any, ctx: Any) -> None:
    """Convert the values of a command's parameters by the types of its function."""
    hints = get_type_hints(command.callback)
    for param in command.get_params(ctx):
        convert, by_typer = _CONVERTERS.get(hints.get(param.name)), type(param).process_value.__get__(param)
        param.process_value = functools.partial(_process_value, param, convert, by_typer)


class _Command(TyperCommand):
    """A command whose help lists the options of each panel under its name."""

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        _convert_quickly(self, ctx)
        return super().parse_args(ctx, args)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        panels: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            if (record := param.get_help_record(ctx)) is None:
                continue
            if isinstance(param, TyperArgument):  # without its type
                panels.setdefault("Arguments", []).append((str(param.metavar), record[1]))
            else:
                panels.setdefault(getattr(param, "rich_help_panel", None) or "Options", []).append(record)
        for title, records in panels.items():
            with formatter.section(title):
                formatter.write_dl(records)


class _Commands(TyperGroup):
    """Commands whose expected errors become one line on standard error."""

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        _convert_quickly(self, ctx)
        return super().parse_args(ctx, args)

    def make_context(self, *args: Any, **options: Any) -> Any:
        with _print_system_errors(), _print_usage_error():
            return super().make_context(*args, **options)

    def invoke(self, ctx: Any) -> Any:
        replace_unprintable()
        try:
            with _print_system_errors(), raise_on_signals(), print_warnings(), _print_usage_error():
                return super().invoke(ctx)
        except VehicleDetectionError as error:
            message = str(error)
            if isinstance(error, (InvalidInputError, DatasetError)):
                message = rename_argument(message, self._option_names(ctx))
            print_error(f"error: {message}")
            raise typer.Exit(BAD_INPUT) from None
        except KeyboardInterrupt as error:
            print_error(f"interrupted{error}")
            code = getattr(error, "code", INTERRUPTED)
            exit_if_abandoned(code)
            raise typer.Exit(code) from None

    def _option_names(self, ctx: Any) -> dict[str, str]:
        """Map the arguments of the command's function to the names that its user knows."""
        command = self.get_command(ctx, ctx.invoked_subcommand)
        return {
            param.name: str(param.metavar) if isinstance(param, TyperArgument) else param.opts[-1]
            for param in (command.params if command else ())
            if param.name
        }


app = typer.Typer(
    cls=_Commands,
    help="Detect and track vehicles in dash-cam images and video.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # rich takes longer to import than the help to print
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _global_options(
    version: Annotated[
        bool, Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


for _command in (demo, detect, video, evaluate, batch, train, train_frames, tune, fetch, info):
    app.command(cls=_Command)(_command)
