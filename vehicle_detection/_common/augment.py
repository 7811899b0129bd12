"""Augmentation of training images: mirroring, brightness, and the loss of quality of another camera."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

# Ranges of degraded patches: log of the downscaling factor, log of the saturation factor, JPEG quality.
_LOG_SHRINK, _LOG_SATURATION, _JPEG_QUALITY = (0.0, 1.6), (-1.5, 0.2), (20.0, 90.0)


def mirror_patches(images: NDArray[np.uint8], *, gamma: float = 0.0) -> NDArray[np.uint8]:
    """Mirror ``(N, H, W, 3)`` patches left to right and change their brightness, in a new array.

    A value `v` becomes ``255 * (v / 255)**e``, with ``log(e)`` uniform in ``[-gamma, gamma]``. The CRC-32 of
    a patch's pixels determines its `e`, which therefore does not depend on the other patches or their order.
    """
    mirrored = np.ascontiguousarray(images[:, :, ::-1])
    if gamma:
        values = np.arange(256) / 255
        for image in mirrored:
            uniform = zlib.crc32(image) / (2**32 - 1)
            exponent = np.exp(gamma * (2 * uniform - 1))
            image[:] = np.round(255 * values**exponent).astype(np.uint8)[image]
    return mirrored


def blur_patches(images: NDArray[np.uint8], *, mirror: bool = True) -> NDArray[np.uint8]:
    """Downscale ``(N, H, W, 3)`` patches by up to 5 and enlarge them again, in a new array.

    A patch's own pixels seed its random numbers. `mirror` flips half of the patches left to right.
    """
    blurred = np.empty_like(images)
    for image, out in zip(images, blurred):
        out[:] = _rescale(image, _seeded_generator(image, 1), mirror)
    return blurred


def degrade_patches(images: NDArray[np.uint8], *, mirror: bool = True) -> NDArray[np.uint8]:
    """Blur ``(N, H, W, 3)`` RGB patches, reduce their saturation and compress them as JPEG, in a new array.

    A patch's own pixels seed its random numbers. `mirror` flips half of the patches left to right.
    """
    degraded = np.empty_like(images)
    for image, out in zip(images, degraded):
        rng = _seeded_generator(image, 2)
        blurred = _rescale(image, rng, mirror)
        saturation = float(np.exp(rng.uniform(*_LOG_SATURATION)))
        gray = cv2.cvtColor(cv2.cvtColor(blurred, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
        pale = cv2.addWeighted(blurred, saturation, gray, 1 - saturation, 0)
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(*_JPEG_QUALITY))]
        _, encoded = cv2.imencode(".jpg", cv2.cvtColor(pale, cv2.COLOR_RGB2BGR), quality)
        decoded = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR), np.uint8)
        out[:] = cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)
    return degraded


def _seeded_generator(image: NDArray[np.uint8], kind: int) -> np.random.Generator:
    return np.random.default_rng((kind, zlib.crc32(image.tobytes())))


def _rescale(image: NDArray[np.uint8], rng: np.random.Generator, mirror: bool) -> NDArray[np.uint8]:
    """Downscale by a random factor and enlarge to the same size; mirror with probability 1/2 if asked to."""
    factor, uniform = float(np.exp(rng.uniform(*_LOG_SHRINK))), rng.random()
    if mirror and uniform < 0.5:
        image = image[:, ::-1]
    height, width = image.shape[:2]
    small = max(round(width / factor), 1), max(round(height / factor), 1)
    downscaled = cv2.resize(np.ascontiguousarray(image), small, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(downscaled, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
