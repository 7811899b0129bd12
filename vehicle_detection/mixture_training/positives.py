"""Positive samples of each template: vehicles in frames and on patches, shifted, relit and truncated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, relight
from vehicle_detection.mixture import (
    EdgePyramid,
    MixtureTemplate,
    mirror_channels,
    window_grid,
)
from vehicle_detection.mixture_training.sources import TrainingFrame
from vehicle_detection.params import MixtureParams

Image = NDArray[np.uint8]
Rows = NDArray[np.float32]
VehicleSamples = Iterator[tuple[Image, Sequence[Floats]]]
"""Images, each with boxes of vehicles."""

_BORDER_DISTANCE = 3  # px; a box this close to a border counts as truncated by it
_VISIBLE_RANGE = (0.3, 0.85)  # fraction of a vehicle that stays visible when it is truncated artificially
_MAX_OUTSIDE = 0.3  # fraction of a cell outside the image from which on the cell counts as outside


def window_features(pyramid: EdgePyramid, box: Floats, template: MixtureTemplate) -> NDArray[np.float32]:
    """Features of the template's window around a box, ``(20, rows, columns)``."""
    box_cells = template.box_cells
    rows, columns = template.weights.shape[:2]
    if template.border:
        # The window ends with the box, so its padding is a part of the box.
        step_x = (box[2] - box[0]) / box_cells[0]
        box, box_cells = box - [template.padding[0] * step_x, 0, 0, 0], (float(columns), box_cells[1])
    return pyramid.feature_map(window_grid(box.tolist(), box_cells, (columns, rows))).channels


def whole_vehicles(
    frames: Sequence[TrainingFrame], params: MixtureParams, rng: np.random.Generator
) -> VehicleSamples:
    """Yield the vehicles at their boxes, at shifted boxes, and in relit frames."""
    for frame in frames:
        boxes = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= params.min_width]
        yield (
            frame.image,
            [_shifted(box, copy, params, rng) for box in boxes for copy in range(params.copies)],
        )
        for _ in range(params.relit_copies if len(boxes) else 0):
            yield relight(frame.image, rng), list(boxes)


def truncated_vehicles(
    frames: Sequence[TrainingFrame], params: MixtureParams, rng: np.random.Generator
) -> VehicleSamples:
    """Yield vehicles truncated by the right border, and others in images cropped through them."""
    for frame in frames:
        width = frame.image.shape[1]
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        for image, boxes in (frame.image, frame.boxes), (mirrored, mirror_boxes(frame.boxes, width)):
            for box in boxes[boxes[:, 2] - boxes[:, 0] >= params.min_width]:
                if box[2] >= width - _BORDER_DISTANCE:
                    copies = [_shifted(box, copy, params, rng) for copy in range(params.border_copies)]
                    yield image, [np.array([x1, y1, width, y2]) for x1, y1, _, y2 in copies]
                end = round(box[0] + rng.uniform(*_VISIBLE_RANGE) * (box[2] - box[0]))
                wide_enough = params.min_width <= end - box[0] and end < width - _BORDER_DISTANCE
                if box[0] > _BORDER_DISTANCE and wide_enough:
                    yield image[:, :end], [np.array([*box[:2], end, box[3]])]


def _shifted(box: Floats, copy: int, params: MixtureParams, rng: np.random.Generator) -> Floats:
    """Shift the edges of a box randomly; copy 0 is not shifted."""
    shift = rng.uniform(-1, 1, 4) * params.jitter_scale * np.tile(box[2:] - box[:2], 2)
    return np.asarray(box + shift * (copy > 0))


def mirror_boxes(boxes: Floats, width: float) -> Floats:
    """Boxes in the mirrored image of this width."""
    return np.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], axis=1)


def vehicle_features(
    samples: VehicleSamples,
    templates: Sequence[MixtureTemplate],
    params: MixtureParams,
    means: Sequence[Rows] | None = None,
) -> list[Rows]:
    """Features of the samples of each template, ``(N, length)``; whole vehicles are mirrored, too.

    Cells outside the image take the features in `means`, ``(20, rows, columns)`` for each template.
    """
    found: list[list[Rows]] = [[] for _ in templates]
    for image, boxes in samples if templates else ():
        if not len(boxes):
            continue
        pyramid = EdgePyramid(image)
        for box in boxes:
            for index in _matching_templates(box, templates, params.aspect_tolerance):
                template = templates[index]
                channels = window_features(pyramid, box, template)
                if means is not None:
                    channels = np.where(_outside_cells(image, box, template), means[index], channels)
                # The samples of border templates already come from both sides.
                views = (channels,) if template.border else (channels, mirror_channels(channels))
                found[index] += [view.transpose(1, 2, 0).ravel() for view in views]
    return [np.array(rows, np.float32).reshape(-1, t.weights.size) for rows, t in zip(found, templates)]


def _outside_cells(image: Image, box: Floats, template: MixtureTemplate) -> NDArray[np.bool_]:
    """Which cells of a template's window lie outside the image, ``(rows, columns)``."""
    outside = []
    for axis, (cells, padding, box_cells) in enumerate(
        zip(template.weights.shape[1::-1], template.padding, template.box_cells)
    ):
        step = (box[axis + 2] - box[axis]) / box_cells
        start = (box[axis] + (np.arange(cells) - padding) * step) / step
        outside.append((start < -_MAX_OUTSIDE) | (start + 1 > image.shape[1 - axis] / step + _MAX_OUTSIDE))
    return np.asarray(outside[1][:, None] | outside[0][None], np.bool_)


def _matching_templates(box: Floats, templates: Sequence[MixtureTemplate], tolerance: float) -> list[int]:
    """Templates with a similar log aspect ratio to that of a box, and the closest one in any case."""
    aspects = np.log([template.box_cells[0] / template.box_cells[1] for template in templates])
    distance = np.abs(np.log((box[2] - box[0]) / (box[3] - box[1])) - aspects)
    return [int(index) for index in np.flatnonzero((distance == distance.min()) | (distance < tolerance))]


def align_mirrored(rows: Rows, rng: np.random.Generator) -> Rows:
    """Keep one of each two neighboring rows, a sample and its mirror image, so that all show the same side.

    k-means with two clusters that are each other's mirror image, from a few random starts.
    """
    if not len(rows):
        return rows
    pairs = rows.reshape(len(rows) // 2, 2, -1)
    centered = pairs - pairs.mean(axis=(0, 1))
    numbers = np.arange(len(pairs))
    best, best_norm = np.zeros(len(pairs), np.intp), -1.0
    for _ in range(5):
        chosen = rng.integers(0, 2, len(pairs))
        for _ in range(15):
            mean = centered[numbers, chosen].mean(axis=0)
            chosen = (centered @ mean).argmax(axis=1)
        if float(np.linalg.norm(mean)) > best_norm:
            best, best_norm = chosen, float(np.linalg.norm(mean))
    return np.ascontiguousarray(pairs[numbers, best])


def jitter_boxes(boxes: Floats, rng: np.random.Generator) -> Floats:
    """Shift and resize boxes randomly, about as much as a search misplaces them."""
    sides = boxes[:, 2:] - boxes[:, :2]
    centers = boxes[:, :2] + sides * (0.5 + rng.uniform(-0.2, 0.2, sides.shape))
    log_scale, log_aspect = rng.uniform(-0.45, 0.3, (len(boxes), 1)), rng.uniform(-0.15, 0.15, sides.shape)
    halves = sides / 2 * np.exp(log_scale + log_aspect)
    return np.concatenate([centers - halves, centers + halves], axis=1)
