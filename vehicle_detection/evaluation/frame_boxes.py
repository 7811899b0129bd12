"""Labelled or predicted boxes of several frames, as columns: `FrameBoxes`."""

from __future__ import annotations

import dataclasses
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import (
    check_array,
    check_boxes,
    check_sequence,
    check_type,
    describe,
    natural_key,
    pluralize,
)
from vehicle_detection.boxes import Detections
from vehicle_detection.datasets import is_image
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.export import check_items, is_result, shown_tracks

if TYPE_CHECKING:
    import pandas

FrameKey = int | str

NO_TRACK = -1
"""Track of a box without identity. A row with `ignore` and this track is a region, not a vehicle."""

_CORNERS = ("x1", "y1", "x2", "y2")
# Attribute and type of each optional column of a table.
_TABLE_COLUMNS: dict[str, tuple[str, type]] = {
    "occluded": ("occluded", int),
    "truncated": ("truncated", float),
    "ignore": ("ignore", bool),
    "score": ("scores", float),
    "distance_m": ("distance_m", float),
    "speed_mps": ("speed_mps", float),
}

VEHICLE_CLASSES = ("car", "van", "truck", "bus", "vehicle")
LOOKALIKE_CLASSES = ("tram", "train", "misc", "trailer", "caravan", "autorickshaw", "vehicle fallback")
"""Classes whose boxes are vehicles by default, and classes whose labels are ignored."""
_CLASS_COLUMNS = ("class", "label", "category")  # of tables, all optional

_FLAGS = {"false": False, "true": True}
# Values of cells that are missing, as after a concatenation of tables.
_USUAL = {"occluded": 0, "truncated": 0.0, "ignore": 0, "track": NO_TRACK, "track_id": NO_TRACK}

_ROW_COLUMNS = ("tracks", "boxes", "occluded", "truncated", "ignore", "scores", "distance_m", "speed_mps")


def check_keys(values: object, name: str) -> tuple[FrameKey, ...]:
    """Return frame keys as Python values that are all int or all str."""
    given = check_sequence(values, name, "frame keys (int or str)")
    keys = tuple(key.item() if isinstance(key, np.generic) else key for key in given)
    kinds = {type(key) for key in keys}
    if kinds - {int} and kinds - {str}:
        listed = ", ".join(sorted(kind.__name__ for kind in kinds))
        raise InvalidInputError(f"{name} must be all int or all str, got {listed}; convert them to one type")
    return keys


def frame_order(key: FrameKey) -> tuple[list[object], str]:
    """Natural sort key: frame 2 comes before frame 10, also in file names."""
    return ([key], "") if isinstance(key, int) else natural_key(key)


def without_suffix(name: str) -> str:
    """Return the name of a frame without the suffix of an image."""
    path = PurePosixPath(name)
    return name[: -len(path.suffix)] if is_image(path.name) else name


def match_names(boxes: FrameBoxes, keys: Sequence[FrameKey], sides: tuple[str, str]) -> FrameBoxes:
    """Rename frames to `keys` where the names differ by a folder or the suffix of an image only.

    Nothing is renamed if a frame is among `keys`. Names that are not unique then are an error, which names
    `boxes` and `keys` by `sides`.
    """
    if set(boxes.frame_keys) & set(keys):
        return boxes
    ours, theirs = (
        {PurePosixPath(without_suffix(key)).name: key for key in side if isinstance(key, str)}
        for side in (boxes.frame_keys, keys)
    )
    shared = ours.keys() & theirs.keys()
    if not shared:
        return boxes
    paths = [[f"/{without_suffix(side[name])}" for side in (ours, theirs)] for name in sorted(shared)]
    different = [pair for pair in paths if not (pair[0].endswith(pair[1]) or pair[1].endswith(pair[0]))]
    if different or len(ours) < len(boxes.frame_keys) or len(theirs) < len(keys):
        name = min(shared)
        raise InvalidInputError(
            f"frame names of {sides[0]} and {sides[1]} differ: {ours[name]!r} and {theirs[name]!r}; use the "
            "same names on both sides, for example with FrameBoxes.renamed"
        )
    names = {ours[name]: theirs[name] for name in shared}
    return boxes.renamed(lambda key: names.get(key, key))


def _column(values: ArrayLike | None, name: str, rows: int, kinds: str, default: Any) -> NDArray[Any]:
    """Check one value per row of one of the dtype `kinds`; returned with the dtype of `default`."""
    filled = np.full(rows, default)
    column = filled if values is None else check_array(values, name)
    if column.size == 0:
        column = column.reshape(-1).astype(filled.dtype)
    if column.shape != (rows,) or column.dtype.kind not in kinds:
        raise InvalidInputError(
            f"{name} must be one value for each of the {rows} boxes, got {describe(column)}"
        )
    return column.astype(filled.dtype)


def class_name(record: Mapping[Any, Any]) -> str:
    """Class of a row of a table in lower case; empty if the row has none."""
    values = (record.get(column) for column in _CLASS_COLUMNS)
    return next((str(value).lower() for value in values if value), "")


def known_classes(names: Iterable[str]) -> set[str]:
    """Classes in a table, given that of each row; none if they are numbers or flags."""
    found = {*names} - {""}
    return set() if any(re.fullmatch(r"[-\d.]+|true|false", name) for name in found) else found


def none_if_unknown(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return a column, or None if all values are NaN."""
    return None if np.isnan(values).all() else values


def _table_frames(table: pandas.DataFrame) -> list[FrameKey]:
    """Frames of a table; whole numbers that a concatenation has made floats are numbers again."""
    frames: list[Any] = table["frame"].tolist()
    if all(type(frame) in (int, float) and float(frame).is_integer() for frame in frames):
        return [int(frame) for frame in frames]
    return frames


def _table_column(table: pandas.DataFrame, name: str, kind: type) -> NDArray[Any]:
    """Return a column of a table as numbers; a missing flag, occlusion or track is the usual one."""
    missing = table[name].isna().tolist()
    values = [
        _USUAL.get(name, math.nan) if gone else _FLAGS.get(str(value).lower(), value)
        for value, gone in zip(table[name].tolist(), missing, strict=True)
    ]
    fractions = [value for value in values if isinstance(value, float) and not value.is_integer()]
    if kind is not float and fractions:
        raise InvalidInputError(
            f"table must hold whole numbers in the column {name}, got {fractions[0]:g}; convert it to int"
        )
    if kind is bool and not all(value in (0, 1) for value in values):
        raise InvalidInputError(f"table must hold 0 or 1 in the column {name}; convert it to bool")
    try:
        return np.array(values, np.float64 if kind is float else np.int64).astype(kind)
    except (TypeError, ValueError, OverflowError):
        raise InvalidInputError(
            f"table must hold numbers in the column {name}, got {describe(values)}; convert it"
        ) from None


def _vehicle_rows(table: pandas.DataFrame) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Mark the rows of a table to keep, and those among them to ignore, by the columns of classes."""
    columns = [name for name in _CLASS_COLUMNS if name in table]
    texts = table[columns].astype(object).where(table[columns].notna(), "")
    names = [class_name(dict(zip(columns, row))) for row in texts.itertuples(index=False)]
    found = known_classes(names)
    if not found:
        return np.ones(len(table), np.bool_), np.zeros(len(table), np.bool_)
    if found.isdisjoint(VEHICLE_CLASSES):
        raise InvalidInputError(
            f"table must have a class among {', '.join(VEHICLE_CLASSES)}; got {', '.join(sorted(found))}; "
            "select the rows of vehicles and drop the column"
        )
    vehicles, lookalike = np.isin(names, VEHICLE_CLASSES), np.isin(names, LOOKALIKE_CLASSES)
    if "score" in table and table["score"].notna().any():  # predictions
        lookalike[:] = False
    return vehicles | lookalike, lookalike


@dataclass(frozen=True, eq=False, repr=False)
class FrameBoxes:
    """Labelled or predicted boxes of several frames, as columns that are checked on construction.

    Attributes
    ----------
    frames
        Frame key of each row: all int (counted from 0) or all str (the image's file name).
    tracks
        ``(N,)`` numbers of the vehicles within the clip, -1 for none; None if no box has one.
    boxes
        ``(N, 4)`` ``[x1, y1, x2, y2]`` in half-open pixels.
    occluded, truncated
        ``(N,)`` occlusion, 0 visible (the default), 1 partly, 2 largely hidden; and fraction of the vehicle
        outside the image, 0-1 (default 0).
    ignore
        ``(N,)`` rows that are not scored; with track -1 the row is a region. Default False.
    scores, distance_m, speed_mps
        ``(N,)`` values of predictions, or None. Unknown distances and speeds are NaN.
    frame_keys
        All frames in order, including those without a box; the frames of the rows are added.

    Raises
    ------
    InvalidInputError
        If columns differ in length or hold invalid values, or a track occurs twice in a frame.

    Examples
    --------
    >>> labels = FrameBoxes([0, 0, 2], [1, 2, 1], [[0, 0, 50, 40], [90, 0, 140, 40], [5, 0, 55, 40]])
    >>> labels, labels.frame_keys, labels.frame(2).boxes
    (FrameBoxes(3 boxes in 2 frames), (0, 2), array([[ 5.,  0., 55., 40.]]))
    """

    frames: Sequence[FrameKey]
    tracks: NDArray[np.int64]
    boxes: NDArray[np.float64]
    _: KW_ONLY
    occluded: NDArray[np.int64] = None  # type: ignore[assignment]
    truncated: NDArray[np.float64] = None  # type: ignore[assignment]
    ignore: NDArray[np.bool_] = None  # type: ignore[assignment]
    scores: NDArray[np.float64] | None = None
    distance_m: NDArray[np.float64] | None = None
    speed_mps: NDArray[np.float64] | None = None
    frame_keys: Sequence[FrameKey] = ()
    _rows: dict[FrameKey, NDArray[np.intp]] = field(init=False)

    if TYPE_CHECKING:  # The constructor converts its arguments.

        def __init__(
            self,
            frames: Iterable[FrameKey],
            tracks: ArrayLike | None,
            boxes: Detections | ArrayLike,
            *,
            occluded: ArrayLike | None = None,
            truncated: ArrayLike | None = None,
            ignore: ArrayLike | None = None,
            scores: ArrayLike | None = None,
            distance_m: ArrayLike | None = None,
            speed_mps: ArrayLike | None = None,
            frame_keys: Iterable[FrameKey] = (),
        ) -> None: ...

    def __post_init__(self) -> None:
        frames = check_keys(self.frames, "frames")
        boxes = check_boxes(self.boxes).astype(np.float64)
        count = len(boxes)
        if len(frames) != count:
            raise InvalidInputError(
                f"frames must be one key for each of the {count} boxes, got {len(frames)} keys"
            )
        columns: dict[str, Any] = {
            "frames": frames,
            "boxes": boxes,
            "tracks": _column(self.tracks, "tracks", count, "iu", np.int64(NO_TRACK)),
            "occluded": _column(self.occluded, "occluded", count, "iub", np.int64(0)),
            "truncated": _column(self.truncated, "truncated", count, "iufb", 0.0),
            "ignore": _column(self.ignore, "ignore", count, "b", False),
        }
        for name in ("scores", "distance_m", "speed_mps"):
            values = getattr(self, name)
            columns[name] = None if values is None else _column(values, name, count, "iuf", 0.0)
        if columns["scores"] is not None and not np.isfinite(columns["scores"]).all():
            raise InvalidInputError("scores must be finite, got NaN or infinity; drop those rows")
        if (columns["tracks"] < NO_TRACK).any():
            lowest = columns["tracks"].min()
            raise InvalidInputError(f"tracks must be numbers from 0, or -1 for none; got {lowest}")
        if (columns["occluded"] < 0).any():
            raise InvalidInputError(
                "occluded must be 0 (visible), 1 (partly) or 2 (largely hidden); got a negative value"
            )
        if not ((columns["truncated"] >= 0) & (columns["truncated"] <= 1)).all():
            raise InvalidInputError("truncated must be a fraction from 0 to 1; got a value outside")
        for (key, track), count in Counter(zip(frames, columns["tracks"].tolist())).items():
            if track != NO_TRACK and count > 1:
                raise InvalidInputError(
                    f"frame {key!r} holds track {track} twice; give each vehicle its own number"
                )
        keys = check_keys((*check_keys(self.frame_keys, "frame_keys"), *frames), "frame_keys")
        columns["frame_keys"] = tuple(sorted(set(keys), key=frame_order))
        rows: dict[FrameKey, list[int]] = defaultdict(list)
        for row, key in enumerate(frames):
            rows[key].append(row)
        columns["_rows"] = {key: np.array(found, np.intp) for key, found in rows.items()}
        for name, column in columns.items():
            object.__setattr__(self, name, column)

    @classmethod
    def from_detections(cls, detections: Mapping[FrameKey, Detections]) -> FrameBoxes:
        """Collect the detections of each frame; frames without any still count as frames.

        Raises
        ------
        InvalidInputError
            If `detections` is not a dictionary of `Detections` by frame.
        """
        check_type(detections, "detections", Mapping, "pass dict(enumerate(detections)) for a list")
        for key, found in detections.items():
            check_type(found, f"detections[{key!r}]", Detections, "pass Detections(boxes, scores)")
        parts = [Detections.empty(), *detections.values()]
        return cls(
            [key for key, found in detections.items() for _ in range(len(found))],
            None,
            np.concatenate([found.boxes for found in parts]),
            scores=np.concatenate([found.scores for found in parts]),
            frame_keys=tuple(detections),
        )

    @classmethod
    def from_results(cls, results: Iterable[Any]) -> FrameBoxes:
        """Collect the tracks that a detector shows from the :class:`FrameResult` of each frame.

        They are what `read_labels` reads from the CSV file that `write_tracks` writes, without its rounding.
        Frames without a track still count as frames.
        """
        keys: list[FrameKey] = []
        rows: list[tuple[FrameKey, Any]] = []  # frame and track
        for result in check_items(results):
            if not is_result(result):
                raise InvalidInputError(
                    f"results must be FrameResult objects, got {describe(result)}; "
                    "read a file with read_labels"
                )
            keys.append(int(result.index))
            rows += [(int(result.index), track) for track in shown_tracks(result)]
        scores, distances, speeds = (
            np.array([getattr(track, name) for _, track in rows], np.float64)  # None becomes NaN
            for name in ("score", "distance_m", "speed_mps")
        )
        return cls(
            [key for key, _ in rows],
            np.array([track.id for _, track in rows], np.int64),
            np.array([track.box for _, track in rows], np.float64),
            scores=scores,
            distance_m=none_if_unknown(distances),
            speed_mps=none_if_unknown(speeds),
            frame_keys=keys,
        )

    def __len__(self) -> int:
        return len(self.boxes)

    def __repr__(self) -> str:
        boxes, frames = pluralize(len(self), "box", "es"), pluralize(len(self.frame_keys), "frame")
        return f"FrameBoxes({boxes} in {frames})"

    def _repr_html_(self) -> str:
        return f"<p>{self!r}</p>{self.to_pandas().to_html(max_rows=20)}"

    def __getitem__(self, rows: int | slice | NDArray[Any] | list[int]) -> FrameBoxes:
        """Select rows by an index, a slice, a mask or a list of indices; `frame_keys` stay the same."""
        taken = [rows] if isinstance(rows, (int, np.integer)) else rows
        return self._take(np.arange(len(self))[taken], self.frame_keys)

    def __iter__(self) -> Iterator[FrameBoxes]:
        """Yield the rows, as `FrameBoxes` of one box each."""
        return (self[row] for row in range(len(self)))

    def rows(self, key: FrameKey) -> NDArray[np.intp]:
        """Row numbers of a frame's boxes; empty for a frame without boxes."""
        check_type(key, "key", (int, str, np.integer), "pass the key of one frame")
        return self._rows.get(key, np.empty(0, np.intp))

    def frame(self, key: FrameKey) -> FrameBoxes:
        """Select the boxes of one frame; empty for a frame without boxes."""
        return self._take(self.rows(key), (key,))

    def renamed(self, rename: Callable[[Any], FrameKey]) -> FrameBoxes:
        """Return a copy in which ``rename(key)`` replaces every frame key."""
        if not callable(rename):
            raise InvalidInputError(f"rename must be a function of a frame key; got {describe(rename)}")
        frames, keys = ([rename(key) for key in each] for each in (self.frames, self.frame_keys))
        return dataclasses.replace(self, frames=frames, frame_keys=keys)

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with one row per box, like a file of `write_labels`; scores only where known.

        >>> FrameBoxes([0, 3], [7, 8], [[0, 0, 50, 40], [5, 0, 55, 40]]).to_pandas().iloc[1].to_dict()
        {'frame': 3, 'track_id': 8, 'x1': 5.0, 'y1': 0.0, 'x2': 55.0, 'y2': 40.0, 'occluded': 0, \
'truncated': 0.0, 'ignore': False}
        """
        import pandas

        columns: dict[str, Any] = {"frame": self.frames, "track_id": self.tracks}
        columns |= dict(zip(_CORNERS, self.boxes.T))
        columns |= {name: getattr(self, column) for name, (column, _) in _TABLE_COLUMNS.items()}
        return pandas.DataFrame({name: each for name, each in columns.items() if each is not None})

    @classmethod
    def from_pandas(cls, table: pandas.DataFrame) -> FrameBoxes:
        """Take the boxes of a table with the columns of `to_pandas`; only frame and corners are required.

        So ``pandas.read_csv`` of a file that `write_tracks` wrote is such a table. A missing track is -1, and
        missing occlusion, truncation and `ignore` are 0. As in `read_labels`, a column ``class``, ``label``
        or ``category`` of names selects vehicles: car, van, truck, bus and vehicle.

        Returns
        -------
        FrameBoxes
            One box for each row of a vehicle, and all frames.

        Raises
        ------
        InvalidInputError
            If a column is missing or holds something else, or no class is that of vehicles.
        """
        given: object = table
        expected = f"table must be a pandas.DataFrame with the columns frame, {', '.join(_CORNERS)}; "
        if not hasattr(given, "iloc") or not hasattr(given, "columns"):
            remedy = "; convert it with table.to_pandas()" if hasattr(given, "to_pandas") else ""
            raise InvalidInputError(f"{expected}got {describe(given)}{remedy}")
        names = list(table.columns)
        missing = [name for name in ("frame", *_CORNERS) if name not in names]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InvalidInputError(f"table must have each column once; got {twice} more than once")
        if missing:
            raise InvalidInputError(f"{expected}it lacks {', '.join(missing)}")
        keys = _table_frames(table)
        vehicles, lookalike = _vehicle_rows(table)
        table = table[vehicles]
        columns: dict[str, Any] = {
            column: _table_column(table, name, kind)
            for name, (column, kind) in _TABLE_COLUMNS.items()
            if name in names
        }
        if lookalike.any():
            columns["ignore"] = columns.get("ignore", False) | lookalike[vehicles]
        track = next((name for name in ("track_id", "track") if name in names), None)
        return cls(
            _table_frames(table),
            None if track is None else _table_column(table, track, int),
            np.stack([_table_column(table, name, float) for name in _CORNERS], axis=1),
            frame_keys=keys,
            **columns,
        )

    def _take(self, rows: NDArray[np.intp], keys: Sequence[FrameKey]) -> FrameBoxes:
        frames = [self.frames[row] for row in rows.tolist()]
        columns = {name: getattr(self, name) for name in _ROW_COLUMNS}
        taken = {name: column[rows] for name, column in columns.items() if column is not None}
        return dataclasses.replace(self, frames=frames, frame_keys=keys, **taken)
