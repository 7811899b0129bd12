"""The command line."""

from __future__ import annotations

__all__ = [
    "main",
]


def main() -> None:
    """Run the command line."""
    # The signals first: importing the commands takes some tenths of a second.
    from vehicle_detection.cli.signals import exit_on_signals

    exit_on_signals()
    from vehicle_detection.cli.app import app

    app(prog_name="vehicle-detection")
