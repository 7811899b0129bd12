"""HOG cells as little stars of edges."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

# Cells in a row from which the lines are thin.
_MANY = 24


def sum_blocks(blocks: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sum for each cell what the blocks that it belongs to hold of it.

    Parameters
    ----------
    blocks
        ``(block rows, block columns, b, b, orient)``, as `hog_blocks` gives it, or weights laid out alike.

    Returns
    -------
    sums, counts : numpy.ndarray
        ``(rows, columns, orient)`` and ``(rows, columns, 1)`` float64: the number of blocks of each cell.
    """
    down, across, side, _, orient = blocks.shape
    sums = np.zeros((down + side - 1, across + side - 1, orient))
    counts = np.zeros((*sums.shape[:2], 1))
    for row in range(side):
        for column in range(side):
            sums[row : row + down, column : column + across] += blocks[:, :, row, column]
            counts[row : row + down, column : column + across] += 1
    return sums, counts


def put_glyphs(
    ax: Axes, cells: NDArray[Any], *, size: float = 1.0, peak: float | None = None, cmap: str = "gray"
) -> LineCollection:
    """Draw a line for each cell and orientation, along the edge: the brighter, the more there is of it.

    Parameters
    ----------
    ax
        Where to draw; it becomes a square-celled picture with its origin at the top left.
    cells
        ``(rows, columns, orient)``; what is zero or less is not drawn.
    size
        Side of a cell in the coordinates of the axes.
    peak
        Value of the brightest line; None takes the greatest.
    cmap
        Colours from nothing to `peak`; its first one is the ground.
    """
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection

    rows, columns, orient = cells.shape
    angles = np.pi * (np.arange(orient) + 0.5) / orient
    row, column, bin_ = np.nonzero(cells > 0)
    values = cells[row, column, bin_]
    order = np.argsort(values, kind="stable")  # Strong ones lie on top.
    row, column, bin_, values = row[order], column[order], bin_[order], values[order]
    middle = np.stack([column + 0.5, row + 0.5], axis=1) * size
    # An edge runs across its gradient; skimage.feature.hog draws the same.
    along = np.stack([np.sin(angles), -np.cos(angles)], axis=1)[bin_] * (0.47 * size)
    top = float(values.max()) if peak is None and len(values) else peak or 1.0
    lines = LineCollection(
        list(np.stack([middle - along, middle + along], axis=1)),
        array=values,
        cmap=cmap,
        linewidths=1.1 if columns <= _MANY else 0.5,
    )
    lines.set_clim(0, top)
    ax.add_collection(lines, autolim=False)
    ax.set_facecolor(colormaps[cmap](0.0))
    ax.set_xlim(0, columns * size)
    ax.set_ylim(rows * size, 0)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    return lines
