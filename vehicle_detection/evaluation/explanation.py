"""Why a detector finds a vehicle in a box: the share of each cell in its score.

The score of a linear classifier is a sum, so that its explanation is exact: the weighted features of each
cell, and the bias. That of a network is explained by occlusion (Zeiler and Fergus, ECCV 2014): cells of the
frame are covered one by one, and the share of a cell is what the score loses without it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import Floats, check, describe
from vehicle_detection.boxes import clip_boxes, iou_matrix
from vehicle_detection.detector import Detector, VehicleDetector
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PATCH_SIZE, FeatureParams, extract_features, part_slices, sum_blocks
from vehicle_detection.network import NetworkModel, NetworkParams, NetworkSearch
from vehicle_detection.svm import VehicleClassifier

# IoU from which a found vehicle or a window belongs to a box.
_MIN_IOU = 0.5
# Windows of a classifier of patches are larger than the boxes of vehicles.
_MIN_WINDOW_IOU = 0.2
# Occlusion: rows and columns of cells, context around the box as a fraction of its sides, pixels of the input
# around that which are searched again, and the stride to which their place is aligned. Larger surroundings
# are reduced to about this number of pixels, to save time.
_OCCLUDED_CELLS, _CONTEXT, _SURROUNDINGS, _STRIDE = 6, 0.1, 64, 32
_MAX_PIXELS = 90_000
# Names of the ninths of a window, row by row.
_PARTS = tuple(
    "the center" if row == column == "middle" else f"the {row} {column}"
    for row, column in product(("upper", "middle", "lower"), ("left", "middle", "right"))
)
# Lower scores than any of a network.
_ANY_SCORE = -1e6


@dataclass(frozen=True, eq=False, repr=False)
class Explanation:
    """How the score of a box comes about.

    >>> from vehicle_detection import render_scene
    >>> from vehicle_detection.scenes import SceneVehicle
    >>> scene = render_scene(shape=(360, 640), vehicles=[SceneVehicle(distance_m=15.0)], random_state=1)
    >>> found = explain(VehicleDetector(), scene.image, scene.boxes[0])
    >>> found.found, list(found.terms), found.cells.shape
    (True, ['cells', 'rest'], (6, 6))
    """

    box: Floats  #: ``(4,)`` the found vehicle that overlaps the given box, if `found`; else the given box
    found: bool
    window: Floats  #: ``(4,)`` rectangle of the window's cells in pixels, which may extend beyond the image
    cells: Floats  #: ``(rows, columns)`` share of each cell in the score, above 0 if it supports a vehicle
    #: Amounts whose sum is `margin`: ``"cells"``, the sum of `cells`; for classifiers of patches ``"bias"``
    #: and ``"color histogram"``, which has no position; for networks ``"rest"``.
    terms: Mapping[str, float]
    score: float | None  #: of the vehicle; for classifiers of patches of the window; None if not found

    @property
    def margin(self) -> float:
        """Sum of the terms: decision value of a classifier; log-odds of a network above its threshold."""
        return float(sum(self.terms.values()))

    def describe(self) -> str:
        """Say in words what was found, and which ninths of the window speak most for and against it."""
        across, down = (_overlap(3, count) for count in self.cells.shape[::-1])
        parts = (down @ self.cells @ across.T).ravel()
        order, largest = np.argsort(-parts), np.abs(parts).max()
        ends = ((order[:2], "for it"), (order[:-3:-1], "against it"))
        clauses = []
        for (numbers, side), sign in zip(ends, (1, -1)):
            named = [_PARTS[number] for number in numbers if sign * parts[number] > 0.25 * largest]
            if named:
                verb = "speaks" if len(named) == 1 else "speak"
                clauses.append(f"{' and '.join(named)} {verb} {side}")
        found = "No vehicle is found here" if self.score is None else "A vehicle is found here"
        return f"{found}: {'; '.join(clauses)}." if clauses else f"{found}; no part stands out."

    def __str__(self) -> str:
        score = "not found" if self.score is None else f"score {self.score:.2f}"
        terms = " ".join(f"{value:+.2f} {name}" for name, value in self.terms.items())
        return f"{score}: margin {self.margin:.2f} = {terms}"

    def __repr__(self) -> str:
        return f"Explanation({self})"


def explain(detector: Detector | VehicleDetector, image: NDArray[np.uint8], box: ArrayLike) -> Explanation:
    """Explain why a detector finds a vehicle in a box of an image, or why not.

    `detector` has a network or a classifier of patches, `image` is ``(H, W, 3)`` uint8 RGB, and `box`
    ``[x1, y1, x2, y2]`` one that `VehicleDetector.detect` returned, or any other.

    Notes
    -----
    The window of a classifier of patches is cropped and scored like a patch; the shared search, which scales
    the frame once, gives similar scores. Shares of a classifier are relative to the mean patch of its
    training set.

    For a network, each of 6x6 cells over the box and a tenth of its sides around is painted gray together
    with half a cell around it, and the surroundings of the box are searched again. The share of the cell is a
    fourth of what the score loses, because each point is covered four times. Parts that can replace each
    other have small shares, so that shares need not add up to the score. The margin of a box without a
    vehicle is that of the network's best box there.

    Examples
    --------
    >>> road = np.full((360, 640, 3), 90, np.uint8)
    >>> explanation = explain(VehicleDetector(), road, [300, 200, 360, 250])
    >>> explanation.found, explanation.margin < 0
    (False, True)
    """
    check.instance(detector, "detector", (Detector, VehicleDetector), "pass VehicleDetector()")
    detector = detector.detector if isinstance(detector, VehicleDetector) else detector
    frame = check.image(image)
    boxes = check.boxes([box], "box").astype(np.float64)
    if boxes.shape != (1, 4) or (boxes[:, 2:] - boxes[:, :2] < 1).any():
        raise InvalidInputError(f"box must be [x1, y1, x2, y2], 1 pixel or larger; got {describe(box)}")
    model = detector.model
    if not isinstance(model, (NetworkModel, VehicleClassifier)):
        raise InvalidInputError(
            "detector must have a network or a classifier of patches, got a function, which cannot be "
            "explained; use VehicleDetector() or a model file"
        )
    height, width = frame.shape[:2]
    inside = clip_boxes(boxes, frame.shape)
    if (inside[:, 2:] - inside[:, :2] < 1).any():
        raise InvalidInputError(f"box must lie in the image of {width}x{height} pixels; got {describe(box)}")
    if isinstance(model, NetworkModel):
        return _explain_network(detector, model, frame, boxes[0])
    return _explain_classifier(detector, model, frame, boxes[0])


def _explain_network(
    detector: Detector, model: NetworkModel, image: NDArray[np.uint8], box: Floats
) -> Explanation:
    params: Any = detector.search_params
    vehicles = detector.search(image).vehicles
    assert vehicles is not None
    overlaps, score = iou_matrix(box[None], vehicles.boxes)[0], None
    if overlaps.max(initial=0) >= _MIN_IOU:
        row = int(np.argmax(overlaps))
        box, score = vehicles.boxes[row].astype(np.float64), float(vehicles.scores[row])
    context = _CONTEXT * (box[2:] - box[:2])
    window = np.concatenate([box[:2] - context, box[2:] + context])
    # OpenVINO would compile the graph for each size.
    with dataclasses.replace(model, runtime="onnxruntime").open_search() as search:
        around = _Surroundings(search, image, window, params)
        complete = around.score(box)
        cells = np.empty((_OCCLUDED_CELLS, _OCCLUDED_CELLS))
        xs, ys = (np.linspace(window[axis], window[axis + 2], _OCCLUDED_CELLS + 1) for axis in (0, 1))
        # A cell is covered with half a cell around it, so that each point is covered four times.
        half = (window[2:] - window[:2]) / (2 * _OCCLUDED_CELLS)
        for y, x in np.ndindex(*cells.shape):
            covered = np.array([xs[x], ys[y], xs[x + 1], ys[y + 1]]) + np.concatenate([-half, half])
            cells[y, x] = (complete - around.score(box, covered)) / 4
    terms = {"cells": float(cells.sum())}
    terms["rest"] = (complete if score is None else score) - terms["cells"]
    return Explanation(box, score is not None, window, cells, terms, score)


class _Surroundings:
    """The part of a frame around a window, at the network's scale, which is cheap to search."""

    def __init__(
        self, search: NetworkSearch, image: NDArray[np.uint8], window: Floats, params: NetworkParams
    ) -> None:
        self._search = search
        input_format = search.model.input_format
        scaled, _ = input_format.fit(image.shape, search.model.input_size_for(params))
        self._factors = np.array([scaled[1] / image.shape[1], scaled[0] / image.shape[0]] * 2)
        limits = np.array(scaled[::-1])
        low, high = np.zeros(2), limits
        if input_format.size is None and not input_format.stretch:
            place = window * self._factors
            low = np.clip((place[:2] - _SURROUNDINGS) // _STRIDE * _STRIDE, 0, limits - _STRIDE).clip(0)
            high = np.clip(-(-(place[2:] + _SURROUNDINGS) // _STRIDE) * _STRIDE, low + 1, limits)
            side = (high - low).max() * min(1.0, math.sqrt(_MAX_PIXELS / np.prod(high - low)))
            params = dataclasses.replace(params, input_size=int(-(-side // _STRIDE) * _STRIDE))
        self._params, self._corner = params, np.tile(low, 2)
        resized = np.asarray(cv2.resize(image, scaled[::-1], interpolation=cv2.INTER_AREA), np.uint8)
        (left, top), (right, bottom) = low.astype(int).tolist(), high.astype(int).tolist()
        self._picture = resized[top:bottom, left:right]

    def _place(self, box: Floats) -> Floats:
        return np.asarray(box * self._factors - self._corner)

    def score(self, box: Floats, covered: Floats | None = None) -> float:
        """Return the score of the network's best box there, with a part of the frame painted gray."""
        picture, model = self._picture.copy(), self._search.model
        if covered is not None:
            x1, y1, x2, y2 = np.rint(self._place(covered)).clip(0).astype(int).tolist()
            picture[y1:y2, x1:x2] = model.input_format.padding
        candidates = self._search.find_candidates(picture, self._params, _ANY_SCORE)
        near = iou_matrix(self._place(box)[None], candidates.boxes)[0] >= _MIN_IOU
        return float(model.scores(np.append(candidates.probabilities[near], 0.0)).max())


def _explain_classifier(
    detector: Detector, model: VehicleClassifier, image: NDArray[np.uint8], box: Floats
) -> Explanation:
    windows = detector.search(image).windows
    overlaps = iou_matrix(box[None], windows.boxes)[0]
    near = np.flatnonzero(overlaps >= _MIN_WINDOW_IOU)
    found = bool(len(near))
    window = windows.boxes[near[np.argmax(windows.scores[near])]].astype(np.float64) if found else box
    x1, y1, x2, y2 = np.rint(clip_boxes(window[None], image.shape)[0]).astype(int).tolist()
    x2, y2 = max(x2, x1 + 1), max(y2, y1 + 1)
    patch = cv2.resize(image[y1:y2, x1:x2], (PATCH_SIZE, PATCH_SIZE))
    features = extract_features(patch[None], model.params)[0].astype(np.float64)
    shares = [each.coef * (features - each.mean) / each.scale for each in model.templates]
    scores = [float(share.sum()) + each.intercept for share, each in zip(shares, model.templates)]
    number = int(np.argmax(scores))
    cells = patch_cell_shares(shares[number], model.params)
    terms = {"cells": float(cells.sum()), "bias": float(model.templates[number].intercept)}
    histogram = part_slices(model.params).get("color histogram")
    if histogram is not None:
        terms["color histogram"] = float(shares[number][histogram].sum())
    place = np.array([x1, y1, x2, y2], np.float64)
    return Explanation(box, found, place, cells, terms, scores[number] if found else None)


def patch_cell_shares(shares: Floats, params: FeatureParams) -> Floats:
    """Sum shares of features by the HOG cells of a patch: those of blocks, coarse blocks and spatial bins.

    Coarse cells and spatial bins are spread over the cells that they cover. The color histogram is left out.
    """
    total = np.zeros((params.cells, params.cells))
    for part, rows in part_slices(params).items():
        values = shares[rows]
        if part == "spatial bins":
            plane = params.spatial_planes(values).sum(axis=0)
        elif part == "color histogram":
            continue
        else:
            side, block = (params.blocks if part == "HOG" else params.coarse_blocks), params.cell_per_block
            shape = (params.hog_channels, side, side, block, block, params.orient)
            plane = sum(sum_blocks(channel).sum(axis=2) for channel in values.reshape(shape))
        spread = _overlap(params.cells, len(plane))
        total += spread @ plane @ spread.T
    return total


def _overlap(cells: int, parts: int) -> Floats:
    """Fraction of each of `parts` equal intervals that lies in each of `cells`, ``(cells, parts)``."""
    edges, ends = np.arange(cells + 1) / cells, np.arange(parts + 1) / parts
    low = np.maximum(edges[:-1, None], ends[None, :-1])
    high = np.minimum(edges[1:, None], ends[None, 1:])
    return np.asarray(np.maximum(high - low, 0.0) * parts)
