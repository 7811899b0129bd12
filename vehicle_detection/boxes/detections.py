"""Boxes with their scores as columns."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import (
    Floats,
    check_array,
    check_boxes,
    check_integer,
    check_sequence,
    describe,
    pluralize,
)
from vehicle_detection.boxes.scores import (
    CERTAIN_SCORE,
    Platt,
    ScoreScale,
    check_score_scale,
    log_odds,
    score_column,
)
from vehicle_detection.errors import InvalidInputError

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True, eq=False)
class Detections:
    """Boxes and their scores as two columns, checked on construction.

    Attributes
    ----------
    boxes, scores
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``, and ``(N,)`` finite float64 scores.
    confidences
        ``(N,)`` calibrated probabilities of a vehicle in [0, 1]; None if they are unknown. A column of NaN,
        as in a table, becomes None.

    Raises
    ------
    InvalidInputError
        If the columns differ in length or contain NaN, or a confidence is not a probability.

    Examples
    --------
    >>> found = Detections([[0, 0, 10, 10], [5, 5, 9, 9]], [0.5, 2.0])
    >>> found
    Detections(2 boxes, scores 0.50 to 2.00)
    >>> found[found.scores > 1].boxes
    array([[5, 5, 9, 9]])
    >>> found + found[:1]
    Detections(3 boxes, scores 0.50 to 2.00)
    """

    boxes: NDArray[Any]
    scores: Floats
    confidences: Floats | None = None

    if TYPE_CHECKING:  # The constructor converts its arguments.

        def __init__(
            self, boxes: Detections | ArrayLike, scores: ArrayLike, confidences: ArrayLike | None = None
        ) -> None: ...

    def __post_init__(self) -> None:
        boxes = check_boxes(self.boxes)
        scores = check_array(self.scores, "scores")
        if scores.size == 0:
            scores = scores.reshape(-1).astype(np.float64)
        if scores.shape != (len(boxes),) or scores.dtype.kind not in "iuf":
            raise InvalidInputError(
                f"scores must be one number for each of the {len(boxes)} boxes, got {describe(scores)}"
            )
        if not np.isfinite(scores).all():
            raise InvalidInputError("scores must be finite, got NaN or infinity; drop those rows")
        object.__setattr__(self, "boxes", boxes)
        object.__setattr__(self, "scores", scores.astype(np.float64, copy=False))
        if _is_unknown(self.confidences):
            object.__setattr__(self, "confidences", None)
        if self.confidences is not None:
            confidences = score_column(self.confidences, "confidences")
            if confidences.shape != scores.shape or not ((confidences >= 0) & (confidences <= 1)).all():
                raise InvalidInputError(
                    f"confidences must be a probability, 0 to 1, for each of the {len(boxes)} boxes, got "
                    f"{describe(self.confidences)}; omit them where they are unknown"
                )
            object.__setattr__(self, "confidences", confidences)

    @classmethod
    def empty(cls) -> Detections:
        """Return detections without any box."""
        return cls(np.empty((0, 4)), np.empty(0))

    @classmethod
    def from_supervision(
        cls,
        detections: Any,
        *,
        score: ScoreScale = "probability",
        threshold: float | None = None,
        class_ids: Collection[int] | None = None,
    ) -> Detections:
        """Convert the detections of another library, such as ``supervision.Detections``.

        Parameters
        ----------
        detections
            An object with ``xyxy``, ``(N, 4)``, with ``confidence`` or ``conf``, ``(N,)`` or None if unknown,
            and, if known, with ``class_id`` or ``cls``, ``(N,)``. The second names are those of the ``boxes``
            of Ultralytics' results.
        score, threshold
            What the confidences are, as in `detector_from`.
        class_ids
            Keep only boxes of these classes, such as ``(2, 5, 7)`` for the cars, buses and trucks of COCO.

        Returns
        -------
        Detections
            Boxes with scores in log-odds above the threshold. If confidences are unknown, the score is 3.

        Raises
        ------
        InvalidInputError
            If an attribute is missing, a column is malformed, or classes are asked for but unknown.

        Examples
        --------
        >>> from types import SimpleNamespace
        >>> found = SimpleNamespace(xyxy=[[0, 0, 9, 9], [5, 5, 9, 9]], confidence=[0.5, 0.9], class_id=[2, 0])
        >>> Detections.from_supervision(found), Detections.from_supervision(found, class_ids=[0])
        (Detections(2 boxes, scores 0.00 to 2.20), Detections(1 box, scores 2.20 to 2.20))
        """
        if not hasattr(detections, "xyxy"):
            raise InvalidInputError(
                f"detections must have an attribute xyxy, got {describe(detections)}; pass a "
                "supervision.Detections"
            )
        scale = check_score_scale(score, threshold)
        if not hasattr(detections, "confidence") and not hasattr(detections, "conf"):
            raise InvalidInputError(
                f"detections must have an attribute confidence or conf, got {describe(detections)}; set it "
                "to None if the confidences are unknown"
            )
        boxes, confidence = check_boxes(detections.xyxy), _first_known(detections, "confidence", "conf")
        if confidence is None:
            scores = np.full(len(boxes), CERTAIN_SCORE)
        else:
            scores = log_odds(confidence, scale, threshold)
        found = cls(boxes, scores)
        if class_ids is None:
            return found
        return select_classes(found, _first_known(detections, "class_id", "cls"), check_class_ids(class_ids))

    def to_pandas(self) -> pandas.DataFrame:
        """Return a table with a row for each box: corners, score and, if known, confidence.

        >>> Detections(np.array([[0.0, 0, 50, 40]]), np.array([1.5])).to_pandas().iloc[0].to_dict()
        {'x1': 0.0, 'y1': 0.0, 'x2': 50.0, 'y2': 40.0, 'score': 1.5}
        """
        import pandas

        columns = {**dict(zip(("x1", "y1", "x2", "y2"), self.boxes.T)), "score": self.scores}
        if self.confidences is not None:
            columns["confidence"] = self.confidences
        return pandas.DataFrame(columns)

    def to_supervision(self, *, tracker_id: ArrayLike | None = None) -> Any:
        """Convert to ``supervision.Detections``, for the drawing, counting and tracking of that library.

        The confidence is that of the detection or, if unknown, ``1 / (1 + exp(-score))``: a score of 0, the
        threshold of a vehicle, becomes 0.5. The class is 0.

        Parameters
        ----------
        tracker_id
            ``(N,)`` numbers of the tracks, if known.

        Returns
        -------
        supervision.Detections
            With ``xyxy`` and ``confidence`` as float32.

        Raises
        ------
        InvalidInputError
            If supervision is not installed.
        """
        try:
            from supervision import Detections as SupervisionDetections
        except ImportError as error:
            raise InvalidInputError(
                "to_supervision needs the package supervision, which is not installed; run "
                "pip install supervision"
            ) from error
        ids = None if tracker_id is None else np.asarray(tracker_id, np.int64).reshape(-1)
        known = self.confidences
        confidences = Platt(-1.0, 0.0).probability(self.scores) if known is None else known
        return SupervisionDetections(
            xyxy=self.boxes.astype(np.float32),
            confidence=confidences.astype(np.float32),
            class_id=np.zeros(len(self), np.int64),
            tracker_id=ids,
        )

    def __add__(self, other: Detections) -> Detections:
        """Join two sets of boxes, such as the windows of two searches."""
        if not isinstance(other, Detections):
            return NotImplemented
        if not len(self) or not len(other):  # without boxes, confidences are not unknown
            return self if len(self) else other
        known = self.confidences is not None and other.confidences is not None
        names = ("boxes", "scores", "confidences") if known else ("boxes", "scores")
        return Detections(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))

    def __repr__(self) -> str:
        if not len(self):
            return "Detections(0 boxes)"
        noun = "box" if len(self) == 1 else "boxes"
        return f"Detections({len(self)} {noun}, scores {self.scores.min():.2f} to {self.scores.max():.2f})"

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, rows: int | slice | NDArray[Any] | list[int]) -> Detections:
        """Take one row by its index, or several by a slice, a mask or a list of indices."""
        taken = [rows] if isinstance(rows, (int, np.integer)) else rows
        known = self.confidences
        return Detections(self.boxes[taken], self.scores[taken], None if known is None else known[taken])

    def __iter__(self) -> Iterator[tuple[NDArray[Any], float]]:
        """Yield ``(box, score)`` pairs."""
        return zip(self.boxes, self.scores.tolist())


def _first_known(detections: Any, *names: str) -> Any:
    """Return the first of these attributes that is not None; None if there is none."""
    values = (getattr(detections, name, None) for name in names)
    return next((value for value in values if value is not None), None)


def check_class_ids(class_ids: object) -> tuple[int, ...]:
    """Return the numbers of the classes to keep."""
    ids = check_sequence(class_ids, "class_ids", "integers, such as (2, 5, 7)")
    return tuple(check_integer(each, "class_ids", low=0) for each in ids)


def select_classes(found: Detections, classes: Any, class_ids: Collection[int]) -> Detections:
    """Keep the boxes of these classes; `classes` is ``(N,)``, or None if they are unknown."""
    if not len(found):
        return found
    column = check_array(classes, "classes")
    if column.shape != (len(found),) or column.dtype.kind not in "iuf":
        raise InvalidInputError(
            f"class_ids needs an integer class for each of {pluralize(len(found), 'box', 'es')}, got "
            f"{describe(classes)}; omit it, or return (boxes, scores, classes)"
        )
    return found[np.isin(column, list(class_ids))]


def _is_unknown(column: object) -> bool:
    """Whether a column holds NaN only."""
    array = np.empty(0) if column is None else check_array(column, "confidences")
    return array.size > 0 and array.dtype.kind == "f" and bool(np.isnan(array).all())
