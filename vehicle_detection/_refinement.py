"""Windows of several templates to boxes of vehicles: suppression, voting, and a linear correction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._checks import check_integer, describe
from vehicle_detection._feature_maps import COARSE, PLANES, feature_planes
from vehicle_detection.boxes import box_areas, clip_boxes, intersection_matrix
from vehicle_detection.errors import InvalidInputError

WEAKEST = -1.0
"""Least value of a template that makes a window a candidate."""

CROP = 12
"""Cells of a side of the crop that corrects a box: the box fills 8 of them."""

CROP_LENGTH = PLANES * CROP * CROP + 4
"""Features of a crop."""

_INSIDE = (8.0, 8.0)
# Overlaps: of windows that vote for one box; above which the weaker of two vehicles goes, by IoU and by the
# share of the smaller one that is covered.
_VOTE, _IOU, _COVER = 0.5, 0.35, 0.75
# What a window's value exceeds this by counts in a vote.
_VOTE_FROM = -1.1
_MOST_VEHICLES = 60
# Least share of a box inside the frame.
_LEAST_INSIDE = 0.35
# A correction moves an edge by this share of the box's side at most; a box is looked at again where it moved
# one by more than the second.
_MOST_SHIFT, _SETTLED = 0.3, 0.15

Floats = NDArray[np.float64]


def finite_array(values: object, name: str, shape: tuple[int | None, ...]) -> NDArray[np.float32]:
    """Return a float32 copy that cannot be written; None in `shape` stands for any number of entries."""
    expected = ", ".join("any" if side is None else str(side) for side in shape)
    try:
        array = np.array(values, np.float32, order="C")
    except (TypeError, ValueError):
        array = np.array(np.nan, np.float32)
    fits = array.ndim == len(shape) and all(side in (None, n) for side, n in zip(shape, array.shape))
    if not fits or not array.size or not np.isfinite(array).all():
        raise InvalidInputError(
            f"{name} must be finite numbers of shape ({expected}), got {describe(values)}; train again"
        )
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class Candidates:
    """Windows as columns: boxes, values of their templates, numbers of the templates."""

    boxes: Floats
    scores: Floats
    templates: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, rows: NDArray[Any] | slice) -> Candidates:
        return Candidates(self.boxes[rows], self.scores[rows], self.templates[rows])

    @classmethod
    def empty(cls) -> Candidates:
        """No window."""
        return cls(np.empty((0, 4)), np.empty(0), np.empty(0, np.intp))

    @classmethod
    def join(cls, parts: Sequence[Candidates], shape: tuple[int, ...]) -> Candidates:
        """Put the windows of several searches together; those that are mostly outside the frame go."""
        parts = [part for part in parts if len(part)] or [cls.empty()]
        both = cls(
            np.concatenate([part.boxes for part in parts]),
            np.concatenate([part.scores for part in parts]),
            np.concatenate([part.templates for part in parts]),
        )
        return both[np.flatnonzero(mostly_inside(both.boxes, shape))]

    def best(self, most: int) -> Candidates:
        """Take the best windows, from the best one down; of equals the first."""
        return self[np.argsort(-self.scores, kind="stable")[:most]]


def mostly_inside(boxes: Floats, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Tell which boxes show enough of a vehicle inside a frame of ``(height, width, ...)``."""
    inside = box_areas(clip_boxes(boxes, shape))
    return np.asarray(inside > _LEAST_INSIDE * box_areas(boxes), np.bool_)


def overlaps(box: Floats, others: Floats) -> tuple[Floats, Floats]:
    """IoU of a box with others, and the share of the smaller of both that they share."""
    shared = intersection_matrix(box[None], others)[0]
    area, areas = float(box_areas(box[None])[0]), box_areas(others)
    return shared / np.maximum(area + areas - shared, 1e-9), shared / np.maximum(
        np.minimum(area, areas), 1e-9
    )


def suppress(windows: Candidates, *, least: float, most: int = _MOST_VEHICLES) -> tuple[Candidates, Floats]:
    """Keep the best window of each group, at the place for which the windows around it vote.

    Parameters
    ----------
    windows
        From the best one down.
    least
        Least value of a window that is kept; weaker ones vote only.

    Returns
    -------
    Candidates
        At most `most` of them; they still overlap as vehicles behind one another do.
    numpy.ndarray
        Support of each: the sum of what the windows that vote for it exceed -1.1 by.
    """
    left = np.flatnonzero(windows.scores >= least)
    boxes: list[Floats] = []
    kept: list[int] = []
    support: list[float] = []
    strengths = np.maximum(windows.scores - _VOTE_FROM, 0)
    weights = strengths**2
    # In columns, and with the areas known: this is done for every group of every frame.
    columns, areas = np.ascontiguousarray(windows.boxes.T), box_areas(windows.boxes)
    while len(left) and len(kept) < most:
        best = int(left[0])
        low = np.maximum(columns[:2], columns[:2, best, None])
        width, height = np.maximum(np.minimum(columns[2:], columns[2:, best, None]) - low, 0)
        shared = width * height
        iou = shared / np.maximum(areas + areas[best] - shared, 1e-9)
        voters = iou > _VOTE
        support.append(float(strengths @ voters))
        votes = weights * voters
        votes[best] = max(votes[best], 1e-9)
        boxes.append(votes @ windows.boxes / votes.sum())
        kept.append(best)
        left = left[iou[left] <= _VOTE]
        left = left[left != best]
    rows = np.array(kept, np.intp)
    groups = Candidates(np.array(boxes).reshape(-1, 4), windows.scores[rows], windows.templates[rows])
    return groups, np.array(support)


def resolve(boxes: Floats, scores: Floats) -> NDArray[np.intp]:
    """Rows of the boxes that stay when the weaker of two on one vehicle goes, from the best one down."""
    left = np.argsort(-scores, kind="stable")
    kept: list[int] = []
    while len(left):
        best, left = left[0], left[1:]
        kept.append(best)
        iou, cover = overlaps(boxes[best], boxes[left])
        left = left[(iou <= _IOU) & (cover <= _COVER)]
    return np.array(kept, np.intp)


def crop_features(image: NDArray[np.uint8], boxes: Floats) -> NDArray[np.float32]:
    """Features of boxes and what is around them, each warped to 12x12 cells of which the box fills 8x8.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8; beyond its border the outermost pixels go on.
    boxes
        ``(N, 4)``, with any part outside.

    Returns
    -------
    numpy.ndarray
        ``(N, 28 * 12 * 12 + 4)`` float32; the last four tell by how much of its sides a box lies outside.
    """
    features = np.empty((len(boxes), CROP_LENGTH), np.float32)
    height, width = image.shape[:2]
    for row, (x1, y1, x2, y2) in zip(features, boxes):
        row[:-4] = box_planes(image, (x1, y1, x2, y2), _INSIDE, (CROP, CROP), COARSE).ravel()
        outside = (-x1 / (x2 - x1), -y1 / (y2 - y1), (x2 - width) / (x2 - x1), (y2 - height) / (y2 - y1))
        row[-4:] = np.clip(outside, 0, 1)
    return features


def box_planes(
    image: NDArray[np.uint8],
    box: Sequence[float],
    inside: tuple[float, float],
    cells: tuple[int, int],
    cell: int,
) -> NDArray[np.float32]:
    """Compute the features of one box, warped to a grid of cells with what is around it.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8; beyond its border the outermost pixels go on.
    box
        ``(x1, y1, x2, y2)``.
    inside
        Columns and rows of cells that the box fills.
    cells
        Columns and rows of the grid, around the same centre.
    cell
        Side of a cell in pixels of the warped box.

    Returns
    -------
    numpy.ndarray
        ``(28, rows, columns)`` float32.
    """
    x1, y1, x2, y2 = box
    step_x, step_y = (x2 - x1) / inside[0], (y2 - y1) / inside[1]
    # One cell more on each side, so that the normalisation of the outermost one sees its neighbours.
    columns, rows = cells[0] + 2, cells[1] + 2
    left = x1 - (columns - inside[0]) / 2 * step_x
    top = y1 - (rows - inside[1]) / 2 * step_y
    patch = _warp(image, (left, top), (step_x / cell, step_y / cell), (columns * cell, rows * cell))
    return feature_planes(patch, cell)[:, 1:-1, 1:-1]


def _warp(
    image: NDArray[np.uint8], corner: tuple[float, float], scale: tuple[float, float], size: tuple[int, int]
) -> NDArray[np.uint8]:
    """Take ``size * scale`` pixels of an image from `corner` on as an image of `size`, without aliasing."""
    origin, real = np.array(corner), np.array(scale)
    if real.max() > 1.5:
        # Reduce the part first: the warp alone looks at four pixels only.
        low = np.clip(np.floor(origin), 0, None).astype(int)
        high = np.clip(np.ceil(origin + real * size), 0, image.shape[1::-1]).astype(int)
        if (high - low >= 2).all():
            part = image[low[1] : high[1], low[0] : high[0]]
            reduced = np.maximum(np.rint((high - low) / np.maximum(real, 1)), 1).astype(int)
            small = cv2.resize(part, (int(reduced[0]), int(reduced[1])), interpolation=cv2.INTER_AREA)
            image = np.asarray(small, np.uint8)
            factor = (high - low) / reduced
            origin, real = (origin - low) / factor, real / factor
    shift = origin + real / 2 - 0.5
    matrix = np.array([[real[0], 0, shift[0]], [0, real[1], shift[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.uint8)


@dataclass(frozen=True, eq=False)
class Refinement:
    """A linear correction of boxes from what they show.

    Attributes
    ----------
    weights
        ``(length, 4)`` float32: shifts of the four edges, in sides of the box, for each feature of
        `crop_features`.
    bias
        ``(4,)`` float32.
    looks
        How often a box is corrected; from the second time on only those that the last correction moved much.
        A box that is far too small or beside its vehicle shows too little of it at first.
    """

    weights: NDArray[np.float32]
    bias: NDArray[np.float32]
    looks: int = 1

    def __post_init__(self) -> None:
        check_integer(self.looks, "looks", low=1, high=10)
        weights = finite_array(self.weights, "refinement.weights", (CROP_LENGTH, 4))
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "bias", finite_array(self.bias, "refinement.bias", (4,)))

    @classmethod
    def none(cls) -> Refinement:
        """Correct nothing."""
        return cls(np.zeros((CROP_LENGTH, 4), np.float32), np.zeros(4, np.float32))

    def shifts(self, image: NDArray[np.uint8], boxes: Floats) -> Floats:
        """Shifts of the edges of each box, in sides of the box, ``(N, 4)``."""
        if not len(boxes):
            return np.empty((0, 4))
        shifts = crop_features(image, boxes) @ self.weights + self.bias
        return np.clip(shifts.astype(np.float64), -_MOST_SHIFT, _MOST_SHIFT)

    def apply(self, image: NDArray[np.uint8], windows: Candidates) -> tuple[Floats, Floats]:
        """Correct boxes, clip them to the image and drop the weaker of two on one vehicle."""
        boxes, values = windows.boxes.copy(), windows.scores
        moving = np.ones(len(boxes), np.bool_)
        for _ in range(self.looks):
            # No box turns inside out: of a side, at least two fifths are left.
            sides = np.tile(boxes[moving, 2:] - boxes[moving, :2], 2)
            shifts = self.shifts(image, boxes[moving])
            boxes[moving] += shifts * sides
            moving[moving] = np.abs(shifts).max(axis=1, initial=0) > _SETTLED
            inside = clip_boxes(boxes, image.shape)
            rows = resolve(inside, values)
            rows = rows[box_areas(inside[rows]) > 0]
            boxes, values, moving = boxes[rows], values[rows], moving[rows]
        return np.asarray(clip_boxes(boxes, image.shape), np.float64), values
