"""Rides of the data set ``bdd`` that are kept out of training: ``python -m tools.rides DATA``.

Their names are printed, one a line.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

from vehicle_detection.datasets import read_labels

_FIRST = 557
"""Rides at the beginning of the labels, half of which were picked for their content."""

_KEPT = 200


def kept_rides(names: Iterable[object]) -> list[str]:
    """Choose the 200 rides to keep out of training, a nearly random sample of the road.

    Parameters
    ----------
    names
        Names of the frames, one frame a ride, in the order of the labels; a name may occur several times.

    Returns
    -------
    list of str
        Names of those rides after the first 557 whose names have the lowest SHA-256, sorted by it; fewer than
        200 if there are no more.
    """
    rides = list(dict.fromkeys(map(str, names)))[_FIRST:]
    return sorted(rides, key=lambda name: hashlib.sha256(name.encode()).hexdigest())[:_KEPT]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the names."""
    parser = argparse.ArgumentParser(prog="python -m tools.rides", description="Print the kept rides.")
    parser.add_argument("data", metavar="DATA", type=Path, help="data folder with labels/bdd.csv")
    options = parser.parse_args(arguments)
    print("\n".join(kept_rides(read_labels(options.data / "labels" / "bdd.csv")["frame"])))


if __name__ == "__main__":
    main()
