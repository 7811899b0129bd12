"""The search of a frame with a network."""

from __future__ import annotations

import math
import os
import threading
import weakref
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, single_threaded_opencv
from vehicle_detection.boxes import Detections, box_areas, greedy_nms
from vehicle_detection.errors import ModelFileError
from vehicle_detection.network.outputs import Candidates
from vehicle_detection.network.runtime import Session, open_session
from vehicle_detection.params import NetworkParams
from vehicle_detection.search import FrameSearch

if TYPE_CHECKING:
    from vehicle_detection.network.model import NetworkModel

# Probabilities of exactly 0 and 1 have no finite log-odds.
_MIN_PROBABILITY = 1e-4


class NetworkSearch(FrameSearch):
    """The search of frames with a network; vehicles lie inside the frame.

    The network's session is opened by the first search.
    """

    params_type = NetworkParams

    def __init__(self, model: NetworkModel, *, n_jobs: int | None = None) -> None:
        super().__init__(n_jobs)
        self.model = model
        self._session: Session | None = None
        self._lock = threading.Lock()
        _SEARCHES.add(self)

    def abandon_session(self) -> None:
        """Open a new session on the next search: a forked child lacks the threads of the last one."""
        if self._session is not None:
            _ABANDONED.append(self._session)
        self._session, self._lock = None, threading.Lock()

    def _search(
        self, frame: NDArray[np.uint8], params: NetworkParams, min_vehicle_score: float
    ) -> tuple[Detections, Detections]:
        candidates = self.find_candidates(frame, params, min(min_vehicle_score, params.min_score))
        boxes, scores = candidates.boxes, self.model.scores(candidates.scores)
        kept = greedy_nms(boxes, scores, max_iou=self.model.nms_iou)
        vehicles = Detections(boxes[kept], scores[kept])
        return (
            Detections(boxes, scores)[scores >= params.min_score],
            vehicles[vehicles.scores >= min_vehicle_score],
        )

    def find_candidates(
        self, frame: NDArray[np.uint8], params: NetworkParams, min_score: float
    ) -> Candidates:
        """Boxes before suppression with at least this score, best first, in pixels of the frame."""
        model = self.model
        with single_threaded_opencv():
            array, scaled = model.input_format.prepare(frame, model.input_size_for(params), self.workspace)
        axes = (2, 3) if model.input_format.channels_first else (1, 2)
        size = array.shape[axes[0]], array.shape[axes[1]]
        outputs = self._open().run(model.feeds(array, size))
        try:
            found = model.output_format.decode(outputs, size, model.class_ids, model.probability(min_score))
        except ModelFileError as error:
            raise ModelFileError(
                f"{model.name} computes invalid values: {error}; download or export it again"
            ) from error
        boxes = _to_frame(found.boxes, frame.shape, scaled)
        inside = box_areas(boxes) > 0
        return Candidates(boxes[inside], found.scores[inside], found.class_ids[inside])

    def _open(self) -> Session:
        with self._lock:
            if self._session is None:
                model = self.model
                self._session = open_session(
                    model.graph,
                    model.name,
                    n_jobs=self._team.n_threads,
                    device=model.device,
                    runtime=model.runtime,
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


def _to_frame(boxes: Floats, shape: tuple[int, ...], scaled: tuple[int, int]) -> Floats:
    """Boxes in pixels of the frame, clipped to it; `scaled` is the frame's height and width in the input."""
    height, width = shape[:2]
    factors = np.array([width / scaled[1], height / scaled[0]] * 2)
    return np.asarray(np.clip(boxes * factors, 0.0, [width, height, width, height]))


def to_log_odds(probabilities: Floats) -> Floats:
    """Log-odds of probabilities, at most those of 0.9999."""
    p = probabilities.clip(_MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
    return np.asarray(np.log(p / (1 - p)))


def to_probability(log_odds: float) -> float:
    """Probability of log-odds; 0 where `to_log_odds` is limited."""
    probability = 1 / (1 + math.exp(-min(max(log_odds, -700.0), 700.0)))
    return 0.0 if probability <= _MIN_PROBABILITY else probability
