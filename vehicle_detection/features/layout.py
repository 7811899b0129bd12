"""Layout of a feature vector: its parts, and the cells that HOG blocks share."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.params import FeatureParams


def part_slices(params: FeatureParams) -> dict[str, slice]:
    """Position of each part in the feature vector, if the vector has it."""
    lengths = {
        "spatial bins": params.spatial_length,
        "color histogram": params.hist_length,
        "HOG": params.hog_length - params.coarse_length,
        "coarse HOG": params.coarse_length,
    }
    stops = itertools.accumulate(lengths.values())
    return {name: slice(stop - lengths[name], stop) for name, stop in zip(lengths, stops) if lengths[name]}


def sum_blocks(blocks: NDArray[Any]) -> NDArray[np.float64]:
    """Sum each cell of ``(block rows, block columns, b, b, orient)`` over the blocks that contain it.

    Returns ``(rows, columns, orient)``; ``sum_blocks(np.ones_like(blocks))`` counts the blocks.
    """
    down, across, side, _, orient = blocks.shape
    sums = np.zeros((down + side - 1, across + side - 1, orient))
    for row in range(side):
        for column in range(side):
            sums[row : row + down, column : column + across] += blocks[:, :, row, column]
    return sums
