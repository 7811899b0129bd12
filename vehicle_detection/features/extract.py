"""Feature vectors ``[spatial | histogram | HOG | coarse HOG]`` of 64x64 patches.

The course's functions are the readable reference: scikit-image's HOG, ``cv2.resize`` and
``numpy.histogram``. `extract_features` computes the same values with compiled kernels, in batches.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    check_bool,
    check_channel,
    check_choice,
    check_image,
    check_integer,
    check_patches,
    check_type,
    describe,
    progress_bar,
    resolve_jobs,
)
from vehicle_detection._kernels import bin_of_value, degree_bounds, orientation_cotangents, sqrt_gradients
from vehicle_detection._kernels import histogram as _histogram_kernels
from vehicle_detection._kernels import hog as _hog_kernels
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.images import read_image
from vehicle_detection.params import COLOR_SPACES, PATCH_SIZE, SPATIAL_ORDERS, FeatureParams


def convert_color(
    image: NDArray[np.uint8], color_space: str = "YCrCb", *, out: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Convert an RGB image to another color space, with OpenCV's 8-bit ranges.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    color_space
        ``"RGB"``, ``"HSV"`` (hue 0-179), ``"LUV"``, ``"HLS"``, ``"YUV"``, ``"YCrCb"`` or ``"LAB"``; the
        course's spelling ``"RGB2YCrCb"`` is also accepted.
    out
        Output array of the image's shape; None allocates one.

    Returns
    -------
    numpy.ndarray
        ``(H, W, 3)`` uint8; a copy, also for ``"RGB"``.

    Raises
    ------
    InvalidInputError
        If the image is not uint8 RGB or the color space is unknown.

    Examples
    --------
    >>> convert_color(np.full((1, 1, 3), 200, np.uint8), "YCrCb").tolist()
    [[[200, 128, 128]]]
    """
    check_image(image)
    space = str(color_space).removeprefix("RGB2")
    check_choice(space, "color_space", COLOR_SPACES)
    if out is not None:
        check_image(out, "out")
        if out.shape != image.shape:
            raise InvalidInputError(f"out must have the shape of image, {image.shape}; got {out.shape}")
    if space != "RGB":
        return np.asarray(cv2.cvtColor(image, getattr(cv2, f"COLOR_RGB2{space}"), dst=out), np.uint8)
    if out is None:
        return image.copy()
    out[:] = image
    return out


def hog_source(image: NDArray[np.uint8], params: FeatureParams) -> NDArray[np.uint8]:
    """Channels of an RGB image that HOG is computed on: ``(H, W, hog_channels)`` uint8."""
    if params.hog_channel == "GRAY":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)[..., None]
    return pick_hog_channels(convert_color(image, params.color_space), params)


def pick_hog_channels(converted: NDArray[np.uint8], params: FeatureParams) -> NDArray[np.uint8]:
    """Select the channels of HOG from an image that is already converted; not for ``"GRAY"``."""
    if params.hog_channel == "ALL":
        return converted
    return np.ascontiguousarray(converted[..., int(params.hog_channel), None])


def hog_blocks(
    img: NDArray[np.uint8],
    orient: int = 9,
    pix_per_cell: int = 8,
    cell_per_block: int = 2,
    *,
    transform_sqrt: bool = False,
) -> NDArray[np.float64]:
    """HOG of one channel: ``(block rows, block columns, cell rows, cell columns, orient)`` float64."""
    from skimage.feature import hog

    _check_hog(img, orient, pix_per_cell, cell_per_block)
    transform_sqrt = check_bool(transform_sqrt, "transform_sqrt")
    cell, block = (pix_per_cell, pix_per_cell), (cell_per_block, cell_per_block)
    blocks = hog(img, orient, cell, block, "L2-Hys", transform_sqrt=transform_sqrt, feature_vector=False)
    return np.asarray(blocks, np.float64)


def _check_hog(img: NDArray[np.uint8], orient: int, pix_per_cell: int, cell_per_block: int) -> None:
    check_channel(img)
    check_integer(orient, "orient", low=1)
    side = check_integer(pix_per_cell, "pix_per_cell", low=1)
    side *= check_integer(cell_per_block, "cell_per_block", low=1)
    height, width = img.shape
    if min(height, width) < side:
        raise InvalidInputError(
            f"img must have at least the size of a block ({side}x{side} pixels); got {width}x{height}"
        )


def get_hog_features(
    img: NDArray[np.uint8],
    orient: int = 9,
    pix_per_cell: int = 8,
    cell_per_block: int = 2,
    *,
    transform_sqrt: bool = False,
) -> NDArray[np.float64]:
    """Histogram of oriented gradients (HOG) of one channel, by scikit-image with L2-Hys normalization.

    Dalal and Triggs, "Histograms of oriented gradients for human detection" (CVPR 2005).

    Parameters
    ----------
    img
        ``(H, W)`` uint8, one channel.
    orient
        Number of orientations over 0-180 degrees.
    pix_per_cell, cell_per_block
        Side lengths of a cell in pixels and of a block in cells.
    transform_sqrt
        Use the square root of the pixel values.

    Returns
    -------
    numpy.ndarray
        1-D float64 in [0, 1], in the order block row, block column, cell row, cell column, orientation.

    Raises
    ------
    InvalidInputError
        If the image is not one uint8 channel, or is smaller than a block.

    Examples
    --------
    >>> get_hog_features(np.zeros((64, 64), np.uint8)).shape
    (1764,)
    """
    return hog_blocks(img, orient, pix_per_cell, cell_per_block, transform_sqrt=transform_sqrt).ravel()


def hog_image(
    img: NDArray[np.uint8], orient: int = 9, pix_per_cell: int = 8, *, transform_sqrt: bool = False
) -> NDArray[np.float64]:
    """Visualize the orientation histogram of each cell as a star of lines.

    Parameters
    ----------
    img, orient, pix_per_cell, transform_sqrt
        As in `get_hog_features`.

    Returns
    -------
    numpy.ndarray
        ``(H, W)`` float64, for ``plt.imshow``.

    Raises
    ------
    InvalidInputError
        If the image is not one uint8 channel, or is smaller than a cell.
    """
    from skimage.feature import hog

    _check_hog(img, orient, pix_per_cell, 1)
    transform_sqrt = check_bool(transform_sqrt, "transform_sqrt")
    cell = (pix_per_cell, pix_per_cell)
    _, picture = hog(img, orient, cell, (1, 1), transform_sqrt=transform_sqrt, visualize=True)
    return np.asarray(picture, np.float64)


def bin_spatial(
    img: NDArray[np.uint8],
    size: int | tuple[int, int] = (32, 32),
    *,
    order: Literal["channels", "interleaved"] = "channels",
) -> NDArray[np.uint8]:
    """Pixel values of a downscaled image.

    Parameters
    ----------
    img
        ``(H, W, 3)`` uint8 in any color space.
    size
        Width and height to scale to, or an integer for both.
    order
        ``"channels"``: one channel after the other; ``"interleaved"``: pixel by pixel.

    Returns
    -------
    numpy.ndarray
        ``(width * height * 3,)`` uint8.

    Raises
    ------
    InvalidInputError
        If an argument is malformed.

    Examples
    --------
    >>> bin_spatial(np.zeros((64, 64, 3), np.uint8), 16).shape
    (768,)
    """
    check_image(img, "img")
    pair = size if isinstance(size, tuple) else (size, size)
    if len(pair) != 2:
        raise InvalidInputError(f"size must be an integer or (width, height); got {describe(size)}")
    width, height = (check_integer(side, "size", low=1) for side in pair)
    check_choice(order, "order", SPATIAL_ORDERS)
    small = np.asarray(cv2.resize(img, (width, height)), np.uint8)
    return (small if order == "interleaved" else small.transpose(2, 0, 1)).ravel()


def color_hist(img: NDArray[np.uint8], nbins: int = 32) -> NDArray[np.int64]:
    """Concatenated histograms of the channels over 0-255.

    Parameters
    ----------
    img
        ``(H, W, 3)`` uint8 in any color space.
    nbins
        Number of bins of each channel.

    Returns
    -------
    numpy.ndarray
        ``(3 * nbins,)`` int64 counts.

    Raises
    ------
    InvalidInputError
        If the image is malformed, or `nbins` is not in 1-256.

    Examples
    --------
    >>> color_hist(np.zeros((2, 2, 3), np.uint8), 2).tolist()
    [4, 0, 4, 0, 4, 0]
    """
    check_image(img, "img")
    check_integer(nbins, "nbins", low=1, high=256)
    channels = [np.histogram(img[..., c], bins=nbins, range=(0, 256))[0] for c in range(3)]
    return np.concatenate(channels)


def single_img_features(image: NDArray[np.uint8], params: FeatureParams | None = None) -> NDArray[np.float64]:
    """Feature vector of one 64x64 patch, computed by the reference functions.

    Parameters
    ----------
    image
        ``(64, 64, 3)`` uint8 RGB.
    params
        Features to compute; the default is ``FeatureParams()``.

    Returns
    -------
    numpy.ndarray
        ``(params.length,)`` float64, ``[spatial | histogram | HOG | coarse HOG]``, each channel by channel.

    Raises
    ------
    InvalidInputError
        If the image is not uint8 RGB of 64x64 pixels.

    Examples
    --------
    >>> single_img_features(np.zeros((64, 64, 3), np.uint8), FeatureParams.preset("luv-2384")).shape
    (2384,)
    """
    params = _check_params(params)
    check_patches([image], PATCH_SIZE, "image")
    parts: list[NDArray[Any]] = []
    if params.spatial_feat:
        converted = convert_color(image, params.spatial_space)
        parts.append(bin_spatial(converted, params.spatial_size, order=params.spatial_order))
    if params.hist_feat:
        counts = color_hist(convert_color(image, params.hist_space), params.hist_bins)
        parts.append(np.sqrt(counts) if params.hist_sqrt else counts)
    if params.hog_feat:
        source = hog_source(image, params)
        orient, block, root = params.orient, params.cell_per_block, params.transform_sqrt
        parts += [
            get_hog_features(channel, orient, side, block, transform_sqrt=root)
            for side in (params.pix_per_cell, 2 * params.pix_per_cell)[: 1 + params.coarse_hog]
            for channel in np.moveaxis(source, -1, 0)
        ]
    return np.concatenate(parts).astype(np.float64)


def extract_features(
    source: Any,
    params: FeatureParams | None = None,
    *,
    n_jobs: int | None = None,
    progress: bool = False,
) -> NDArray[np.float32]:
    """Feature vectors of many patches, equal to those of `single_img_features`.

    Parameters
    ----------
    source
        ``(N, 64, 64, 3)`` uint8 RGB, a `PatchSet`, or a list of patches or a list or array of paths of image
        files.
    params
        Features to compute; the default is ``FeatureParams()``.
    n_jobs
        Number of threads, without effect on the result; None uses ``VEHICLE_DETECTION_JOBS`` or all cores.
    progress
        Show a progress bar on standard error.

    Returns
    -------
    numpy.ndarray
        ``(N, params.length)`` float32.

    Raises
    ------
    InvalidInputError
        If a patch is not uint8 RGB of 64x64 pixels, or a file is missing or unreadable.

    Examples
    --------
    >>> extract_features(np.zeros((5, 64, 64, 3), np.uint8)).shape
    (5, 6156)
    """
    params = _check_params(params)
    patches = read_patches(source, "source")
    features = np.empty((len(patches), params.length), np.float32)
    batches = [slice(start, start + 256) for start in range(0, len(patches), 256)]

    def run(batch: slice) -> int:
        _extract_batch(patches[batch], features[batch], params)
        return len(features[batch])

    with (
        progress_bar(progress, len(patches), unit="patch", desc="features") as bar,
        ThreadPoolExecutor(resolve_jobs(n_jobs)) as pool,
    ):
        for count in pool.map(run, batches):
            bar.update(count)
    return features


def _extract_batch(patches: NDArray[np.uint8], features: NDArray[np.float32], params: FeatureParams) -> None:
    """Fill the features of a batch of patches."""
    spatial, hist, hog = np.split(features, np.cumsum([params.spatial_length, params.hist_length]), axis=1)
    # Convert the colors of the whole batch as one tall image.
    tall = np.ascontiguousarray(patches).reshape(-1, PATCH_SIZE, 3)
    converted = {
        space: convert_color(tall, space).reshape(patches.shape) for space in params.used_color_spaces
    }
    if params.spatial_feat:
        size = (params.spatial_size,) * 2
        for row, patch in zip(spatial, converted[params.spatial_space]):
            params.spatial_planes(row)[:] = cv2.resize(patch, size).transpose(2, 0, 1)
    if params.hist_feat:
        bins = params.hist_bins
        _histogram_kernels.patch_histograms(converted[params.hist_space], bin_of_value(bins), bins, hist)
        if params.hist_sqrt:
            np.sqrt(hist, out=hist)
    if params.hog_feat:
        channels, sizes = (
            params.hog_channels,
            (params.pix_per_cell, params.cell_per_block, params.coarse_blocks),
        )
        gray = params.hog_channel == "GRAY"
        source = (
            hog_source(tall, params) if gray else pick_hog_channels(converted[params.color_space], params)
        )
        source = source.reshape(len(patches), PATCH_SIZE, PATCH_SIZE, channels)
        if params.transform_sqrt:
            bounds = degree_bounds(params.orient)
            _hog_kernels.patch_hog_from_angles(*sqrt_gradients(source), bounds, channels, *sizes, hog)
        else:
            flat = source.reshape(len(patches), PATCH_SIZE, PATCH_SIZE * channels)
            _hog_kernels.patch_hog(flat, channels, *sizes, orientation_cotangents(params.orient), hog)


def read_patches(source: Any, name: str) -> NDArray[np.uint8]:
    """Return patches as ``(N, 64, 64, 3)`` uint8; the files of a list of paths are read."""
    source = getattr(source, "patches", source)  # of a PatchSet
    if isinstance(source, (str, os.PathLike)) or not isinstance(source, Iterable):
        raise InvalidInputError(
            f"{name} must be patches or a list of paths, got {describe(source)}; "
            "read a folder or zip with vehicle_detection.load_patches"
        )
    if not isinstance(source, np.ndarray) or (source.ndim == 1 and source.dtype.kind in "UO"):
        source = [read_image(item) if isinstance(item, (str, os.PathLike)) else item for item in source]
    return check_patches(source, PATCH_SIZE, name)


def _check_params(params: FeatureParams | None) -> FeatureParams:
    if params is None:
        return FeatureParams()
    check_type(params, "params", FeatureParams, "pass FeatureParams(...) or FeatureParams.preset(...)")
    return params
