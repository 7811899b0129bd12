"""What the scores of detections and of tracks share: their frames, what is neutral, ratios and summaries."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import describe
from vehicle_detection.boxes import box_areas, intersection_matrix, iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation.labels import NO_TRACK, FrameBoxes, FrameKey, check_keys, frame_order

# Share of a box that lies in an ignored box which is taken as a region.
_WITHIN = 0.5


@dataclass(frozen=True)
class Scores:
    """What both kinds of scores can do."""

    def summary(self) -> str:
        """Say the scores in a few aligned lines."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, ready for JSON; a ratio with nothing to count is None."""
        return {key: _plain(value) for key, value in dataclasses.asdict(self).items()}

    def __str__(self) -> str:
        return self.summary()


def prepare_sides(
    predictions: FrameBoxes, labels: FrameBoxes, frames: Sequence[FrameKey] | None
) -> tuple[FrameBoxes, FrameBoxes, list[FrameKey]]:
    """Check both sides, drop predictions that are to be ignored, and list the frames in order."""
    for name, side in (("predictions", predictions), ("labels", labels)):
        if not isinstance(side, FrameBoxes):
            raise InvalidInputError(
                f"{name} must be Labels, got {describe(side)}; read a file with read_labels or convert the "
                "Detections of each frame with Labels.from_detections"
            )
    predictions = predictions[~predictions.ignore]
    given = None if frames is None else check_keys(frames, "frames")
    sides = {"predictions": predictions.frame_keys, "labels": labels.frame_keys, "frames": given or ()}
    first = {name: keys[0] for name, keys in sides.items() if keys}
    if len({type(key) for key in first.values()}) > 1:
        listed = ", ".join(f"{key!r} in {name}" for name, key in first.items())
        raise InvalidInputError(
            f"frames must go by numbers or by names throughout, got {listed}; convert with Labels.renamed"
        )
    if given is not None:
        return predictions, labels, _given_frames(predictions, given)
    # Without a frame in common, names that differ by folder or suffix alone are a slip, not a result of 0.
    ours, theirs = set(predictions.frames), set(labels.frames)
    if not ours & theirs:
        stems = [{PurePosixPath(str(key)).stem for key in side} for side in (ours, theirs)]
        if stems[0] & stems[1]:
            raise InvalidInputError(
                f"predictions and labels name their frames differently: {predictions.frames[0]!r} and "
                f"{labels.frames[0]!r}; convert with Labels.renamed"
            )
    return predictions, labels, sorted({*predictions.frame_keys, *labels.frame_keys}, key=frame_order)


def _given_frames(predictions: FrameBoxes, frames: tuple[FrameKey, ...]) -> list[FrameKey]:
    known = set(frames)
    if len(known) < len(frames):
        twice = next(key for key, count in Counter(frames).items() if count > 1)
        raise InvalidInputError(f"frames must differ, got {twice!r} more than once; list each frame once")
    unknown = next((key for key in predictions.frames if key not in known), None)
    if unknown is not None:
        raise InvalidInputError(
            f"predictions hold frame {unknown!r}, which is not among the {len(frames)} frames; add it to "
            "frames or drop these predictions"
        )
    return sorted(frames, key=frame_order) if frames and isinstance(frames[0], int) else list(frames)


def find_ignored(
    boxes: NDArray[np.float64],
    labels: FrameBoxes,
    rows: NDArray[np.intp],
    limit: float,
    *,
    as_regions: bool = False,
) -> NDArray[np.bool_]:
    """Whether each box lies with its center in a region, or covers an ignored box, of the label `rows`.

    With `as_regions` also whether half of it or more lies in an ignored box, whatever that is.
    """
    ignored = rows[labels.ignore[rows]]
    regions = labels.boxes[ignored[labels.tracks[ignored] == NO_TRACK]]
    center = (boxes[:, :2] + boxes[:, 2:]) / 2
    inside = (regions[:, :2] <= center[:, None]) & (center[:, None] < regions[:, 2:])
    covers = iou_matrix(boxes, labels.boxes[ignored]) >= limit
    if as_regions:
        shared = intersection_matrix(boxes, labels.boxes[ignored])
        covers |= shared >= np.maximum(_WITHIN * box_areas(boxes)[:, None], 1e-9)
    return np.asarray(inside.all(axis=2).any(axis=1) | covers.any(axis=1))


def rates(tp: int, fp: int, fn: int) -> tuple[int, int, int, float, float, float]:
    """Put precision, recall and F1 beside the counts."""
    return tp, fp, fn, ratio(tp, tp + fp), ratio(tp, tp + fn), ratio(2 * tp, 2 * tp + fp + fn)


def ratio(part: float, whole: float) -> float:
    """Divide; NaN where there is nothing to count."""
    return part / whole if whole else math.nan


def mean(values: ArrayLike) -> float:
    """Average; NaN for no values."""
    array = np.asarray(values, np.float64)
    return float(array.mean()) if array.size else math.nan


def _plain(value: Any) -> Any:
    """Turn NaN into None, at any depth: JSON knows no NaN."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return None if isinstance(value, float) and math.isnan(value) else value


def as_text(value: float) -> str:
    """Write a ratio or length of a summary."""
    return "n/a" if math.isnan(value) else f"{value:.3f}"


def as_lines(title: str, rows: dict[str, str]) -> str:
    """Lay out a summary: a title, and under it a line for each name with its text."""
    width = max(map(len, rows))
    return "\n".join([title, *(f"  {name:<{width}}  {text}" for name, text in rows.items())])
