"""Features of one image: color conversion, HOG, spatial bins and color histograms; their defaults."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    check_array,
    check_choice,
    check_flags,
    check_integer,
    check_number,
    check_type,
    describe,
)
from vehicle_detection._kernels import degree_bounds, orientation_cotangents, sqrt_gradients
from vehicle_detection._kernels import features as kernels
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import COLOR_SPACES, SPATIAL_ORDERS

Image = NDArray[Any]
Size = int | Sequence[int]
SpatialOrder = Literal["interleaved", "channels"]

Formula = Literal["old", "new"]
FORMULAS = ("old", "new")
# OpenCV's names of the color spaces by their name in upper case.
_OPENCV_SPACES = {space.upper(): space for space in (*COLOR_SPACES, "BGR", "GRAY")}


@dataclasses.dataclass(frozen=True)
class _Defaults:
    transform_sqrt: bool = False
    formula: Formula = "old"


_defaults = _Defaults()


def set_lesson_defaults(*, transform_sqrt: bool | None = None, formula: Formula | None = None) -> None:
    """Set the defaults in which published versions of ``lesson_functions.py`` differ.

    They hold for all later calls in this process that do not pass the option. A `HeatmapDetector` keeps those
    of its construction. None leaves a default as it is.

    Parameters
    ----------
    transform_sqrt
        Default of all functions that compute HOG, initially False. True if your own file calls
        scikit-image's ``hog`` with ``transform_sqrt=True``, as most published ones do.
    formula
        Default of `slide_window`, initially ``"old"``. ``"new"`` if your own ``slide_window`` computes
        ``nx_buffer``. `find_cars` keeps its own default.

    Raises
    ------
    InvalidInputError
        If a value is invalid; no default changes then.

    Examples
    --------
    >>> import numpy as np
    >>> from vehicle_detection.course import slide_window
    >>> image = np.zeros((64, 128, 3), np.uint8)
    >>> set_lesson_defaults(formula="new")
    >>> len(slide_window(image, xy_overlap=(0.5, 0)))
    3
    >>> set_lesson_defaults(formula="old")
    """
    global _defaults
    given: dict[str, Any] = {}
    if transform_sqrt is not None:
        check_flags(transform_sqrt=transform_sqrt)
        given["transform_sqrt"] = bool(transform_sqrt)
    if formula is not None:
        check_choice(formula, "formula", FORMULAS)
        given["formula"] = formula
    _defaults = dataclasses.replace(_defaults, **given)


def or_default(value: Any, name: str) -> Any:
    """Return an option's value, or its default if it is None."""
    return getattr(_defaults, name) if value is None else value


def check_lesson_image(img: Any, name: str = "img", *, drop_alpha: bool = False) -> Image:
    """Return an ``(H, W, 3)`` image as uint8 or float32; `drop_alpha` accepts a fourth channel."""
    has_alpha = isinstance(img, np.ndarray) and img.ndim == 3 and img.shape[2] == 4
    if has_alpha and drop_alpha:
        img = np.ascontiguousarray(img[..., :3])
    elif has_alpha:
        raise InvalidInputError(
            f"{name} must be an (H, W, 3) RGB array, got {describe(img)}; drop the alpha channel with "
            f"{name}[..., :3]"
        )
    if not isinstance(img, np.ndarray) or img.ndim != 3 or img.shape[2] != 3 or not img.size:
        raise InvalidInputError(f"{name} must be an (H, W, 3) RGB array; got {describe(img)}")
    if img.dtype in (np.uint8, np.float32):
        return img
    if img.dtype.kind != "f":
        raise InvalidInputError(
            f"{name} must be uint8 or float, got {img.dtype}; convert it with {name}.astype(numpy.uint8)"
        )
    return img.astype(np.float32)


def check_size(size: Any, name: str) -> tuple[int, int]:
    """Return ``(width, height)`` of a pair or of one number."""
    pair = (size, size) if check_array(size, name).ndim == 0 else tuple(size)
    if len(pair) != 2:
        raise InvalidInputError(f"{name} must be (width, height); got {describe(size)}")
    return check_integer(pair[0], name, low=1), check_integer(pair[1], name, low=1)


def check_range(limits: Any, name: str) -> tuple[float, float] | None:
    """Return the range of a histogram; None stands for the range of the values."""
    if limits is None:
        return None
    if check_array(limits, name).shape != (2,):
        raise InvalidInputError(f"{name} must be (low, high) or None; got {describe(limits)}")
    low = check_number(limits[0], name)
    return low, check_number(limits[1], name, above=low)


def convert_color(img: Image, conv: str = "RGB2YCrCb") -> Image:
    """Convert the color space of an image, by the name of OpenCV's conversion.

    Returns a new image, uint8 or float32.

    Parameters
    ----------
    img
        ``(H, W, 3)`` uint8, or float as OpenCV defines it: 0-1, hue 0-360, LUV and LAB with negative values.
        A fourth channel is left out.
    conv
        ``"RGB2YCrCb"``, ``"BGR2YCrCb"``, ``"RGB2LUV"``, ``"RGB2HLS"``, ``"RGB2GRAY"``, ..., or an inverse
        such as ``"YCrCb2RGB"``, in upper or lower case; a color space alone, such as ``"LUV"``, means from
        RGB.

    Examples
    --------
    >>> convert_color(np.full((1, 1, 3), 200, np.uint8)).tolist()
    [[[200, 128, 128]]]
    """
    image = check_lesson_image(img, drop_alpha=True)
    names = str(conv).upper().rpartition("2")
    source, target = (_OPENCV_SPACES.get(name) for name in (names[0] or "RGB", names[2]))
    if source in (None, "GRAY") or target is None or {source, target}.isdisjoint({"RGB", "BGR"}):
        raise InvalidInputError(
            f"conv must be RGB2 or BGR2 and one of {', '.join(_OPENCV_SPACES.values())}, or an inverse such "
            f"as HSV2RGB; got {describe(conv)}"
        )
    if source == target:
        return image.copy()
    return np.asarray(cv2.cvtColor(image, getattr(cv2, f"COLOR_{source}2{target}")))


def get_hog_features(
    img: Any,
    orient: int,
    pix_per_cell: int,
    cell_per_block: int,
    vis: bool = False,
    feature_vec: bool = True,
    *,
    transform_sqrt: bool | None = None,
    visualise: bool = False,
    visualize: bool = False,
) -> Any:
    """HOG of one channel, with a picture of it if `vis` is set.

    Parameters
    ----------
    img
        ``(H, W)``, one channel, uint8 or float.
    orient
        Orientations over 0-180 degrees.
    pix_per_cell, cell_per_block
        Side of a cell in pixels and of a block in cells.
    vis, visualise, visualize
        Return a pair of the features and the picture.
    feature_vec
        Return the features as a vector; False gives the array of blocks.
    transform_sqrt
        Take the square root of the values first. The course has published both: a model trained one way does
        not work the other way. None is the default of `set_lesson_defaults`, initially False. Float channels
        must not be negative for True.

    Returns
    -------
    features : numpy.ndarray
        1-D, or ``(block rows, block columns, cell_per_block, cell_per_block, orient)``; float64, or float32
        for a float32 image. Blocks are normalized by L2-Hys, scikit-image's default since version 0.15.
    hog_image : numpy.ndarray
        ``(H, W)``, only with `vis`.

    Examples
    --------
    >>> channel = np.zeros((64, 64), np.uint8)
    >>> get_hog_features(channel, 9, 8, 2).shape
    (1764,)
    >>> features, hog_image = get_hog_features(channel, 9, 8, 2, vis=True, feature_vec=False)
    >>> features.shape, hog_image.shape
    ((7, 7, 2, 2, 9), (64, 64))
    """
    if not isinstance(img, np.ndarray) or img.ndim != 2 or img.dtype.kind not in "uif":
        raise InvalidInputError(
            f"img must be one (H, W) channel of numbers, got {describe(img)}; pick one with image[..., 0]"
        )
    check_flags(vis=vis, visualise=visualise, visualize=visualize, feature_vec=feature_vec)
    transform_sqrt = or_default(transform_sqrt, "transform_sqrt")
    check_flags(transform_sqrt=transform_sqrt)
    sizes = {"orient": orient, "pix_per_cell": pix_per_cell, "cell_per_block": cell_per_block}
    orient, pix_per_cell, cell_per_block = (check_integer(size, name, low=1) for name, size in sizes.items())
    channel = img if img.dtype in (np.uint8, np.float32) else img.astype(np.float64)
    blocks = hog_blocks(channel[..., None], orient, pix_per_cell, cell_per_block, bool(transform_sqrt))[0]
    blocks = np.ascontiguousarray(blocks, np.float32 if channel.dtype == np.float32 else np.float64)
    features = blocks.ravel() if feature_vec else blocks
    if not (vis or visualise or visualize):
        return features
    from skimage.feature import hog

    # The picture does not depend on the size of a block.
    cell = (pix_per_cell, pix_per_cell)
    _, picture = hog(channel, orient, cell, (1, 1), transform_sqrt=transform_sqrt, visualize=True)
    return features, picture


def bin_spatial(
    img: Any,
    size: Size | str = (32, 32),
    *last_size: Size,
    color_space: str = "RGB",
    order: SpatialOrder = "interleaved",
) -> NDArray[Any]:
    """Pixel values of a resized image as a vector.

    Returns ``(width * height * 3,)``, or ``(width * height,)`` of one channel, of the image's dtype.

    Parameters
    ----------
    img
        ``(H, W, 3)``, or one channel ``(H, W)``, uint8 or float. A fourth channel is left out.
    size
        ``(width, height)`` to resize to, or one number for both.
    last_size
        The size, if the color space comes first, as in an early quiz: ``bin_spatial(img, "HSV", (16, 16))``.
    color_space
        Color space to convert to first, from RGB.
    order
        ``"interleaved"``: pixel by pixel, ``cv2.resize(img, size).ravel()``, as in the lesson.
        ``"channels"``: one channel after the other, as in the HOG sub-sampling quiz and in the main API. A
        model trained on one order does not work on the other.

    Examples
    --------
    >>> image = np.full((64, 64, 3), (1, 2, 3), np.uint8)
    >>> bin_spatial(image, (2, 1)).tolist(), bin_spatial(image, (2, 1), order="channels").tolist()
    ([1, 2, 3, 1, 2, 3], [1, 1, 2, 2, 3, 3])
    """
    one_channel = isinstance(img, np.ndarray) and img.ndim == 2
    image = check_lesson_image(img[..., None].repeat(3, 2) if one_channel else img, drop_alpha=True)
    check_choice(order, "order", SPATIAL_ORDERS)
    check_type(color_space, "color_space", str, "pass a name such as 'YCrCb'")
    if isinstance(size, str) and len(last_size) <= 1:
        color_space, size = size, last_size[0] if last_size else (32, 32)
    elif last_size:
        raise InvalidInputError(f"bin_spatial takes an image and a size; got {len(last_size)} more")
    if one_channel:
        if color_space != "RGB":
            raise InvalidInputError(f"color_space must be RGB for one channel; got {describe(color_space)}")
        return np.asarray(cv2.resize(image[..., 0], check_size(size, "size"))).ravel()
    if color_space != "RGB":
        image = convert_color(image, color_space)
    small = np.asarray(cv2.resize(image, check_size(size, "size")))
    return small.ravel() if order == "interleaved" else small.transpose(2, 0, 1).ravel()


def color_hist(
    img: Image, nbins: int = 32, bins_range: tuple[float, float] | None = (0, 256)
) -> NDArray[np.int64]:
    """Histogram of each channel, one after the other.

    Returns ``(3 * nbins,)`` int64 counts.

    Parameters
    ----------
    img
        ``(H, W, 3)``, uint8 or float. A fourth channel is left out.
    nbins
        Bins of each channel.
    bins_range
        Values that the bins cover. With the default, all values of a 0-1 image fall into the first bin: pass
        ``(0, 1)``. None takes each channel's own minimum and maximum, as the HOG sub-sampling quiz does.

    Examples
    --------
    >>> color_hist(np.zeros((2, 2, 3), np.uint8), 4).tolist()
    [4, 0, 0, 0, 4, 0, 0, 0, 4, 0, 0, 0]
    """
    image = check_lesson_image(img, drop_alpha=True)
    check_integer(nbins, "nbins", low=1)
    limits = check_range(bins_range, "bins_range")
    if limits is None:
        return np.concatenate([np.histogram(image[..., channel], nbins)[0] for channel in range(3)])
    return count_bins(bin_indices(image, nbins, limits), nbins)


def hog_blocks(
    image: Image, orient: int, pix_per_cell: int, cell_per_block: int, transform_sqrt: bool = False
) -> NDArray[np.float32]:
    """HOG of each channel: ``(channels, rows, columns, block, block, orient)`` float32, a view."""
    maps = hog_maps(image, orient, pix_per_cell, cell_per_block, transform_sqrt)
    rows, columns = (count - cell_per_block + 1 for count in maps.shape[4:])
    return maps[..., :rows, :columns].transpose(0, 4, 5, 1, 2, 3)


def hog_maps(
    image: Image, orient: int, pix_per_cell: int, cell_per_block: int, transform_sqrt: bool = False
) -> NDArray[np.float32]:
    """HOG of each channel: ``(channels, block, block, orient, cell rows, cell columns)`` float32.

    The last ``cell_per_block - 1`` rows and columns hold no whole block.
    """
    cell, block = pix_per_cell, cell_per_block
    height, width, channels = image.shape
    side = cell * block
    if min(height, width) < side:
        raise InvalidInputError(
            f"img must be at least one block large ({side}x{side} pixels); got {width}x{height}"
        )
    cells = np.empty((channels, orient, height // cell, width // cell), np.float32)
    if transform_sqrt:
        gradients = sqrt_gradients(image) if image.dtype == np.uint8 else _sqrt_gradients(image)
        kernels.sum_orientations(*gradients, degree_bounds(orient), channels, cell, cells)
    else:
        flat = np.ascontiguousarray(image).reshape(height, -1)
        kernels.hog_cells(flat, channels, cell, orientation_cotangents(orient), cells)
    blocks = np.empty((channels, block, block, *cells.shape[1:]), np.float32)
    kernels.normalize_blocks(cells, block, 1, blocks)
    return blocks


def _sqrt_gradients(image: NDArray[Any]) -> tuple[NDArray[np.float64], ...]:
    """Gradients of the square root of a float image and their arctangents, like `sqrt_gradients`."""
    if image.min() < 0:
        raise InvalidInputError(
            "transform_sqrt must be False for negative values, which float LUV and LAB images have; "
            "convert a uint8 image, or switch it off"
        )
    image = np.sqrt(image)
    across, down = np.zeros_like(image), np.zeros_like(image)
    across[:, 1:-1] = image[:, 2:] - image[:, :-2]
    down[1:-1] = image[2:] - image[:-2]
    gx, gy = (part.reshape(len(image), -1).astype(np.float64) for part in (across, down))
    return gx, gy, np.arctan2(gy, gx)


def bin_indices(image: Image, bins: int, limits: tuple[float, float]) -> NDArray[np.intp]:
    """Histogram bin of each value, as `numpy.histogram` assigns it; `bins` for values out of range."""
    values = np.arange(256).reshape(1, -1, 1) if image.dtype == np.uint8 else image
    edges = np.histogram_bin_edges(values, bins, limits).astype(np.float64)
    indices = np.empty(values.shape, np.intp)
    kernels.find_bins(values, edges, indices)
    return indices.ravel()[image] if image.dtype == np.uint8 else indices


def count_bins(indices: NDArray[np.intp], bins: int) -> NDArray[np.int64]:
    """Histogram of each channel from `bin_indices`, one after the other."""
    separate = (indices + np.arange(3) * (bins + 1)).ravel()
    return np.bincount(separate, minlength=3 * (bins + 1)).reshape(3, -1)[:, :bins].ravel()
