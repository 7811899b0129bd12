"""``python -m benchmarks [NAME...]``: run benchmarks, print the table and write the JSON file."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from benchmarks import (
    _accuracy,
    _batch,
    _compare,
    _cuts,
    _drives,
    _features,
    _fleet,
    _frames,
    _lenses,
    _limits,
    _memory,
    _peers,
    _quality,
    _scaling,
    _search,
    _startup,
    _truth,
    _video,
    _wrappers,
)
from benchmarks._material import DATA_VARIABLE, Context, is_real
from benchmarks._report import Row, print_table, write_json

BENCHMARKS: dict[str, Callable[[Context], list[Row]]] = {
    "search": _search.run,
    "video": _video.run,
    "limits": _limits.run,
    "quality": _quality.run,
    "memory": _memory.run,
    "features": _features.run,
    "startup": _startup.run,
    "accuracy": _accuracy.run,
    "frames": _frames.run,
    "drives": _drives.run,
    "lenses": _lenses.run,
    "cuts": _cuts.run,
    "truth": _truth.run,
    "batch": _batch.run,
    "fleet": _fleet.run,
    "scaling": _scaling.run,
    "wrappers": _wrappers.run,
    "peers": _peers.run,
}

ON_REQUEST = {"peers"}
"""Benchmarks that run only by name: this one installs packages."""

OUTPUT = Path(__file__).with_name("results.json")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the named benchmarks, by default all but those on request."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BENCHMARKS) + "; truth: folders")
    parser.add_argument(
        "--long", action="store_true", help="memory: also a run of 3,000 frames; batch: three rounds"
    )
    parser.add_argument("--plots", type=Path, metavar="DIR", help="scaling: write scaling.png to this folder")
    parser.add_argument(
        "--seeds", type=int, default=1, metavar="N", help="drives, lenses: drives of each kind"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="drives, lenses, truth: number of processes"
    )
    parser.add_argument("--fps", type=float, metavar="N", help="truth: frame rate of the sequences")
    parser.add_argument("--compare", metavar="REF", help="only compare the speed with another commit's")
    parser.add_argument("--output", type=Path, default=OUTPUT, metavar="FILE", help="the JSON file to write")
    options = parser.parse_args(arguments)
    folders = {name for name in options.names if name not in BENCHMARKS and Path(name).is_dir()}
    unknown = sorted(set(options.names) - set(BENCHMARKS) - folders)
    if unknown:
        parser.error(f"no benchmark {unknown[0]!r}; choose from {', '.join(BENCHMARKS)}")
    for name in ("seeds", "jobs"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} must be at least 1, got {getattr(options, name)}")

    # Files and pipes have no width; this one fits the longest rows.
    console = Console(width=None if sys.stdout.isatty() else 112)
    if not is_real():
        console.print(f"{DATA_VARIABLE} is not set: using rendered images, without verdicts on quality")
    results = {}
    with tempfile.TemporaryDirectory(prefix="benchmarks") as work:
        context = Context(
            Path(work),
            plots=options.plots,
            long=options.long,
            seeds=options.seeds,
            jobs=options.jobs,
            sequences=[Path(name) for name in options.names if name in folders],
            fps=options.fps,
        )
        if options.compare:
            print_table({"compare": _compare.compare(context, options.compare)}, console)
            return
        names = [name for name in options.names if name not in folders]
        if folders and "truth" not in names:
            names.append("truth")
        for name in names or [name for name in BENCHMARKS if name not in ON_REQUEST]:
            console.print(f"measuring {name} ...", highlight=False)
            results[name] = BENCHMARKS[name](context)
    print_table(results, console)
    write_json(results, options.output)


if __name__ == "__main__":
    main()
