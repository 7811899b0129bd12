"""Speed of the camera's own vehicle over time, from a GPX track, NMEA sentences or a CSV table."""

from __future__ import annotations

import csv
import functools
import io
import logging
import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import zip_longest
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import (
    Floats,
    Limit,
    check,
    invalid,
    pluralize,
    read_regular_file,
    shorten,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tables import TrackTable

_LOGGER = logging.getLogger(__name__)

# Gap (s) between two values from which on the speed between them is unknown.
_MAX_GAP = 5.0
# Span (s) of the positions that give a speed: single positions have errors of some meters.
_SPAN = 3.0
_EARTH_RADIUS = 6_371_009.0  # m
_MAX_SPEED = 150.0  # m/s
_UNUSUAL_SPEED = 70.0  # m/s, above which the unit is probably another one
# Speed (m/s) by the positions above which they show the unit of the stated speed, and the number of points.
_MOVING, _MOVING_POINTS = 5.0, 5
# Units in which stated speeds are found, in place of m/s: values for 1 m/s.
_OTHER_UNITS = {"km/h": 3.6, "mph": 1 / 0.44704, "knots": 3600 / 1852}
# A time with its zone; seconds by which neighbouring points differ from it, and degrees between them.
_ZONE, _ZONE_TOLERANCE, _NEAR = re.compile(r"T.*(Z|[+-]\d\d:?\d\d)\s*$", re.IGNORECASE), 10.0, 0.01
_OUTLYING = 366 * 86400.0  # s from the median time, such as the dates of a receiver without satellites
_LONGEST_START = 3600.0  # s that a receiver may need to find its position
_RATE_SENTENCES = 60  # number of sentences, from the first position on, whose times give their rate
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
    # Times of the video and of the record from which on they differ, as `segment_clock` returns them.
    clock: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        for name in ("seconds", "speeds_mps"):
            given = getattr(self, name)
            values = check.array(given, name)
            if values.ndim != 1 or not len(values) or values.dtype.kind not in "iuf":
                raise invalid(name, "be a list of numbers", given, "pass at least one")
            if not np.isfinite(values).all():
                raise InvalidInputError(f"{name} must be finite, got NaN or infinity; drop these values")
            object.__setattr__(self, name, values.astype(np.float64))
        if len(self.seconds) != len(self.speeds_mps):
            expected = f"have one value for each of the {len(self.seconds)} seconds"
            raise invalid("speeds_mps", expected, len(self.speeds_mps))
        if (np.diff(self.seconds) <= 0).any():
            raise InvalidInputError("seconds must ascend; sort them and drop repeated ones")
        if (self.speeds_mps < 0).any():
            lowest = float(self.speeds_mps.min())
            raise invalid("speeds_mps", "be at least 0", lowest, "pass speeds, not velocities")
        object.__setattr__(self, "max_gap", check.number(self.max_gap, "max_gap", above=0))
        clock = check.array(self.clock, "clock")
        pairs = clock.ndim == 2 and clock.shape[1] == 2 and clock.dtype.kind in "iuf"
        if clock.size and not (pairs and np.isfinite(clock).all()):
            raise invalid("clock", "be pairs of seconds", self.clock, "pass what segment_clock returns")

    @classmethod
    def constant(cls, speed_mps: float) -> OwnSpeed:
        """Return a speed that does not change."""
        speed = check.number(speed_mps, "speed_mps", low=0, high=_MAX_SPEED)
        return cls(np.array([-1e12, 1e12]), np.array([speed, speed]), max_gap=1e13)

    def at(self, seconds: ArrayLike) -> Floats:
        """Speed in m/s at each time: interpolated; NaN before, after and in long gaps of the record."""
        given = check.array(seconds, "seconds")
        if given.dtype.kind not in "iuf":
            raise invalid("seconds", "be numbers", seconds, "pass times in seconds")
        times: Floats = given.astype(np.float64)
        if self.clock:
            played, recorded = np.array(self.clock).T
            times = times + (recorded - played)[np.maximum(np.searchsorted(played, times, "right") - 1, 0)]
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

    Stated speeds are compared with the positions: those in another unit are converted, and zeros while the
    positions move are replaced, with a warning; others that differ are an error.

    Parameters
    ----------
    path
        ``.gpx``: a GPS track with times. ``.nmea``: RMC sentences. ``.csv``: a table with a header and the
        columns ``time_s``, one of ``speed_mps``, ``speed_kmh`` and ``speed_mph``, and perhaps ``latitude``
        and ``longitude``; other columns are ignored. Where no speed is stated, it is computed from positions
        3 s apart.
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
    check.path(path, "path")
    file = Path(path)
    shift = check.number(offset, "offset", low=-1e12, high=1e12)  # also Unix time
    readers = {".gpx": _read_gpx, ".nmea": _read_nmea, ".csv": _read_csv}
    reader = readers.get(file.suffix.lower())
    if reader is None:
        raise invalid("path", f"end in {' or '.join(readers)}", file.name, "convert the record")
    points = reader(read_regular_file(file, f"path {file}", Limit.RECORD_BYTES), str(file))
    if reader is not _read_csv:
        points = _from_first_point(points, str(file))
    seconds, speeds = _plausible_speeds(points, str(file))
    return OwnSpeed(seconds - shift, speeds)


def _from_first_point(points: Floats, name: str) -> Floats:
    """Sort points by time, leave out those with dates far from all others, and count from the first one."""
    points = _ascending(points[np.isfinite(points[:, 0])])
    if len(points):
        outlying = np.abs(points[:, 0] - np.median(points[:, 0])) > _OUTLYING
        if outlying.any():
            date = datetime.fromtimestamp(points[outlying][0, 0], UTC).date()
            count = pluralize(int(outlying.sum()), "point")
            _LOGGER.warning("%s: left out %s years from the others, such as of %s", name, count, date)
        points = points[~outlying]
    if len(points) < 2:
        nmea = name.lower().endswith(".nmea")
        remedy = "record RMC sentences with dates and checksums"
        remedy = remedy if nmea else "export a track, not a route, with times as in 2026-05-01T08:00:00Z"
        raise InvalidInputError(
            f"path {name} must have at least two track points with times, got {len(points)}; {remedy}"
        )
    return np.asarray(points - [points[0, 0], 0, 0, 0])


def _plausible_speeds(points: Floats, name: str) -> tuple[Floats, Floats]:
    """Return times (s) and speeds (m/s) of points: time, stated speed (m/s), latitude, longitude, or NaN."""
    times, stated = points[:, 0], points[:, 1]
    by_position = _speeds_of(points)
    moving = (by_position > _MOVING) & np.isfinite(stated)
    zero = moving & (stated == 0)
    if zero.sum() >= _MOVING_POINTS:
        first = int(np.argmax(zero))
        _LOGGER.warning(
            "%s: the speed is 0 at %d points, such as %g s after the first one, where the positions move by "
            "%.0f km/h; the positions are used there",
            *(name, zero.sum(), times[first] - times[0], by_position[first] * 3.6),
        )
        stated, moving = np.where(zero, np.nan, stated), moving & ~zero
    if moving.sum() >= _MOVING_POINTS:
        stated = stated / _unit_of(times - times[0], stated, by_position, moving, name)
    stated = np.where(stated <= _MAX_SPEED, stated, np.nan)
    speeds = np.where(np.isfinite(stated), stated, np.minimum(by_position, _MAX_SPEED))
    known = np.isfinite(speeds)
    if not known.any():
        raise InvalidInputError(
            f"path {name} has no speeds, and no positions at most {_MAX_GAP:g} s apart to compute them; "
            "record them every second"
        )
    fastest = int(np.nanargmax(speeds))
    if speeds[fastest] > _UNUSUAL_SPEED:
        _LOGGER.warning(
            "%s: the speed is %.0f km/h %g s after the first point; check its unit",
            *(name, speeds[fastest] * 3.6, times[fastest] - times[0]),
        )
    return times[known], speeds[known]


def _unit_of(
    seconds: Floats, stated: Floats, by_position: Floats, moving: NDArray[np.bool_], name: str
) -> float:
    """Return the unit of stated speeds, as its value for 1 m/s; an error if it is none."""
    ratios = stated[moving] / by_position[moving]
    ratio = float(np.median(ratios))
    if 0.75 < ratio < 1.33:
        return 1.0
    unit, value = min(_OTHER_UNITS.items(), key=lambda each: abs(each[1] / ratio - 1))
    if abs(value / ratio - 1) > 0.07 or np.mean(np.abs(ratios / ratio - 1) < 0.15) < 0.8:
        at = int(np.argmax(moving))
        raise InvalidInputError(
            f"path {name}: {seconds[at]:g} s after the first point, the speed is {stated[at]:.1f} m/s, but "
            f"the positions move by {by_position[at]:.1f} m/s, and others differ as well (median ratio "
            f"{ratio:.2f}); correct the speeds, or leave them out"
        )
    _LOGGER.warning(
        "%s: the speeds are %.2f times those of the positions, so they are read as %s", name, ratio, unit
    )
    return value


def _ascending(rows: Floats) -> Floats:
    """Sort rows by their times, the first column, and keep the first one of each time."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return rows[np.diff(rows[:, 0], prepend=-np.inf) > 0]


def _read_csv(data: bytes, name: str) -> Floats:
    """Read the points of a table."""
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
    rows = {number: row for number, row in enumerate(table[1:], start=2) if any(map(str.strip, row))}
    if not rows:
        raise InvalidInputError(f"path {name} has no rows below its header")
    columns = {cells[0]: cells[1:] for cells in zip_longest(header, *rows.values(), fillvalue="")}
    times = _numbers(columns["time_s"])
    speeds = _numbers(columns[unit]) * _SPEED_COLUMNS[unit]
    wrong = ~np.isfinite(times) | ~((speeds >= 0) & (speeds <= _MAX_SPEED))
    if wrong.any():
        number, row = list(rows.items())[int(np.argmax(wrong))]
        raise InvalidInputError(
            f"path {name}, line {number}: time_s and {unit} must be numbers, and the speed from 0 to "
            f"{_MAX_SPEED:g} m/s; got {shorten(','.join(row))}"
        )
    places = [columns.get(column, [""] * len(rows)) for column in ("latitude", "longitude")]
    return _ascending(np.column_stack([times, speeds, *_positions(*places)]))


def _positions(latitudes: Iterable[Any], longitudes: Iterable[Any]) -> tuple[Floats, Floats]:
    return _numbers(latitudes, -90, 90), _numbers(longitudes, -180, 180)


def _numbers(values: Iterable[Any], low: float = -math.inf, high: float = math.inf) -> Floats:
    """Return texts or numbers as numbers in a range, with NaN for anything else."""
    import pandas

    numbers = pandas.to_numeric(pandas.Series([*values], dtype=object), errors="coerce")
    return np.asarray(numbers.where(numbers.between(low, high)), np.float64)


def _seconds(texts: Iterable[str]) -> Floats:
    """Return times (ISO 8601, without a zone UTC) as seconds since 1970, with NaN for anything else."""
    import pandas

    texts = pandas.Series([*texts], dtype=object).str.strip()
    times = pandas.to_datetime(texts, format="ISO8601", utc=True, errors="coerce")
    return np.asarray((times - pandas.Timestamp(0, tz="UTC")).dt.total_seconds(), np.float64)


class _NoDoctype(ElementTree.TreeBuilder):
    """Refuses a document type, whose entities can expand to any size; GPX needs none."""

    def doctype(self, *_: Any) -> None:
        raise InvalidInputError("it has a document type declaration, which GPX does not need; remove it")


def _check_zones(points: Floats, texts: Sequence[str], name: str) -> None:
    """Refuse times of two zones: neighbouring points of the file that are whole quarters of an hour apart.

    So they are where a receiver finds its time zone, or where summer time ends.
    """
    known = np.flatnonzero(np.isfinite(points).all(axis=1, where=[True, False, True, True]))
    steps = np.diff(points[known], axis=0)
    quarters = steps[:, 0] / 900
    zoned = np.array([_ZONE.search(texts[row]) is not None for row in known.tolist()], np.bool_)
    mixed = zoned[1:] != zoned[:-1]
    whole = (np.round(quarters) != 0) & (np.abs(quarters - np.round(quarters)) * 900 < _ZONE_TOLERANCE)
    wrong = whole & (mixed | ((quarters < 0) & (quarters > -60))) & (np.abs(steps[:, 2:]).max(axis=1) < _NEAR)
    if wrong.any():
        before, after = known[np.argmax(wrong) :][:2]
        raise InvalidInputError(
            f"path {name}: the time of point {after + 1}, {texts[after].strip()}, seems to have another time "
            f"zone than {texts[before].strip()} before it; write all times in UTC"
        )


def _read_gpx(data: bytes, name: str) -> Floats:
    """Read the points of a GPX document, with times since 1970."""
    parser = ElementTree.XMLParser(target=_NoDoctype())
    try:
        parser.feed(data)
        document = parser.close()
    except InvalidInputError as error:
        raise InvalidInputError(f"path {name} is refused: {error}") from None
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the latter two: of the encoding
        raise InvalidInputError(f"path {name} is no GPX file: {error}; export it again as UTF-8") from None
    # GPX 1.0 and 1.1 have different namespaces; the speed of version 1.1 is in an extension.
    points = list(document.iterfind(".//{*}trkpt"))
    times = [point.findtext(".//{*}time") or "" for point in points]
    speeds = _numbers((point.findtext(".//{*}speed") for point in points), 0, 4 * _MAX_SPEED)
    places = _positions(*([point.get(axis) for point in points] for axis in ("lat", "lon")))
    found = np.column_stack([_seconds(times), speeds, *places])
    _check_zones(found, times, name)
    return found


_RMC = re.compile(
    r"\$(?P<text>[A-Z]{2}RMC,(\d{6}(?:\.\d+)?)?,"
    r"(?:A,(\d\d)(\d+\.?\d*),([NS]),(\d{3})(\d+\.?\d*),([EW])|V,[\d.]*,[NS]?,[\d.]*,[EW]?),"
    r"([\d.]*),[^,]*,(\d{6})?[^*\s]*)\*(?P<sum>[0-9A-Fa-f]{2})"
)


def _read_nmea(data: bytes, name: str) -> Floats:
    """Read the points of RMC sentences, with times since 1970.

    A record begins with its first sentence. If the receiver has not found its position by then, the first
    point has that time, and an unknown position and speed.
    """
    rows = list[tuple[Any, ...]]()
    for found in _RMC.finditer(data.decode("ascii", "replace")):
        _, clock, lat, lat_minutes, south, lon, lon_minutes, west, knots, date, given = found.groups()
        if functools.reduce(lambda bits, letter: bits ^ ord(letter), found["text"], 0) == int(given, 16):
            # A receiver that has just started knows neither the date nor the time.
            day, time = date or "", clock or ""
            time = f"20{day[4:]}-{day[2:4]}-{day[:2]}T{time[:2]}:{time[2:4]}:{time[4:]}"
            if lat is None:
                rows.append((time, None, None, None))
                continue
            north = (int(lat) + float(lat_minutes) / 60) * (-1 if south == "S" else 1)
            east = (int(lon) + float(lon_minutes) / 60) * (-1 if west == "W" else 1)
            rows.append((time, knots, north, east))
    times, speeds, *places = zip(*rows) if rows else [()] * 4
    in_mps = _numbers(speeds, 0, 4 * _MAX_SPEED) / _OTHER_UNITS["knots"]
    return _from_first_sentence(np.column_stack([_seconds(times), in_mps, *_positions(*places)]), name)


def _from_first_sentence(points: Floats, name: str) -> Floats:
    """Leave out points without a position, but keep the time of the first sentence."""
    located = np.isfinite(points[:, 0] + points[:, 2])
    if located.sum() < 2 or located[0]:
        return points[located]
    first = int(np.argmax(located))
    seconds = points[first, 0] - points[:first, 0]
    # The clock of a receiver without satellites may be wrong, or unset: sentences have a constant rate.
    right = (seconds > 0) & (seconds < _LONGEST_START)
    start = int(np.argmax(right)) if right.any() else first
    after = points[first:, 0]
    after = after[np.isfinite(after)][:_RATE_SENTENCES]
    waiting = float(points[first, 0] - points[start, 0] + start * (after[-1] - after[0]) / (len(after) - 1))
    _LOGGER.warning(
        "%s: the first position is %g s after the first sentence, with which the video starts",
        *(name, round(waiting, 3)),
    )
    return np.concatenate([[(points[first, 0] - waiting, *[math.nan] * 3)], points[located]])


def _speeds_of(points: Floats) -> Floats:
    """Speeds (m/s) by the positions of points; NaN where they are unknown, far apart in time, or jump."""
    speeds = np.full(len(points), np.nan)
    known = np.flatnonzero(np.isfinite(points[:, 2:]).all(axis=1))
    known = known[_is_measured(points[known])]
    times, (latitude, longitude) = points[known, 0], np.deg2rad(points[known, 2:]).T
    steps = np.diff(times)
    jumps = _great_circle(latitude[:-1], longitude[:-1], latitude[1:], longitude[1:]) > _MAX_SPEED * steps
    breaks = np.flatnonzero((steps > _MAX_GAP) | jumps) + 1
    for part in np.split(np.arange(len(known)), breaks):
        if len(part) > 1:
            speeds[known[part]] = _smooth_speeds(times[part], latitude[part], longitude[part])
    return speeds


def _is_measured(points: Floats) -> NDArray[np.bool_]:
    """Whether each position is measured: a log may repeat it until the receiver has the next one."""
    measured = np.ones(len(points), np.bool_)
    measured[1:] = np.diff(points[:, 2:], axis=0).any(axis=1)
    seconds = np.diff(points[measured, 0], append=points[-1:, 0])  # until the next position
    if len(points) < 2 or np.median(seconds) < 1.5 * np.median(np.diff(points[:, 0])):
        return np.ones(len(points), np.bool_)
    # Positions that are the same for longer are those of a vehicle that stands.
    return np.asarray(measured | (seconds > _MAX_GAP)[np.cumsum(measured) - 1])


def _smooth_speeds(times: Floats, latitude: Floats, longitude: Floats) -> Floats:
    """Speeds (m/s) from positions (radians): distance along the great circle between positions 3 s apart."""
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
