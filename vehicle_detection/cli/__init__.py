"""The command line."""

from __future__ import annotations

import atexit
import gc
import os
import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line."""
    # The compiler brings more than 100,000 objects. Looking for garbage among them at the start and at the
    # end would take a fifth of a short command's time.
    gc.set_threshold(50_000, 20, 20)
    atexit.register(gc.freeze)
    _open_closed_streams()
    # The signals first: importing the commands takes some tenths of a second.
    from vehicle_detection.cli.signals import exit_on_signals

    exit_on_signals()
    from vehicle_detection.cli.app import app

    words = sys.argv[1:]
    if os.name == "nt":  # where shells leave this to programs; patterns are expanded by the commands
        words = [os.path.expandvars(os.path.expanduser(word)) for word in words]
    app(words, prog_name="vehicle-detection", windows_expand_args=False)


def _open_closed_streams() -> None:
    """Open the null device in place of closed standard streams; services may start without them.

    Standard input first, so that each gets its own descriptor: 0, 1 or 2, the lowest that is free.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115
