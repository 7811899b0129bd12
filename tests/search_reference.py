"""The readable reference of the fast search: scikit-image's HOG of an image, a feature vector per window.

This is what `find_cars` computes for each resized band. `single_img_features` is the reference of one patch.
"""

from __future__ import annotations

import itertools
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection import FeatureParams, InvalidInputError, VehicleClassifier, convert_color
from vehicle_detection._common import check
from vehicle_detection.features import PATCH_SIZE, color_parts, hog_blocks, hog_source


def score_windows(
    image: NDArray[np.uint8], windows: ArrayLike, classifier: VehicleClassifier
) -> NDArray[np.float64]:
    """Scores of 64x64 windows on the grid of HOG cells, ``(N,)``, with one HOG of the whole image."""
    check.image(image)
    boxes, cell = check.boxes(windows, "windows").astype(np.int64), classifier.params.pix_per_cell
    if (boxes[:, 2:] - boxes[:, :2] != PATCH_SIZE).any() or (boxes[:, :2] % cell).any():
        raise InvalidInputError(
            f"windows must be {PATCH_SIZE}x{PATCH_SIZE} pixels, at multiples of {cell} pixels; resize the "
            "image so that the window is 64x64"
        )
    return classifier.decision_function(shared_features(image, boxes, classifier.params))


def shared_features(
    image: NDArray[np.uint8], boxes: NDArray[np.int64], params: FeatureParams
) -> NDArray[np.float64]:
    """Feature vectors of 64x64 windows on the grid of HOG cells."""
    cell, blocks = params.pix_per_cell, params.blocks
    spatial_image = convert_color(image, params.spatial_space)
    hist_image = convert_color(image, params.hist_space)
    hog: list[NDArray[Any]] = []
    coarse: list[NDArray[Any]] = []
    if params.hog_feat:
        source = hog_source(image, params)
        planes = [source[..., channel] for channel in range(params.hog_channels)]
        hog = [
            hog_blocks(plane, params.orient, cell, params.cell_per_block, params.transform_sqrt)
            for plane in planes
        ]
        coarse = [_coarse_blocks(plane, params) for plane in planes] if params.coarse_hog else []
    span = 2 * params.coarse_blocks
    features = np.empty((len(boxes), params.length))
    for row, (x1, y1, x2, y2) in enumerate(boxes):
        parts = color_parts(spatial_image[y1:y2, x1:x2], hist_image[y1:y2, x1:x2], params)
        top, left = y1 // cell, x1 // cell
        parts += [part[top : top + blocks, left : left + blocks].ravel() for part in hog]
        parts += [part[top : top + span : 2, left : left + span : 2].ravel() for part in coarse]
        features[row] = np.concatenate(parts)
    return features


def _coarse_blocks(channel: NDArray[np.uint8], params: FeatureParams) -> NDArray[np.float64]:
    """HOG of double-sized cells at every cell: ``[y, x]`` is the block that starts at cell ``[y, x]``.

    For odd cells the image is shifted by one cell. The new border is a reflection: the gradient between an
    image and its reflection is zero, as at the image's border.
    """
    cell, block, orient = params.pix_per_cell, params.cell_per_block, params.orient
    rows, columns = (side // cell for side in channel.shape)
    found = np.zeros((rows, columns, block, block, orient))
    for odd_y, odd_x in itertools.product((0, 1), repeat=2):
        shifted = cv2.copyMakeBorder(channel, odd_y * cell, 0, odd_x * cell, 0, cv2.BORDER_REFLECT_101)
        blocks = hog_blocks(np.asarray(shifted, np.uint8), orient, 2 * cell, block, params.transform_sqrt)
        blocks = blocks[odd_y:, odd_x:]
        found[odd_y::2, odd_x::2][: len(blocks), : blocks.shape[1]] = blocks
    return found
