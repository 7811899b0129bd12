"""Train the rescorer, a second-stage RBF SVM, on the boxes that the templates propose."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.boxes import iou_matrix
from vehicle_detection.mixture import (
    CROP_CELLS,
    N_CHANNELS,
    MixtureSearch,
    Projection,
    Rescorer,
    mirror_channels,
    rescoring_features,
)
from vehicle_detection.mixture_training.negatives import is_negative
from vehicle_detection.mixture_training.positives import jitter_boxes
from vehicle_detection.mixture_training.sources import TrainingFrame
from vehicle_detection.params import MixtureParams, PyramidParams

Floats = NDArray[np.float64]
Crops = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Edge and color features of some crops, as `rescoring_features` returns them."""

# Numbers of principal components, and the standard deviation that the color components are scaled to.
_EDGE_COMPONENTS, _COLOR_COMPONENTS, _COLOR_STD = 200, 40, 0.5
# RBF kernel, for edge components with a standard deviation of 1, and inverse regularization strength.
_GAMMA, _C = 0.5, 3.0
# IoU from which on a proposed box is positive, and range of IoU in which a jittered box is negative.
_MIN_POSITIVE_IOU, _NEGATIVE_IOU = 0.55, (0.15, 0.45)
# Positive copies of a labelled box, the jitter of all but the first, and negatives beside each labelled box.
_COPIES, _JITTER_SCALE, _BESIDE = 3, 0.06, 2
_MIN_MARGIN = -1.1  # of the proposals to train on, lower than that of any box that is rescored


def train_rescorer(
    frames: Sequence[TrainingFrame],
    search: MixtureSearch,
    params: MixtureParams,
    rng: np.random.Generator,
    pool: ThreadPoolExecutor,
) -> Rescorer | None:
    """Train a rescorer on the boxes that a search proposes; None if one of the classes has no sample."""
    from sklearn.svm import SVC

    seeds = rng.integers(2**32, size=len(frames)).tolist()

    def crops(frame: TrainingFrame, seed: int) -> tuple[Crops, Crops]:
        positive, negative = _sample_boxes(frame, search, params, np.random.default_rng(seed))
        return rescoring_features(frame.image, positive), rescoring_features(frame.image, negative)

    positives, negatives = (_join(parts) for parts in zip(*pool.map(crops, frames, seeds)))
    if not (len(positives[0]) and len(negatives[0])):
        return None
    # Negatives are plentiful, so each is taken either as it is or mirrored; positives are taken both ways.
    positives = _join([positives, _mirror(positives)])
    flipped = rng.random((len(negatives[0]), 1)) < 0.5
    edges, colors = (np.where(flipped, *pair) for pair in zip(_mirror(negatives), negatives))
    negatives = edges, colors
    is_vehicle = np.repeat([True, False], [len(positives[0]), len(negatives[0])])
    edges, colors = _join([positives, negatives])
    seed = int(rng.integers(2**31))
    to_edges = _fit_projection(edges, _EDGE_COMPONENTS, 1.0, seed)
    to_colors = _fit_projection(colors, _COLOR_COMPONENTS, _COLOR_STD, seed)
    points = np.hstack([to_edges(edges), to_colors(colors)])
    svm = SVC(C=_C, gamma=_GAMMA, cache_size=2000).fit(points, is_vehicle)
    vectors, coefficients, bias = svm.support_vectors_, svm.dual_coef_[0], float(svm.intercept_[0])
    return Rescorer(to_edges, to_colors, vectors, coefficients, bias, _GAMMA, params.blend_weight)


def _sample_boxes(
    frame: TrainingFrame, search: MixtureSearch, params: MixtureParams, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Positive boxes (labels, shifted labels, proposals on them) and negatives (other proposals, parts)."""
    windows = search.score_windows(frame.image, PyramidParams())
    proposals = search.model.propose_boxes(frame.image, windows, min_margin=_MIN_MARGIN)[0]
    negatives = proposals[is_negative(proposals, frame)]
    positives = proposals[iou_matrix(proposals, frame.boxes).max(axis=1, initial=0) >= _MIN_POSITIVE_IOU]
    wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= params.min_width]
    copies = np.tile(wide, (_COPIES, 1))
    shifts = rng.uniform(-1, 1, copies.shape) * _JITTER_SCALE * np.tile(copies[:, 2:] - copies[:, :2], 2)
    shifts[: len(wide)] = 0
    beside = jitter_boxes(np.tile(wide, (3 * _BESIDE, 1)), rng)
    overlap = iou_matrix(beside, frame.boxes).max(axis=1, initial=0)
    beside = beside[(overlap > _NEGATIVE_IOU[0]) & (overlap < _NEGATIVE_IOU[1])][: _BESIDE * len(wide)]
    return np.concatenate([copies + shifts, positives]), np.concatenate([negatives, beside])


def _join(parts: Sequence[Crops]) -> Crops:
    edges, colors = zip(*parts)
    return np.concatenate(edges), np.concatenate(colors)


def _mirror(crops: Crops) -> Crops:
    """Features of the mirrored crops."""
    edges, colors = crops
    # All crops at once, one below the other.
    channels = edges.reshape(-1, N_CHANNELS, CROP_CELLS, CROP_CELLS).swapaxes(0, 1)
    mirrored = mirror_channels(channels.reshape(N_CHANNELS, -1, CROP_CELLS)).reshape(channels.shape)
    mirrored_colors = colors.reshape(-1, 3 * CROP_CELLS, CROP_CELLS)[:, :, ::-1]
    return mirrored.swapaxes(0, 1).reshape(edges.shape), mirrored_colors.reshape(colors.shape)


def _fit_projection(rows: NDArray[np.float32], count: int, std: float, seed: int) -> Projection:
    """Principal components, scaled so that the projected rows have a total standard deviation of `std`."""
    from sklearn.decomposition import PCA

    pca = PCA(min(count, *rows.shape), svd_solver="randomized", random_state=seed).fit(rows)
    scale = std / max(np.sqrt(pca.explained_variance_.sum()), 1e-9)
    return Projection(pca.mean_, pca.components_ * scale)
