"""Groups the files of dash-cams, which write segments of one to ten minutes, into trips.

A file name contains the camera and either the time of the first frame (``20260131_081500_F.MP4``,
``2026-01-31_08-15-00-front.mp4``) or a running number of four digits (``GRMN0001.MP4``, ``GX010042.MP4``).
With a number, the modification times show whether there is a gap, unless the files were copied without them.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

from vehicle_detection._common import check_sequence, describe, is_url, pluralize
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video import FrameSource, Source, is_video_file, list_files, open_source, probe_video

File = Path | str

# Seconds by which the start of a segment may differ from the end of the one before: names hold whole seconds.
_TOLERANCE = 3.0
# Maximum length of a segment in seconds, where its file cannot be probed.
_MAX_SEGMENT = 660.0

_TIME = re.compile(
    r"(?<!\d)(20\d{2})[-_.]?(\d{2})[-_.]?(\d{2})[-_. T]{0,3}(\d{2})[-_.h]?(\d{2})[-_.m]?(\d{2})(?!\d{6})"
)
# Nextbase, whose years have two digits: 260131_081500_001_FH.MP4.
_SHORT_TIME = re.compile(r"^(\d{2})(\d{2})(\d{2})_(\d{2})(\d{2})(\d{2})(?=_\d{3}_[A-Z]{2}$)", re.IGNORECASE)
# A number that counts the files of a camera, perhaps with a letter or two for the kind of recording.
_COUNTER = re.compile(r"(?<!\d)\d{3,}(?=[A-Za-z]{0,2}(?![A-Za-z0-9]))")
_GOPRO = re.compile(r"^G[HXLP](\d{2})(\d{4})$", re.IGNORECASE)
_CAMERA_WORDS = {
    "front": "front", "rear": "rear", "back": "rear", "left": "left", "right": "right",
    "interior": "interior", "inside": "interior", "cabin": "interior", "in": "interior",
    "f": "front", "r": "rear", "b": "rear", "i": "interior",
    # BlackVue: an event letter before the camera's.
    "nf": "front", "ef": "front", "pf": "front", "mf": "front",
    "nr": "rear", "er": "rear", "pr": "rear", "mr": "rear",
    # Nextbase, in high resolution; copies in low resolution are other trips.
    "fh": "front", "rh": "rear",
}  # fmt: skip
# Folders with names of letters alone are not named after a camera.
_CAMERA_FOLDERS = {word: camera for word, camera in _CAMERA_WORDS.items() if len(word) >= 4}
UNKNOWN_CAMERA = "unknown"
"""Camera of a file whose name does not contain it."""


@dataclass(frozen=True)
class _Segment:
    """What the name of a file contains."""

    camera: str
    start: datetime | None
    series: str  # name without time, number and camera; numbers of one series follow each other
    number: int | None
    end: float | None = None  # modification time, where the name has no time


@dataclass(frozen=True)
class Trip:
    """Consecutive segments of one camera.

    >>> print(Trip(("20260131_081500_F.MP4", "20260131_081600_F.MP4"), "front"))
    front, 2 files
    """

    files: tuple[File, ...]  # in order: paths, or URLs
    camera: str  # front, rear, left, right, interior or unknown
    start: datetime | None = None  # of the first frame by the camera's clock, if the name contains it

    def __str__(self) -> str:
        camera = "" if self.camera == UNKNOWN_CAMERA else f"{self.camera}, "
        return f"{camera}{pluralize(len(self.files), 'file')}"


def find_trips(files: Iterable[File], *, duration: Callable[[File], float] | None = None) -> list[Trip]:
    """Group files into trips, by their folders and names.

    A segment follows another one of the same folder and camera if it starts when the other ends, by the times
    in the names; or if it has the next number of four digits, and the modification times leave no gap.
    Front and rear cameras are different trips.

    Parameters
    ----------
    files
        Paths or URLs of videos, in any order. The trips are ordered by folder, camera and time.
    duration
        Function that returns the length of a file in seconds; called only where the times in the names leave
        open whether there is a gap. None: such segments are different trips.

    Examples
    --------
    >>> names = ["20260131_081500_F.MP4", "20260131_081600_F.MP4", "20260131_081700_F.MP4"]
    >>> names += ["20260131_081500_R.MP4", "20260131_093000_F.MP4"]
    >>> for trip in find_trips(names):
    ...     print(trip.camera, trip.start, len(trip.files))
    front 2026-01-31 08:15:00 3
    front 2026-01-31 09:30:00 1
    rear 2026-01-31 08:15:00 1
    """
    groups: defaultdict[tuple[str, str, str, bool], list[tuple[_Segment, File]]] = defaultdict(list)
    for file in check_sequence(files, "files", "paths"):
        if not isinstance(file, (str, Path)):
            raise InvalidInputError(f"files must be paths or URLs, got {describe(file)}; pass strings")
        name = _posix(file)
        segment = _parse_name(name)
        if segment.start is None and isinstance(file, Path):
            segment = replace(segment, end=_modification_time(file))
        # Folders named after cameras are told apart by their path already.
        key = (str(name.parent), segment.camera, segment.series, segment.start is not None)
        groups[key].append((segment, file))
    trips = []
    for key in sorted(groups):
        members = sorted(
            groups[key],
            key=lambda pair: (pair[0].start or datetime.min, pair[0].number or 0, _posix(pair[1]).name),
        )
        trips += _split(members, duration)
    return trips


def open_trip(source: Source, **options: Any) -> FrameSource:
    """Open the consecutive segments of a folder or pattern as one video, and any other source.

    A folder or a pattern, such as ``"CARD/*F.MP4"``, must hold the segments of one trip; all frames have the
    size and rate of the first one. Other options: see `open_source`.

    Examples
    --------
    >>> with open_trip("test_images/*.jpg", fps=10) as images:
    ...     images.info.frames
    6
    """
    files = list_files(source) if isinstance(source, (str, os.PathLike)) else []
    if len(files) > 1 and is_video_file(files[0]):
        trips = find_trips(files, duration=lambda each: probe_video(each).duration)
        if len(trips) > 1:
            listed = "; ".join(f"{trip} from {Path(trip.files[0]).name}" for trip in trips[:4])
            example = files[0].parent / f"*{Path(trips[0].files[0]).name[-5:]}"
            raise InvalidInputError(
                f"source {source} holds {len(trips)} trips ({listed}{', ...' if len(trips) > 4 else ''}); "
                f"select one with a pattern such as '{example}', or process all with vehicle-detection batch"
            )
        source = trips[0].files
    return open_source(source, **options)


def _posix(file: File) -> PurePosixPath:
    """Path of a file, or of a URL without its query, which may hold another time."""
    text = os.fspath(file)
    if is_url(text):
        return PurePosixPath(re.split("[?#]", text)[0] if text.startswith(("http://", "https://")) else text)
    return PurePosixPath(PurePath(text).as_posix())


def _parse_name(name: PurePosixPath) -> _Segment:
    """Read time, number and camera from the name of a file."""
    stem = name.stem
    gopro = _GOPRO.match(stem)
    if gopro:  # the chapter comes before the number of the recording
        return _Segment(_folder_camera(name), None, f"gopro {gopro[2]}", int(gopro[1]))
    start, rest = None, stem
    found = _SHORT_TIME.search(stem) or _TIME.search(stem)
    if found:
        year, *others = (int(part) for part in found.groups())
        with contextlib.suppress(ValueError):  # not a time after all
            start = datetime(year if year >= 100 else 2000 + year, *others)  # type: ignore[arg-type]
            # With a time, a counter adds nothing; other numbers are those of vehicles and channels.
            rest = f"{stem[: found.start()]} {_COUNTER.sub('', stem[found.end() :])}"
    camera, rest = _take_camera(rest, codes=start is not None)
    if camera is None:
        camera = _folder_camera(name)
    numbers = re.findall(r"\d{4,}", stem if start else rest)
    number = int(numbers[-1]) if numbers else None
    if start:
        series = re.sub(r"(?<![A-Za-z0-9])\d{3,}(?![A-Za-z0-9])", "", rest)
    else:
        series = re.sub(r"\d+(?=\D*$)", "#", rest)
    return _Segment(camera, start, series.strip(" _-.").lower(), number)


def _take_camera(stem: str, *, codes: bool) -> tuple[str | None, str]:
    """Find the camera's word in a name, the last one first, and return the name without it.

    One or two letters mean a camera at the end of a name only, with `codes` or after a digit.
    """
    for word in reversed(list(re.finditer(r"[A-Za-z]+", stem))):
        camera = _CAMERA_WORDS.get(word[0].lower())
        at_end = not re.search(r"[A-Za-z0-9]", stem[word.end() :])
        is_code = at_end and (codes or stem[word.start() - 1 : word.start()].isdecimal())
        if camera and (len(word[0]) >= 4 or is_code):
            return camera, stem[: word.start()] + stem[word.end() :]
    return None, stem


def _folder_camera(name: PurePosixPath) -> str:
    """Camera that a file's folder is named after."""
    for word in re.findall(r"[a-z]+", name.parent.name.lower()):
        if word in _CAMERA_FOLDERS:
            return _CAMERA_FOLDERS[word]
    return UNKNOWN_CAMERA


def _split(members: Sequence[tuple[_Segment, File]], duration: Callable[[File], float] | None) -> list[Trip]:
    """Split the sorted files of one camera where a segment does not follow the one before."""
    steps = [_step(before, after) for (before, _), (after, _) in itertools.pairwise(members)]
    usual = _usual_step([step for step in steps if step is not None])
    by_number = members[0][0].start is None
    trips = [[members[0]]]
    for before, after, step in zip(members, members[1:], steps):
        if by_number and not _next_number(before[0], after[0]):
            follows = False
        elif step is None or (by_number and abs(step) <= _TOLERANCE):  # copied without their times
            follows = by_number
        elif step > _MAX_SEGMENT and duration is None:
            follows = False
        elif usual is not None and abs(step - usual) <= _TOLERANCE:
            follows = True
        elif usual is not None and step > usual:
            follows = False
        else:  # a shorter segment may be the last one of its trip
            segment = after if by_number else before
            follows = duration is not None and abs(step - duration(segment[1])) <= _TOLERANCE
        if follows:
            trips[-1].append(after)
        else:
            trips.append([after])
    return [Trip(tuple(file for _, file in trip), trip[0][0].camera, trip[0][0].start) for trip in trips]


def _step(before: _Segment, after: _Segment) -> float | None:
    """Seconds between the starts of two segments, or between their ends, if known."""
    if before.start is not None and after.start is not None:
        return (after.start - before.start).total_seconds()
    if before.end is not None and after.end is not None:
        return after.end - before.end
    return None


def _modification_time(file: Path) -> float | None:
    try:
        return file.stat().st_mtime
    except OSError:
        return None


def _usual_step(steps: Sequence[float]) -> float | None:
    """Length of the camera's segments, if two steps agree on it: the most frequent step between starts."""
    counts = Counter(round(step) for step in steps if 0 < step <= _MAX_SEGMENT)
    agreeing = {
        step: sum(counts[step + offset] for offset in (-1, 0, 1)) * 10 + count
        for step, count in counts.items()
    }
    best = max(agreeing, key=lambda step: (agreeing[step], step), default=None)
    return float(best) if best is not None and agreeing[best] >= 20 else None


def _next_number(before: _Segment, after: _Segment) -> bool:
    return before.number is not None and after.number == before.number + 1
