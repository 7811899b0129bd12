"""The command line."""

from vehicle_detection.cli.app import main

__all__ = [
    "main",
]
