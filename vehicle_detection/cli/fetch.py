"""The command that downloads the course's training patches."""

from __future__ import annotations

import sys
from pathlib import Path

from vehicle_detection.cli.options import option
from vehicle_detection.cli.output import output_folder, print_line


def fetch(
    output: Path | None = option(
        None, "DIR", "Folder, such as data; default: the user's cache.", "-o", "--output"
    ),
) -> None:
    """Download the course's training patches (110 MB) once."""
    from vehicle_detection.datasets import fetch_patches

    with output_folder(output, "--output"):
        paths = fetch_patches(output, progress=sys.stderr.isatty())
    for path in paths:
        print_line(str(path))
