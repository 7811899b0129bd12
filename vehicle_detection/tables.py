"""`TrackTable`: the rows of tracks, detections or labels of several frames, as columns."""

from __future__ import annotations

import logging
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import (
    Floats,
    check,
    invalid,
    is_listing,
    natural_key,
    parse_number,
    pluralize,
    shorten,
)
from vehicle_detection.boxes import (
    TABLE_COLUMNS,
    VEHICLE_CLASSES,
    Detections,
    confidence_score,
    warn_of_vehicles,
)
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.tracking import TRACK_VALUES, UNKNOWN_LABEL, is_result, shown_tracks

if TYPE_CHECKING:
    import pandas

FrameKey = int | str

NO_TRACK = -1
"""Track of a box without identity. A row with `ignore` and this track is a region, not a vehicle."""

CORNERS = ("x1", "y1", "x2", "y2")
BOX_COLUMNS = ("frame", "track_id", *CORNERS, "score")
TRACK_COLUMNS = (*BOX_COLUMNS[:-1], *TRACK_VALUES)
"""Columns of a table of tracks, in the order of the files."""
LABEL_COLUMNS = ("occluded", "truncated", "ignore")

LOOKALIKE_CLASSES = ("tram", "train", "misc", "trailer", "caravan", "autorickshaw", "vehicle fallback")
"""Classes whose labels are ignored boxes."""
_CLASS_COLUMNS = ("class", "label", "category")
_OWN_COLUMNS = ({"score", "confidence", "label"}, {"track_id", "label", *LABEL_COLUMNS})  # of written files

_LOGGER = logging.getLogger(__name__)

_FLAGS = {"false": False, "true": True, "0": False, "1": True, "0.0": False, "1.0": True}
# Distances and speeds beyond the first are unknown, corners of boxes are errors.
_ABSURD, _MAX_ID = 1e9, 2**62
_REAL = (int, float, np.integer, np.floating)


class _Column(NamedTuple):
    """Default of a column, which also sets its type, and its allowed range."""

    missing: float | str
    low: float = -math.inf
    high: float = math.inf
    expected: str = "a finite number"


_COLUMNS = {
    "track_id": _Column(NO_TRACK, NO_TRACK, expected="a number from 0, or -1 for none"),
    "score": _Column(math.nan),
    "distance_m": _Column(math.nan),
    "speed_mps": _Column(math.nan),
    "confidence": _Column(math.nan, 0, 1, "a probability from 0 to 1"),
    "distance_std_m": _Column(math.nan, 0, expected="at least 0"),
    "speed_std_mps": _Column(math.nan, 0, expected="at least 0"),
    "label": _Column(UNKNOWN_LABEL),
    "time_since_update": _Column(math.nan, 0, expected="at least 0"),
    "occluded": _Column(0, 0, expected="0 (visible), 1 (partly) or 2 (largely hidden)"),
    "truncated": _Column(0.0, 0, 1, "a fraction from 0 to 1"),
    "ignore": _Column(False),
}
"""All columns except ``frame`` and the corners of the boxes."""
_CORNER = _Column(math.nan, -_ABSURD, _ABSURD, f"a number of pixels up to {_ABSURD:g}")

_NUMBERS = (*TRACK_VALUES[:-1], "time_since_update")  # values of a `Track`


class TrackTable:
    """Boxes of several frames, one row each: tracks, detections or labels.

    ``table["score"]`` is a column, named as in the files; one that the table lacks is full of its default.
    ``table[rows]`` selects rows by an index, a slice, a mask or a list and keeps all frame keys; `frame` and
    `select` keep only theirs. Iterating yields the key and the table of each frame. A table of a video grows
    by `append`, which sets `first_time`, the time of the video's first frame in seconds, None if unknown.
    Selections keep it, even without that frame.

    Parameters
    ----------
    frame
        Frame key of each row: all int (counted from 0) or all str (the image's file name).
    track_id
        ``(N,)`` numbers of the vehicles within the video, each at most once a frame; -1 for none.
    boxes
        ``(N, 4)`` ``[x1, y1, x2, y2]`` in half-open pixels.
    frame_keys
        All frames, including those without a box; the frames of the rows are added.
    **columns
        Other columns, ``(N,)`` or None: ``score``, ``confidence``, ``distance_m``, ``distance_std_m``,
        ``speed_mps`` and ``speed_std_mps``, NaN where a value is unknown; ``label``, the class, ``"vehicle"``
        if unknown; ``time_since_update`` (s), only in memory; and of labels, which have no ``score``,
        ``occluded`` (0 visible, 1 partly, 2 largely), ``truncated`` (fraction) and ``ignore`` (not scored).

    Examples
    --------
    >>> labels = TrackTable([0, 0, 2], [1, 2, 1], [[0, 0, 50, 40], [90, 0, 140, 40], [5, 0, 55, 40]])
    >>> labels, labels.frame_keys, labels.frame(2).boxes
    (TrackTable(3 boxes in 2 frames), (0, 2), array([[ 5.,  0., 55., 40.]]))
    >>> labels["track_id"]
    array([1, 2, 1])
    """

    def __init__(
        self,
        frame: Iterable[FrameKey] = (),
        track_id: ArrayLike | None = None,
        boxes: Detections | ArrayLike = (),
        *,
        frame_keys: Iterable[FrameKey] = (),
        **columns: ArrayLike | None,
    ) -> None:
        unknown = next((name for name in columns if name not in _COLUMNS), None)
        if unknown is not None:
            raise InvalidInputError(f"column must be one of {', '.join(_COLUMNS)}; got {unknown!r}")
        frames, corners = check_keys(frame, "frame"), check.boxes(boxes).astype(np.float64)
        count = len(corners)
        if len(frames) != count:
            raise InvalidInputError(f"frame must be one key for each of the {count} boxes, got {len(frames)}")
        columns = {"track_id": track_id, **columns}
        if columns.get("score") is None:
            columns |= {name: columns.get(name) for name in LABEL_COLUMNS}
        given = {
            name: _check_column(values, name, count)
            for name, values in columns.items()
            if values is not None or name in ("track_id", *LABEL_COLUMNS)
        }
        if not np.isfinite(given.get("score", 0)).all():
            raise InvalidInputError("score must be finite, got NaN or infinity; drop those rows")
        for (key, track), times in Counter(zip(frames, given["track_id"].tolist())).items():
            if track != NO_TRACK and times > 1:
                twice = f"frame {key!r} holds track {track} twice"
                raise InvalidInputError(f"{twice}; give each vehicle its own number")
        kind = object if frames and isinstance(frames[0], str) else np.int64
        keys = set(check_keys((*check_keys(frame_keys, "frame_keys"), *frames), "frame_keys"))
        self._set({"frame": np.array(frames, kind), "boxes": corners, **given}, sorted(keys, key=frame_order))

    def _set(self, columns: dict[str, NDArray[Any]], keys: Sequence[FrameKey]) -> Self:
        # Columns of an appended table have room for more rows than `_size`.
        self._columns, self._size = columns, len(columns["boxes"])
        self._keys: list[FrameKey] = list(keys)
        self._times: dict[int, float] = {}  # of appended frames with a known time
        self._rows: dict[FrameKey, NDArray[np.intp]] | None = None
        self._growing = not self._keys
        self.first_time: float | None = None
        return self

    def _take(self, rows: NDArray[np.intp], keys: Sequence[FrameKey]) -> TrackTable:
        taken = {name: column[: self._size][rows] for name, column in self._columns.items()}
        table = TrackTable.__new__(TrackTable)._set(taken, keys)
        table._times = {int(key): self._times[int(key)] for key in keys if key in self._times}
        table.first_time = self.first_time
        return table

    @classmethod
    def from_detections(cls, detections: Mapping[FrameKey, Detections] | Sequence[Detections]) -> TrackTable:
        """Collect the detections of each frame, by its key; frames without any count as frames.

        The keys of a list are the names of the images' files, or numbers where there are none.
        """
        if isinstance(detections, list):
            paths = [getattr(found, "path", None) for found in detections]
            keys: Any = range(len(paths)) if None in paths else [path.name for path in paths if path]
            keys = keys if len({*keys}) == len(paths) else map(str, paths)
            return cls.from_detections(dict(zip(keys, detections)))
        if not isinstance(detections, Mapping):
            raise invalid("detections", "be a list or a dictionary", detections)
        for key, found in detections.items():
            check.instance(found, f"detections[{key!r}]", Detections, "pass Detections(boxes, scores)")
        parts = [Detections.empty(), *detections.values()]
        columns = {}
        for name, attribute in TABLE_COLUMNS.items():
            values = [getattr(each, attribute, None) for each in parts]
            if name in _COLUMNS and (name == "confidence" or any(each is not None for each in values)):
                gaps = [np.full(len(each), _COLUMNS[name].missing) for each in parts]
                columns[name] = np.concatenate([g if v is None else v for g, v in zip(gaps, values)])
        return cls(
            [key for key, found in detections.items() for _ in range(len(found))],
            None,
            np.concatenate([found.boxes for found in parts]),
            score=np.concatenate([found.scores for found in parts]),
            **columns,
            frame_keys=tuple(detections),
        )

    @classmethod
    def from_results(cls, results: Iterable[Any]) -> TrackTable:
        """Collect the tracks that a detector shows from the :class:`FrameResult` of each frame.

        Frames without a track still count as frames. `write_tracks` writes the same, rounded.
        """
        if isinstance(results, Mapping) or not is_listing(results):
            raise InvalidInputError(f"results must be a list of FrameResult, got {check.describe(results)}")
        table = cls()
        for result in results:
            if not is_result(result):
                remedy = "use read_labels for files, TrackTable.from_pandas for tables"
                raise invalid("results", "be FrameResult objects", result, remedy)
            table.append(result)
        return table

    @classmethod
    def from_pandas(cls, table: pandas.DataFrame, *, classes: Collection[str] | None = None) -> TrackTable:
        """Take the boxes of a table with the columns of `to_pandas`; only frame and corners are required.

        ``pandas.read_csv`` of a file of `write_tracks` is such a table. A missing track is -1, other missing
        values are 0. A column ``class``, ``label`` or ``category`` selects vehicles as in `read_labels`.
        """
        if not hasattr(table, "iloc") or not hasattr(table, "columns"):
            remedy = "convert it with table.to_pandas()" if hasattr(table, "to_pandas") else ""
            must = f"be a pandas.DataFrame with the columns frame, {', '.join(CORNERS)}"
            raise invalid("table", must, table, remedy)
        names = list(table.columns)
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InvalidInputError(f"table must have each column once; got {twice} more than once")
        cells = {
            name: [None if gone else value for value, gone in zip(table[name].tolist(), table[name].isna())]
            for name in names
        }
        places = [f"table row {row}" for row in range(len(table))]
        try:
            return cls(**parse_cells(cells, "table", places, classes)[0])
        except DatasetError as error:
            raise InvalidInputError(str(error)) from None

    def append(self, frame: Any, time: float | None = None, tracks: Iterable[Any] = ()) -> None:
        """Add the shown tracks of the next frame.

        `frame` is a :class:`FrameResult`, or its number, ascending from 0, with its `time` (s) and `tracks`.
        """
        if is_result(frame):
            frame, time, tracks = frame.index, getattr(frame, "time", None), frame.tracks
        check.integer(frame, "frame", low=0)
        if not self._growing:
            raise InvalidInputError("append needs a table that was empty at first; start with TrackTable()")
        first = int(self._keys[-1]) + 1 if self._keys else 0
        if frame < first:
            must, remedy = f"be at least {first}, as frames are added in order", "use a table for each video"
            raise invalid("frame", must, frame, remedy)
        if time is not None:
            time = check.number(time, "time", low=-1e12, high=1e12)
        shown = shown_tracks(tracks)
        self._reserve(self._size + len(shown))
        new = slice(self._size, self._size + len(shown))
        self._columns["frame"][new] = frame
        self._columns["track_id"][new] = [track.id for track in shown]
        if shown:
            self._columns["boxes"][new] = [track.box for track in shown]
            self._columns["label"][new] = [getattr(track, "label", UNKNOWN_LABEL) for track in shown]
            for name in _NUMBERS:
                # None becomes NaN.
                values = np.array([getattr(track, name, None) for track in shown], np.float64)
                self._columns[name][new] = np.where(np.abs(values) < _ABSURD, values, np.nan)
        self._size += len(shown)
        if not self._keys:
            self.first_time = time
        if time is not None:
            self._times[int(frame)] = time
        self._keys.append(int(frame))
        self._rows = None

    def _reserve(self, size: int) -> None:
        """Make room for `size` rows; columns double, so that appending takes constant time on average."""
        if not self._keys:
            self._columns |= {name: np.empty(0) for name in _NUMBERS} | {"label": np.empty(0, object)}
            for name in LABEL_COLUMNS:
                self._columns.pop(name, None)
        if size > len(self._columns["boxes"]):
            count = max(2 * size, 64)
            grown = {name: np.resize(each, (count, *each.shape[1:])) for name, each in self._columns.items()}
            self._columns = grown

    def __len__(self) -> int:
        return self._size

    def __repr__(self) -> str:
        boxes, frames = pluralize(len(self), "box", "es"), pluralize(len(self._keys), "frame")
        return f"TrackTable({boxes} in {frames})"

    def _repr_html_(self) -> str:
        return f"<p>{self!r}</p>{self.to_pandas().to_html(max_rows=20)}"

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that the table has, in the order of the files."""
        names = [name for name in (*TRACK_VALUES, *LABEL_COLUMNS) if name in self._columns]
        return ("frame", "track_id", *CORNERS, *names)

    @property
    def boxes(self) -> Floats:
        """``(N, 4)`` boxes ``[x1, y1, x2, y2]``."""
        return self._columns["boxes"][: self._size]

    @property
    def frame_keys(self) -> tuple[FrameKey, ...]:
        """All frames in order, including those without a box."""
        return tuple(self._keys)

    @overload
    def __getitem__(self, item: str) -> NDArray[Any]: ...
    @overload
    def __getitem__(self, item: int | slice | NDArray[Any] | list[int]) -> TrackTable: ...
    def __getitem__(self, item: str | int | slice | NDArray[Any] | list[int]) -> NDArray[Any] | TrackTable:
        if not isinstance(item, str):
            taken = [item] if isinstance(item, (int, np.integer)) else item
            return self._take(np.arange(len(self))[taken], self._keys)
        if item in CORNERS:
            return self.boxes[:, CORNERS.index(item)]
        if item in self._columns:
            return self._columns[item][: self._size]
        if item not in _COLUMNS:
            raise InvalidInputError(f"column must be one of {', '.join(_COLUMNS)}; got {item!r}")
        return np.full(len(self), _COLUMNS[item].missing)

    def rows(self, key: FrameKey) -> NDArray[np.intp]:
        """Row numbers of a frame's boxes; empty for a frame without boxes."""
        check.instance(key, "key", (int, str, np.integer), "pass the key of one frame")
        if self._rows is None:
            found: dict[FrameKey, list[int]] = defaultdict(list)
            for row, of_row in enumerate(self["frame"].tolist()):
                found[of_row].append(row)
            self._rows = {of_rows: np.array(rows, np.intp) for of_rows, rows in found.items()}
        return self._rows.get(key, np.empty(0, np.intp))

    def frame(self, key: FrameKey) -> TrackTable:
        """Select the boxes of one frame; empty for a frame without boxes."""
        return self._take(self.rows(key), (key,))

    def select(self, keys: Iterable[FrameKey]) -> TrackTable:
        """Select the boxes of some frames, which are all frames of the result."""
        wanted = set(keys)
        rows = [row for row, key in enumerate(self["frame"].tolist()) if key in wanted]
        return self._take(np.array(rows, np.intp), sorted(wanted, key=frame_order))

    def __iter__(self) -> Iterator[tuple[FrameKey, TrackTable]]:
        return ((key, self.frame(key)) for key in self.frame_keys)

    def by_track(self) -> dict[int, TrackTable]:
        """Rows of each track by frame, in the order of first frames; boxes without a track are left out."""
        numbers = {key: number for number, key in enumerate(self._keys)}
        frames = np.array([numbers[key] for key in self["frame"].tolist()], np.intp)
        order = np.lexsort((frames, self["track_id"]))
        order = order[self["track_id"][order] != NO_TRACK]
        starts = np.flatnonzero(np.diff(self["track_id"][order])) + 1
        parts = [part for part in np.split(order, starts) if len(part)]
        parts.sort(key=lambda part: int(frames[part[0]]))  # stable: by id within a frame
        return {int(self["track_id"][part[0]]): self._take(part, self._keys) for part in parts}

    def counts(self) -> NDArray[np.int64]:
        """Count the rows in each frame from 0 to the last one, of a table with numbered frames.

        A frame that a live source dropped counts as the one before, which a written video shows again.
        """
        keys = np.array(self._keys, np.int64)
        if not len(keys):
            return keys
        numbers, counts = np.unique(self["frame"].astype(np.int64), return_counts=True)
        of_keys = np.zeros(len(keys), np.int64)
        of_keys[np.searchsorted(keys, numbers)] = counts
        shown = np.searchsorted(keys, np.arange(keys[-1] + 1), side="right") - 1
        return np.where(shown >= 0, of_keys[shown], 0)

    def times(self) -> Floats | None:
        """Time (s) of each frame from 0 to the last one, interpolated where it is unknown or does not ascend.

        None if that is so for most frames, for the first or the last one, and for frames with names.
        """
        if not self._times:
            return None
        times = np.full(int(self._keys[-1]) + 1, np.nan)
        times[list(self._times)] = list(self._times.values())
        known = np.isfinite(times)
        latest = np.maximum.accumulate(np.where(known, times, -np.inf))
        known[1:] &= times[1:] > latest[:-1]
        rows = np.flatnonzero(known)
        if 2 * rows.size <= times.size or not known[0] or not known[-1]:
            return None
        return np.asarray(np.interp(np.arange(times.size), rows, times[rows]))

    def renamed(self, rename: Callable[[Any], FrameKey]) -> TrackTable:
        """Return a copy, without times, in which ``rename(key)`` replaces every frame key."""
        if not callable(rename):
            raise InvalidInputError(f"rename must be a function of a frame key; got {check.describe(rename)}")
        frames, keys = ([rename(key) for key in each] for each in (self["frame"].tolist(), self._keys))
        columns = {name: self._columns[name][: self._size] for name in self._columns if name in _COLUMNS}
        return TrackTable(frames, boxes=self.boxes, frame_keys=keys, **columns)

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with one row per box and the columns of the files, NaN where a value is unknown.

        A table that has grown by `append` also has the times of the frames, ``time_s``.

        >>> TrackTable([0, 3], [7, 8], [[0, 0, 50, 40], [5, 0, 55, 40]]).to_pandas().iloc[1].to_dict()
        {'frame': 3, 'track_id': 8, 'x1': 5.0, 'y1': 0.0, 'x2': 55.0, 'y2': 40.0, 'occluded': 0, \
'truncated': 0.0, 'ignore': False}
        """
        import pandas

        times = self.times()  # of all frames from 0 on
        more = {} if times is None else {"time_s": times[self["frame"].astype(np.intp)]}
        return pandas.DataFrame({name: self[name] for name in self.columns} | more)


def check_keys(values: object, name: str) -> tuple[FrameKey, ...]:
    """Return frame keys as Python values that are all int or all str."""
    given = check.sequence(values, name, "frame keys (int or str)")
    keys = tuple(key.item() if isinstance(key, np.generic) else key for key in given)
    kinds = {type(key) for key in keys}
    if kinds - {int} and kinds - {str}:
        listed = ", ".join(sorted(kind.__name__ for kind in kinds))
        raise InvalidInputError(f"{name} must be all int or all str, got {listed}; convert them to one type")
    return keys


def frame_order(key: FrameKey) -> tuple[list[object], str]:
    """Natural sort key: frame 2 comes before frame 10, also in file names."""
    return ([key], "") if isinstance(key, int) else natural_key(key)


def _check_column(values: ArrayLike | None, name: str, rows: int) -> NDArray[Any]:
    """Check one value per row; returned with the dtype of the column."""
    column: Any = _COLUMNS[name]
    filled = np.full(rows, column.missing)
    if name == "label":
        labels = [UNKNOWN_LABEL] * rows if values is None else np.asarray(values).tolist()
        if len(labels) != rows or not all(isinstance(label, str) for label in labels):
            raise invalid("label", f"be a name for each of the {rows} boxes", values)
        return np.array(labels, object)
    given = filled if values is None else check.array(values, name)
    if given.size == 0:
        given = given.reshape(-1).astype(filled.dtype)
    kinds = {"b": "b", "i": "iub", "f": "iufb"}[filled.dtype.kind]
    if given.shape != (rows,) or given.dtype.kind not in kinds:
        raise invalid(name, f"be one value for each of the {rows} boxes", given)
    outside = (given < column.low) | (given > column.high)
    if outside.any():
        raise InvalidInputError(f"{name} must be {column.expected}; got {given[outside][0]}")
    return given.astype(filled.dtype)


def parse_cells(
    cells: Mapping[str, Sequence[Any]],
    source: object,
    places: Sequence[str],
    classes: Collection[str] | None = None,
) -> tuple[dict[str, Any], list[str]]:
    """Arguments of `TrackTable` from cells, which are text or values, by the name of their column.

    `places` states where each row is, for messages. Keeps vehicles and, as ignored rows, lookalikes; also
    returns the places of the kept rows.
    """
    missing = [name for name in ("frame", *CORNERS) if name not in cells]
    if missing:
        found = shorten(", ".join(map(str, cells)), 300) or "an empty file"
        raise DatasetError(f"{source} lacks the columns {', '.join(missing)}; found {found}")
    keys = _parse_frames(cells["frame"], places)
    cells = _with_scores(cells, places)
    scores = cells.get("score")
    predicted = scores is not None and (not scores or not all(map(_is_missing, scores)))
    vehicles, lookalike, labels = _vehicle_rows(cells, source, classes, predicted)
    rows = np.flatnonzero(vehicles).tolist()
    where = [places[row] for row in rows]
    columns: dict[str, Any] = {}
    if labels is not None:
        columns["label"] = [labels[row] or UNKNOWN_LABEL for row in rows]
    for name in (*CORNERS, *(_COLUMNS.keys() - columns.keys())):
        used = "track" if name == "track_id" and name not in cells else name
        if name != "label" and used in cells and (name != "score" or predicted):
            columns[name] = _parse_numbers(used, [cells[used][row] for row in rows], where)
    if lookalike.any():
        columns["ignore"] = columns.get("ignore", False) | lookalike[rows]
    columns["boxes"] = np.stack([columns.pop(name) for name in CORNERS], axis=1)
    return {"frame": [keys[row] for row in rows], "frame_keys": keys, **columns}, where


def _with_scores(cells: Mapping[str, Sequence[Any]], places: Sequence[str]) -> Mapping[str, Sequence[Any]]:
    """Add the log-odds of confidences as scores if a table has no others: such boxes are no labels."""
    confidences = cells.get("confidence", cells.get("conf", ()))
    if not all(map(_is_missing, cells.get("score", ()))) or all(map(_is_missing, confidences)):
        return cells
    known = _parse_numbers("confidence", confidences, places).tolist()
    return {**cells, "confidence": confidences, "score": list(map(confidence_score, known))}


def _is_missing(cell: Any) -> bool:
    """Whether a cell is empty, None or NaN."""
    return cell is None or str(cell).strip().lower() in ("", "nan")


def _parse_frames(cells: Sequence[Any], places: Sequence[str]) -> list[FrameKey]:
    """Frames as numbers or names; whole numbers that a concatenation has made floats are numbers again."""
    keys: list[FrameKey] = []
    for cell, place in zip(cells, places, strict=True):
        if isinstance(cell, str) and cell:
            keys.append(cell)  # which may be "nan"
        elif _is_missing(cell):
            raise DatasetError(f"{place}: frame is empty; enter its number from 0 or its file name")
        elif isinstance(cell, _REAL) and type(cell) is not bool and 0 <= cell <= _MAX_ID and cell % 1 == 0:
            keys.append(int(cell))
        else:
            got = check.describe(cell)
            raise DatasetError(f"{place}: frame must be a whole number from 0 or a name, got {got}")
        if type(keys[-1]) is not type(keys[0]):
            raise DatasetError(f"{place}: frame must be a number in every row, or a name in every row")
    return keys


def _vehicle_rows(
    cells: Mapping[str, Sequence[Any]], source: object, classes: Collection[str] | None, predicted: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], list[str] | None]:
    """Mark the rows to keep, and the labels of lookalikes among them, by the columns of classes.

    Also returns the class of each row, None if the file has none. Files written here hold vehicles only.
    """
    count = len(cells["frame"])
    given = [cells[name] for name in _CLASS_COLUMNS if name in cells]
    firsts = [next((cell for cell in row if not _is_missing(cell)), "") for row in zip(*given)]
    names = [re.sub(r"^(\d+)\.0+$", r"\1", str(cell).strip().lower()) for cell in firsts]
    found = {*names} - {""}
    # Classes that are numbers or flags have no names: all rows are vehicles.
    numbered = any(re.fullmatch(r"[-\d.]+|true|false", name) for name in found)
    is_own = any(cells.keys() >= own for own in _OWN_COLUMNS)
    if not count or (classes is None and (not found or numbered or is_own)):
        others = found - {*VEHICLE_CLASSES, *LOOKALIKE_CLASSES}
        if len(others) > numbered and (numbered or "score" not in cells):
            text = "%s: boxes of class %s are read as vehicles; classes= selects some"
            _LOGGER.warning(text, source, shorten(", ".join(sorted(others))))
        return np.ones(count, np.bool_), np.zeros(count, np.bool_), names if found and not numbered else None
    if not found:
        raise DatasetError(f"{source} has no classes; leave out classes=")
    wanted = VEHICLE_CLASSES if classes is None else classes
    check_classes(source, found, wanted)
    if "" in names:
        _LOGGER.warning("%s: boxes without a class are left out: %d", source, names.count(""))
    vehicles = np.array([name in wanted for name in names])
    lookalike = ~vehicles & np.isin(names, LOOKALIKE_CLASSES) & (not predicted)
    return vehicles | lookalike, lookalike, None if numbered else names


def check_classes(
    source: object, found: Collection[str], wanted: Collection[str], kind: str = "class"
) -> None:
    """Refuse a file in which no class is that of vehicles: it would have no box. Warn of similar classes."""
    if not any(name in wanted for name in found):
        listed = shorten(", ".join(map(repr, sorted(found))), 300) or "none"
        must = f"has no {kind} among {', '.join(sorted(wanted))}"
        raise DatasetError(f"{source} {must}; found {listed}; name those of vehicles with classes=")
    if wanted is VEHICLE_CLASSES:
        warn_of_vehicles(str(source), found, {*wanted, *LOOKALIKE_CLASSES})


def _parse_numbers(name: str, cells: Sequence[Any], places: Sequence[str]) -> NDArray[Any]:
    """Numbers of a column; a missing one, except for a corner or a score, gets the column's default."""
    column = _COLUMNS.get("track_id" if name == "track" else name, _CORNER)
    kind = type(column.missing)
    values = []
    for cell, place in zip(cells, places, strict=True):
        value: Any = column.missing
        if _is_missing(cell) and name == "score":
            raise DatasetError(f"{place}: some boxes have a score and some have none; give all or none")
        if kind is bool and not _is_missing(cell):
            value = _FLAGS.get(str(cell).strip().lower())
            if value is None:
                raise DatasetError(f"{place}: {name} must be 0 or 1, got {check.describe(cell)}")
        elif not _is_missing(cell) or name in CORNERS:
            value = parse_number(cell, name, place)
            if kind is int and value != int(value):
                raise DatasetError(f"{place}: {name} must be a whole number, got {check.describe(cell)}")
            if not column.low <= value <= column.high or (kind is int and value > _MAX_ID):
                raise DatasetError(f"{place}: {name} must be {column.expected}, got {check.describe(cell)}")
        values.append(kind(value))
    return np.array(values, {bool: np.bool_, int: np.int64, float: np.float64}[kind])
