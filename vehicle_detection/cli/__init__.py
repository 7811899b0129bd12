"""The command line."""

from __future__ import annotations

import atexit
import gc

__all__ = [
    "main",
]


def main() -> None:
    """Run the command line."""
    # The compiler brings more than 100,000 objects. Looking for garbage among them at the start and at the
    # end would take a fifth of a short command's time.
    gc.set_threshold(50_000, 20, 20)
    atexit.register(gc.freeze)
    # The signals first: importing the commands takes some tenths of a second.
    from vehicle_detection.cli.signals import exit_on_signals

    exit_on_signals()
    from vehicle_detection.cli.app import app

    app(prog_name="vehicle-detection")
