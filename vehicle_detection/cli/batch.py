"""The command that processes many trips."""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument

from vehicle_detection.cli.options import (
    Blur,
    CameraHeight,
    CameraName,
    Classes,
    Confidence,
    Device,
    Every,
    FieldOfView,
    Horizon,
    Model,
    NoAudio,
    Preset,
    flag,
    option,
    parse_classes,
)
from vehicle_detection.cli.output import (
    UNKNOWN_LENS,
    option_names,
    output_folder,
    print_error,
    print_line,
)
from vehicle_detection.errors import InvalidInputError


@option_names(
    out="--output",
    retry_failed="--retry-failed",
    dry_run="--dry-run",
    field_of_view="--fov",
    camera_height_m="--camera-height",
)
def batch(
    output: Annotated[
        str,
        option(
            "DIR|URL",
            "Folder or URL of the results, such as results or s3://fleet/results.",
            "-o",
            "--output",
        ),
    ],
    sources: Annotated[
        list[str] | None,
        Argument(
            metavar="SOURCES...",
            help="Video files, folders, quoted patterns and URLs, such as CARD/ or s3://cam/*.mp4.",
        ),
    ] = None,
    model: Model = "default",
    classes: Classes = None,
    device: Device = "cpu",
    conf: Confidence = None,
    jobs: Annotated[
        int | None, option("N", "Worker processes of one thread, such as 4; default: one per core.")
    ] = None,
    shard: Annotated[
        str | None, option("I/N", "Process the I-th of N parts, such as 2/8, for job arrays.")
    ] = None,
    dask: Annotated[
        str | None,
        option("ADDRESS|local", "Use a Dask cluster, such as tcp://10.0.0.5:8786, or start one here."),
    ] = None,
    group: Annotated[str, option("trip|file", "Make consecutive segments one trip, or each file.")] = "trip",
    tracks_only: Annotated[bool, flag("--tracks-only", help="Write no videos.")] = False,
    horizon: Horizon = None,
    camera: CameraName = None,
    fov: FieldOfView = None,
    camera_height: CameraHeight = None,
    every: Every = None,
    blur: Blur = None,
    preset: Preset = "veryfast",
    no_audio: NoAudio = False,
    retry_failed: Annotated[
        bool, flag("--retry-failed", help="Process trips again whose source could not be processed.")
    ] = False,
    dry_run: Annotated[bool, flag("--dry-run", help="Only list the trips that would be processed.")] = False,
    status: Annotated[bool, flag("--status", help="Only show what has been done.")] = False,
    summary: Annotated[
        Path | None, option("FILE.csv", "Table with a row for each trip that has been done.")
    ] = None,
    quiet: Annotated[bool, flag("-q", "--quiet", help="Print errors only.")] = False,
) -> None:
    """Track the vehicles of many videos in parallel; run again to do what is missing or changed."""
    if summary is not None:
        from vehicle_detection._common import check_suffix

        check_suffix(summary, "--summary", (".csv",))
        if dry_run:
            raise InvalidInputError("--dry-run has no results for --summary; omit one of them")
    if status:
        from vehicle_detection.batch import batch_status

        print_line(str(batch_status(output)))
        _write_summary(output, summary)
        return
    if not sources:
        raise InvalidInputError("SOURCES... must name at least one video, folder, pattern or URL")
    from vehicle_detection._common import hide_credentials, is_url, local_path
    from vehicle_detection.batch import open_dask, run_batch

    options: dict[str, Any] = {
        "classes": parse_classes(classes),
        "device": None if device == "cpu" else device,
        "conf": conf,
        "horizon": horizon,
        "camera": camera,
        "field_of_view": fov,
        "camera_height_m": camera_height,
        "every": every,
        "blur": blur,
    }
    with contextlib.ExitStack() as stack:
        executor = None
        if dask is not None and not dry_run:
            executor, dashboard = stack.enter_context(open_dask(dask, jobs))
            if not quiet:
                print_line(f"dashboard {dashboard}")
        folder = local_path(output)
        if folder and not dry_run and not is_url(folder):
            stack.enter_context(output_folder(Path(folder), "--output"))
        done = run_batch(
            sources,
            output,
            executor,
            model=model,
            options={name: value for name, value in options.items() if value is not None},
            jobs=jobs,
            shard=shard,
            group=group,
            tracks_only=tracks_only,
            audio=not no_audio,
            preset=preset,
            retry_failed=retry_failed,
            dry_run=dry_run,
            progress=not quiet,
            on_record=functools.partial(_print_record, done=not quiet and not sys.stderr.isatty()),
        )
    if dry_run:
        for trip in done.planned or ():
            _print_trip(trip)
        print_line(str(done))
        return
    _write_summary(output, summary)
    lens_is_known = any(option is not None for option in (camera, fov))
    if done.done and not lens_is_known and not quiet:
        print_error(UNKNOWN_LENS)
    if not quiet:
        print_line(str(done))
        print_line(f"wrote {hide_credentials(output)}" + (f", {summary}" if summary else ""))
    if done.errors:  # the machine's fault: a job that is started again does the rest
        raise typer.Exit(1)


def _print_record(record: Mapping[str, Any], *, done: bool) -> None:
    """Warn of a trip without results; with `done` also print others, for logs, which show no progress bar."""
    from vehicle_detection._common import encodable, hide_credentials, pluralize
    from vehicle_detection.batch import with_source

    source = record["sources"][0]["uri"]
    # A log that cannot be written does not end the batch.
    with contextlib.suppress(OSError, ValueError):
        if record["status"] != "done":
            print_error(f"warning: {with_source(source, record['message'])}")
        elif done:
            name = encodable(hide_credentials(source))
            print_error(f"done: {name}, {pluralize(record['frames'], 'frame')}")


def _print_trip(trip: Mapping[str, Any]) -> None:
    """Print a trip that would be processed: its start, camera and files."""
    from vehicle_detection._common import encodable, hide_credentials, pluralize

    start = (trip["start"] or "unknown start").replace("T", " ")
    replaced = f", replaces {pluralize(len(trip['replaces']), 'earlier result')}" if trip["replaces"] else ""
    first = encodable(hide_credentials(trip["files"][0]))
    print_line(f"{start}  {trip['camera']}  {pluralize(len(trip['files']), 'file')} from {first}{replaced}")


def _write_summary(output: str, summary: Path | None) -> None:
    """Write the table of all trips of a batch."""
    if summary is None:
        return
    from vehicle_detection._common import atomic_write
    from vehicle_detection.batch import batch_summary

    table = batch_summary(output)
    with atomic_write(summary, "--summary") as part:
        table.to_csv(part, index=False)
