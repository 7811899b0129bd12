"""Variants of training patches: mirrored, and of another brightness."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray


def mirror_patches(images: NDArray[np.uint8], *, gamma: float = 0.0) -> NDArray[np.uint8]:
    """Mirror each patch left to right and give it another brightness.

    A value `v` becomes ``255 * (v / 255)**e``, with ``log(e)`` spread evenly over ``[-gamma, gamma]``. A
    patch's own pixels, by their CRC-32, decide on its `e`: it is the same in any set and any order.

    Parameters
    ----------
    images
        ``(N, H, W, 3)`` uint8.
    gamma
        Largest logarithm of the exponent; 0 keeps the brightness.

    Returns
    -------
    numpy.ndarray
        A new array of the same shape, uint8.
    """
    mirrored = np.ascontiguousarray(images[:, :, ::-1])
    if gamma:
        values = np.arange(256) / 255
        for image in mirrored:
            share = zlib.crc32(image) / (2**32 - 1)
            exponent = np.exp(gamma * (2 * share - 1))
            image[:] = np.round(255 * values**exponent).astype(np.uint8)[image]
    return mirrored
