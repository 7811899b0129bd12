"""Boxes of vehicles: their arithmetic, suppression of overlapping ones, and their scores.

Boxes are ``(N, 4)`` arrays ``[x1, y1, x2, y2]`` in half-open pixels: the width is ``x2 - x1``. Functions
without ``check_`` in their body are for arrays that were checked.
"""

from __future__ import annotations

import logging
import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import Floats, check, describe, fields, invalid, pluralize
from vehicle_detection.errors import InvalidInputError

_LOGGER = logging.getLogger(__name__)

if TYPE_CHECKING:
    import pandas

VEHICLE_CLASSES = ("car", "van", "truck", "bus", "vehicle")
"""Names of the classes that are vehicles by default, of labels and of networks."""

# The last word of other names that are those of vehicles.
_VEHICLE = re.compile(
    "(car|van|truck|bus|vehicle|suv|pickup|taxi|sedan|hatchback|minivan|minibus)s?|buses|lorry|lorries"
)

ScoreScale = Literal["probability", "logit"] | tuple[float, float]
"""What the scores of another detector are: see `log_odds`."""

# Log-odds of a certain detection: 95%.
_CERTAIN_SCORE = 3.0
# Lower bound of a divisor. An empty box shares no area with any other, so its ratios become 0.
_TINY = np.finfo(np.float64).tiny
# Boxes at one distance: least ratio of their heights, largest difference of their lower edges in heights. And
# the fraction of the narrower one's width that boxes on one vehicle share.
_ALIKE_HEIGHT, _ALIKE_BOTTOM, _PART_OVERLAP = 0.8, 0.15, 0.4


@dataclass(frozen=True, eq=False)
class Detections:
    """Boxes and their scores as columns, checked on construction.

    Attributes
    ----------
    boxes, scores
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``, and ``(N,)`` finite float64 scores, by which boxes are ranked.
        Those of vehicles are log-odds above the model's threshold: 0 is the threshold, whatever its
        confidence. Windows of a classifier have the values of its decision function, and boxes of a heat map
        the heat.
    confidences
        ``(N,)`` calibrated probabilities of a vehicle in [0, 1]; None if they are unknown. A column of NaN,
        as in a table, becomes None.
    labels, class_ids
        ``(N,)`` names of the classes, such as ``"car"``, and their numbers in the model; None if unknown.

    Examples
    --------
    >>> found = Detections([[0, 0, 10, 10], [5, 5, 9, 9]], [0.5, 2.0], [0.62, 0.88], ["car", "bus"])
    >>> found
    Detections(2 boxes, confidences 0.62 to 0.88, 1 bus, 1 car)
    >>> found[found.labels == "bus"].boxes
    array([[5, 5, 9, 9]])
    >>> found + found[:1]
    Detections(3 boxes, confidences 0.62 to 0.88, 1 bus, 2 car)
    """

    boxes: NDArray[Any]
    scores: Floats
    confidences: Floats | None = None
    labels: NDArray[np.str_] | None = None
    class_ids: NDArray[np.int64] | None = None

    if TYPE_CHECKING:  # The constructor converts its arguments.

        def __init__(
            self,
            boxes: Detections | ArrayLike,
            scores: ArrayLike,
            confidences: ArrayLike | None = None,
            labels: ArrayLike | None = None,
            class_ids: ArrayLike | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        boxes, confidences = check.boxes(self.boxes), self.confidences
        scores = _score_column(self.scores, "scores", len(boxes))
        if confidences is not None:
            given = check.array(confidences, "confidences")
            unknown = given.size and given.dtype.kind == "f" and np.isnan(given).all()
            confidences = None if unknown else _score_column(given, "confidences", len(boxes))
        if confidences is not None and not ((confidences >= 0) & (confidences <= 1)).all():
            remedy = "omit them where they are unknown"
            raise invalid("confidences", "be probabilities, 0 to 1", self.confidences, remedy)
        vars(self).update(boxes=boxes, scores=scores, confidences=confidences)
        if self.labels is not None:
            labels = check.sequence(self.labels, "labels", "names of the classes of boxes")
            if len(labels) != len(boxes) or not all(isinstance(label, str) for label in labels):
                raise invalid("labels", f"be a name for each of the {len(boxes)} boxes", self.labels)
            vars(self)["labels"] = np.array(labels, np.str_)
        if self.class_ids is not None:
            numbers = _score_column(self.class_ids, "class_ids", len(boxes))
            vars(self)["class_ids"] = numbers.astype(np.int64)

    @classmethod
    def from_columns(cls, boxes: NDArray[Any], scores: Floats) -> Self:
        """Make detections of columns that the library has computed, without checking them."""
        detections = object.__new__(cls)
        vars(detections).update(boxes=boxes, scores=scores)
        return detections

    def with_columns(self, **columns: Any) -> Self:
        """Return the same detections with other columns, which are not checked."""
        other = object.__new__(type(self))
        vars(other).update(vars(self), **columns)
        return other

    @classmethod
    def empty(cls) -> Detections:
        """Return detections without any box."""
        return cls.from_columns(np.empty((0, 4)), np.empty(0))

    @classmethod
    def from_supervision(
        cls,
        detections: Any,
        *,
        score: ScoreScale = "probability",
        threshold: float | None = None,
        class_ids: Collection[int] | None = None,
    ) -> Detections:
        """Convert the detections of another library: ``supervision.Detections``, or results of Ultralytics.

        They have ``xyxy``, ``(N, 4)``, ``confidence`` or ``conf``, ``(N,)`` or None if unknown (the score is
        then 3), and, if known, ``class_id`` or ``cls``, ``(N,)``; the second names are those of Ultralytics.
        Names of classes are those in ``data["class_name"]`` or ``names``. `score` and `threshold` are as in
        `detector_from`. `class_ids` keeps only boxes of these classes, such as ``(2, 5, 7)`` for the cars,
        buses and trucks of COCO. What `to_supervision` returns becomes the same detections again.

        >>> from types import SimpleNamespace
        >>> found = SimpleNamespace(xyxy=[[0, 0, 9, 9], [5, 5, 9, 9]], confidence=[0.5, 0.9], class_id=[2, 0])
        >>> Detections.from_supervision(found), Detections.from_supervision(found, class_ids=[0]).scores
        (Detections(2 boxes, confidences 0.50 to 0.90), array([2.19722458]))
        """
        names = getattr(detections, "names", None)
        detections = detections.boxes if hasattr(getattr(detections, "boxes", None), "xyxy") else detections
        has_confidence = hasattr(detections, "confidence") or hasattr(detections, "conf")
        if not hasattr(detections, "xyxy") or not has_confidence:
            remedy = "pass a supervision.Detections, whose confidence may be None"
            raise invalid("detections", "have xyxy, and confidence or conf", detections, remedy)
        scale = check_score_scale(score, threshold)
        boxes, confidence = check.boxes(detections.xyxy), _first_known(detections, "confidence", "conf")
        classes, data = _first_known(detections, "class_id", "cls"), getattr(detections, "data", None)
        extra = data if isinstance(data, dict) else {}
        scores = np.full(len(boxes), _CERTAIN_SCORE)
        if confidence is not None:
            scores = log_odds(confidence, scale, threshold)
        if "score" in extra and scale == "probability" and threshold is None:
            scores = extra["score"]  # log-odds above the threshold of the model that found them
        labels = extra.get("class_name")
        if labels is None and names is not None and classes is not None:
            labels = [str(names[int(each)]) for each in check.array(classes, "classes")]
        known = confidence if scale == "probability" else None
        found = cls(boxes, scores, known, labels, None if classes is None else check.array(classes, "cls"))
        return found if class_ids is None else select_classes(found, check_class_ids(class_ids))

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with a row for each box: corners, score and, if known, confidence, class, distance.

        >>> Detections(np.array([[0.0, 0, 50, 40]]), np.array([1.5])).to_pandas().iloc[0].to_dict()
        {'x1': 0.0, 'y1': 0.0, 'x2': 50.0, 'y2': 40.0, 'score': 1.5}
        """
        import pandas

        columns = {**dict(zip(("x1", "y1", "x2", "y2"), self.boxes.T)), "score": self.scores}
        more = {name: getattr(self, attribute, None) for name, attribute in TABLE_COLUMNS.items()}
        return pandas.DataFrame(columns | {name: each for name, each in more.items() if each is not None})

    def to_supervision(self, *, tracker_id: ArrayLike | None = None) -> Any:
        """Convert to ``supervision.Detections``, for the drawing, counting and tracking of that library.

        The confidence is that of the detection or, if unknown, ``1 / (1 + exp(-score))``: a score of 0, the
        threshold of a vehicle, becomes 0.5. The class is 0 if it is unknown; its name, ``"vehicle"`` if
        unknown, is in ``data["class_name"]``, and the score in ``data["score"]``. `tracker_id` are ``(N,)``
        numbers of the tracks, if known.
        """
        try:
            from supervision import Detections as SupervisionDetections
        except ImportError as error:
            raise InvalidInputError("to_supervision needs supervision; pip install supervision") from error
        ids = None if tracker_id is None else np.asarray(tracker_id, np.int64).reshape(-1)
        known, labels, classes = self.confidences, self.labels, self.class_ids
        confidences = LOG_ODDS.probability(self.scores) if known is None else known
        names = np.full(len(self), "vehicle") if labels is None else labels
        return SupervisionDetections(
            xyxy=self.boxes.astype(np.float32),
            confidence=confidences.astype(np.float32),
            class_id=np.zeros(len(self), np.int64) if classes is None else classes,
            tracker_id=ids,
            data={"class_name": names, "score": self.scores},
        )

    def __add__(self, other: Detections) -> Detections:
        """Join two sets of boxes, such as the windows of two searches; what one of them lacks is unknown."""
        if not isinstance(other, Detections):
            return NotImplemented
        if not len(self) or not len(other):  # without boxes, nothing is unknown
            return self if len(self) else other
        joined = {}
        for name in _columns(self):
            first, second = getattr(self, name), getattr(other, name, None)
            joined[name] = None if first is None or second is None else np.concatenate([first, second])
        return self.with_columns(**joined)

    def __repr__(self) -> str:
        if not len(self):
            return "Detections(0 boxes)"
        known = self.confidences
        name, values = ("scores", self.scores) if known is None else ("confidences", known)
        facts = [pluralize(len(self), "box", "es"), f"{name} {values.min():.2f} to {values.max():.2f}"]
        kinds = Counter([] if self.labels is None else self.labels.tolist())
        facts += [f"{count} {label}" for label, count in sorted(kinds.items()) if label != "vehicle"]
        return f"Detections({', '.join(facts)})"

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, rows: int | slice | NDArray[Any] | list[int]) -> Self:
        """Take one row by its index, or several by a slice, a mask or a list of indices."""
        taken = [rows] if isinstance(rows, (int, np.integer)) else rows
        columns = ((name, getattr(self, name)) for name in _columns(self))
        return self.with_columns(**{name: None if each is None else each[taken] for name, each in columns})

    def __iter__(self) -> Iterator[tuple[NDArray[Any], float]]:
        """Yield ``(box, score)`` pairs."""
        return zip(self.boxes, self.scores.tolist())


TABLE_COLUMNS = {
    "confidence": "confidences",
    "label": "labels",
    "class_id": "class_ids",
    "distance_m": "distances_m",
    "distance_std_m": "distance_stds_m",
}
"""Columns by the names that they have in tables; distances are those of images."""


def _columns(detections: Detections) -> list[str]:
    """Names of the columns, also those of a subclass, whose other fields say that they are none."""
    fields = type(detections).__dataclass_fields__.items()
    return [name for name, each in fields if each.metadata.get("column", True)]


def _score_column(values: ArrayLike, name: str, count: int | None = None) -> Floats:
    """Return finite numbers as ``(N,)`` float64, one for each of `count` boxes."""
    array = check.array(values, name)
    if array.size == 0:
        array = array.reshape(-1).astype(np.float64)
    if array.ndim != 1 or array.dtype.kind not in "iuf" or (count is not None and len(array) != count):
        each = "each box" if count is None else f"each of the {count} boxes"
        remedy = "; pass names of classes as labels" if name == "class_ids" else ""
        raise InvalidInputError(f"{name} must be one number for {each}, got {describe(values)}{remedy}")
    if not np.isfinite(array).all():
        raise InvalidInputError(f"{name} must be finite, got NaN or infinity; drop those rows")
    return array.astype(np.float64, copy=False)


def _first_known(detections: Any, *names: str) -> Any:
    """Return the first of these attributes that is not None; None if there is none."""
    values = (getattr(detections, name, None) for name in names)
    return next((value for value in values if value is not None), None)


def check_class_ids(class_ids: object) -> tuple[int, ...]:
    """Return the numbers of the classes to keep."""
    ids = check.sequence(class_ids, "class_ids", "integers, such as (2, 5, 7)")
    return tuple(check.integer(each, "class_ids", low=0) for each in ids)


def select_classes(found: Detections, class_ids: Collection[int]) -> Detections:
    """Keep the boxes of these classes."""
    if found.class_ids is not None:
        return found[np.isin(found.class_ids, list(class_ids))]
    if not len(found):
        return found
    must = f"come with an integer class for each of {pluralize(len(found), 'box', 'es')}"
    raise invalid("class_ids", must, None, "omit it, or return (boxes, scores, classes)")


def box_areas(boxes: NDArray[Any]) -> Floats:
    """Area of each ``[x1, y1, x2, y2]`` box in pixels; ``(N,)`` float64."""
    return np.asarray((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]), np.float64)


def intersection_matrix(first: NDArray[Any], second: NDArray[Any]) -> Floats:
    """Area that each box of `first` shares with each box of `second`; ``(N, M)`` float64."""
    left = np.maximum(first[:, None, :2], second[None, :, :2])
    right = np.minimum(first[:, None, 2:], second[None, :, 2:])
    return np.asarray(np.clip(right - left, 0, None).prod(axis=2), np.float64)


def _iou(shared: Floats, areas: Floats, others: Floats) -> Floats:
    return np.asarray(shared / np.maximum(areas + others - shared, _TINY))


def _coverage(shared: Floats, areas: Floats, others: Floats) -> Floats:
    return np.asarray(shared / np.maximum(np.minimum(areas, others), _TINY))


def overlap_matrices(first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """IoU of ``(N, 4)`` with ``(M, 4)`` boxes, and shared fraction of the smaller box; each ``(N, M)``."""
    shared = intersection_matrix(first, second)
    areas, others = box_areas(first)[:, None], box_areas(second)[None]
    return _iou(shared, areas, others), _coverage(shared, areas, others)


def on_one_vehicle(boxes: Floats) -> NDArray[np.bool_]:
    """``(N, N)``: whether two boxes are at one distance and share much of the narrower one's width.

    Two vehicles at one distance from the camera do not overlap in the image. The side of a near vehicle in
    the next lane, however, looks like a vehicle of the same height.
    """
    left, _, right, bottom = boxes.T
    widths, heights = right - left, bottom - boxes[:, 1]
    higher, lower = np.maximum(heights[:, None], heights), np.minimum(heights[:, None], heights)
    apart = np.abs(bottom[:, None] - bottom)
    at_one_distance = (lower > _ALIKE_HEIGHT * higher) & (apart < _ALIKE_BOTTOM * higher)
    shared = np.minimum(right[:, None], right) - np.maximum(left[:, None], left)
    overlapping = shared > _PART_OVERLAP * np.minimum(widths[:, None], widths)
    return np.asarray(at_one_distance & overlapping)


def iou_matrix(first: Detections | ArrayLike, second: Detections | ArrayLike) -> Floats:
    """Intersection over union of ``(N, 4)`` with ``(M, 4)`` boxes: ``(N, M)`` float64 in [0, 1].

    The IoU of a box without area is 0, even with itself.

    >>> iou_matrix([[0, 0, 10, 10]], [[0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30]]).round(2)
    array([[1.  , 0.33, 0.  ]])
    """
    a = check.boxes(first, "first").astype(np.float64)
    b = check.boxes(second, "second").astype(np.float64)
    return overlap_matrices(a, b)[0]


def clip_boxes(boxes: Detections | ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
    """Clip ``(N, 4)`` boxes to an image of ``(height, width, ...)``: a new array of the same dtype.

    A box outside the image collapses onto its border.

    >>> clip_boxes([[-5, 10, 30, 60]], (50, 20, 3))
    array([[ 0, 10, 20, 50]])
    """
    array = check.boxes(boxes)
    height, width = check.shape(shape)
    limits = np.array([width, height, width, height])
    return np.asarray(np.clip(array, 0, limits), array.dtype)


def iter_nms(
    boxes: Floats, order: NDArray[np.intp], *, max_iou: float, max_coverage: float = np.inf
) -> Iterator[tuple[int, Floats]]:
    """Yield the rows that greedy non-maximum suppression keeps, each with its IoU with all ``(N, 4)`` boxes.

    `order` lists the candidate rows from the best one down. A candidate is dropped if its IoU with a kept
    box exceeds `max_iou`, or if they share more than the fraction `max_coverage` of the smaller one.
    """
    # The areas and one row per coordinate are computed once, because this runs in every frame.
    columns, areas = np.ascontiguousarray(boxes.T), box_areas(boxes)
    while len(order):
        best, order = order[0], order[1:]
        low = np.maximum(columns[:2], columns[:2, best, None])
        width, height = np.maximum(np.minimum(columns[2:], columns[2:, best, None]) - low, 0)
        shared = width * height
        iou = _iou(shared, areas, areas[best])
        kept = iou[order] <= max_iou
        if max_coverage < 1:
            kept &= _coverage(shared[order], areas[order], areas[best]) <= max_coverage
        order = order[kept]
        yield int(best), iou


def greedy_nms(boxes: Floats, scores: Floats, *, max_iou: float) -> NDArray[np.intp]:
    """Rows that `iter_nms` keeps, best score first; equal scores keep their order."""
    order = np.argsort(-scores, kind="stable")
    return np.array([row for row, _ in iter_nms(boxes, order, max_iou=max_iou)], np.intp)


def non_max_suppression(
    boxes: Detections | ArrayLike, scores: ArrayLike, *, threshold: float = 0.5
) -> NDArray[np.intp]:
    """Keep the best box of each group of overlapping boxes, greedily by score.

    Boxes are ``(N, 4)`` and scores ``(N,)`` numbers, higher is better; the box with the lower score is
    dropped if the IoU of two exceeds `threshold`. Returns the indices of the kept boxes, best score first;
    equal scores keep their order.

    >>> non_max_suppression([[0, 0, 10, 10], [1, 0, 11, 10], [50, 0, 60, 10]], [0.5, 0.9, 0.1])
    array([1, 2])
    """
    detections = Detections(check.boxes(boxes), check.array(scores, "scores"))
    max_iou = check.number(threshold, "threshold", low=0, high=1)
    return greedy_nms(detections.boxes.astype(np.float64), detections.scores, max_iou=max_iou)


def logit(probability: float) -> float:
    """Return the log-odds of a probability in (0, 1)."""
    return math.log(probability / (1 - probability))


def confidence_score(confidence: float) -> float:
    """Return the log-odds of a confidence from 0 to 1, whose ends have no finite ones."""
    return logit(min(max(confidence, 1e-6), 1 - 1e-6))


def log_odds(scores: ArrayLike, score: ScoreScale, threshold: float | None = None) -> Floats:
    """Convert the scores of another detector to log-odds above its threshold, ``(N,)`` float64.

    Probabilities become ``log(p / (1 - p))`` minus that of the threshold, 0.5 by default; log-odds are
    reduced by the threshold, 0 by default; ``(low, high)`` maps low to 0 and high to 3, which is 95%.
    """
    values = _score_column(scores, "scores")
    if isinstance(score, tuple):
        low, high = score
        return (values - low) / (high - low) * _CERTAIN_SCORE
    if score == "logit":
        return values - (0.0 if threshold is None else threshold)
    if values.size and (values.min() < 0 or values.max() > 1):
        got = f"{values.min():g} to {values.max():g}"
        remedy = 'pass score="logit" for log-odds, or score=(low, high)'
        raise InvalidInputError(f'scores must be 0 to 1 with score="probability", got {got}; {remedy}')
    limit = 0.5 if threshold is None else threshold
    # Probabilities of exactly 0 and 1 have no finite log-odds.
    p = values.clip(1e-3, 1 - 1e-3)
    return np.asarray(np.log(p / (1 - p)) - logit(limit))


def check_score_scale(score: object, threshold: float | None) -> ScoreScale:
    """Return the scale of `log_odds` if it and the threshold are valid."""
    if isinstance(score, (tuple, list)) and len(score) == 2:
        low = check.number(score[0], "score[0]")
        if threshold is not None:
            raise invalid("threshold", "be omitted with score=(low, high): it is low", threshold)
        return low, check.number(score[1], "score[1]", above=low)
    check.choice(score, "score", ("probability", "logit"))
    if threshold is not None and score == "probability":
        check.number(threshold, "threshold", above=0, high=0.999)
    elif threshold is not None:
        check.number(threshold, "threshold")
    return score  # type: ignore[return-value]


@dataclass(frozen=True)
class Platt(fields.Checked):
    """The sigmoid ``1 / (1 + exp(a * score + b))`` of a score's probability, as `calibrate_scores` fits it.

    `a` is negative where higher scores are vehicles.

    >>> platt = Platt(-2.0, 1.0)
    >>> platt.probability([0.0, 2.0]).round(2), platt.score(0.5)
    (array([0.27, 0.95]), 0.5)
    """

    a: float = fields.number()
    b: float = fields.number()

    def probability(self, scores: ArrayLike) -> Floats:
        """Probability of a vehicle for each score, float64 in [0, 1], of the same shape."""
        values = check.array(scores, "scores")
        if values.dtype.kind not in "iuf" or np.isnan(values).any():
            raise InvalidInputError(f"scores must be numbers without NaN; got {describe(scores)}")
        exponent = np.asarray(self.a * values.astype(np.float64) + self.b)
        # Both branches avoid the overflow of exp, and keep small probabilities exact.
        small = np.exp(-np.abs(exponent))
        return np.asarray(np.where(exponent > 0, small, 1.0) / (1 + small))

    def score(self, probability: float) -> float:
        """Return the score that has this probability, in (0, 1), for use as a threshold."""
        value = check.number(probability, "probability", above=0)
        if value >= 1 or self.a == 0:
            raise invalid("probability", "lie in (0, 1) and a must not be 0", (value, self.a))
        return (-logit(value) - self.b) / self.a


LOG_ODDS = Platt(-1.0, 0.0)
"""Probability of a score that is a log-odds value: 0 is 50%."""


def warn_of_vehicles(source: str, found: Iterable[str], read: Iterable[str]) -> None:
    """Warn of classes that are not read, but seem to be vehicles by their last word: "big truck", "bus-l"."""
    words = {
        name: [word for word in re.split("[^a-z]+", name) if len(word) > 2] for name in {*found} - {*read}
    }
    others = sorted(name for name, each in words.items() if each and _VEHICLE.fullmatch(each[-1]))
    if others:
        _LOGGER.warning(
            "%s: vehicles of class %s are left out; classes= selects all classes of vehicles",
            source,
            ", ".join(others[:9]),
        )
