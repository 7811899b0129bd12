"""Signals that end a command: it removes unfinished files, and exits with 128 plus the signal's number."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

# SIGHUP: the terminal was closed. SIGBREAK: Ctrl-Break on Windows, and the end of its terminal.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
_ENDING_SIGNALS = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
# Seconds after a signal in which others are ignored, so that a second Ctrl-C does not interrupt the cleanup.
_CLEANUP_SECONDS = 1.0


class Interrupted(KeyboardInterrupt):
    """A signal has arrived; `code` is the exit code for it."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.code = 128 + number


def exit_on_signals() -> None:
    """Exit at once on a signal: for the start, when nothing needs to be cleaned up."""
    _set_handlers(_exit)


@contextlib.contextmanager
def raise_on_signals() -> Iterator[None]:
    """Raise `Interrupted` in the block; after it, ignore signals if the start's handlers were active."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    last = -_CLEANUP_SECONDS

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal last
        # Importing it takes tenths of a second; while it is imported, it has no such function.
        postpone = getattr(sys.modules.get("vehicle_detection._common.signals"), "postpone", None)
        if postpone is not None and postpone(number, frame):
            return
        previous, last = last, time.monotonic()
        if last - previous > _CLEANUP_SECONDS:
            raise Interrupted(number)

    before = _set_handlers(interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if handler is _exit else handler)


def _set_handlers(handler: signal._HANDLER) -> dict[int, signal._HANDLER]:
    """Set the handler of all signals that are not ignored, as by nohup; return the earlier ones."""
    before: dict[int, signal._HANDLER] = {}
    for number in _ENDING_SIGNALS:
        if signal.getsignal(number) not in (signal.SIG_IGN, None):
            before[number] = signal.signal(number, handler)
    return before


def _exit(number: int, frame: FrameType | None) -> NoReturn:
    os.write(2, b"interrupted\n")
    os._exit(128 + number)
