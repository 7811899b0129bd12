"""Operations on pixel arrays: seamless noise, tiling and compositing."""

from __future__ import annotations

import functools
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Rng = np.random.Generator
Color = tuple[float, float, float]
Dtype = TypeVar("Dtype", bound=np.generic)


def wrapped_noise(rng: Rng, shape: tuple[int, int], *, falloff: float, stretch: float = 1.0) -> Floats:
    """Return noise with zero mean and unit variance that repeats seamlessly along both axes.

    Its amplitude falls with frequency to the power `falloff` (0: white noise, 2: smooth clouds); a `stretch`
    above 1 elongates it along the rows.
    """
    spectrum = np.fft.rfft2(rng.standard_normal(shape, dtype=np.float32))
    field = np.fft.irfft2(spectrum * _amplitudes(shape, falloff, stretch), s=shape)
    return np.asarray(field / field.std(), np.float32)


@functools.cache
def _amplitudes(shape: tuple[int, int], falloff: float, stretch: float) -> Floats:
    """Amplitude of each frequency of `wrapped_noise`; cached because few shapes are in use."""
    fy = np.fft.fftfreq(shape[0])[:, None] * shape[0]
    fx = np.fft.rfftfreq(shape[1])[None, :] * shape[1] * stretch
    radius = np.hypot(fy, fx)
    radius[0, 0] = np.inf
    return np.asarray(radius**-falloff, np.float32)


def tile_to(tile: NDArray[Dtype], height: int, width: int) -> NDArray[Dtype]:
    """Repeat a seamless ``(h, w, ...)`` tile to `height` rows and `width` columns."""
    return tile.take(range(height), axis=0, mode="wrap").take(range(width), axis=1, mode="wrap")


def blend(target: Floats, color: NDArray[Any], alpha: NDArray[Any]) -> None:
    """Composite a color over `target` in place; `alpha` (0-1) is not yet multiplied into `color`."""
    target += alpha * (color - target)


def alpha_over(base: NDArray[Any], color: NDArray[Any], alpha: NDArray[Any]) -> Floats:
    """Composite a color that has been multiplied by `alpha` (0-1) over `base`."""
    return np.asarray(base * (1 - alpha) + color, np.float32)
