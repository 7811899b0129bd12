"""What the templates of a mixture are trained to find: vehicles as each template sees them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import relight
from vehicle_detection.mixture import (
    COARSE,
    FINE,
    BoxRegressor,
    MixtureTemplate,
    crop_channels,
    mirror_channels,
)
from vehicle_detection.mixture_training.negatives import Frame
from vehicle_detection.params import MixtureParams

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]
VehicleSamples = Iterator[tuple[Image, Floats]]
"""Images and the place of a vehicle in each."""

# A vehicle is cut by a border that it comes nearer to than this, in pixels; share of a vehicle that is left
# where it is cut on purpose.
_AT_BORDER, _SHOWN = 3, (0.3, 0.85)
# Where the vehicle is on most patches, in shares of their sides; what share of a cell may lie beyond one.
_ON_PATCH, _SLACK = np.array([0.05, 0.14, 0.95, 0.89]), 0.3


def window_features(image: Image, box: Floats, template: MixtureTemplate) -> NDArray[np.float32]:
    """Features of a box as a template sees it, ``(28, rows, columns)``."""
    inside = template.box_cells
    rows, columns = template.weights.shape[:2]
    step_x, step_y = (box[2] - box[0]) / inside[0], (box[3] - box[1]) / inside[1]
    cell = FINE if np.sqrt(step_x * step_y) < COARSE else COARSE
    if template.border:
        # The window ends with the box: its margin is part of what is warped.
        box, inside = box - [template.padding[0] * step_x, 0, 0, 0], (float(columns), inside[1])
    return crop_channels(image, box.tolist(), inside, (columns, rows), cell)


def whole_vehicles(
    frames: Sequence[Frame], params: MixtureParams, rng: np.random.Generator
) -> VehicleSamples:
    """Vehicles where they are, moved a little, and at other exposures."""
    for frame in frames:
        boxes = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= params.min_width]
        for box in boxes:
            for copy in range(params.jitter):
                shift = rng.uniform(-1, 1, 4) * params.jitter_scale * np.tile(box[2:] - box[:2], 2)
                yield frame.image, box + shift * (copy > 0)
        for _ in range(params.exposures if len(boxes) else 0):
            image = relight(frame.image, rng)
            for box in boxes:
                yield image, box


def truncated_vehicles(
    frames: Sequence[Frame], params: MixtureParams, rng: np.random.Generator
) -> VehicleSamples:
    """Vehicles that the right border cuts, and whole ones in images that are cut through them."""
    for frame in frames:
        width = frame.image.shape[1]
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        for image, boxes in (frame.image, frame.boxes), (mirrored, mirror_boxes(frame.boxes, width)):
            for box in boxes[boxes[:, 2] - boxes[:, 0] >= params.min_width]:
                sides = np.tile(box[2:] - box[:2], 2)
                if box[2] >= width - _AT_BORDER:
                    for copy in range(params.border_jitter):
                        x1, y1, _, y2 = box + rng.uniform(-1, 1, 4) * params.jitter_scale * sides * (copy > 0)
                        yield image, np.array([x1, y1, width, y2])
                end = round(box[0] + rng.uniform(*_SHOWN) * sides[0])
                if box[0] > _AT_BORDER and params.min_width <= end - box[0] and end < width - _AT_BORDER:
                    yield image[:, :end], np.array([*box[:2], end, box[3]])


def mirror_boxes(boxes: Floats, width: float) -> Floats:
    """Boxes in the mirrored image of this width."""
    return np.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], axis=1)


def vehicle_features(
    vehicles: VehicleSamples, templates: Sequence[MixtureTemplate], params: MixtureParams
) -> list[NDArray[np.float32]]:
    """Features of the vehicles of each template, ``(N, length)``."""
    found: list[list[NDArray[np.float32]]] = [[] for _ in templates]
    for image, box in vehicles if templates else ():
        for index in _alike(box, templates, params.near):
            planes = window_features(image, box, templates[index])
            # At the border every vehicle comes from both sides already.
            found[index] += (
                _rows(planes) if templates[index].border else _rows(planes, mirror_channels(planes))
            )
    return _stacked(found, templates)


def patch_features(
    patches: Sequence[Image],
    placing: BoxRegressor,
    templates: Sequence[MixtureTemplate],
    known: Sequence[NDArray[np.float32]],
    params: MixtureParams,
) -> list[NDArray[np.float32]]:
    """Features of the vehicles on patches, each of which one vehicle mostly fills, for each template.

    Parameters
    ----------
    patches
        Images of any size.
    placing
        Finds the vehicle on its patch: a correction of boxes.
    templates
        Of whole vehicles.
    known
        Features of vehicles in frames, as `vehicle_features` gives them. A patch does not show what is around
        a vehicle: what a template looks at there is what it sees on the average around those.

    Returns
    -------
    list of numpy.ndarray
        As `vehicle_features` gives them.
    """
    found: list[list[NDArray[np.float32]]] = [[] for _ in templates]
    means = [
        rows.mean(axis=0).reshape(template.weights.shape).transpose(2, 0, 1)
        for template, rows in zip(templates, known)
    ]
    for image in patches:
        box = place_on_patch(image, placing)
        for index in _alike(box, templates, params.near):
            planes = window_features(image, box, templates[index]).copy()
            unseen = _beyond(image, box, templates[index])
            planes[:, unseen] = means[index][:, unseen]
            found[index] += _rows(planes, mirror_channels(planes))
    return _stacked(found, templates)


def place_on_patch(image: Image, placing: BoxRegressor) -> Floats:
    """Box of the vehicle on a patch: where it is on most of them, corrected twice."""
    size = np.tile(image.shape[1::-1], 2)
    box = _ON_PATCH * size
    for _ in range(2):
        box = box + placing.shifts(image, box[None])[0] * np.tile(box[2:] - box[:2], 2)
    return np.asarray(np.clip(box, 0, size), np.float64)


def _beyond(image: Image, box: Floats, template: MixtureTemplate) -> NDArray[np.bool_]:
    """Which cells of a template lie beyond the image by more than a part of a cell, ``(rows, columns)``."""
    outside = []
    for axis, (cells, margin, inside) in enumerate(
        zip(template.weights.shape[1::-1], template.padding, template.box_cells)
    ):
        step = (box[axis + 2] - box[axis]) / inside
        start = (box[axis] + (np.arange(cells) - margin) * step) / step
        outside.append((start < -_SLACK) | (start + 1 > image.shape[1 - axis] / step + _SLACK))
    return np.asarray(outside[1][:, None] | outside[0][None], np.bool_)


def _alike(box: Floats, templates: Sequence[MixtureTemplate], near: float) -> list[int]:
    """Templates of about a box's aspect ratio, the nearest one in any case."""
    aspects = np.log([template.box_cells[0] / template.box_cells[1] for template in templates])
    apart = np.abs(np.log((box[2] - box[0]) / (box[3] - box[1])) - aspects)
    return [int(index) for index in np.flatnonzero((apart == apart.min()) | (apart < near))]


def _rows(*views: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    return [view.transpose(1, 2, 0).ravel() for view in views]


def _stacked(
    found: Sequence[Sequence[NDArray[np.float32]]], templates: Sequence[MixtureTemplate]
) -> list[NDArray[np.float32]]:
    return [np.array(rows, np.float32).reshape(-1, t.weights.size) for rows, t in zip(found, templates)]


def align_mirrored(
    rows: NDArray[np.float32], rng: np.random.Generator, tries: int = 5
) -> NDArray[np.float32]:
    """Choose of each vehicle and its mirror image, which are neighboring rows, the one like the others.

    Two clusters that are each other's mirror image, by k-means from a few random starts.
    """
    if not len(rows):
        return rows
    pairs = rows.reshape(len(rows) // 2, 2, -1)
    centerd = pairs - pairs.mean(axis=(0, 1))
    number = np.arange(len(pairs))
    best, length = np.zeros(len(pairs), np.intp), -1.0
    for _ in range(tries):
        chosen = rng.integers(0, 2, len(pairs))
        for _ in range(15):
            mean = centerd[number, chosen].mean(axis=0)
            chosen = (centerd @ mean).argmax(axis=1)
        if float(np.linalg.norm(mean)) > length:
            best, length = chosen, float(np.linalg.norm(mean))
    return np.ascontiguousarray(pairs[number, best])


def jitter_boxes(boxes: Floats, rng: np.random.Generator) -> Floats:
    """Boxes as a search may find them: beside their vehicles, too small or too large, of another shape."""
    sides = boxes[:, 2:] - boxes[:, :2]
    centers = boxes[:, :2] + sides * (0.5 + rng.uniform(-0.2, 0.2, sides.shape))
    size, shape = rng.uniform(-0.45, 0.3, (len(boxes), 1)), rng.uniform(-0.15, 0.15, sides.shape)
    halves = sides / 2 * np.exp(size + shape)
    return np.concatenate([centers - halves, centers + halves], axis=1)
