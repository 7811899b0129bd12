"""Detectors from elsewhere: any function that finds boxes in an image, as a model (`detector_from`)."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, fields, invalid
from vehicle_detection.boxes import (
    Detections,
    Platt,
    ScoreScale,
    box_areas,
    check_class_ids,
    check_score_scale,
    clip_boxes,
    log_odds,
    logit,
    select_classes,
)
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import DetectorError, InvalidInputError
from vehicle_detection.search import FrameSearch

DetectorFunction = Callable[[NDArray[np.uint8]], Any]


@dataclass(frozen=True, kw_only=True)
class FunctionParams(fields.Checked):
    """Parameters of a detector that is a function: it searches the whole frame by itself.

    `min_score` is the minimum score, in log-odds, of the boxes that count as positive windows.

    >>> FunctionParams(min_score=1).min_score
    1
    """

    min_score: float = fields.number(0.0)

    @classmethod
    def default(cls) -> FunctionParams:
        """Return the default parameters."""
        return cls()


@dataclass(frozen=True, eq=False, kw_only=True)
class FunctionModel:
    """A function as a model; `detector_from` documents the arguments and creates one."""

    search_params_type: ClassVar[type[FunctionParams]] = FunctionParams
    searches_every_frame: ClassVar[bool] = True

    function: DetectorFunction
    score: ScoreScale = "probability"
    threshold: float | None = None
    class_ids: Collection[int] | None = None
    thread_safe: bool = False
    name: str | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    # An argument, so that `dataclasses.replace` keeps it: copies call the same function.
    _lock: contextlib.AbstractContextManager[Any] | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not callable(self.function):
            remedy = "it returns boxes and scores"
            raise invalid("function", "be a function of an image", self.function, remedy)
        vars(self)["thread_safe"] = check.boolean(self.thread_safe, "thread_safe")
        check.instance(self.name, "name", str | None, "omit it for the function's name")
        lock = self._lock
        if self.thread_safe:
            lock = contextlib.nullcontext()
        elif lock is None or isinstance(lock, contextlib.nullcontext):
            lock = threading.Lock()
        vars(self).update(
            name=self.name or getattr(self.function, "__name__", type(self.function).__name__),
            score=check_score_scale(self.score, self.threshold),
            class_ids=None if self.class_ids is None else check_class_ids(self.class_ids),
            _lock=lock,
        )

    def __copy__(self) -> Self:
        """Return the model itself, because a copy would have a lock of its own."""
        return self

    def __deepcopy__(self, _: object) -> Self:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        values = {
            each.name: getattr(self, each.name) for each in dataclasses.fields(self) if each.name != "_lock"
        }
        return functools.partial(type(self), **values), ()

    @property
    def calibration(self) -> Platt:
        """Probability of the log-odds above the threshold."""
        limit = 0.0 if isinstance(self.score, tuple) or self.threshold is None else self.threshold
        if self.score == "probability" and self.threshold is not None:
            limit = logit(limit)
        return Platt(-1.0, -limit)

    def with_confidence(self, conf: float) -> FunctionModel:
        """Return the model with the threshold at this probability."""
        if isinstance(self.score, tuple):
            remedy = "change the lower end of score=(low, high), or return probabilities"
            raise invalid("conf", "be None for scores on a scale of their own", conf, remedy)
        return dataclasses.replace(self, threshold=conf if self.score == "probability" else logit(conf))

    def open_search(self, jobs: int | None = None) -> FunctionSearch:
        """Open a search of frames that calls the function; `jobs` has no effect."""
        return FunctionSearch(self, jobs)

    def summary(self) -> tuple[str, dict[str, str]]:
        """Describe the model for display: a title, and named facts."""
        scale = self.score if isinstance(self.score, str) else "{:g} to {:g}".format(*self.score)
        threshold = "default" if self.threshold is None else f"{self.threshold:g}"
        return f"function {self.name}", {"scores": scale, "threshold": threshold}

    def find(self, frame: NDArray[np.uint8]) -> Detections:
        """Call the function on a copy of a frame: boxes clipped to it, with log-odds."""
        place = f"a frame of {frame.shape[1]}x{frame.shape[0]} pixels"
        try:
            assert self._lock is not None
            with self._lock:
                returned = self.function(frame.copy())
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise DetectorError(f"the function {self.name} failed on {place}: {reason}") from error
        try:
            found = self._convert(returned)
        except InvalidInputError as error:
            wrong = f"the function {self.name} returned an invalid result"
            raise DetectorError(f"{wrong} for {place}: {error}") from error
        clipped = found.with_columns(boxes=clip_boxes(found.boxes.astype(np.float64), frame.shape))
        return clipped[box_areas(clipped.boxes) > 0]

    def _convert(self, returned: Any) -> Detections:
        """Return detections of what the function returned; boxes within one pixel are fractions."""
        labels = None
        if isinstance(returned, Detections):
            labels = returned.labels
            returned = (returned.boxes, returned.scores, returned.class_ids)
        if hasattr(returned, "xyxy"):
            found = Detections.from_supervision(
                returned, score=self.score, threshold=self.threshold, class_ids=self.class_ids
            )
        elif isinstance(returned, (tuple, list)) and len(returned) in (2, 3):
            classes = returned[2] if len(returned) == 3 else None
            scores = log_odds(returned[1], self.score, self.threshold)
            found = Detections(returned[0], scores, labels=labels, class_ids=classes)
            if self.class_ids is not None:
                found = select_classes(found, self.class_ids)
        else:
            must = "be (boxes, scores), (boxes, scores, classes), or an object with xyxy, as Results.boxes"
            raise invalid("it", must, returned, "for an image without vehicles return ([], [])")
        boxes = found.boxes
        if boxes.size and boxes.min() >= 0 and boxes.max() <= 1 and (box_areas(boxes) > 0).any():
            got = f"{boxes.min():g} to {boxes.max():g}, as fractions of the frame are"
            remedy = "multiply x by its width and y by its height"
            raise InvalidInputError(f"boxes must be in pixels, got {got}; {remedy}")
        return found


class FunctionSearch(FrameSearch):
    """The search that calls a function for each frame."""

    params_type = FunctionParams

    def __init__(self, model: FunctionModel, jobs: int | None = None) -> None:
        super().__init__(jobs)
        self._model = model

    def _search(
        self, frame: NDArray[np.uint8], params: FunctionParams, min_vehicle_score: float
    ) -> tuple[Detections, Detections]:
        found = self._model.find(frame)
        return found[found.scores >= params.min_score], found[found.scores >= min_vehicle_score]


def detector_from(
    function: DetectorFunction,
    *,
    score: ScoreScale = "probability",
    threshold: float | None = None,
    class_ids: Collection[int] | None = None,
    thread_safe: bool = False,
    name: str | None = None,
    **options: Any,
) -> VehicleDetector:
    """Make a detector of any function that finds boxes: to track, draw, evaluate and render with it.

    Parameters
    ----------
    function
        Called with an ``(H, W, 3)`` uint8 RGB image of its own. It returns ``(boxes, scores)``, ``(N, 4)``
        ``[x1, y1, x2, y2]`` in pixels and ``(N,)``, or ``(boxes, scores, classes)`` with numbers of classes;
        or `Detections`, which may have names of classes, ``labels``; or an object with ``xyxy`` (see
        `Detections.from_supervision`). Boxes are clipped to the image. It should return weak boxes as well:
        the tracker uses them, images show only those above the threshold.
    score
        What the scores are, also those of `Detections`. They are converted to log-odds above the threshold,
        the unit of `TrackParams`: ``"probability"``, 0 to 1; ``"logit"``, log-odds; ``(low, high)``, any
        scale, of which `low` is the threshold and becomes 0, and `high`, a certain vehicle, becomes 3 (95%).
    threshold
        Score from which a box is a vehicle in a single image: by default 0.5 for probabilities and 0 for
        log-odds. Pass 0.25 if that is the usual threshold of your detector.
    class_ids, name
        Keep only boxes of these classes, integers as the function returns them; and name in messages.
    thread_safe
        Whether the function may be called from several threads, as `process_video` does; otherwise the calls
        wait for each other. Sessions of ONNX Runtime and the ``predict`` of scikit-learn are thread-safe.
    **options
        Further arguments of `VehicleDetector`, such as ``track_params`` and ``camera``.

    Raises
    ------
    DetectorError
        In the methods of the detector, if the function fails or returns something else; the message names the
        function and the frame.

    Notes
    -----
    With the defaults of `TrackParams`, scores from 0 on are vehicles in a single image; tracks start from
    -0.3 on (a probability of 0.43), are confirmed at an average of 0.2 (0.55), and are continued by boxes
    down to -1.5 (0.18). The probabilities hold for a threshold of 0.5.

    Examples
    --------
    >>> def bright_spot(image):
    ...     y, x = np.unravel_index(image.sum(axis=2).argmax(), image.shape[:2])
    ...     return [[x - 20, y - 20, x + 20, y + 20]], [0.9]
    >>> detector = detector_from(bright_spot)
    >>> image = np.zeros((90, 160, 3), np.uint8)
    >>> image[50, 100] = 255
    >>> detector.detect(image).boxes.tolist()
    [[80.0, 30.0, 120.0, 70.0]]
    """
    own: Any = {"threshold": threshold, "class_ids": class_ids, "thread_safe": thread_safe, "name": name}
    return VehicleDetector(FunctionModel(function=function, score=score, **own), **options)
