"""Why a detector finds a vehicle in a box: the share of each cell in its score.

A linear score is a sum, so that its explanation is exact: the weighted features of each cell, and the bias.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import Floats, check_boxes, check_image, check_type, describe
from vehicle_detection.boxes import box_areas, iou_matrix
from vehicle_detection.camera import truncated_edges
from vehicle_detection.classifier import VehicleClassifier
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.drawing import blur_boxes, draw_boxes, draw_cell_shares
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.events import TrackLog
from vehicle_detection.features import extract_features, part_slices, sum_blocks
from vehicle_detection.mixture import (
    MIRROR_ORDER,
    RESCORE_MIN,
    CellGrid,
    EdgePyramid,
    MixtureTemplate,
    TemplateMixture,
    prepare,
    window_grid,
)
from vehicle_detection.params import PATCH_SIZE, FeatureParams
from vehicle_detection.video import Source, borrow_source

# IoU from which a found vehicle or a window belongs to a box.
_MIN_IOU = 0.5
# Part of an image around a window that a picture shows, as a fraction of its longer side; height of the
# picture in pixels, and color of its box.
_AROUND, _PICTURE_HEIGHT, _BOX_COLOR = 0.2, 180, (240, 228, 66)
# Windows of a classifier of patches are larger than the boxes of vehicles.
_MIN_WINDOW_IOU = 0.2


@dataclass(frozen=True, eq=False, repr=False)
class Explanation:
    """How the score of a box comes about.

    Attributes
    ----------
    box, found
        ``(4,)`` the explained box: the found vehicle that overlaps the given box, if `found`; else the given
        box itself.
    window
        ``(4,)`` rectangle of the window's cells in pixels, which may extend beyond the image.
    cells
        ``(rows, columns)`` share of each cell in the linear score, positive where it speaks for a vehicle.
    terms
        Named amounts whose sum is `margin`: ``"cells"``, the sum of `cells`; ``"bias"``; for classifiers of
        patches ``"color histogram"``, which has no position; for mixtures ``"votes and size"``,
        ``"second stage"``, ``"candidates"`` and ``"perspective"``, if there are.
    template
        Number of the template with the best window, from 0.
    score
        Score of the found vehicle; for classifiers of patches that of the window. None if it is not found.

    Examples
    --------
    >>> from vehicle_detection import render_scene
    >>> from vehicle_detection.synthetic import SceneVehicle
    >>> scene = render_scene(shape=(360, 640), vehicles=[SceneVehicle(distance_m=15.0)], random_state=1)
    >>> found = explain(VehicleDetector(), scene.image, scene.boxes[0])
    >>> found.found, list(found.terms)
    (True, ['cells', 'bias', 'votes and size', 'second stage', 'candidates', 'perspective'])
    """

    box: Floats
    found: bool
    window: Floats
    cells: Floats
    terms: Mapping[str, float]
    template: int
    score: float | None

    @property
    def margin(self) -> float:
        """Sum of the terms: margin of a mixture, decision value of a classifier."""
        return float(sum(self.terms.values()))

    def __str__(self) -> str:
        score = "not found" if self.score is None else f"score {self.score:.2f}"
        terms = " ".join(f"{value:+.2f} {name}" for name, value in self.terms.items())
        return f"{score}, template {self.template + 1}: margin {self.margin:.2f} = {terms}"

    def __repr__(self) -> str:
        return f"Explanation({self})"


def explain(detector: VehicleDetector, image: NDArray[np.uint8], box: ArrayLike) -> Explanation:
    """Explain why a detector finds a vehicle in a box of an image, or why not.

    Parameters
    ----------
    detector
        A `VehicleDetector` with a mixture of templates or a classifier of patches.
    image
        ``(H, W, 3)`` uint8 RGB.
    box
        ``[x1, y1, x2, y2]`` in pixels: one that `VehicleDetector.detect` returned, or any other.

    Returns
    -------
    Explanation
        The share of each cell in the linear score of the best window, and what else contributes.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or the model is a function, whose scores have no parts.

    Notes
    -----
    The terms of a mixture are sums and differences of what its search computes; its search rounds features
    to 7 bits and weights to 8, so that ``"cells"`` differs from it by about 0.004. The window of a classifier
    of patches is cropped and scored like a patch; the shared search, which scales the frame once, gives
    similar scores. Shares of a classifier are relative to the mean patch of its training set.

    Examples
    --------
    >>> road = np.full((360, 640, 3), 90, np.uint8)
    >>> explanation = explain(VehicleDetector(), road, [300, 200, 360, 250])
    >>> explanation.found, abs(explanation.terms["cells"]) < 0.1
    (False, True)
    """
    check_type(detector, "detector", VehicleDetector, "pass VehicleDetector()")
    frame = check_image(image)
    boxes = check_boxes([box], "box").astype(np.float64)
    if boxes.shape != (1, 4) or (boxes[:, 2:] - boxes[:, :2] < 1).any():
        raise InvalidInputError(f"box must be [x1, y1, x2, y2], 1 pixel or larger; got {describe(box)}")
    model = detector.model
    if isinstance(model, TemplateMixture):
        return _explain_mixture(detector, model, frame, boxes[0])
    if isinstance(model, VehicleClassifier):
        return _explain_classifier(detector, model, frame, boxes[0])
    raise InvalidInputError(
        "detector must have a linear model, got a function, whose scores have no parts; "
        "use VehicleDetector() or a model file"
    )


# Largest number of tracks that are explained, each of which takes a search of a frame.
_MAX_EXPLAINED = 12


class ExplainedTrack(NamedTuple):
    """A box of a track that is explained, and a picture of it."""

    frame: int  # in which the box is, counted from the first processed frame
    picture: NDArray[np.uint8]  # the vehicle, and beside it the same with the shares of the cells
    explanation: Explanation


def explain_tracks(detector: VehicleDetector, source: Source, log: TrackLog) -> dict[int, ExplainedTrack]:
    """Explain a box of each of the twelve longest tracks: the largest detected one inside the frame.

    Parameters
    ----------
    detector, source, log
        The detector, a source that can be read again, and the tracks of its frames.

    Returns
    -------
    dict
        Explained box of each track, by its id, in ascending order.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or the model is a function, whose scores have no parts.
    VideoError
        If the source cannot be read.
    """
    known = [track for track in log.histories() if np.isfinite(track.boxes).all(axis=1).any()]
    tracks = sorted(known, key=lambda track: -len(track.frames))[:_MAX_EXPLAINED]
    explained = {}
    with borrow_source(source) as opened:
        shape = opened.info.shape[:2]
        fps = float(opened.info.fps)
        offset, interval = round((log.first_time or 0.0) * fps), detector.search_interval(fps)
        for track in tracks:
            truncated = truncated_edges(track.boxes, shape).any(axis=1)
            # Predicted boxes have no detection to explain; they are the last choice.
            detected = (track.columns["time_since_update"] == 0) & (track.frames % interval == 0)
            weights = np.where(truncated, 0.01, 1.0) * np.where(detected, 1.0, 1e-9)
            row = int(np.nanargmax(weights * box_areas(track.boxes)))
            frame = int(track.frames[row])
            with opened.read(offset + frame, 1) as frames:
                for _, _, image in frames:
                    explanation = explain(detector, image, track.boxes[row])
                    picture = _draw_explanation(detector, image, explanation)
                    explained[track.id] = ExplainedTrack(frame, picture, explanation)
    return dict(sorted(explained.items()))


def _draw_explanation(
    detector: VehicleDetector, image: NDArray[np.uint8], explanation: Explanation
) -> NDArray[np.uint8]:
    """Draw an explained box twice, side by side: as it is, and with the shares of its cells."""
    if detector.blur is not None:
        boxes = np.concatenate([detector.detect(image).boxes, explanation.box[None]])
        image = blur_boxes(image, boxes, region=detector.blur)
    both = np.stack([explanation.window, explanation.box])
    around = _AROUND * (both[:, 2:].max(axis=0) - both[:, :2].min(axis=0)).max()
    low, high = both[:, :2].min(axis=0) - around, both[:, 2:].max(axis=0) + around
    left, top = np.maximum(low, 0).astype(int).tolist()
    right, bottom = np.minimum(high, image.shape[1::-1]).astype(int).tolist()
    plain = np.ascontiguousarray(image[top:bottom, left:right])
    scale = _PICTURE_HEIGHT / len(plain)
    size = max(1, round(scale * plain.shape[1])), _PICTURE_HEIGHT
    plain = np.asarray(cv2.resize(plain, size, interpolation=cv2.INTER_AREA), np.uint8)
    corner = np.array([left, top, left, top])
    shares = draw_cell_shares(plain, (explanation.window - corner) * scale, explanation.cells)
    shares = draw_boxes(shares, [(explanation.box - corner) * scale], color=_BOX_COLOR, thickness=2)
    return np.hstack([plain, shares])


def _best_overlap(box: Floats, boxes: Floats, min_iou: float) -> int | None:
    """Row of the box with the largest IoU; None if all are below `min_iou`."""
    overlaps = iou_matrix(box[None], boxes)[0]
    best = int(np.argmax(overlaps)) if len(boxes) else 0
    return best if len(boxes) and overlaps[best] >= min_iou else None


def _explain_mixture(
    detector: VehicleDetector, model: TemplateMixture, image: NDArray[np.uint8], box: Floats
) -> Explanation:
    params: Any = detector.search_params_of(image.shape)
    vehicles = detector.search(image).vehicles
    assert vehicles is not None
    row = _best_overlap(box, vehicles.boxes, _MIN_IOU)
    with model.open_search() as search:
        pyramid, windows = search.score_windows(prepare(image), params)
        every = model.detect_vehicles(pyramid, windows, min_margin=-np.inf)
        frame_terms = {"candidates": every.shift} if model.count_weight else {}
        proposals, margins = model.propose_boxes(pyramid, windows, min_margin=RESCORE_MIN)
        corrected, final, proposal_rows = model.rescore_boxes(pyramid, proposals, margins)
        place = None if row is None else _best_overlap(vehicles.boxes[row], corrected, _MIN_IOU)
        if row is not None and place is not None:
            proposal = int(proposal_rows[place])
            # The windows are sorted, so that the first one that overlaps is the best.
            near = np.flatnonzero(iou_matrix(proposals[proposal][None], windows.boxes)[0] >= _MIN_IOU)
            if len(near):
                best = int(near[0])
                number = int(windows.templates[best])
                grid, weights = _place(model.templates[number], windows.boxes[best], image.shape[1])
                cells = _cell_shares(pyramid, grid, weights)
                terms = {"cells": float(cells.sum()), "bias": model.templates[number].bias}
                terms["votes and size"] = float(margins[proposal]) - sum(terms.values())
                if model.rescorer is not None:
                    terms["second stage"] = float(final[place] - margins[proposal])
                terms |= frame_terms
                if model.perspective_weight:
                    same = _best_overlap(vehicles.boxes[row], every.boxes, _MIN_IOU)
                    terms["perspective"] = 0.0 if same is None else float(every.perspective[same])
                score = float(vehicles.scores[row])
                found = vehicles.boxes[row].astype(np.float64)
                return Explanation(found, True, _window_of(grid), cells, terms, number, score)
    # Not found: place each template on the box itself.
    pyramid = EdgePyramid(prepare(image))
    placed = []
    for number, template in enumerate(model.templates):
        if not template.border:
            rows, columns = template.weights.shape[:2]
            grid = window_grid(box.tolist(), template.box_cells, (columns, rows))
            placed.append((number, grid, _cell_shares(pyramid, grid, template.weights)))
    if not placed:
        raise InvalidInputError("box must be a found vehicle for a model of border templates only")
    number, grid, cells = max(placed, key=lambda each: each[2].sum() + model.templates[each[0]].bias)
    terms = {"cells": float(cells.sum()), "bias": model.templates[number].bias}
    if model.rescorer is not None:
        margin = np.array([sum(terms.values())])
        terms["second stage"] = float((model.rescorer.apply(pyramid, box[None], margin)[1] - margin)[0])
    terms |= frame_terms
    return Explanation(box, False, _window_of(grid), cells, terms, number, None)


def _place(template: MixtureTemplate, box: Floats, width: int) -> tuple[CellGrid, NDArray[np.float32]]:
    """Cells of the window whose box this is, and the weights of these cells."""
    rows, columns = template.weights.shape[:2]
    steps = (box[2:] - box[:2]) / template.box_cells
    left, top = box[:2] - np.array(template.padding) * steps
    weights = template.weights
    if template.border and box[0] <= 0 and box[2] < width:  # the mirror image, at the left border
        left, weights = box[0], weights[:, ::-1, MIRROR_ORDER]
    return CellGrid(float(left), float(top), float(steps[0]), float(steps[1]), rows, columns), weights


def _cell_shares(pyramid: EdgePyramid, grid: CellGrid, weights: NDArray[np.float32]) -> Floats:
    """Weighted channels of each cell, ``(rows, columns)``."""
    channels = pyramid.feature_map(grid).channels
    return np.asarray((weights.astype(np.float64) * channels.transpose(1, 2, 0)).sum(axis=2))


def _window_of(grid: CellGrid) -> Floats:
    right, bottom = grid.left + grid.columns * grid.step_x, grid.top + grid.rows * grid.step_y
    return np.array([grid.left, grid.top, right, bottom])


def _explain_classifier(
    detector: VehicleDetector, model: VehicleClassifier, image: NDArray[np.uint8], box: Floats
) -> Explanation:
    windows = detector.search(image).windows
    overlaps = iou_matrix(box[None], windows.boxes)[0]
    near = np.flatnonzero(overlaps >= _MIN_WINDOW_IOU)
    found = bool(len(near))
    window = windows.boxes[near[np.argmax(windows.scores[near])]].astype(np.float64) if found else box
    height, width = image.shape[:2]
    x1, y1, x2, y2 = np.rint(np.clip(window, 0, [width, height, width, height])).astype(int).tolist()
    if x2 - x1 < 1 or y2 - y1 < 1:
        raise InvalidInputError(f"box must lie in the image of {width}x{height} pixels; got {box.tolist()}")
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
    return Explanation(box, found, place, cells, terms, number, scores[number] if found else None)


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
