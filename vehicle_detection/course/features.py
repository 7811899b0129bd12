"""The features of the lesson, ``[spatial | histogram | HOG]``: functions, options and their defaults."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING, dataclass
from typing import Any, ClassVar, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection import _kernels as kernels
from vehicle_detection import features as library
from vehicle_detection._common import check, describe, fields, invalid, is_listing, warn
from vehicle_detection.course.versions import (
    CHANNEL_ORDERS,
    READERS,
    check_range,
    check_switch,
    lesson_function,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import COLOR_SPACES, PATCH_SIZE, SPATIAL_ORDERS, FeatureParams
from vehicle_detection.images import read_image
from vehicle_detection.svm import UNIT_CHANNELS

Image = NDArray[Any]
Images = list[Image] | NDArray[Any]
Size = int | Sequence[int]

# OpenCV's names of the color spaces by their name in upper case.
_OPENCV_SPACES = {space.upper(): space for space in (*COLOR_SPACES, "BGR", "GRAY")}
_CHUNK = 4096  # number of images that are read and processed at a time
# Values of the options of a group of features that is switched off.
UNUSED: dict[str, dict[str, Any]] = {
    "spatial_feat": {"spatial_size": (32, 32)},
    "hist_feat": {"hist_bins": 32, "hist_range": (0, 256)},
    "hog_feat": {"orient": 9, "pix_per_cell": 8, "cell_per_block": 2, "hog_channel": 0},
}
_checked: dict[str, FeatureOptions] = {}  # the options of earlier calls
_MAX_CHECKED = 64
# Range of the maximum of images with values 0-1; almost black ones may have either range.
_UNIT_MAXIMA = (0.1, 2.0)


def check_lesson_image(img: Any, name: str = "img", *, drop_alpha: bool = False) -> Image:
    """Return an ``(H, W, 3)`` image as uint8 or float32; `drop_alpha` accepts a fourth channel."""
    if isinstance(img, np.ndarray) and img.ndim == 3 and img.shape[2] == 4:
        if not drop_alpha:
            remedy = f"drop the alpha channel with {name}[..., :3]"
            raise invalid(name, "be an (H, W, 3) RGB array", img, remedy)
        img = np.ascontiguousarray(img[..., :3])
    if not isinstance(img, np.ndarray) or img.ndim != 3 or img.shape[2] != 3 or not img.size:
        raise InvalidInputError(f"{name} must be an (H, W, 3) RGB array; got {describe(img)}")
    if img.dtype in (np.uint8, np.float32):
        return img
    if img.dtype.kind != "f":
        raise invalid(name, "be uint8 or float", img, f"convert it with {name}.astype(numpy.uint8)")
    return img.astype(np.float32)


def check_size(size: Any, name: str) -> tuple[int, int]:
    """Return ``(width, height)`` of a pair or of one number."""
    pair = (size, size) if check.array(size, name).ndim == 0 else tuple(size)
    if len(pair) != 2:
        raise InvalidInputError(f"{name} must be (width, height); got {describe(size)}")
    return check.integer(pair[0], name, low=1), check.integer(pair[1], name, low=1)


@lesson_function()
def convert_color(img: Image, conv: str = "RGB2YCrCb", *, color_space: str | None = None) -> Image:
    """Convert the color space by the name of OpenCV's conversion: a new image, uint8 or float32.

    Parameters
    ----------
    img
        ``(H, W, 3)`` uint8, or float as OpenCV defines it: 0-1, hue 0-360, LUV and LAB with negative values.
        A fourth channel is left out.
    conv
        ``"RGB2YCrCb"``, ``"BGR2LUV"``, ``"RGB2GRAY"``, ..., or an inverse such as ``"YCrCb2RGB"``, in upper
        or lower case; a color space alone, such as ``"LUV"``, means from RGB.
    color_space
        Another name of `conv`, for such a color space.

    Examples
    --------
    >>> convert_color(np.full((1, 1, 3), 200, np.uint8)).tolist()
    [[[200, 128, 128]]]
    """
    image = check_lesson_image(img, drop_alpha=True)
    conv = conv if color_space is None else color_space
    names = str(conv).upper().rpartition("2")
    source, target = (_OPENCV_SPACES.get(name) for name in (names[0] or "RGB", names[2]))
    if source in (None, "GRAY") or target is None or {source, target}.isdisjoint({"RGB", "BGR"}):
        spaces = ", ".join(_OPENCV_SPACES.values())
        must = f"be RGB2 or BGR2 and one of {spaces}, or an inverse such as HSV2RGB"
        raise invalid("conv or color_space", must, conv)
    if source == target:
        return image.copy()
    return np.asarray(cv2.cvtColor(image, getattr(cv2, f"COLOR_{source}2{target}")))


@lesson_function()
def get_hog_features(
    img: Any,
    orient: int = 9,
    pix_per_cell: int = 8,
    cell_per_block: int = 2,
    vis: bool = False,
    feature_vec: bool = True,
    *,
    transform_sqrt: bool = False,
    visualise: bool = False,
    visualize: bool = False,
) -> Any:
    """HOG of one channel, with a picture of it if `vis` is set.

    Returns 1-D, or ``(block rows, block columns, cell_per_block, cell_per_block, orient)``; float64, or
    float32 for a float32 image. With `vis`, a pair of this and a picture ``(H, W)``. Blocks are normalized by
    L2-Hys, scikit-image's default since version 0.15.

    Parameters
    ----------
    img
        ``(H, W)``, one channel, uint8 or float.
    orient, pix_per_cell, cell_per_block
        Orientations over 0-180 degrees; sides of a cell in pixels and of a block in cells.
    vis, visualise, visualize
        Return a pair of the features and the picture.
    feature_vec
        Return the features as a vector; False gives the array of blocks.
    transform_sqrt
        Take the square root of the values first, which must not be negative. The course has published both:
        a model trained one way does not work the other way.

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
        raise invalid("img", "be one (H, W) channel of numbers", img, "pick one with image[..., 0]")
    check.flags(vis=vis, visualise=visualise, visualize=visualize, feature_vec=feature_vec)
    transform_sqrt = check_switch(transform_sqrt, "transform_sqrt")
    sizes = {"orient": orient, "pix_per_cell": pix_per_cell, "cell_per_block": cell_per_block}
    orient, pix_per_cell, cell_per_block = (check.integer(size, name, low=1) for name, size in sizes.items())
    channel = img if img.dtype in (np.uint8, np.float32) else img.astype(np.float64)
    blocks = hog_blocks(channel[..., None], orient, pix_per_cell, cell_per_block, transform_sqrt)[0]
    blocks = np.ascontiguousarray(blocks, np.float32 if channel.dtype == np.float32 else np.float64)
    features = blocks.ravel() if feature_vec else blocks
    if not (vis or visualise or visualize):
        return features
    from skimage.feature import hog

    # The picture does not depend on the size of a block.
    cell = (pix_per_cell, pix_per_cell)
    _, picture = hog(channel, orient, cell, (1, 1), transform_sqrt=transform_sqrt, visualize=True)
    return features, picture


@lesson_function(order="spatial_order")
def bin_spatial(
    img: Any,
    size: Size | str = (32, 32),
    *last_size: Size,
    color_space: str = "RGB",
    order: str = "interleaved",
) -> NDArray[Any]:
    """Pixel values of a resized image, ``(width * height * channels,)`` of its dtype.

    Parameters
    ----------
    img
        ``(H, W, 3)``, or one channel ``(H, W)``, uint8 or float. A fourth channel is left out.
    size, last_size
        ``(width, height)`` to resize to, or one number for both. It may follow the color space, as in an
        early quiz: ``bin_spatial(img, "HSV", (16, 16))``.
    color_space
        Color space to convert to first, from RGB.
    order
        ``"interleaved"``: pixel by pixel, as in the lesson. ``"channels"``: one channel after the other, as
        in the HOG sub-sampling quiz and the main API. A model trained on one order needs this order.

    Examples
    --------
    >>> image = np.full((64, 64, 3), (1, 2, 3), np.uint8)
    >>> bin_spatial(image, (2, 1)).tolist(), bin_spatial(image, (2, 1), order="channels").tolist()
    ([1, 2, 3, 1, 2, 3], [1, 1, 2, 2, 3, 3])
    """
    one_channel = isinstance(img, np.ndarray) and img.ndim == 2
    image = check_lesson_image(img[..., None].repeat(3, 2) if one_channel else img, drop_alpha=True)
    check.choice(order, "order", SPATIAL_ORDERS)
    check.instance(color_space, "color_space", str, "pass a name such as 'YCrCb'")
    if isinstance(size, str) and len(last_size) <= 1:
        color_space, size = size, last_size[0] if last_size else (32, 32)
    elif last_size:
        raise InvalidInputError(f"bin_spatial takes an image and a size; got {len(last_size)} more")
    if one_channel and color_space != "RGB":
        raise InvalidInputError(f"color_space must be RGB for one channel; got {describe(color_space)}")
    if color_space != "RGB":
        image = convert_color(image, color_space)
    small = np.asarray(cv2.resize(image[..., 0] if one_channel else image, check_size(size, "size")))
    return (small if one_channel or order == "interleaved" else small.transpose(2, 0, 1)).ravel()


@lesson_function(bins_range="hist_range")
def color_hist(
    img: Image, nbins: int = 32, bins_range: tuple[float, float] | None = (0, 256)
) -> NDArray[np.int64]:
    """Histogram of each channel, one after the other: ``(3 * nbins,)`` int64 counts.

    Parameters
    ----------
    img, nbins
        ``(H, W, 3)``, uint8 or float, of which a fourth channel is left out; bins of each channel.
    bins_range
        Values that the bins cover. With the default, all values of a 0-1 image fall into the first bin: pass
        ``(0, 1)``. None takes each channel's own minimum and maximum, as the HOG sub-sampling quiz does.

    Examples
    --------
    >>> color_hist(np.zeros((2, 2, 3), np.uint8), 4).tolist()
    [4, 0, 0, 0, 4, 0, 0, 0, 4, 0, 0, 0]
    """
    image = check_lesson_image(img, drop_alpha=True)
    check.integer(nbins, "nbins", low=1)
    limits = check_range(bins_range, "bins_range")
    warn_of_first_bin(image, limits)
    return _histogram(image, nbins, limits)


def _histogram(image: Image, bins: int, limits: tuple[float, float] | None) -> NDArray[np.int64]:
    """Histogram of each channel, one after the other; None is the range of the channel's values."""
    if limits is None:
        try:
            return np.concatenate([np.histogram(image[..., channel], bins)[0] for channel in range(3)])
        except ValueError:
            if image.dtype != np.float32:
                raise
            # The colors of a gray image may differ by roundings only, too little for edges in float32.
            return _histogram(image.astype(np.float64), bins, None)
    separate = (bin_indices(image, bins, limits) + np.arange(3) * (bins + 1)).ravel()
    return np.bincount(separate, minlength=3 * (bins + 1)).reshape(3, -1)[:, :bins].ravel()


def is_unit(image: Image) -> bool:
    """Whether an image has values 0-1."""
    low, high = _UNIT_MAXIMA
    return image.dtype != np.uint8 and low < image.max() <= high


def warn_of_first_bin(image: Image, limits: tuple[float, float] | None, color_space: str = "RGB") -> None:
    """Warn if all values of a 0-1 image fall into the first bin of a histogram."""
    if limits is not None and limits[1] > 100 and color_space in UNIT_CHANNELS and is_unit(image):
        low, high = limits
        warn(
            f"the image has values 0-1, which are all in the first bin of a histogram of {low:g}-{high:g}: "
            "its colors are lost. Pass hist_range=(0, 1) or None, or compute all features from 0-255: "
            'set_lesson_defaults(imread="cv2", divide_by=1)'
        )


def hog_blocks(
    image: Image, orient: int, pix_per_cell: int, cell_per_block: int, transform_sqrt: bool = False
) -> NDArray[np.float32]:
    """HOG of each channel: ``(channels, rows, columns, block, block, orient)`` float32, a view."""
    cell, block = pix_per_cell, cell_per_block
    height, width, _ = image.shape
    side = cell * block
    if min(height, width) < side:
        raise invalid("img", f"be at least one block large ({side}x{side} pixels)", image)
    blocks = kernels.hog_blocks(kernels.hog_cells(image, orient, cell, transform_sqrt), block)
    rows, columns = height // cell - block + 1, width // cell - block + 1
    return blocks[..., :rows, :columns].transpose(0, 4, 5, 1, 2, 3)


def bin_indices(image: Image, bins: int, limits: tuple[float, float]) -> NDArray[np.intp]:
    """Histogram bin of each value, as `numpy.histogram` assigns it; `bins` for values out of range."""
    values = np.arange(256).reshape(1, -1, 1) if image.dtype == np.uint8 else image
    edges = np.histogram_bin_edges(values, bins, limits).astype(np.float64)
    indices = np.empty(values.shape, np.intp)
    kernels.find_bins(values, edges, indices)
    return indices.ravel()[image] if image.dtype == np.uint8 else indices


@lesson_function()
def single_img_features(
    img: Image,
    color_space: str = "RGB",
    spatial_size: Size = (32, 32),
    hist_bins: int = 32,
    orient: int = 9,
    pix_per_cell: int = 8,
    cell_per_block: int = 2,
    hog_channel: int | str = 0,
    spatial_feat: bool = True,
    hist_feat: bool = True,
    hog_feat: bool = True,
    vis: bool = False,
    *,
    hist_range: tuple[float, float] | None = (0, 256),
    transform_sqrt: bool = False,
    spatial_order: str = "interleaved",
) -> Any:
    """Feature vector of one image; the options are those of `extract_features`.

    Returns 1-D float64, ``[spatial | histogram | HOG]``; with `vis`, a pair of it and a picture of the HOG of
    a single `hog_channel`, ``(H, W)`` float64.

    Examples
    --------
    >>> single_img_features(np.zeros((64, 64, 3), np.uint8), "YCrCb", hog_channel="ALL").shape
    (8460,)
    """
    options, image = FeatureOptions.of(locals()), check_lesson_image(img, drop_alpha=True)
    check.flags(vis=vis)
    features = options.compute([image])[0].astype(np.float64)
    if not vis:
        return features
    if not options.hog_feat:
        raise InvalidInputError("vis needs hog_feat=True, got False; omit vis")
    if options.hog_channel == "ALL":
        raise InvalidInputError("vis needs the HOG of one channel, got 'ALL'; pass hog_channel=0, 1 or 2")
    channel = convert_color(image, options.color_space)[..., int(options.hog_channel)]
    sizes = options.orient, options.pix_per_cell, options.cell_per_block
    _, picture = get_hog_features(channel, *sizes, vis=True, transform_sqrt=options.transform_sqrt)
    return features, picture


@lesson_function()
def extract_features(
    imgs: Iterable[str | os.PathLike[str] | Image],
    color_space: str = "RGB",
    spatial_size: Size = (32, 32),
    hist_bins: int = 32,
    orient: int = 9,
    pix_per_cell: int = 8,
    cell_per_block: int = 2,
    hog_channel: int | str = 0,
    spatial_feat: bool = True,
    hist_feat: bool = True,
    hog_feat: bool = True,
    *,
    hist_range: tuple[float, float] | None = (0, 256),
    transform_sqrt: bool = False,
    spatial_order: str = "interleaved",
    imread: Literal["mpimg", "cv2"] | Callable[[str], Image] = "mpimg",
    channel_order: Literal["RGB", "BGR"] = "RGB",
) -> list[NDArray[Any]]:
    """Feature vectors of a list of images.

    Returns a 1-D vector for each image, ``[spatial | histogram | HOG]``: float32 for 64x64 uint8 images,
    which the library's kernels compute, float64 for others.

    Parameters
    ----------
    imgs
        File names, or images ``(H, W, 3)`` RGB. A fourth channel, transparency, is dropped.
    color_space
        ``"RGB"``, ``"HSV"``, ``"LUV"``, ``"HLS"``, ``"YUV"``, ``"YCrCb"`` or ``"LAB"``. The keyword of two
        earlier quizzes, ``cspace=``, is accepted too: with HOG options only, it selects HOG alone, and with
        color options only, spatial bins and histograms alone, as in those quizzes.
    spatial_size, hist_bins, hist_range, spatial_order
        See `bin_spatial` and `color_hist`.
    orient, pix_per_cell, cell_per_block, transform_sqrt
        See `get_hog_features`.
    hog_channel, spatial_feat, hist_feat, hog_feat
        0, 1, 2 or ``"ALL"``, and switches for the three parts.
    imread, channel_order
        ``"mpimg"`` reads a PNG as float 0-1 and other files as uint8, ``"cv2"`` all as uint8, which is
        faster: search uint8 images then, and pass ``divide_by=1`` to `find_cars`. Or a function of a file
        name. ``"BGR"`` has blue first, as ``cv2.imread`` without a conversion.

    Examples
    --------
    >>> images = [np.zeros((64, 64, 3), np.uint8)] * 2
    >>> [len(vector) for vector in extract_features(images, cspace="HLS", orient=9)]
    [1764, 1764]
    """
    options, read = FeatureOptions.of(locals()), _reader(imread, channel_order)
    if not is_listing(imgs):
        raise InvalidInputError(f"imgs must be a list of file names or images; got {describe(imgs)}")
    if isinstance(imgs, np.ndarray) and imgs.ndim in (2, 3) and imgs.dtype.kind in "uif":
        raise invalid("imgs", "be a list of images", imgs, "pass [image], or use single_img_features")
    if isinstance(imgs, np.ndarray) and are_uint8_patches(imgs):
        return options.compute(imgs)
    items: list[Any] = list(imgs)
    vectors: list[NDArray[Any]] = []
    for start in range(0, len(items), _CHUNK):
        images = []
        for index, item in enumerate(items[start : start + _CHUNK], start):
            image = read(os.fspath(item)) if isinstance(item, (str, os.PathLike)) else item
            images.append(check_lesson_image(image, f"imgs[{index}]", drop_alpha=True))
        if len({image.dtype == np.uint8 for image in images}) > 1:
            warn(
                "imgs have values 0-1 and 0-255, which do not mix: PNG files are read as 0-1, others not; "
                'imread="cv2" reads all as 0-255'
            )
        vectors += options.compute(images)
    return vectors


extract_features_all = extract_features


def _reader(imread: str | Callable[[str], Image], channel_order: str) -> Callable[[str], Image]:
    check.choice(channel_order, "channel_order", CHANNEL_ORDERS)
    if callable(imread):
        return imread
    check.choice(imread, "imread", READERS)

    def read(path: str) -> Image:
        image: Image = read_image(path)
        image = image if channel_order == "RGB" else np.ascontiguousarray(image[..., ::-1])
        is_unit = imread == "mpimg" and path.lower().endswith(".png")
        return np.divide(image, 255, dtype=np.float32) if is_unit else image

    return read


@dataclass(frozen=True, kw_only=True)
class FeatureOptions(fields.Checked):
    """The feature options of a lesson function, checked."""

    unused: ClassVar = UNUSED

    color_space: str = fields.choice(MISSING, COLOR_SPACES)
    spatial_size: tuple[int, int] = fields.checked_field(MISSING, check_size)  # (width, height)
    hist_bins: int = fields.integer(low=1)
    orient: int = fields.integer(low=1)
    pix_per_cell: int = fields.integer(low=1)
    cell_per_block: int = fields.integer(low=1)
    hog_channel: int | str = fields.choice(MISSING, (0, 1, 2, "ALL"))
    spatial_feat: bool = fields.checked_field(MISSING, check_switch)
    hist_feat: bool = fields.checked_field(MISSING, check_switch)
    hog_feat: bool = fields.checked_field(MISSING, check_switch)
    hist_range: tuple[float, float] | None = fields.checked_field(MISSING, check_range)
    transform_sqrt: bool = fields.checked_field(MISSING, check_switch)
    spatial_order: Literal["interleaved", "channels"] = fields.choice(MISSING, SPATIAL_ORDERS)

    def __post_init__(self) -> None:
        for switch, unused in self.unused.items():  # the lesson's code does not read them
            if not check_switch(getattr(self, switch), switch):
                for name, value in unused.items():
                    object.__setattr__(self, name, value)
        super().__post_init__()
        if not (self.spatial_feat or self.hist_feat or self.hog_feat):
            raise InvalidInputError("spatial_feat, hist_feat and hog_feat are all False; switch one on")

    @classmethod
    def of(cls, arguments: dict[str, Any]) -> Self:
        """Pick the options from all arguments of a lesson function by name; check each set of them once."""
        options = {field.name: arguments[field.name] for field in dataclasses.fields(cls)}
        key = f"{cls.__name__}({options})"
        if key not in _checked:
            if len(_checked) == _MAX_CHECKED:
                _checked.clear()
            _checked[key] = cls(**options)
        return _checked[key]  # type: ignore[return-value]

    @functools.cached_property
    def blocks(self) -> int:
        """HOG block positions along a side of a 64x64 window."""
        return PATCH_SIZE // self.pix_per_cell - self.cell_per_block + 1

    @functools.cached_property
    def spatial_length(self) -> int:
        """Length of the spatial bins."""
        return 3 * self.spatial_size[0] * self.spatial_size[1] if self.spatial_feat else 0

    @functools.cached_property
    def length(self) -> int:
        """Length of the feature vector of a 64x64 window."""
        hog = (self.blocks * self.cell_per_block) ** 2 * self.orient * (3 if self.hog_channel == "ALL" else 1)
        hist = 3 * self.hist_bins if self.hist_feat else 0
        return self.spatial_length + hist + (hog if self.hog_feat else 0)

    @functools.cached_property
    def has_library_range(self) -> bool:
        """Whether the histogram covers the range of the library's."""
        return not self.hist_feat or self.hist_range == (0, 256)

    @functools.cached_property
    def params(self) -> FeatureParams | None:
        """Parameters of the library for the same vector, but for `hist_range`; None if there are none."""
        width, height = self.spatial_size
        if self.spatial_feat and width != height:
            return None
        names = [field.name for field in dataclasses.fields(FeatureOptions) if field.name != "hist_range"]
        try:
            return FeatureParams(**{name: getattr(self, name) for name in names} | {"spatial_size": width})
        except InvalidInputError:
            return None

    def compute(self, images: Images) -> list[NDArray[Any]]:
        """Feature vectors of images in the lesson's order: float32 from the kernels, else float64."""
        if self.hist_feat and len(images):
            warn_of_first_bin(images[0], self.hist_range, self.color_space)
        params = self.params if self.has_library_range else None
        if params is None or not are_uint8_patches(images):
            return [self._compute_one(image) for image in images]
        return list(library.extract_features(np.asarray(images), params))

    def _compute_one(self, image: Image) -> NDArray[np.float64]:
        """Feature vector of one image by the lesson's steps."""
        converted = convert_color(image, self.color_space)
        parts: list[NDArray[Any]] = self.color_parts(converted)
        if self.hog_feat:
            parts.append(self.hog(converted).ravel())
        return np.concatenate(parts).astype(np.float64)

    def color_parts(self, converted: Image) -> list[NDArray[Any]]:
        """Spatial bins and histogram of a converted image, where they are used."""
        parts: list[NDArray[Any]] = []
        if self.spatial_feat:
            parts.append(bin_spatial(converted, self.spatial_size, order=self.spatial_order))
        if self.hist_feat:
            parts.append(_histogram(converted, self.hist_bins, self.hist_range))
        return parts

    def hog_source(self, converted: Image) -> Image:
        """Select the channels of HOG of a converted image, ``(H, W, channels)``."""
        return converted[..., slice(None) if self.hog_channel == "ALL" else [int(self.hog_channel)]]

    def hog(self, converted: Image) -> NDArray[np.float32]:
        """HOG of a converted image, see `hog_blocks`."""
        sizes = (self.orient, self.pix_per_cell, self.cell_per_block)
        return hog_blocks(self.hog_source(converted), *sizes, self.transform_sqrt)


def are_uint8_patches(images: Images) -> bool:
    """Whether images are 64x64 uint8 RGB, whose features the library's kernels compute."""
    kind = (np.uint8, (PATCH_SIZE, PATCH_SIZE, 3))
    return len(images) > 0 and all(
        isinstance(image, np.ndarray) and (image.dtype, image.shape) == kind for image in images
    )
