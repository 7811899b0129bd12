"""Events as files: CSV, JSON, and a clip of the video for each."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
from collections.abc import Iterable
from pathlib import Path

from vehicle_detection._common import atomic_write, check_number, check_suffix, progress_bar
from vehicle_detection.drive.events import EVENT_COLUMNS, Event, check_events
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video import cut_video, open_source

EVENT_SUFFIXES = (".csv", ".json")
"""Suffixes of files of events."""

# Longest time (s) that a clip shows before and after an event.
_MAX_EXTENT = 5.0


def write_events(events: Iterable[Event], path: str | os.PathLike[str]) -> int:
    """Write events to a file; the file appears only when it is complete.

    Parameters
    ----------
    events
        What `find_events` returned.
    path
        ``.csv`` (unknown values are empty) or ``.json`` (a list of objects; unknown values are null).

    Returns
    -------
    int
        Number of events written.

    Raises
    ------
    InvalidInputError
        If the suffix is another one, the folder is missing or read-only, or `events` holds something else.

    Examples
    --------
    >>> import tempfile
    >>> from vehicle_detection.drive import Event
    >>> file = Path(tempfile.mkdtemp()) / "events.csv"
    >>> event = Event(kind="met", track_id=3, frame=50, start_frame=40, end_frame=52, time_s=2.0)
    >>> write_events([event], file)
    1
    >>> print(file.read_text().splitlines()[1])
    met,3,50,40,52,2.0,,,,,,,,,,
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
    """Cut a short clip of each event out of an annotated video.

    Parameters
    ----------
    events, fps
        What `find_events` returned, and the frame rate.
    video
        The video that `process_video` wrote from the frames of the events.
    folder
        Existing folder; the clips are called ``0012.4s_cut_in_7.mp4`` after time, kind and track.
    margin
        Seconds before and after the frames of an event, of which at most 5 s are shown on either side.
    progress
        Show a progress bar if standard error is a terminal.

    Returns
    -------
    list of pathlib.Path
        The clips, in the order of the events.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or a file or the folder is missing.
    VideoError
        If the video cannot be read, or a clip cannot be written.

    Examples
    --------
    >>> cut_clips([], "found.mp4", "clips", fps=25)
    []
    """
    rate = check_number(fps, "fps", above=0, high=1e6)
    margin = check_number(margin, "margin", low=0, high=3600)
    paths = []
    listed = check_events(events)
    if not listed:
        return []
    if not Path(folder).is_dir():
        raise InvalidInputError(f"folder {folder} does not exist; create it")
    with (
        open_source(video) as source,
        progress_bar(progress, len(listed), unit="clip", interactive_only=True) as bar,
    ):
        for event in listed:
            start = max(event.start_frame / rate - margin, event.time_s - _MAX_EXTENT, 0.0)
            end = min((event.end_frame + 1) / rate + margin, event.time_s + _MAX_EXTENT)
            path = Path(folder) / f"{event.time_s:06.1f}s_{event.kind}_{event.track_id}.mp4"
            cut_video(source, path, start=start, end=end)
            paths.append(path)
            bar.update()
    return paths
