"""What the kernels are given: bounds of bins and gradients, rounded as the references round them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def orientation_cotangents(orient: int) -> NDArray[np.float32]:
    """Cotangent of the lower bound of each orientation bin, infinite for the first."""
    angles = np.arange(orient) * (np.pi / orient)
    # Rounding makes the bound at 90 degrees exact, so that a vertical edge falls where it should.
    cosines, sines = np.cos(angles).round(15), np.sin(angles)
    cotangents = np.full(orient, np.inf)
    np.divide(cosines, sines, out=cotangents, where=sines > 0)
    return cotangents.astype(np.float32)


def degree_bounds(orient: int) -> NDArray[np.float64]:
    """Bounds of the orientation bins in degrees, ``(orient + 1,)``, as scikit-image rounds them."""
    return np.asarray((180.0 / orient) * np.arange(orient + 1), np.float64)


def bin_of_value(bins: int) -> NDArray[np.intp]:
    """Histogram bin of each value 0-255 when `bins` bins cover ``[0, 256)``; ``(256,)`` intp."""
    return np.arange(256, dtype=np.intp) * bins // 256


def sqrt_gradients(source: NDArray[np.uint8]) -> tuple[NDArray[np.float64], ...]:
    """Gradients of the square root of images, and their arctangent, as scikit-image computes them.

    Parameters
    ----------
    source
        ``(..., H, W, C)`` uint8.

    Returns
    -------
    tuple of numpy.ndarray
        ``gx``, ``gy`` and ``arctan2(gy, gx)``, each ``(..., H, W * C)`` float64.
    """
    root = np.sqrt(np.arange(256.0))[source]
    gx, gy = np.zeros_like(root), np.zeros_like(root)
    np.subtract(root[..., :, 2:, :], root[..., :, :-2, :], out=gx[..., :, 1:-1, :])
    np.subtract(root[..., 2:, :, :], root[..., :-2, :, :], out=gy[..., 1:-1, :, :])
    shape = (*root.shape[:-2], -1)
    return gx.reshape(shape), gy.reshape(shape), np.arctan2(gy, gx).reshape(shape)
