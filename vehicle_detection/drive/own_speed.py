"""Speed of the camera's own vehicle over time, from a GPX track or a CSV table."""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from vehicle_detection._common import (
    Floats,
    Limit,
    check_array,
    check_number,
    check_path,
    describe,
    read_regular_file,
    shorten,
    store_number,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tables import TrackTable

# Gap (s) between two values from which on the speed between them is unknown.
_MAX_GAP = 5.0
# Span (s) of the positions that give a speed: single positions have errors of some meters.
_SPAN = 3.0
_EARTH_RADIUS = 6_371_009.0  # m
_MAX_SPEED = 150.0  # m/s
# Factors from the columns of a table to m/s.
_SPEED_COLUMNS = {"speed_mps": 1.0, "speed_kmh": 1 / 3.6, "speed_mph": 0.44704}


@dataclass(frozen=True, eq=False)
class OwnSpeed:
    """Speed of the camera's own vehicle over the time of a video.

    Examples
    --------
    >>> speed = OwnSpeed([0.0, 2.0], [10.0, 14.0])
    >>> speed.at([1.0, 3.0])
    array([12., nan])
    """

    seconds: Floats  # (N,) ascending times; 0 is the start of the video
    speeds_mps: Floats  # (N,) speeds over ground in m/s, at least 0
    max_gap: float = _MAX_GAP  # seconds between two times from which on the speed is unknown

    def __post_init__(self) -> None:
        for name in ("seconds", "speeds_mps"):
            given = getattr(self, name)
            values = check_array(given, name)
            if values.ndim != 1 or not len(values) or values.dtype.kind not in "iuf":
                raise InvalidInputError(
                    f"{name} must be a list of numbers, got {describe(given)}; pass at least one"
                )
            if not np.isfinite(values).all():
                raise InvalidInputError(f"{name} must be finite, got NaN or infinity; drop these values")
            object.__setattr__(self, name, values.astype(np.float64))
        if len(self.seconds) != len(self.speeds_mps):
            raise InvalidInputError(
                f"speeds_mps must have one value for each of the {len(self.seconds)} seconds, "
                f"got {len(self.speeds_mps)}"
            )
        if (np.diff(self.seconds) <= 0).any():
            raise InvalidInputError("seconds must ascend; sort them and drop repeated ones")
        if (self.speeds_mps < 0).any():
            raise InvalidInputError(
                f"speeds_mps must be at least 0, got {self.speeds_mps.min():g}; pass speeds, not velocities"
            )
        store_number(self, "max_gap", above=0)

    @classmethod
    def constant(cls, speed_mps: float) -> OwnSpeed:
        """Return a speed that does not change."""
        speed = check_number(speed_mps, "speed_mps", low=0, high=_MAX_SPEED)
        return cls(np.array([-1e12, 1e12]), np.array([speed, speed]), max_gap=1e13)

    def at(self, seconds: ArrayLike) -> Floats:
        """Speed in m/s at each time: interpolated; NaN before, after and in long gaps of the record."""
        given = check_array(seconds, "seconds")
        if given.dtype.kind not in "iuf":
            raise InvalidInputError(
                f"seconds must be numbers, got {describe(seconds)}; pass times in seconds"
            )
        times: Floats = given.astype(np.float64)
        speeds = np.interp(times, self.seconds, self.speeds_mps, left=np.nan, right=np.nan)
        if len(self.seconds) > 1:
            after = np.clip(np.searchsorted(self.seconds, times), 1, len(self.seconds) - 1)
            in_gap = self.seconds[after] - self.seconds[after - 1] > self.max_gap
            speeds = np.where(in_gap & ~np.isin(times, self.seconds), np.nan, speeds)
        return speeds


def own_speeds(speed: OwnSpeed, table: TrackTable, *, fps: float) -> Floats:
    """Speed of the own vehicle in m/s in each frame of the tracks of a video; NaN where it is unknown.

    `fps` is the frame rate, for frames that were added without a time.
    """
    times = table.times()
    if times is None:
        times = (table.first_time or 0.0) + np.arange(len(table.counts())) / fps
    return speed.at(times)


def read_own_speed(path: str | os.PathLike[str], *, offset: float = 0.0) -> OwnSpeed:
    r"""Read the speed of the camera's own vehicle.

    Parameters
    ----------
    path
        ``.gpx``: a GPS track with times. Its speeds are used if it holds them, otherwise they are computed
        from positions 3 s apart. ``.csv``: a table with a header and the columns ``time_s`` and one of
        ``speed_mps``, ``speed_kmh`` and ``speed_mph``; other columns are ignored.
    offset
        Time of the video's start in the record: seconds after the first point of a track, or the value of
        ``time_s``. Negative if the record starts later than the video.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "speed.csv"
    >>> _ = file.write_text("time_s,speed_kmh\n0,90\n1,93.6\n")
    >>> read_own_speed(file).at([0.5])
    array([25.5])
    """
    check_path(path, "path")
    file = Path(path)
    shift = check_number(offset, "offset", low=-1e9, high=1e9)
    reader = {".gpx": _read_gpx, ".csv": _read_csv}.get(file.suffix.lower())
    if reader is None:
        raise InvalidInputError(f"path must end in .gpx or .csv, got {file.name!r}; convert the record")
    rows = reader(read_regular_file(file, f"path {file}", Limit.RECORD_BYTES), str(file))
    seconds, speeds = _ascending(np.array(rows)).T
    return OwnSpeed(seconds - shift, speeds)


def _ascending(rows: Floats) -> Floats:
    """Sort rows by their times, the first column, and keep the first one of each time."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return rows[np.diff(rows[:, 0], prepend=-np.inf) > 0]


def _read_csv(data: bytes, name: str) -> Sequence[tuple[float, float]]:
    """Read times (s) and speeds (m/s) of a table."""
    try:
        table = list(csv.reader(io.StringIO(data.decode("utf-8-sig"), newline="")))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(f"path {name} is no CSV table: {error}; write it as UTF-8") from None
    header = [cell.strip() for cell in table[0]] if table else []
    unit = next((column for column in _SPEED_COLUMNS if column in header), None)
    if "time_s" not in header or unit is None:
        raise InvalidInputError(
            f"path {name} must have the columns time_s and one of {', '.join(_SPEED_COLUMNS)}; "
            f"got {shorten(', '.join(header), 300) or 'no header'}"
        )
    columns = header.index("time_s"), header.index(unit)
    rows = []
    for number, row in enumerate(table[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        try:
            time, speed = (float(row[column]) for column in columns)
        except (ValueError, IndexError):
            raise InvalidInputError(
                f"path {name}, line {number}: time_s and {unit} must be numbers; correct the line"
            ) from None
        speed *= _SPEED_COLUMNS[unit]
        if not math.isfinite(time) or not 0 <= speed <= _MAX_SPEED:
            raise InvalidInputError(
                f"path {name}, line {number}: the speed must be from 0 to {_MAX_SPEED:g} m/s at a finite "
                f"time; got {shorten(','.join(row))}"
            )
        rows.append((time, speed))
    if not rows:
        raise InvalidInputError(f"path {name} has no rows below its header")
    return rows


class _NoDoctype(ElementTree.TreeBuilder):
    """Refuses a document type, whose entities can expand to any size; GPX needs none."""

    def doctype(self, *_: Any) -> None:
        raise InvalidInputError("it has a document type declaration, which GPX does not need; remove it")


def _parse_float(text: str | None, low: float, high: float) -> float:
    """Return a number in this range; NaN for anything else."""
    try:
        value = float(text or "nan")
    except ValueError:
        return math.nan
    return value if low <= value <= high else math.nan


def _parse_time(text: str) -> float:
    """Return an ISO 8601 time as seconds since 1970; NaN for anything else. Without a zone it is UTC."""
    # Python 3.11 accepts up to 6 decimals, but any number is allowed.
    try:
        time = datetime.fromisoformat(re.sub(r"(\.\d{6})\d+", r"\1", text.strip()))
        return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return math.nan


def _read_gpx(data: bytes, name: str) -> Floats:
    """Read times (s) since the first point, and speeds (m/s), of the points of a GPX document."""
    parser = ElementTree.XMLParser(target=_NoDoctype())
    try:
        parser.feed(data)
        document = parser.close()
    except ElementTree.ParseError as error:
        raise InvalidInputError(f"path {name} is no GPX file: {error}; export it again") from None
    except InvalidInputError as error:
        raise InvalidInputError(f"path {name} is refused: {error}") from None
    # GPX 1.0 and 1.1 have different namespaces; the speed of version 1.1 is in an extension.
    rows = [
        (
            _parse_time(point.findtext(".//{*}time") or ""),
            _parse_float(point.findtext(".//{*}speed"), 0, _MAX_SPEED),
            _parse_float(point.get("lat"), -90, 90),
            _parse_float(point.get("lon"), -180, 180),
        )
        for point in document.iterfind(".//{*}trkpt")
    ]
    points = _ascending(np.array([row for row in rows if math.isfinite(row[0])]).reshape(-1, 4))
    if len(points) < 2:
        raise InvalidInputError(
            f"path {name} must have at least two track points with times, got {len(points)}; export a "
            "recorded track, not a route"
        )
    times, speeds = points[:, 0] - points[0, 0], points[:, 1]
    if np.isfinite(speeds).mean() < 0.5:
        latitude, longitude = np.deg2rad(points[:, 2:]).T
        known = np.isfinite(latitude) & np.isfinite(longitude)
        times, latitude, longitude = times[known], latitude[known], longitude[known]
        steps = np.diff(times)
        jumps = _great_circle(latitude[:-1], longitude[:-1], latitude[1:], longitude[1:]) > _MAX_SPEED * steps
        breaks = np.flatnonzero((steps > _MAX_GAP) | jumps) + 1
        parts = np.split(np.column_stack([times, latitude, longitude]), breaks)
        speeds = np.concatenate([_speeds_of(*part.T) for part in parts])
    known = np.isfinite(speeds)
    if not known.any():
        raise InvalidInputError(
            f"path {name} has no speeds, and no positions at most {_MAX_GAP:g} s apart to compute them; "
            "record them every second"
        )
    return np.column_stack([times[known], np.minimum(speeds[known], _MAX_SPEED)])


def _speeds_of(times: Floats, latitude: Floats, longitude: Floats) -> Floats:
    """Speeds (m/s) from positions (radians): distance along the great circle between positions 3 s apart."""
    if len(times) < 2:
        return np.full(len(times), np.nan)
    first = np.clip(times - _SPAN / 2, times[0], max(times[-1] - _SPAN, times[0]))
    last = np.minimum(first + _SPAN, times[-1])
    # A track that crosses the date line has no jump in its unwrapped longitude.
    columns = latitude, np.unwrap(longitude)
    (lat_1, lat_2), (lon_1, lon_2) = (
        [np.interp(each, times, column) for each in (first, last)] for column in columns
    )
    return np.asarray(_great_circle(lat_1, lon_1, lat_2, lon_2) / (last - first))


def _great_circle(
    latitude: Floats, longitude: Floats, other_latitude: Floats, other_longitude: Floats
) -> Floats:
    """Distances (m) between positions (radians), by the haversine formula."""
    half = np.sin((other_latitude - latitude) / 2) ** 2
    half += np.cos(latitude) * np.cos(other_latitude) * np.sin((other_longitude - longitude) / 2) ** 2
    return np.asarray(2 * _EARTH_RADIUS * np.arcsin(np.sqrt(np.minimum(half, 1.0))))
