"""Variants of training images: mirrored, of another brightness, and as a worse camera takes them."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

# A degraded patch: times that it is smaller (logarithms), share of its color (logarithms), JPEG quality.
_SHRINK, _COLOUR, _QUALITY = (0.0, 1.6), (-1.5, 0.2), (20.0, 90.0)
# Another exposure: exponent of the values (its logarithm), and the share of their range that is left.
_EXPONENT, _RANGE = (-0.7, 0.7), (0.5, 1.0)


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


def blur_patches(images: NDArray[np.uint8], *, mirror: bool = True) -> NDArray[np.uint8]:
    """Make each patch as coarse as if it had been taken from further away, up to five times.

    Parameters
    ----------
    images
        ``(N, H, W, 3)`` uint8.
    mirror
        Mirror half of them left to right.

    Returns
    -------
    numpy.ndarray
        A new array of the same shape, uint8. A patch's own pixels decide how coarse it becomes.
    """
    blurred = np.empty_like(images)
    for image, out in zip(images, blurred):
        out[:] = _coarse(image, _generator(image, 1), mirror)
    return blurred


def degrade_patches(images: NDArray[np.uint8], *, mirror: bool = True) -> NDArray[np.uint8]:
    """Make each patch coarse, pale and compressed, as another camera may take it.

    Parameters
    ----------
    images
        ``(N, H, W, 3)`` uint8 RGB.
    mirror
        Mirror half of them left to right.

    Returns
    -------
    numpy.ndarray
        A new array of the same shape, uint8. A patch's own pixels decide on what becomes of it.
    """
    degraded = np.empty_like(images)
    for image, out in zip(images, degraded):
        rng = _generator(image, 2)
        coarse = _coarse(image, rng, mirror)
        color = float(np.exp(rng.uniform(*_COLOUR)))
        gray = cv2.cvtColor(cv2.cvtColor(coarse, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
        pale = cv2.addWeighted(coarse, color, gray, 1 - color, 0)
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(*_QUALITY))]
        _, coded = cv2.imencode(".jpg", cv2.cvtColor(pale, cv2.COLOR_RGB2BGR), quality)
        decoded = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
        out[:] = cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)
    return degraded


def relight(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Give an image another exposure and less contrast.

    A value `v` becomes ``255 * (r * (v / 255)**e + a)``: the exponent, the range that is left and where it
    lies are drawn once for the whole image.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8.
    rng
        Draws three numbers.

    Returns
    -------
    numpy.ndarray
        A new array of the same shape, uint8.
    """
    exponent, left = float(np.exp(rng.uniform(*_EXPONENT))), rng.uniform(*_RANGE)
    values = left * (np.arange(256) / 255) ** exponent + rng.uniform(0, 1 - left)
    return np.asarray(cv2.LUT(image, np.round(255 * values).astype(np.uint8)), np.uint8)


def _generator(image: NDArray[np.uint8], kind: int) -> np.random.Generator:
    return np.random.default_rng((kind, zlib.crc32(image.tobytes())))


def _coarse(image: NDArray[np.uint8], rng: np.random.Generator, mirror: bool) -> NDArray[np.uint8]:
    """Shrink and enlarge again."""
    factor, side = float(np.exp(rng.uniform(*_SHRINK))), rng.random()
    if mirror and side < 0.5:
        image = image[:, ::-1]
    height, width = image.shape[:2]
    small = max(round(width / factor), 1), max(round(height / factor), 1)
    shrunken = cv2.resize(np.ascontiguousarray(image), small, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(shrunken, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
