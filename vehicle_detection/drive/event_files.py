"""Files of the events of a drive: a table, and a clip of each."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
from collections.abc import Iterable
from pathlib import Path

from vehicle_detection._common import atomic_write, check, check_suffix, progress_bar
from vehicle_detection.drive.events import EVENT_COLUMNS, Event, check_events
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video import cut_video, open_source

EVENT_SUFFIXES = (".csv", ".json")
"""Suffixes of files of events."""

# Longest time (s) that a clip shows before and after an event.
_MAX_EXTENT = 5.0


def write_events(events: Iterable[Event], path: str | os.PathLike[str]) -> int:
    """Write events to a file, which appears only when it is complete; return their number.

    Parameters
    ----------
    events
        What `find_events` returned.
    path
        ``.csv`` (unknown values are empty) or ``.json`` (a list of objects; unknown values are null).

    Examples
    --------
    >>> import tempfile
    >>> from vehicle_detection.drive import Event
    >>> file = Path(tempfile.mkdtemp()) / "events.csv"
    >>> event = Event(kind="met", track_id=3, frame=50, start_frame=40, end_frame=52, time_s=2.0)
    >>> write_events([event], file)
    1
    >>> print(file.read_text().splitlines()[1])
    met,3,50,40,52,2.0,,,,,False,,,,,,,
    """
    target = check_suffix(path, "path", EVENT_SUFFIXES)
    rows = [dataclasses.asdict(event) for event in check_events(events)]
    with atomic_write(target, "path") as part, part.open("w", encoding="utf-8", newline="") as file:
        if target.suffix.lower() == ".json":
            json.dump(rows, file, indent=1)
            file.write("\n")
        else:
            writer = csv.DictWriter(file, EVENT_COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    return len(rows)


def cut_clips(
    events: Iterable[Event],
    video: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    fps: float,
    margin: float = 2.0,
    progress: bool = False,
) -> list[Path]:
    """Cut a short clip of each event out of an annotated video; return their paths, in the same order.

    Parameters
    ----------
    events, video, fps
        What `find_events` returned, the video that `process_video` wrote, and its frame rate.
    folder
        Existing folder; the clips are called ``0012.4s_cut_in_7.mp4`` after time, kind and track.
    margin
        Seconds before and after the frames of an event, of which at most 5 s are shown on either side.
    progress
        Show a progress bar if standard error is a terminal.

    Examples
    --------
    >>> cut_clips([], "found.mp4", "clips", fps=25)
    []
    """
    rate = check.number(fps, "fps", above=0, high=1e6)
    margin = check.number(margin, "margin", low=0, high=3600)
    listed = check_events(events)
    if not listed:
        return []
    if not Path(folder).is_dir():
        raise InvalidInputError(f"folder {folder} does not exist; create it")
    names = [f"{event.time_s:06.1f}s_{event.kind}_{event.track_id}.mp4" for event in listed]
    paths = [Path(folder) / name for name in names]
    bar = progress_bar(progress, len(listed), unit="clip", interactive_only=True)
    with open_source(video) as source, bar as shown:
        for event, path in zip(listed, paths):
            start = max(event.start_frame / rate - margin, event.time_s - _MAX_EXTENT, 0.0)
            end = min((event.end_frame + 1) / rate + margin, event.time_s + _MAX_EXTENT)
            cut_video(source, path, start=start, end=end)
            shown.update()
    return paths
