"""Feature vectors ``[spatial | histogram | HOG | coarse HOG]`` of 64x64 patches.

The course's functions are the readable reference: scikit-image's HOG, ``cv2.resize`` and
``numpy.histogram``. `extract_features` computes the same values with compiled kernels, in batches.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection import _kernels as kernels
from vehicle_detection._common import check, fields, invalid, progress_bar, resolve_jobs
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.images import read_image

PATCH_SIZE = 64
"""Side length in pixels of a training patch and of a resized window."""

COLOR_SPACES = ("RGB", "HSV", "LUV", "HLS", "YUV", "YCrCb", "LAB")
SPATIAL_ORDERS = ("channels", "interleaved")
HOG_CHANNELS: tuple[int | str, ...] = (0, 1, 2, "ALL", "GRAY")
_LUV = {"color_space": "LUV", "hist_bins": 16, "orient": 8, "hog_channel": 0, "transform_sqrt": True}
_LAB = {"color_space": "LAB", "spatial_size": 32}


def _check_spatial_size(size: Any, name: str) -> int:
    """Return an integer; a pair of equal numbers is accepted too."""
    if isinstance(size, (tuple, list)) and len(size) == 2 and size[0] == size[1]:
        size = size[0]
    return check.integer(size, name, low=1, high=PATCH_SIZE)


@dataclass(frozen=True, kw_only=True)
class FeatureParams(fields.Checked):
    """Features of a 64x64 patch: ``[spatial | histogram | HOG | coarse HOG]``, each channel by channel.

    Attributes
    ----------
    color_space, spatial_color_space, hist_color_space
        ``"RGB"``, ``"HSV"``, ``"LUV"``, ``"HLS"``, ``"YUV"``, ``"YCrCb"`` or ``"LAB"``; that of the spatial
        bins and of the histogram, None for `color_space`.
    spatial_feat, hist_feat, hog_feat
        Which of the three parts to compute.
    spatial_size
        Side length of the grid of spatial bins, which gives ``spatial_size**2 * 3`` values; also a pair.
    spatial_order
        ``"channels"``: the spatial bins of one channel after the other; ``"interleaved"``: pixel by pixel,
        as ``cv2.resize(image, size).ravel()`` orders them. With the other order than that of the training,
        a model's scores are wrong.
    hist_bins, hist_sqrt
        Number of bins of each channel's histogram over 0-255; take the square roots of the counts, so that a
        full bin dominates less.
    orient, pix_per_cell, cell_per_block
        Number of HOG orientations over 0-180 degrees; sides of a cell in pixels and of a block in cells.
    hog_channel
        Channel of HOG: 0, 1, 2, ``"ALL"``, or ``"GRAY"`` for the gray image in any `color_space`.
    transform_sqrt, coarse_hog
        Compute HOG on the square root of the pixel values; append the HOG of cells of twice the size.
    hist_gain, coarse_gain
        Factors of the scaled histogram and the scaled coarse HOG in training: a larger one weakens the
        regularization of these few features. They change the weights only, not the features.

    Examples
    --------
    >>> FeatureParams.preset("ycrcb-6156").length
    6156
    >>> FeatureParams(orient=12, hog_channel=0).hog_length
    2352
    """

    color_space: str = fields.choice("YCrCb", COLOR_SPACES)
    spatial_color_space: str | None = fields.choice(None, (None, *COLOR_SPACES))
    hist_color_space: str | None = fields.choice(None, (None, *COLOR_SPACES))
    spatial_feat: bool = fields.flag(True)
    hist_feat: bool = fields.flag(True)
    hog_feat: bool = fields.flag(True)
    spatial_size: int = fields.checked_field(16, _check_spatial_size)
    spatial_order: Literal["channels", "interleaved"] = fields.choice("channels", SPATIAL_ORDERS)
    hist_bins: int = fields.integer(32, low=1, high=256)
    orient: int = fields.integer(9, low=1, high=180)
    pix_per_cell: int = fields.integer(8, low=2, high=PATCH_SIZE)
    cell_per_block: int = fields.integer(2, low=1, high=PATCH_SIZE // 2)
    hog_channel: int | Literal["ALL", "GRAY"] = fields.choice("ALL", HOG_CHANNELS)
    transform_sqrt: bool = fields.flag(False)
    hist_sqrt: bool = fields.flag(False)
    coarse_hog: bool = fields.flag(False)
    hist_gain: float = fields.number(1.0, low=0.01, high=100)
    coarse_gain: float = fields.number(1.0, low=0.01, high=100)

    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "luv-2384": _LUV,
        "ycrcb-6156": {},
        "ycrcb-8460": {"spatial_size": 32},
        "lab-8460": _LAB,
        "lab-9432": {**_LAB, "hist_sqrt": True, "coarse_hog": True, "hist_gain": 4.0, "coarse_gain": 3.0},
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("hist_gain", "coarse_gain"):  # the same file for 1 and 1.0
            object.__setattr__(self, name, float(getattr(self, name)))
        if not (self.spatial_feat or self.hist_feat or self.hog_feat):
            raise InvalidInputError("spatial_feat, hist_feat and hog_feat are all False; set one to True")
        check.integer(self.cell_per_block, "cell_per_block", low=1, high=self.cells)
        if not isinstance(self.hog_channel, str):  # 1.0 and True are equal to 1
            object.__setattr__(self, "hog_channel", check.integer(self.hog_channel, "hog_channel", low=0))
        if self.coarse_hog and self.cells // 2 < self.cell_per_block:
            block = f"a block of {self.cell_per_block} cells of {2 * self.pix_per_cell} pixels"
            raise invalid("coarse_hog", f"be False, because {block} does not fit into a patch", True)

    @classmethod
    def preset(cls, name: str) -> FeatureParams:
        """Parameters by name, one of `PRESETS`; ``"lab-9432"`` are those of the shipped model "highway"."""
        check.choice(name, "preset", cls.PRESETS)
        return cls(**cls.PRESETS[name])

    def spatial_planes(self, values: NDArray[Any]) -> NDArray[Any]:
        """View spatial features ``(..., spatial_length)`` as ``(..., 3, spatial_size, spatial_size)``."""
        size = self.spatial_size
        if self.spatial_order == "interleaved":
            return np.moveaxis(values.reshape(*values.shape[:-1], size, size, 3), -1, -3)
        return values.reshape(*values.shape[:-1], 3, size, size)

    @property
    def spatial_space(self) -> str:
        """Color space of the spatial bins."""
        return self.spatial_color_space or self.color_space

    @property
    def hist_space(self) -> str:
        """Color space of the histogram."""
        return self.hist_color_space or self.color_space

    @property
    def used_color_spaces(self) -> set[str]:
        """Color spaces that an image is converted to, apart from the gray image of HOG."""
        parts = (
            (self.spatial_space, self.spatial_feat),
            (self.hist_space, self.hist_feat),
            (self.color_space, self.hog_feat and self.hog_channel != "GRAY"),
        )
        return {space for space, is_used in parts if is_used}

    @property
    def hog_channels(self) -> int:
        """Number of channels of HOG."""
        return 3 if self.hog_channel == "ALL" else 1

    @property
    def cells(self) -> int:
        """Number of HOG cells along a side of the patch."""
        return PATCH_SIZE // self.pix_per_cell

    @property
    def blocks(self) -> int:
        """Number of HOG block positions along a side of the patch."""
        return self.cells - self.cell_per_block + 1

    @property
    def coarse_blocks(self) -> int:
        """Number of block positions of the coarse HOG along a side of the patch; 0 without it."""
        return self.cells // 2 - self.cell_per_block + 1 if self.coarse_hog else 0

    @property
    def spatial_length(self) -> int:
        """Number of spatial features."""
        return self.spatial_size**2 * 3 if self.spatial_feat else 0

    @property
    def hist_length(self) -> int:
        """Number of histogram features."""
        return self.hist_bins * 3 if self.hist_feat else 0

    @property
    def hog_length(self) -> int:
        """Number of HOG features, including the coarse ones."""
        return self._block_values(self.blocks) + self.coarse_length

    @property
    def coarse_length(self) -> int:
        """Number of coarse HOG features, the last ones of the vector."""
        return self._block_values(self.coarse_blocks)

    def _block_values(self, blocks: int) -> int:
        return (blocks * self.cell_per_block) ** 2 * self.orient * self.hog_channels * self.hog_feat

    @property
    def length(self) -> int:
        """Length of the feature vector."""
        return self.spatial_length + self.hist_length + self.hog_length

    @property
    def gains(self) -> NDArray[np.float64]:
        """Factor of each scaled feature in training, ``(length,)`` float64."""
        gains = np.ones(self.length)
        gains[self.spatial_length :][: self.hist_length] = self.hist_gain
        gains[self.length - self.coarse_length :] = self.coarse_gain
        return gains


def convert_color(image: NDArray[np.uint8], color_space: str = "YCrCb") -> NDArray[np.uint8]:
    """Convert an RGB image to another color space, with OpenCV's 8-bit ranges.

    Returns ``(H, W, 3)`` uint8; a copy, also for ``"RGB"``.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    color_space
        ``"RGB"``, ``"HSV"`` (hue 0-179), ``"LUV"``, ``"HLS"``, ``"YUV"``, ``"YCrCb"`` or ``"LAB"``; the
        course's spelling ``"RGB2YCrCb"`` is also accepted.

    Examples
    --------
    >>> convert_color(np.full((1, 1, 3), 200, np.uint8), "YCrCb").tolist()
    [[[200, 128, 128]]]
    """
    check.image(image)
    space = str(color_space).removeprefix("RGB2")
    check.choice(space, "color_space", COLOR_SPACES)
    if space == "RGB":
        return image.copy()
    return np.asarray(cv2.cvtColor(image, getattr(cv2, f"COLOR_RGB2{space}")), np.uint8)


def hog_source(
    image: NDArray[np.uint8], params: FeatureParams, converted: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Channels of an RGB image that HOG is computed on: ``(H, W, hog_channels)`` uint8.

    `converted` is the image in `params.color_space`, if it is known already.
    """
    if params.hog_channel == "GRAY":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)[..., None]
    if converted is None:
        converted = convert_color(image, params.color_space)
    if params.hog_channel == "ALL":
        return converted
    return np.ascontiguousarray(converted[..., int(params.hog_channel), None])


def hog_blocks(
    img: NDArray[np.uint8], orient: int, pix_per_cell: int, cell_per_block: int, transform_sqrt: bool = False
) -> NDArray[np.float64]:
    """HOG of one channel by scikit-image with L2-Hys normalization.

    Returns ``(block rows, block columns, cell rows, cell columns, orient)`` float64. Dalal and Triggs,
    "Histograms of oriented gradients for human detection" (CVPR 2005).
    """
    from skimage.feature import hog

    cell, block = (pix_per_cell, pix_per_cell), (cell_per_block, cell_per_block)
    blocks = hog(img, orient, cell, block, "L2-Hys", transform_sqrt=transform_sqrt, feature_vector=False)
    return np.asarray(blocks, np.float64)


def single_img_features(image: NDArray[np.uint8], params: FeatureParams | None = None) -> NDArray[np.float64]:
    """Feature vector of one patch by scikit-image, OpenCV and NumPy: the reference of `extract_features`.

    Returns ``(params.length,)`` float64. HOG is that of Dalal and Triggs, "Histograms of oriented gradients
    for human detection" (CVPR 2005), with L2-Hys normalization. `vehicle_detection.course` has the functions
    of the single parts.

    Parameters
    ----------
    image, params
        ``(64, 64, 3)`` uint8 RGB; the default is ``FeatureParams()``.

    Examples
    --------
    >>> single_img_features(np.zeros((64, 64, 3), np.uint8), FeatureParams.preset("luv-2384")).shape
    (2384,)
    """
    params = _check_params(params)
    check.patches([image], PATCH_SIZE, "image")
    spatial, hist = (convert_color(image, space) for space in (params.spatial_space, params.hist_space))
    parts = color_parts(spatial, hist, params)
    if params.hog_feat:
        source = hog_source(image, params)
        orient, block, root = params.orient, params.cell_per_block, params.transform_sqrt
        parts += [
            hog_blocks(channel, orient, side, block, root).ravel()
            for side in (params.pix_per_cell, 2 * params.pix_per_cell)[: 1 + params.coarse_hog]
            for channel in np.moveaxis(source, -1, 0)
        ]
    return np.concatenate(parts).astype(np.float64)


def color_parts(
    spatial: NDArray[np.uint8], hist: NDArray[np.uint8], params: FeatureParams
) -> list[NDArray[Any]]:
    """Spatial bins and histogram of a patch in their color spaces, where they are used."""
    parts: list[NDArray[Any]] = []
    if params.spatial_feat:
        bins = cv2.resize(spatial, (params.spatial_size,) * 2)
        parts.append((bins if params.spatial_order == "interleaved" else bins.transpose(2, 0, 1)).ravel())
    if params.hist_feat:
        planes = np.moveaxis(hist, -1, 0)
        counts = np.concatenate([np.histogram(each, params.hist_bins, (0, 256))[0] for each in planes])
        parts.append(np.sqrt(counts) if params.hist_sqrt else counts)
    return parts


def extract_features(
    source: Any, params: FeatureParams | None = None, *, jobs: int | None = None, progress: bool = False
) -> NDArray[np.float32]:
    """Feature vectors of many patches, equal to those of `single_img_features`.

    Returns ``(N, params.length)`` float32.

    Parameters
    ----------
    source
        ``(N, 64, 64, 3)`` uint8 RGB, a `PatchSet`, or a list of patches or of paths of image files.
    params
        Features to compute; the default is ``FeatureParams()``.
    jobs, progress
        Number of threads, without effect on the result (None: ``VEHICLE_DETECTION_JOBS`` or all cores); show
        a progress bar on standard error.

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
        ThreadPoolExecutor(resolve_jobs(jobs)) as pool,
    ):
        for count in pool.map(run, batches):
            bar.update(count)
    return features


def _extract_batch(patches: NDArray[np.uint8], features: NDArray[np.float32], params: FeatureParams) -> None:
    """Fill the features of a batch of patches."""
    spatial, hist, hog = np.split(features, np.cumsum([params.spatial_length, params.hist_length]), axis=1)
    # Convert the colors of the whole batch as one tall image.
    tall = np.ascontiguousarray(patches).reshape(-1, PATCH_SIZE, 3)
    converted = {space: convert_color(tall, space) for space in params.used_color_spaces}
    if params.spatial_feat:
        size = (params.spatial_size,) * 2
        for row, patch in zip(spatial, converted[params.spatial_space].reshape(patches.shape)):
            params.spatial_planes(row)[:] = cv2.resize(patch, size).transpose(2, 0, 1)
    if params.hist_feat:
        hist[:] = kernels.count_bins(converted[params.hist_space], params.hist_bins, PATCH_SIZE)[..., 0]
        if params.hist_sqrt:
            np.sqrt(hist, out=hist)
    if params.hog_feat:
        source = hog_source(tall, params, converted.get(params.color_space))
        source = source.reshape(len(patches), PATCH_SIZE, PATCH_SIZE, -1)
        for start in range(0, len(patches), _PATCHES):
            rows = slice(start, start + _PATCHES)
            _fill_hog(source[rows], hog[rows], params)


# Patches whose HOG is computed together: as many as fit into the cache.
_PATCHES = 8


def _fill_hog(source: NDArray[np.uint8], hog: NDArray[np.float32], params: FeatureParams) -> None:
    """Fill the HOG of a few patches ``(N, 64, 64, channels)``, as the channels of one image."""
    image = source.transpose(1, 2, 0, 3).reshape(PATCH_SIZE, PATCH_SIZE, -1)
    cells = kernels.hog_cells(image, params.orient, params.pix_per_cell, params.transform_sqrt)
    parts = [kernels.hog_blocks(cells, params.cell_per_block)[..., : params.blocks, : params.blocks]]
    if params.coarse_blocks:
        coarse = kernels.hog_blocks(kernels.pool_cells(cells), params.cell_per_block, dilation=2)
        parts.append(coarse[..., ::2, ::2][..., : params.coarse_blocks, : params.coarse_blocks])
    start = 0
    for part in parts:
        # From (channel, cell row, cell column, orientation, block row, block column) to scikit-image's order.
        ordered = part.transpose(0, 4, 5, 1, 2, 3)
        shape, stop = (len(hog), -1, *ordered.shape[1:]), start + part.size // len(hog)
        hog[:, start:stop].reshape(shape)[:] = ordered.reshape(shape)
        start = stop


def read_patches(source: Any, name: str) -> NDArray[np.uint8]:
    """Return patches as ``(N, 64, 64, 3)`` uint8; the files of a list of paths are read."""
    source = getattr(source, "patches", source)  # of a PatchSet
    if isinstance(source, (str, os.PathLike)) or not isinstance(source, Iterable):
        remedy = "read a folder or zip with vehicle_detection.load_patches"
        raise invalid(name, "be patches or a list of paths", source, remedy)
    if not isinstance(source, np.ndarray) or (source.ndim == 1 and source.dtype.kind in "UO"):
        source = [read_image(item) if isinstance(item, (str, os.PathLike)) else item for item in source]
    return check.patches(source, PATCH_SIZE, name)


def _check_params(params: FeatureParams | None) -> FeatureParams:
    if params is None:
        return FeatureParams()
    check.instance(params, "params", FeatureParams, "pass FeatureParams(...) or FeatureParams.preset(...)")
    return params


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
    for row, column in np.ndindex(side, side):
        sums[row : row + down, column : column + across] += blocks[:, :, row, column]
    return sums
