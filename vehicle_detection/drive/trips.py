"""Groups the files of dash-cams, which write segments of one to ten minutes, into trips.

A file name contains the camera and either the time of the first frame (``20260131_081500_F.MP4``,
``2026-01-31_08-15-00-front.mp4``) or a running number of four digits (``GRMN0001.MP4``, ``GX010042.MP4``).
A segment follows another one if it starts when the other ends: names hold the start of a segment, and the
modification time of a numbered file is its end, unless the file was copied without it.
"""

from __future__ import annotations

import contextlib
import fnmatch
import glob
import itertools
import logging
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

from vehicle_detection._common import (
    available_cores,
    check,
    describe,
    is_url,
    is_web_address,
    pluralize,
    without_query,
)
from vehicle_detection.errors import InvalidInputError, VideoError
from vehicle_detection.video import FrameSource, Source, is_video_file, list_files, open_source, probe_video

_LOGGER = logging.getLogger(__name__)

File = Path | str

# Seconds by which the start of a segment may differ from the end of the one before: names hold whole seconds.
_TOLERANCE = 3.0
# Maximum length of a segment in seconds, where its file cannot be probed.
_MAX_SEGMENT = 660.0

# Names with earlier years are those of cameras whose clock was not set.
_FIRST_YEAR = 2009

_TIME = re.compile(
    r"(?<!\d)(20\d{2})[-_.]?(\d{2})[-_.]?(\d{2})[-_. T]{0,3}(\d{2})[-_.:h]?(\d{2})[-_.:m]?(\d{2})(?!\d{6})"
)
# Years of two digits: 260131_081500_001_FH.MP4 (Nextbase), FILE260131-081500F.MP4 (Mio).
_SHORT_TIME = re.compile(
    r"^[A-Za-z]*(\d{2})(0[1-9]|1[0-2])([0-3]\d)[-_]([01]\d|2[0-3])([0-5]\d)([0-5]\d)(?!\d)"
)
# A number that counts the files of a camera, perhaps with a letter or two for the kind of recording.
_COUNTER = re.compile(r"(?<!\d)\d{3,}(?=[A-Za-z]{0,2}(?![A-Za-z0-9]))")
# Chapters of one recording of a GoPro: GH010042, GH020042; up to HERO5 GOPR0042, GP010042. GL: low
# resolution. community.gopro.com, "Camera File Naming Convention"
_GOPRO = re.compile(r"^G(?:OPR|([HXLPS])(\d{2}))(\d{4})$", re.IGNORECASE)
# What follows the time in the names of a maker, without counters: a letter for the camera, and one for copies
# in low resolution, which are other trips.
_MAKERS = (
    # BlackVue: the kind of recording first (acolomba/blackvuesync on GitHub); Viofo: P for parking; 70mai;
    # Thinkware.
    (
        re.compile(r"^[-_]+[NEPMIOATBRXGDLYF]?([FRBI])L?(S?)$"),
        {"F": "front", "R": "rear", "B": "rear", "I": "interior"},
    ),
    # Nextbase, of iQ with the kind of event (support.nextbase.com, "File Names").
    (re.compile(r"^__([FRC])(?:H|(L))(?:_[A-Z]+)?$"), {"F": "front", "R": "rear", "C": "interior"}),
    # Vantrue: the kind of recording first; cameras in the order of N4 and N5 (dashcamigo on GitHub).
    (re.compile(r"^__[A-Z]_([ABC])()$"), {"A": "front", "B": "interior", "C": "rear"}),
)
_CAMERA_WORDS = {
    "front": "front", "rear": "rear", "back": "rear", "left": "left", "right": "right",
    "interior": "interior", "inside": "interior", "cabin": "interior", "in": "interior",
    "f": "front", "r": "rear", "b": "rear", "i": "interior",
}  # fmt: skip
# Folders with names of letters alone are not named after a camera.
_CAMERA_FOLDERS = {word: camera for word, camera in _CAMERA_WORDS.items() if len(word) >= 4}
UNKNOWN_CAMERA = "unknown"
"""Camera of a file whose name does not contain it."""


@dataclass(frozen=True)
class _Segment:
    """A file, and what its name contains."""

    file: File
    name: PurePosixPath  # of a URL without its query
    camera: str
    start: datetime | None
    series: str  # name without time, number and camera; numbers of one series follow each other
    number: int | None
    chapter: bool = False  # the number counts the parts of one recording


@dataclass(frozen=True)
class Trip:
    """Consecutive segments of one camera.

    >>> print(Trip(("20260131_081500_F.MP4", "20260131_081600_F.MP4"), "front"))
    front, 2 files
    """

    files: tuple[File, ...]  # in order: paths, or URLs
    camera: str  # front, rear, left, right, interior or unknown
    start: datetime | None = None  # of the first frame by the camera's clock, if the name contains it
    gap_s: float | None = None  # after the trip before it, where known; negative if they overlap

    def __str__(self) -> str:
        camera = "" if self.camera == UNKNOWN_CAMERA else f"{self.camera}, "
        return f"{camera}{pluralize(len(self.files), 'file')}"


def find_trips(files: Iterable[File], *, duration: Callable[[File], float] | None = None) -> list[Trip]:
    """Group files into trips, by their folders, names and lengths.

    A segment follows another one of the same folder, camera and suffix if it starts when the other ends, by
    the times in the names; or if it has the next number of four digits, and the modification times leave no
    gap. Where these are not those of the camera, the numbers decide, with a warning. Gaps and overlaps begin
    another trip. Front and rear cameras are different trips.

    Parameters
    ----------
    files
        Paths or URLs of videos, in any order. The trips are ordered by folder, camera and time.
    duration
        Function that returns the length of a file in seconds, or 0 if it is unknown: then the next segment is
        another trip. None: files and web addresses are probed.

    Examples
    --------
    >>> names = ["20260131_081500_F.MP4", "20260131_081600_F.MP4", "20260131_081700_F.MP4"]
    >>> names += ["20260131_081500_R.MP4", "20260131_093000_F.MP4"]
    >>> for trip in find_trips(names, duration=lambda name: 60.0):
    ...     print(trip.camera, trip.start, len(trip.files))
    front 2026-01-31 08:15:00 3
    front 2026-01-31 09:30:00 1
    rear 2026-01-31 08:15:00 1
    """
    groups: defaultdict[tuple[str, str, str, bool, str], list[_Segment]] = defaultdict(list)
    for file in check.sequence(files, "files", "paths"):
        if not isinstance(file, (str, Path)):
            raise InvalidInputError(f"files must be paths or URLs, got {describe(file)}; pass strings")
        each = _parse_name(file)
        # Cameras with folders of their own are told apart by the path, and converted copies by the suffix.
        folder, suffix = str(each.name.parent), each.name.suffix.lower()
        groups[folder, each.camera, each.series, each.start is not None, suffix].append(each)
    _warn_of_dates([each for members in groups.values() for each in members])
    if duration is None:
        probed = [each.file for members in groups.values() if len(members) > 1 for each in members]
        with ThreadPoolExecutor(available_cores(), thread_name_prefix="vehicle-probe") as pool:
            duration = dict(zip(probed, pool.map(_probe_length, probed), strict=True)).__getitem__
    trips = []
    for key in sorted(groups):
        members = groups[key]
        members.sort(key=lambda each: (each.start or datetime.min, each.number or 0, each.name.name))
        trips += _split(members, duration)
    return trips


def _warn_of_dates(segments: Sequence[_Segment]) -> None:
    """Warn of dates in names that are those of a clock that was not set: in the future, or long ago."""
    dated = [(each.start, each.file) for each in segments if each.start is not None]
    latest = datetime.now() + timedelta(days=2)
    last = max((start for start, _ in dated if start < latest), default=latest)
    for start, file in dated:
        reset = (start.month, start.day) == (1, 1) and last - start > timedelta(days=366)
        if start > latest or start.year < _FIRST_YEAR or reset:
            _LOGGER.warning("%s is dated %s: the clock of the camera seems to be wrong", file, start.date())
            return


def _probe_length(file: File) -> float:
    """Length of a video in seconds; 0 if it is unknown, as on storage from which it would be copied."""
    copied = is_url(str(file)) and not is_web_address(str(file))
    try:
        return 0.0 if copied else probe_video(file).duration
    except (InvalidInputError, VideoError):  # reported when its trip is processed
        return 0.0


def open_trip(source: Source, **options: Any) -> FrameSource:
    """Open the consecutive segments of a folder or pattern as one video, and any other source.

    A folder or a pattern, such as ``"CARD/*F.MP4"``, must hold the segments of one trip. Files of a list may
    belong to several: tracks end at each gap, with a warning. All frames have the size and rate of the first
    one. Other options: see `open_source`.

    Examples
    --------
    >>> with open_trip("test_images/*.jpg", fps=10) as images:
    ...     images.info.frames
    6
    """
    files = list_files(source) if isinstance(source, (str, os.PathLike)) else []
    if len(files) > 1 and is_video_file(files[0]):
        trips = find_trips(files)
        if len(trips) > 1:
            listed = "; ".join(f"{trip} from {Path(trip.files[0]).name}{_gap(trip)}" for trip in trips[:4])
            raise InvalidInputError(
                f"source {source} holds {len(trips)} trips ({listed}{', ...' if len(trips) > 4 else ''}); "
                f"select one, such as with '{_pattern_of(trips[0], files)}', or process all with "
                "vehicle-detection batch"
            )
        source = trips[0].files
    opened = open_source(source, **options)
    if isinstance(source, (list, tuple)) and len(opened.files) > 1 and is_video_file(opened.files[0]):
        _mark_gaps(opened)
    return opened


def _pattern_of(trip: Trip, files: Sequence[Path]) -> str:
    """Return a pattern that selects the files of a trip and no others, or else the first one of them."""
    first, names = Path(trip.files[0]), [Path(file).name for file in trip.files]
    if len(names) == 1:
        return str(first)
    columns = itertools.takewhile(lambda letters: len({*letters}) == 1, zip(*names))
    begin = "".join(letters[0] for letters in columns)
    for name in (f"*{glob.escape(first.name[-5:])}", f"{glob.escape(begin)}*{first.suffix}"):
        pattern = os.path.join(glob.escape(str(first.parent)), name)
        if [file for file in files if fnmatch.fnmatch(str(file), pattern)] == list(trip.files):
            return pattern
    return str(first)


def _mark_gaps(source: FrameSource) -> None:
    """Begin another scene where the names of two files state that one does not follow the other, and warn."""
    starts = [_parse_name(file).start for file in source.files]
    for (begin, end), files, (first, second) in zip(
        *map(itertools.pairwise, (source.segment_starts, source.files, starts))
    ):
        if first is None or second is None:
            continue
        gap = (second - first).total_seconds() - (end - begin)
        if abs(gap) > _TOLERANCE:
            source.breaks.add(round(end * source.info.fps))
            place = f"{abs(gap):.0f} s {'after' if gap > 0 else 'before'} the end of {files[0]}"
            _LOGGER.warning("%s begins %s; tracks end there", files[1], place)


def _gap(trip: Trip) -> str:
    if trip.gap_s is None:
        return ""
    return f", {abs(trip.gap_s):.0f} s {'after' if trip.gap_s > 0 else 'before'} the end of the one before"


def segment_clock(source: FrameSource) -> tuple[tuple[float, float], ...]:
    """Seconds of a trip's video, and of the camera's clock since the first frame, from which on they differ.

    Such as after pauses between segments; steps of up to a second are those of the names. Empty without times
    in the names.
    """
    check.instance(source, "source", FrameSource, "pass what open_trip returns")
    starts = [_parse_name(file).start for file in source.files]
    clock, offset = list[tuple[float, float]](), 0.0
    for begin, start in zip(source.segment_starts, starts):
        if start is None or starts[0] is None:
            return ()
        elapsed = (start - starts[0]).total_seconds()
        if not clock or abs(elapsed - begin - offset) > 1:
            offset = elapsed - begin
            clock.append((begin, elapsed))
    return tuple(clock)


def _parse_name(file: File) -> _Segment:
    """Read time, number and camera from the name of a file, or of a URL: its query may hold another time."""
    text = os.fspath(file)
    name = PurePosixPath(without_query(text) if is_url(text) else PurePath(text).as_posix())
    stem = name.stem
    gopro = _GOPRO.match(stem)
    if gopro:  # the chapter comes before the number of the recording
        low = "low " if gopro[1] in ("L", "l") else ""
        series = f"gopro {low}{gopro[3]}"
        return _Segment(file, name, _folder_camera(name), None, series, int(gopro[2] or 0), chapter=True)
    start, rest, camera = None, stem, None
    found = _SHORT_TIME.search(stem) or _TIME.search(stem)
    if found:
        year, *others = (int(part) for part in found.groups())
        with contextlib.suppress(ValueError):  # not a time after all
            start = datetime(year if year >= 100 else 2000 + year, *others)  # type: ignore[arg-type]
            # With a time, a counter adds nothing; other numbers are those of vehicles and channels.
            camera, after = _take_code(_COUNTER.sub("", stem[found.end() :]))
            rest = f"{stem[: found.start()]} {after}"
    if camera is None:
        camera, rest = _take_camera(rest, codes=start is not None)
    if camera is None:
        camera = _folder_camera(name)
    numbers = [] if start else re.findall(r"\d{4,}", rest)
    number = int(numbers[-1]) if numbers else None
    counter, kept = (r"(?<![A-Za-z0-9])\d{3,}(?![A-Za-z0-9])", "") if start else (r"\d+(?=\D*$)", "#")
    series = re.sub(counter, kept, rest).strip(" _-.").lower()
    return _Segment(file, name, camera, start, series, number)


def _take_code(text: str) -> tuple[str | None, str]:
    """Find the camera by what a maker writes after the time, and return what else tells trips apart."""
    for pattern, cameras in _MAKERS:
        if code := pattern.match(text.upper()):
            return cameras[code[1]], code[2] or ""
    return None, text


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


def _split(segments: Sequence[_Segment], duration: Callable[[File], float]) -> list[Trip]:
    """Split the sorted files of one camera where a segment does not follow the one before."""
    trips, gaps = [[segments[0]]], list[float | None]([None])
    unclear = None
    for before, after in itertools.pairwise(segments):
        gap = _find_gap(before, after, duration)
        by_number = before.number is not None and after.number == before.number + 1
        follows = gap is not None and abs(gap) <= _TOLERANCE
        if before.start is None:
            # No camera writes two files at once: earlier times are those of a copy.
            copied = gap is None or gap < -_TOLERANCE
            follows = by_number and (follows or copied or before.chapter)
            if follows and copied and not before.chapter:
                unclear = unclear or after.file
        if follows:
            trips[-1].append(after)
        else:
            trips.append([after])
            gaps.append(gap)
    if unclear is not None:
        _LOGGER.warning(
            "%s and others follow each other by their numbers only, because their modification times are not "
            "those of the camera: gaps are not noticed; copy the card with its times (cp -p)",
            unclear,
        )
    return [
        Trip(tuple(each.file for each in trip), trip[0].camera, trip[0].start, gap)
        for trip, gap in zip(trips, gaps, strict=True)
    ]


def _find_gap(first: _Segment, second: _Segment, duration: Callable[[File], float]) -> float | None:
    """Seconds from the end of a segment to the start of the next one, if known."""
    if first.start is not None and second.start is not None:
        length = duration(first.file)
        return (second.start - first.start).total_seconds() - length if length > 0 else None
    end, next_end = _modification_time(first.file), _modification_time(second.file)
    if first.chapter or end is None or next_end is None:
        return None
    step = next_end - end
    if step <= _TOLERANCE:  # copied without their times, or in another order
        return None
    length = duration(second.file)
    # A last file that cannot be read may have any length.
    return step - length if length > 0 else max(step - _MAX_SEGMENT, 0.0)


def _modification_time(file: File) -> float | None:
    """End of a segment, unless its file was copied without its time; None for a URL."""
    try:
        return file.stat().st_mtime if isinstance(file, Path) else None
    except OSError:
        return None
