"""Files of a drive: a table of its events, a clip of each, and subtitles."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vehicle_detection._common import (
    UNITS,
    Units,
    atomic_write,
    check,
    check_suffix,
    pluralize,
    progress_bar,
    write_text,
)
from vehicle_detection.annotator import MAX_SPEED_STD
from vehicle_detection.drive.events import EVENT_COLUMNS, Event, check_events
from vehicle_detection.drive.own_speed import OwnSpeed, own_speeds
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tables import NO_TRACK, TrackTable
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
        Seconds before the first and after the last frame of an event; a clip has at most 5 s before and 5 s
        after the event's time.
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


SUBTITLE_SUFFIXES = (".srt", ".ass")
"""Suffixes of files of subtitles."""

# Seconds for which an event is shown.
_EVENT_SECONDS = 3
_ASS_HEADER = """\
[Script Info]
ScriptType: v4.00+
WrapStyle: 0
PlayResX: 1280
PlayResY: 720

[V4+ Styles]
Format: Name, Fontname, Fontsize, PrimaryColour, SecondaryColour, OutlineColour, BackColour, Bold, Italic, \
Underline, StrikeOut, ScaleX, ScaleY, Spacing, Angle, BorderStyle, Outline, Shadow, Alignment, \
MarginL, MarginR, MarginV, Encoding
Style: Default,Arial,26,&H00FFFFFF,&H00FFFFFF,&H00000000,&H80000000,0,0,0,0,100,100,0,0,1,2,0,7,16,16,12,1

[Events]
Format: Layer, Start, End, Style, Name, MarginL, MarginR, MarginV, Effect, Text
"""


def write_subtitles(
    table: TrackTable,
    path: str | os.PathLike[str],
    *,
    fps: float,
    events: Iterable[Event] = (),
    own_speed: OwnSpeed | None = None,
    units: Literal["metric", "imperial"] = "metric",
) -> int:
    """Write what a video shows as subtitles, second by second; return their number.

    A subtitle states the own speed if it is known, the largest number of vehicles at once, the nearest one
    with its distance and speed, and for three seconds each event; seconds with the same text share one.
    Players load a file beside the video with the same name. It appears only when it is complete.

    Parameters
    ----------
    table, fps, events
        The tracks of the video, its frame rate, and what `find_events` found in the tracks.
    path
        ``.srt`` (SubRip) or ``.ass`` (Advanced SubStation Alpha, in the upper left corner).
    own_speed
        Speed of the camera's vehicle over the time of the source. Where it is known, speeds are those over
        ground; elsewhere they are relative to the camera.
    units
        ``"metric"`` (m and km/h) or ``"imperial"`` (ft and mph).

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from vehicle_detection import TrackTable
    >>> from vehicle_detection.drive import OwnSpeed
    >>> table = TrackTable()
    >>> for frame in range(50):
    ...     table.append(frame, frame / 25)
    >>> file = Path(tempfile.mkdtemp()) / "found.srt"
    >>> write_subtitles(table, file, fps=25, own_speed=OwnSpeed.constant(25.0))
    1
    >>> print(file.read_text().rstrip())
    1
    00:00:00,000 --> 00:00:02,000
    own speed 90 km/h
    no vehicle
    """
    check.instance(table, "table", TrackTable, "pass TrackTable.from_results(results) or from_pandas(table)")
    target = check_suffix(path, "path", SUBTITLE_SUFFIXES)
    rate = check.number(fps, "fps", above=0, high=1e6)
    check.instance(own_speed, "own_speed", OwnSpeed | None, "pass what read_own_speed returns")
    check.choice(units, "units", UNITS)
    listed = check_events(events)
    cues = list(_merge(_second_texts(table, rate, listed, own_speed, UNITS[units])))
    end = len(table.counts()) / rate
    is_ass = target.suffix.lower() == ".ass"
    text = _ASS_HEADER if is_ass else ""
    for number, (start, stop, lines) in enumerate(cues, start=1):
        last = min(stop, end)
        if is_ass:
            times, said = f"{_ass_time(start)},{_ass_time(last)}", r"\N".join(lines)
            text += f"Dialogue: 0,{times},Default,,0,0,0,,{said}\n"
        else:
            said = "\n".join(lines)
            text += f"{number}\n{_srt_time(start)} --> {_srt_time(last)}\n{said}\n\n"
    write_text(target, text, "path")
    return len(cues)


def _second_texts(
    table: TrackTable, fps: float, events: list[Event], own_speed: OwnSpeed | None, units: Units
) -> Iterator[tuple[str, ...]]:
    """Yield the lines for each second of a video."""
    counts = table.counts()
    seconds = math.ceil(len(counts) / fps - 1e-9)
    nearest = _nearest_tracks(table, fps)
    # In the middle of each second.
    frames = np.minimum((np.arange(seconds) + 0.5) * fps, len(counts) - 1).astype(np.intp)
    own = np.full(seconds, np.nan) if own_speed is None else own_speeds(own_speed, table, fps=fps)[frames]
    shown: defaultdict[int, list[Event]] = defaultdict(list)
    for event in events:
        for second in range(int(event.time_s), int(event.time_s) + _EVENT_SECONDS):
            shown[second].append(event)
    for second in range(seconds):
        first, last = (math.ceil(edge * fps - 1e-9) for edge in (second, second + 1))
        frame_second = second
        if first == last:  # the frame of an earlier second is still shown
            first, frame_second = first - 1, math.floor((first - 1) / fps + 1e-9)
        speed = None if np.isnan(own[second]) else float(own[second])
        count = int(counts[first:last].max(initial=0))
        lines = [] if speed is None else [f"own speed {units.speed_text(speed, None, signed=False)}"]
        lines.append(_vehicles(count, nearest.get(frame_second), speed, units))
        lines += [event.text(units, with_time=False) for event in shown[second]]
        yield tuple(lines)


def _vehicles(count: int, nearest: Any, own_mps: float | None, units: Units) -> str:
    """Describe the vehicles of a second; `nearest` is a row of `_nearest_tracks`, if there is one."""
    text = pluralize(count, "vehicle") if count else "no vehicle"
    if nearest is None:
        return text
    text += (
        f", nearest #{nearest.track_id}: {units.distance_text(nearest.distance_m, nearest.distance_std_m)}"
    )
    if math.isnan(nearest.speed_mps):
        return text
    if own_mps is None:
        return f"{text}, {units.speed_text(nearest.speed_mps, None)} relative"
    over_ground = own_mps + nearest.speed_mps
    oncoming = ", oncoming" * (over_ground < -MAX_SPEED_STD)
    return f"{text}, {units.speed_text(abs(over_ground), None, signed=False)}{oncoming}"


def _nearest_tracks(table: TrackTable, fps: float) -> dict[int, Any]:
    """Medians of the track with the smallest median distance in each second, by the second."""
    import pandas

    names = ("frame", "track_id", "distance_m", "distance_std_m", "speed_mps")
    rows = pandas.DataFrame({name: table[name] for name in names})
    rows["speed_mps"] = rows["speed_mps"].where(table["speed_std_mps"] <= MAX_SPEED_STD)
    rows["second"] = np.floor(rows["frame"].astype(float) / fps + 1e-9).astype(int)
    known = rows[(rows["track_id"] != NO_TRACK) & np.isfinite(rows["distance_m"])]
    medians = known.groupby(["second", "track_id"], as_index=False).median()
    nearest = medians.sort_values("distance_m", kind="stable").drop_duplicates("second")
    return {row.second: row for row in nearest.itertuples()}


def _merge(texts: Iterable[tuple[str, ...]]) -> Iterator[tuple[int, int, tuple[str, ...]]]:
    """Yield first and last edge, in seconds, and lines of each run of seconds with the same lines."""
    start = 0
    for lines, run in groupby(texts):
        stop = start + len(list(run))
        yield start, stop, lines
        start = stop


def _srt_time(seconds: float) -> str:
    whole, milliseconds = divmod(round(seconds * 1000), 1000)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d},{milliseconds:03d}"


def _ass_time(seconds: float) -> str:
    whole, hundredths = divmod(round(seconds * 100), 100)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}.{hundredths:02d}"
