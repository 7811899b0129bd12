"""A network that finds vehicles: its parameters, its model, and the search of a frame with it."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import threading
import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, atomic_write, fields, single_threaded_opencv
from vehicle_detection.boxes import Detections, Platt, greedy_nms, logit
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.network.runtime import Array, Device, Port, Runtime, Session, open_session
from vehicle_detection.network.tensors import Candidates, InputFormat, OutputFormat, Size
from vehicle_detection.search import FrameSearch

INPUT_SIZE = 640
"""Longer side of the input of a network without fixed sizes."""

Margins = tuple[float, float, float]
"""Margins of boxes: at each side in pixels and as a share of the width, and at the top in pixels."""

# Probabilities of exactly 0 and 1 have no finite log-odds.
_MIN_PROBABILITY = 1e-4


@dataclass(frozen=True, kw_only=True)
class NetworkParams(fields.Checked):
    """Search parameters of a network, which always searches the whole frame.

    Attributes
    ----------
    input_size
        Longer side of the network's input in pixels, a multiple of 32. Larger inputs show smaller vehicles
        and take more time. None: the size in the model file, 640 for the shipped network.
    min_score
        Minimum log-odds above the model's threshold of the boxes before suppression that are positive
        windows.

    Examples
    --------
    >>> NetworkParams(input_size=960).input_size
    960
    """

    input_size: int | None = fields.integer(None, low=32, high=8192)
    min_score: float = fields.number(0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.input_size is not None and self.input_size % 32:
            raise InvalidInputError(
                f"input_size must be a multiple of 32, got {self.input_size}; "
                f"pass {-(-self.input_size // 32) * 32}"
            )

    @classmethod
    def default(cls) -> NetworkParams:
        """Return the default parameters."""
        return cls()


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class NetworkModel(fields.Checked):
    """A network that finds vehicles; `load_model` creates it.

    Attributes
    ----------
    graph, name, metadata
        Content of the ONNX file, how messages refer to it, and the training facts or other metadata in it.
    input_format, output_format, input_size
        How to make its input and to decode its outputs; longer side of its input, unless `NetworkParams` has
        one.
    classes, class_ids
        Names of the classes by their numbers, None if they are unknown; and numbers of those to keep, None:
        all.
    slope, offset
        Platt scaling: ``slope * logit(p) + offset`` is the log-odds that a box contains a vehicle, given its
        probability `p` in the network's output.
    threshold
        Minimum of these log-odds of a vehicle.
    nms_iou
        IoU above which the less probable of two boxes is dropped.
    margins
        By how much boxes of the network are too large, see `trim`.
    input_name, extra_inputs
        Name of the input that gets the image, and the other inputs, which get its width and height.
    device, runtime
        ``"cpu"`` or ``"cuda"``, and ``"onnxruntime"``, ``"openvino"`` or ``"auto"`` (the faster one).

    Examples
    --------
    >>> from vehicle_detection import load_model
    >>> model = load_model("default")
    >>> model.input_size, model.classes
    (640, {0: 'vehicle'})
    """

    search_params_type: ClassVar[type[NetworkParams]] = NetworkParams
    searches_every_frame: ClassVar[bool] = False

    graph: bytes
    name: str
    input_format: InputFormat
    output_format: OutputFormat
    extra_inputs: tuple[Port, ...] = ()
    input_name: str = "image"
    input_size: int = INPUT_SIZE
    classes: Mapping[int, str] | None = None
    class_ids: NDArray[np.intp] | None = None
    slope: float = fields.number(1.0, above=0, high=1e9)
    offset: float = fields.number(0.0, low=-1e9, high=1e9)
    threshold: float = fields.number(0.0, low=-1e9, high=1e9)
    nms_iou: float = fields.number(0.6, low=0, high=1)
    margins: Margins = (0.0, 0.0, 0.0)
    device: Device = "cpu"
    runtime: Runtime = "auto"
    metadata: Mapping[str, Any] = field(default_factory=dict)

    @functools.cached_property
    def calibration(self) -> Platt:
        """Probability that a box contains a vehicle, by its score: the log-odds above the threshold.

        `slope` and `offset` are applied already, by `scores`.
        """
        return Platt(-1.0, -self.threshold)

    def with_confidence(self, conf: float) -> NetworkModel:
        """Return the model with the threshold at this probability."""
        return dataclasses.replace(self, threshold=logit(conf))

    def open_search(self, jobs: int | None = None) -> NetworkSearch:
        """Open a search with this network; several threads work on each frame."""
        return NetworkSearch(self, jobs)

    def __repr__(self) -> str:
        return f"NetworkModel({self.summary()[0]})"

    def summary(self) -> tuple[str, dict[str, str]]:
        """Describe the model for display: a title, and named facts."""
        probability = float(Platt(-1.0, 0.0).probability(self.threshold))
        size = self.input_format.size
        facts = {
            "input": f"{self.input_size} px" if size is None else f"{size[1]}x{size[0]} px",
            "file": f"{len(self.graph) / 1e6:.1f} MB",
        }
        if self.classes is not None and len(self.classes) > 1:
            ids = self.classes if self.class_ids is None else self.class_ids.tolist()
            facts["classes"] = ", ".join(self.classes.get(number, str(number)) for number in ids)
        return f"network, threshold at a probability of {probability:.2g}", facts

    def scores(self, probabilities: Floats) -> Floats:
        """Convert probabilities of the network to log-odds above the threshold."""
        return self.slope * to_log_odds(probabilities) + self.offset - self.threshold

    def network_probability(self, score: float) -> float:
        """Probability in the network's output that gives this score, rounded down; undoes `scores`."""
        return to_probability((score + self.threshold - self.offset) / self.slope - 1e-6)

    def name_classes(self, class_ids: NDArray[np.intp]) -> dict[str, NDArray[Any] | None]:
        """Columns of detections that state their classes; without names, these are unknown."""
        if self.classes is None:
            return {"class_ids": class_ids}
        labels = [self.classes.get(number, str(number)) for number in class_ids.tolist()]
        return {"class_ids": class_ids, "labels": np.array(labels, np.str_)}

    def input_size_for(self, params: NetworkParams) -> int:
        """Longer side of the input in pixels."""
        size = self.input_format.size
        if params.input_size is None:
            return self.input_size
        if size is not None and params.input_size != max(size):
            raise InvalidInputError(
                f"input_size must be omitted for {self.name}, whose input has the fixed size "
                f"{size[1]}x{size[0]}; got {params.input_size}"
            )
        return params.input_size

    def feeds(self, image: Array, size: Size) -> dict[str, Array]:
        """Return the network's inputs by name, for an image of this height and width."""
        sizes = np.array([[size[1], size[0]]], np.int64)  # of the image to which boxes are scaled
        return {self.input_name: image} | {port.name: sizes.astype(port.dtype) for port in self.extra_inputs}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the ONNX file from which the model was loaded."""
        with atomic_write(path, "path") as part:
            part.write_bytes(self.graph)


class NetworkSearch(FrameSearch):
    """The search of frames with a network, whose session the first search opens."""

    params_type = NetworkParams

    def __init__(self, model: NetworkModel, jobs: int | None = None) -> None:
        super().__init__(jobs)
        self.model = model
        self._session: Session | None = None
        self._lock = threading.Lock()
        _SEARCHES.add(self)

    def reduction(self, shape: tuple[int, ...], params: NetworkParams) -> int:
        """Whole factor by which the search reduces frames of this shape first."""
        return self.model.input_format.reduction(shape, self.model.input_size_for(params))

    def abandon_session(self) -> None:
        """Open a new session on the next search: a forked child lacks the threads of the last one."""
        if self._session is not None:
            _ABANDONED.append(self._session)
        self._session, self._lock = None, threading.Lock()

    def _search(
        self, frame: NDArray[np.uint8], params: NetworkParams, min_vehicle_score: float
    ) -> tuple[Detections, Detections]:
        candidates = self.find_candidates(frame, params, min(min_vehicle_score, params.min_score))
        found = Detections(candidates.boxes, self.model.scores(candidates.probabilities))
        kept = greedy_nms(found.boxes, found.scores, max_iou=self.model.nms_iou)
        kept = kept[found.scores[kept] >= min_vehicle_score]
        vehicles = found[kept].with_columns(**self.model.name_classes(candidates.class_ids[kept]))
        return found[found.scores >= params.min_score], vehicles

    def find_candidates(
        self, frame: NDArray[np.uint8], params: NetworkParams, min_score: float
    ) -> Candidates:
        """Boxes whose log-odds are at least `min_score`, best first, in pixels of the frame."""
        model = self.model
        with single_threaded_opencv():
            array, scaled = model.input_format.prepare(frame, model.input_size_for(params), self.workspace)
        axes = (2, 3) if model.input_format.channels_first else (1, 2)
        size = array.shape[axes[0]], array.shape[axes[1]]
        outputs = self._open().run(model.feeds(array, size))
        lowest = model.network_probability(min_score)
        try:
            found = model.output_format.decode(outputs, size, model.class_ids, lowest)
        except ModelFileError as error:
            raise ModelFileError(
                f"{model.name} computes invalid values: {error}; download or export it again"
            ) from error
        # From the input, in which the frame has the size `scaled`, to pixels of the frame.
        height, width = frame.shape[:2]
        factors = np.array([width / scaled[1], height / scaled[0]] * 2)
        trimmed = trim(found.boxes, model.margins, scaled)
        boxes = np.clip(trimmed * factors, 0.0, [width, height, width, height])
        inside = (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
        return Candidates(boxes[inside], found.probabilities[inside], found.class_ids[inside])

    def _open(self) -> Session:
        with self._lock:
            if self._session is None:
                model, jobs = self.model, self._team.n_threads
                self._session = open_session(
                    model.graph, model.name, jobs=jobs, device=model.device, runtime=model.runtime
                )
            return self._session

    def close(self) -> None:
        """Close the session; the next search opens another one."""
        super().close()
        with self._lock:
            # Searches in other threads may still use it; the last reference closes it.
            self._session = None


_SEARCHES: weakref.WeakSet[NetworkSearch] = weakref.WeakSet()
# Sessions of the parent process: closing one would wait for its threads for ever.
_ABANDONED: list[Session] = []


def _after_fork() -> None:
    for search in list(_SEARCHES):
        search.abandon_session()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def trim(boxes: Floats, margins: Margins, size: Size) -> Floats:
    """Boxes without their margins; edges at those of the frame, of this height and width, stay.

    The network learns from frames whose edges are blurred over a pixel, and encloses the blur, most of all
    around narrow vehicles: the share of the width may be negative. No box grows.

    >>> trim(np.array([[10.0, 20.0, 110.0, 100.0], [0.0, 20.0, 50.0, 100.0]]), (1.5, -0.01, 1.0), (360, 640))
    array([[ 10.5,  21. , 109.5, 100. ],
           [  0. ,  21. ,  49. , 100. ]])
    """
    side, share, top = margins
    x1, y1, x2, y2 = boxes.T
    inset = np.clip(side + share * (x2 - x1), 0, (x2 - x1) / 4)
    return np.column_stack(
        [
            np.where(x1 > 1, x1 + inset, x1),
            np.where(y1 > 1, y1 + np.minimum(top, (y2 - y1) / 4), y1),
            np.where(x2 < size[1] - 1, x2 - inset, x2),
            y2,
        ]
    )


def to_log_odds(probabilities: Floats) -> Floats:
    """Log-odds of probabilities, at most those of 0.9999."""
    p = probabilities.clip(_MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
    return np.asarray(np.log(p / (1 - p)))


def to_probability(log_odds: float) -> float:
    """Probability of log-odds; 0 where `to_log_odds` is limited."""
    probability = 1 / (1 + math.exp(-min(max(log_odds, -700.0), 700.0)))
    return 0.0 if probability <= _MIN_PROBABILITY else probability
