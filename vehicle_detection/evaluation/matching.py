"""Match detections to labels frame by frame, and find the detections to be ignored."""

from __future__ import annotations

import logging
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check
from vehicle_detection.boxes import box_areas, intersection_matrix, iou_matrix
from vehicle_detection.datasets import without_suffix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tables import NO_TRACK, FrameKey, TrackTable, check_keys, frame_order

_LOGGER = logging.getLogger(__name__)


def match_names(table: TrackTable, keys: Sequence[FrameKey], sides: tuple[str, str]) -> TrackTable:
    """Rename frames to `keys` where the names differ by folders, slashes or the suffix of an image only.

    A name that may be that of several frames is an error, which names `table` and `keys` by `sides`, and so
    is one of another folder unless other names are equal.
    """
    equal = set(table.frame_keys) & set(keys)
    by_name: dict[str, list[tuple[str, str]]] = {}  # keys and their paths by file name
    for key in keys:
        if isinstance(key, str) and key not in equal:
            path = _path_of(key)
            by_name.setdefault(path.rpartition("/")[2], []).append((key, path))
    matched: dict[str, FrameKey] = {}  # name in the table of each key
    for name in table.frame_keys:
        if not isinstance(name, str) or name in equal:
            continue
        path = _path_of(name)
        others = by_name.get(path.rpartition("/")[2], [])
        alike = [key for key, other in others if path.endswith(other) or other.endswith(path)]
        if not others or (equal and not alike):
            continue  # a frame of the table only
        if len(alike) != 1 or alike[0] in matched:
            raise InvalidInputError(
                f"frame names of {sides[0]} and {sides[1]} differ: {name!r} and {others[0][0]!r}; use the "
                "same names on both sides, for example with TrackTable.renamed"
            )
        matched[alike[0]] = name
    keys_of = {name: key for key, name in matched.items()}
    return table.renamed(lambda name: keys_of.get(name, name)) if matched else table


def _path_of(name: str) -> str:
    """Name of a frame as a path from a root, with slashes, without the suffix of an image.

    macOS decomposes the letters of names, such as that of "ä" into "a" and an accent.
    """
    return "/" + without_suffix(unicodedata.normalize("NFC", name).replace("\\", "/"))


def prepare_evaluation(
    predictions: TrackTable, labels: TrackTable, frames: Sequence[FrameKey] | None
) -> tuple[TrackTable, TrackTable, list[FrameKey]]:
    """Check both sides, drop the predictions marked ``ignore``, and list the frames in order."""
    for name, side in (("predictions", predictions), ("labels", labels)):
        check.instance(side, name, TrackTable, "use read_labels for a file, or TrackTable.from_detections")
    predictions = predictions[~predictions["ignore"]]
    predictions = match_names(predictions, labels.frame_keys, ("predictions", "labels"))
    given = None if frames is None else check_keys(frames, "frames")
    sides = {"predictions": predictions.frame_keys, "labels": labels.frame_keys, "frames": given or ()}
    first = {name: keys[0] for name, keys in sides.items() if keys}
    if len({type(key) for key in first.values()}) > 1:
        listed = ", ".join(f"{key!r} in {name}" for name, key in first.items())
        raise InvalidInputError(
            f"frame keys must be all numbers or all names, got {listed}; use the same keys on both sides"
        )
    if given is None and len(first) == 2 and set(predictions.frame_keys).isdisjoint(labels.frame_keys):
        _LOGGER.warning("predictions and labels share no frame; they hold %r and %r", *first.values())
    if given is None:
        return predictions, labels, sorted({*predictions.frame_keys, *labels.frame_keys}, key=frame_order)
    for key, count in Counter(given).items():
        if count > 1:
            raise InvalidInputError(f"frames must differ, got {key!r} more than once; list each frame once")
    unknown = set(predictions["frame"].tolist()) - set(given)
    if unknown:
        raise InvalidInputError(
            f"predictions hold frame {min(unknown, key=frame_order)!r}, which is not among the {len(given)} "
            "frames; add it to frames or drop these predictions"
        )
    in_order = sorted(given, key=frame_order) if given and isinstance(given[0], int) else list(given)
    return predictions, labels, in_order  # names stay in the given order


def find_ignored(
    boxes: NDArray[np.float64],
    labels: TrackTable,
    rows: NDArray[np.intp],
    min_iou: float,
    *,
    as_regions: bool = False,
) -> NDArray[np.bool_]:
    """Which boxes have their center in a region, or overlap an ignored box, among the label `rows`.

    With `as_regions` also those of which at least half lies in an ignored box.
    """
    ignored = rows[labels["ignore"][rows]]
    regions = labels.boxes[ignored[labels["track_id"][ignored] == NO_TRACK]]
    center = (boxes[:, :2] + boxes[:, 2:]) / 2
    inside = (regions[:, :2] <= center[:, None]) & (center[:, None] < regions[:, 2:])
    covers = iou_matrix(boxes, labels.boxes[ignored]) >= min_iou
    if as_regions:
        shared = intersection_matrix(boxes, labels.boxes[ignored])
        covers |= shared >= np.maximum(box_areas(boxes)[:, None] / 2, 1e-9)
    return np.asarray(inside.all(axis=2).any(axis=1) | covers.any(axis=1))


@dataclass(frozen=True)
class DetectionMatches:
    """The result of matching N predictions to labels."""

    match: NDArray[np.intp]  # (N,) row of the matched label, -1 for none
    iou: NDArray[np.float64]  # (N,) IoU with it
    ignored: NDArray[np.bool_]  # (N,) whether the prediction counts neither as right nor as wrong
    usable: NDArray[np.intp]  # rows of the labels that are scored

    @property
    def missed(self) -> NDArray[np.intp]:
        """Rows of the scored labels that no prediction matches."""
        return np.setdiff1d(self.usable, self.match)


def match_detections(
    predictions: TrackTable,
    labels: TrackTable,
    keys: Sequence[FrameKey],
    min_iou: float,
    *,
    ignored_as_regions: bool = False,
) -> DetectionMatches:
    """Match each frame of `keys` greedily by score, then find the unmatched predictions to be ignored."""
    count = len(predictions)
    scores, ignore = np.nan_to_num(predictions["score"]), labels["ignore"]
    match, iou, ignored = np.full(count, -1, np.intp), np.zeros(count), np.zeros(count, np.bool_)
    usable: list[int] = []
    for key in keys:
        here, rows = predictions.rows(key), labels.rows(key)
        targets = rows[~ignore[rows]]
        usable += targets.tolist()
        overlaps = iou_matrix(predictions.boxes[here], labels.boxes[targets])
        best = overlaps.max(axis=1, initial=0)
        for index in np.lexsort((-best, -scores[here])) if len(targets) else ():
            target = int(np.argmax(overlaps[index]))
            if overlaps[index, target] >= min_iou:
                match[here[index]], iou[here[index]] = targets[target], overlaps[index, target]
                overlaps[:, target] = -1
        rest = here[match[here] < 0]
        ignored[rest] = find_ignored(
            predictions.boxes[rest], labels, rows, min_iou, as_regions=ignored_as_regions
        )
    return DetectionMatches(match, iou, ignored, np.array(usable, np.intp))
