"""The command that processes many trips."""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from typer import Argument

import vehicle_detection as vd
from vehicle_detection.cli import common
from vehicle_detection.cli import options as shared
from vehicle_detection.cli.options import flag, option, parse_classes, takes
from vehicle_detection.cli.output import UNKNOWN_LENS, option_names, output_folder, print_error, print_line
from vehicle_detection.errors import InvalidInputError

# Options that have the names of the detector's and of `run_batch`.
_DETECTOR_OPTIONS = "conf", "horizon", "camera", "fov", "camera_height", "every", "blur"
_RUN_OPTIONS = "model", "jobs", "shard", "group", "tracks_only", "preset", "retry_failed", "dry_run"


@dataclass(frozen=True, kw_only=True)
class BatchOptions:
    """Options of ``batch``."""

    output: str = option(
        "DIR|URL",
        "Folder or URL of the results, such as results or s3://fleet/results.",
        "-o",
        "--output",
        default=...,
    )
    sources: list[str] | None = Argument(
        None,
        metavar="SOURCES...",
        help="Video files, folders, quoted patterns and URLs, such as CARD/ or s3://cam/*.mp4.",
    )
    model: str = shared.MODEL
    classes: str | None = shared.CLASSES
    device: str = shared.DEVICE
    conf: float | None = shared.CONFIDENCE
    jobs: int | None = option("N", "Worker processes of one thread, such as 4; default: one per core.")
    shard: str | None = option("I/N", "Process the I-th of N parts, such as 2/8, for job arrays.")
    dask: str | None = option(
        "ADDRESS|local", "Use a Dask cluster, such as tcp://10.0.0.5:8786, or start one here."
    )
    group: str = option("trip|file", "Make consecutive segments one trip, or each file.", default="trip")
    tracks_only: bool = flag("--tracks-only", "Write no videos.")
    horizon: float | None = shared.HORIZON
    camera: str | None = shared.CAMERA
    fov: float | None = shared.FIELD_OF_VIEW
    camera_height: float | None = shared.CAMERA_HEIGHT
    every: int | None = shared.EVERY
    blur: str | None = shared.BLUR
    preset: str = shared.PRESET
    no_audio: bool = shared.NO_AUDIO
    retry_failed: bool = flag("--retry-failed", "Process trips again whose source could not be processed.")
    dry_run: bool = flag("--dry-run", "Only list the trips that would be processed.")
    status: bool = flag("--status", "Only show what has been done.")
    summary: Path | None = option("FILE.csv", "Table with a row for each trip that has been done.")
    quiet: bool = flag("-q", "Print errors only.", "--quiet")


@option_names(out="--output", retry_failed="--retry-failed", dry_run="--dry-run", height_m="--camera-height")
@takes(BatchOptions)
def batch(options: BatchOptions) -> None:
    """Track the vehicles of many videos in parallel; run again to do what is missing or changed."""
    output, summary = options.output, options.summary
    if summary is not None:
        common.check_suffix(summary, "--summary", (".csv",))
        if options.dry_run:
            raise InvalidInputError("--dry-run has no results for --summary; omit one of them")
    if options.status:
        print_line(str(vd.drive.batch_status(output)))
        _write_summary(output, summary)
        return
    if not options.sources:
        raise InvalidInputError("SOURCES... must name at least one video, folder, pattern or URL")
    done = _run(options, options.sources)
    if options.dry_run:
        for trip in done.planned or ():
            start = (trip["start"] or "unknown start").replace("T", " ")
            files = common.pluralize(len(trip["files"]), "file")
            first = common.encodable(common.hide_credentials(trip["files"][0]))
            results = common.pluralize(len(trip["replaces"]), "earlier result")
            replaced = f", replaces {results}" if trip["replaces"] else ""
            print_line(f"{start}  {trip['camera']}  {files} from {first}{replaced}")
        print_line(str(done))
        return
    _write_summary(output, summary)
    if not options.quiet:
        if done.done and options.camera is None and options.fov is None:
            print_error(UNKNOWN_LENS)
        print_line(str(done))
        print_line(f"wrote {common.hide_credentials(output)}" + (f", {summary}" if summary else ""))
    if done.errors:  # the machine's fault: a job that is started again does the rest
        raise typer.Exit(1)


def _run(options: BatchOptions, sources: list[str]) -> Any:
    """Process the trips of the sources, on a Dask cluster if one is named."""
    detector: dict[str, Any] = {name: getattr(options, name) for name in _DETECTOR_OPTIONS}
    detector |= {"classes": parse_classes(options.classes)}
    detector |= {} if options.device == "cpu" else {"device": options.device}
    with contextlib.ExitStack() as stack:
        executor = None
        if options.dask is not None and not options.dry_run:
            executor, dashboard = stack.enter_context(vd.drive.open_dask(options.dask, options.jobs))
            if not options.quiet:
                print_line(f"dashboard {dashboard}")
        folder = common.local_path(options.output)
        if folder and not options.dry_run and not common.is_url(folder):
            stack.enter_context(output_folder(Path(folder), "--output"))
        shown = not options.quiet
        return vd.run_batch(
            sources,
            options.output,
            executor,
            options={name: value for name, value in detector.items() if value is not None},
            audio=not options.no_audio,
            progress=shown,
            on_record=functools.partial(_print_record, done=shown and not sys.stderr.isatty()),
            **{name: getattr(options, name) for name in _RUN_OPTIONS},
        )


def _print_record(record: Mapping[str, Any], *, done: bool) -> None:
    """Warn of a trip without results; with `done` also print others, for logs, which show no progress bar."""
    source = record["sources"][0]["uri"]
    # A log that cannot be written does not end the batch.
    with contextlib.suppress(OSError, ValueError):
        if record["status"] != "done":
            print_error(f"warning: {vd.drive.with_source(source, record['message'])}")
        elif done:
            name = common.encodable(common.hide_credentials(source))
            print_error(f"done: {name}, {common.pluralize(record['frames'], 'frame')}")


def _write_summary(output: str, summary: Path | None) -> None:
    """Write the table of all trips of a batch."""
    if summary is not None:
        table = vd.drive.batch_summary(output).map(
            lambda cell: common.spreadsheet_text(cell) if isinstance(cell, str) else cell
        )
        with common.atomic_write(summary, "--summary") as part:
            table.to_csv(part, index=False)
