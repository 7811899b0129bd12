"""Vehicles on patches without surroundings, such as the course's, as samples of the templates."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats
from vehicle_detection.mixture import N_EDGE_FEATURES, EdgePyramid, MixtureTemplate, edge_features
from vehicle_detection.mixture_training.positives import jitter_boxes, mirror_boxes, vehicle_features
from vehicle_detection.mixture_training.sources import TrainingFrame
from vehicle_detection.params import MixtureParams

Image = NDArray[np.uint8]
Rows = NDArray[np.float32]

_BOX_ON_PATCH = np.array([0.05, 0.14, 0.95, 0.89])  # typical box of a vehicle, as fractions of the sides
# Largest shift of an edge per step, as a fraction of the box's side, and ridge regularization.
_MAX_SHIFT, _ALPHA = 0.3, 30.0


@dataclass(frozen=True, eq=False)
class BoxRegressor:
    """A linear regression of the shifts of a box's edges from its `edge_features`."""

    weights: NDArray[np.float32]  # (length, 4)
    bias: NDArray[np.float32]  # (4,)

    @classmethod
    def none(cls) -> BoxRegressor:
        """Return a regressor that shifts nothing."""
        return cls(np.zeros((N_EDGE_FEATURES, 4), np.float32), np.zeros(4, np.float32))

    def shifts(self, pyramid: EdgePyramid, boxes: Floats) -> Floats:
        """Shifts of the edges of each box, ``(N, 4)``, as fractions of the box's sides."""
        shifts = edge_features(pyramid, boxes) @ self.weights + self.bias
        return np.clip(shifts.astype(np.float64), -_MAX_SHIFT, _MAX_SHIFT)


def fit_box_regressor(
    frames: Sequence[TrainingFrame],
    params: MixtureParams,
    rng: np.random.Generator,
    pool: ThreadPoolExecutor,
) -> BoxRegressor:
    """Fit the shifts from jittered boxes to labels by ridge regression."""
    from sklearn.linear_model import Ridge

    def samples(frame: TrainingFrame, seed: int) -> tuple[Rows, Floats]:
        """Features and shifts of some boxes of a frame and of its mirror image."""
        wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= params.min_width]
        if not len(wide):
            return np.empty((0, N_EDGE_FEATURES), np.float32), np.empty((0, 4))
        labels = np.tile(wide, (params.copies, 1))
        boxes = jitter_boxes(labels, np.random.default_rng(seed))
        shifts = (labels - boxes) / np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        mirrored = np.ascontiguousarray(frame.image[:, ::-1])
        mirrored_boxes = mirror_boxes(boxes, frame.image.shape[1])
        features = (
            edge_features(EdgePyramid(frame.image), boxes),
            edge_features(EdgePyramid(mirrored), mirrored_boxes),
        )
        return np.concatenate(features), np.concatenate([shifts, mirror_boxes(shifts, 0)])

    seeds = rng.integers(2**32, size=len(frames)).tolist()
    features, shifts = (np.concatenate(side) for side in zip(*pool.map(samples, frames, seeds)))
    if not len(features):
        return BoxRegressor.none()
    ridge = Ridge(alpha=_ALPHA).fit(features.astype(np.float64), np.clip(shifts, -0.5, 0.5))
    return BoxRegressor(ridge.coef_.T.astype(np.float32), ridge.intercept_.astype(np.float32))


def patch_features(
    patches: Sequence[Image],
    regressor: BoxRegressor,
    templates: Sequence[MixtureTemplate],
    known: Sequence[Rows],
    params: MixtureParams,
) -> list[Rows]:
    """Features of the vehicles on patches for templates of whole vehicles, as in `vehicle_features`.

    A patch does not show the surroundings of its vehicle, so cells outside it take the mean over the features
    of vehicles in frames, `known`. The regressor locates the vehicle on its patch.
    """
    means = [
        rows.mean(axis=0).reshape(template.weights.shape).transpose(2, 0, 1)
        for template, rows in zip(templates, known)
    ]
    samples = ((image, [locate_on_patch(image, regressor)]) for image in patches)
    return vehicle_features(samples, templates, params, means)


def locate_on_patch(image: Image, regressor: BoxRegressor) -> Floats:
    """Box of the vehicle on a patch: the typical box, corrected twice."""
    size = np.tile(image.shape[1::-1], 2)
    box, pyramid = _BOX_ON_PATCH * size, EdgePyramid(image)
    for _ in range(2):
        box = box + regressor.shifts(pyramid, box[None])[0] * np.tile(box[2:] - box[:2], 2)
    return np.asarray(np.clip(box, 0, size), np.float64)
