"""Train the second opinion on what the templates of a mixture found in labelled frames."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.boxes import iou_matrix
from vehicle_detection.mixture import (
    CROP_CELLS,
    N_CHANNELS,
    N_COLOR_FEATURES,
    N_EDGE_FEATURES,
    MixtureSearch,
    Projection,
    Rescorer,
    mirror_channels,
    rescoring_features,
)
from vehicle_detection.mixture_training.negatives import Frame, is_negative
from vehicle_detection.mixture_training.positives import jitter_boxes
from vehicle_detection.params import MixtureParams, PyramidParams

Floats = NDArray[np.float64]
Rows = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Edges and colors of some crops, as `rescoring_features` gives them."""

# Principal components that are kept of edges and colors, and the weight of the colors' spread.
_EDGE_AXES, _COLOUR_AXES, _COLOUR_WEIGHT = 200, 40, 0.5
# The kernel, where the spread of all edges is 1, and the inverse strength of the regularisation.
_GAMMA, _C = 0.5, 3.0
# IoU from which on a found box shows its vehicle; between which a moved one shows too little of it.
_RIGHT, _WRONG = 0.55, (0.15, 0.45)
# Copies of a labelled box, by how much of their sides all but the first are moved, and boxes beside it.
_COPIES, _SHAKE, _BESIDE = 3, 0.06, 2
# What the templates give the weakest boxes that are trained on: below what is ever verified.
_LEAST = -1.1


def train_rescorer(
    frames: Sequence[Frame],
    search: MixtureSearch,
    params: MixtureParams,
    rng: np.random.Generator,
    pool: ThreadPoolExecutor,
) -> Rescorer | None:
    """Train a second opinion on the boxes that a search finds.

    Parameters
    ----------
    frames
        Labelled frames.
    search
        Search with the templates and the correction of boxes.
    params
        Share of the opinion, and width of the narrowest vehicle.
    rng
        Draws the moved boxes, and the seed of the principal components.
    pool
        Threads.

    Returns
    -------
    Rescorer or None
        None where nothing false was found, nor anything right.

    Notes
    -----
    Vehicles are the labelled boxes, a little moved too, and what was found at them; the others are what was
    found where no vehicle is, and boxes that show a part of one only.
    """
    seeds = rng.integers(2**32, size=len(frames)).tolist()

    def views(frame: Frame, seed: int) -> tuple[Rows, Rows]:
        right, wrong = _boxes(frame, search, params, np.random.default_rng(seed))
        return rescoring_features(frame.image, right), rescoring_features(frame.image, wrong)

    found = list(pool.map(views, frames, seeds))
    vehicles, clutter = (_joined(rows) for rows in zip(*found))
    if not (len(vehicles[0]) and len(clutter[0])):
        return None
    # Of clutter there is enough: each piece is taken as it is or mirrored.
    shown = _joined([vehicles, _mirrored(vehicles)])
    align_mirrored = rng.random((len(clutter[0]), 1)) < 0.5
    back_edges, back_colors = _mirrored(clutter)
    empty = (
        np.where(align_mirrored, back_edges, clutter[0]),
        np.where(align_mirrored, back_colors, clutter[1]),
    )
    is_vehicle = np.repeat([True, False], [len(shown[0]), len(clutter[0])])
    edges, colors = _joined([shown, empty])
    seed = int(rng.integers(2**31))
    to_edges = _principal(edges, _EDGE_AXES, 1.0, seed)
    to_colors = _principal(colors, _COLOUR_AXES, _COLOUR_WEIGHT, seed)
    points = np.hstack([to_edges(edges), to_colors(colors)])
    return _fit(to_edges, to_colors, points, is_vehicle, params.rescorer)


def _boxes(
    frame: Frame, search: MixtureSearch, params: MixtureParams, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Boxes of a frame that show a vehicle, and boxes that do not."""
    windows = search.score_windows(frame.image, PyramidParams())
    found, _ = search.model.propose_boxes(frame.image, windows, min_margin=_LEAST)
    wrong = found[is_negative(found, frame)]
    right = found[iou_matrix(found, frame.boxes).max(axis=1, initial=0) >= _RIGHT]
    wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= params.min_width]
    copies = np.tile(wide, (_COPIES, 1))
    shifts = rng.uniform(-1, 1, copies.shape) * _SHAKE * np.tile(copies[:, 2:] - copies[:, :2], 2)
    shifts[: len(wide)] = 0
    beside = jitter_boxes(np.tile(wide, (3 * _BESIDE, 1)), rng)
    overlap = iou_matrix(beside, frame.boxes).max(axis=1, initial=0)
    beside = beside[(overlap > _WRONG[0]) & (overlap < _WRONG[1])][: _BESIDE * len(wide)]
    return np.concatenate([copies + shifts, right]), np.concatenate([wrong, beside])


def _joined(parts: Sequence[Rows]) -> Rows:
    edges = np.concatenate([np.empty((0, N_EDGE_FEATURES), np.float32), *(each for each, _ in parts)])
    colors = np.concatenate([np.empty((0, N_COLOR_FEATURES), np.float32), *(each for _, each in parts)])
    return edges, colors


def _mirrored(rows: Rows) -> Rows:
    """Rows of the mirrored crops."""
    edges, colors = rows
    count = len(edges)
    planes = edges.reshape(count, N_CHANNELS, CROP_CELLS, CROP_CELLS).transpose(1, 0, 2, 3)
    align_mirrored = mirror_channels(planes.reshape(N_CHANNELS, count * CROP_CELLS, CROP_CELLS))
    align_mirrored = (
        align_mirrored.reshape(N_CHANNELS, count, CROP_CELLS, CROP_CELLS)
        .transpose(1, 0, 2, 3)
        .reshape(count, N_EDGE_FEATURES)
    )
    return align_mirrored, colors.reshape(count, 3 * CROP_CELLS, CROP_CELLS)[:, :, ::-1].reshape(
        count, N_COLOR_FEATURES
    )


def _principal(rows: NDArray[np.float32], count: int, weight: float, seed: int) -> Projection:
    """Principal components, scaled so that what they give has a spread of `weight`."""
    from sklearn.decomposition import PCA

    fitted = PCA(min(count, *rows.shape), svd_solver="randomized", random_state=seed).fit(rows)
    scale = weight / max(np.sqrt(fitted.explained_variance_.sum()), 1e-9)
    return Projection(fitted.mean_, fitted.components_ * scale)


def _fit(
    edges: Projection,
    colors: Projection,
    points: NDArray[np.float32],
    is_vehicle: NDArray[np.bool_],
    blend_weight: float,
) -> Rescorer:
    """Train the kernel machine."""
    from sklearn.svm import SVC

    machine = SVC(C=_C, gamma=_GAMMA, cache_size=2000).fit(points, is_vehicle)
    bias = float(machine.intercept_[0])
    return Rescorer(
        edges, colors, machine.support_vectors_, machine.dual_coef_[0], bias, _GAMMA, blend_weight
    )
