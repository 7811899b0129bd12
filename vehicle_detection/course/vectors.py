"""Feature vectors of images, ``[spatial | histogram | HOG]``, and the options that define them."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Iterable
from dataclasses import MISSING, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from vehicle_detection import features as library
from vehicle_detection._common import (
    Checked,
    check_flags,
    checked_field,
    choice,
    describe,
    integer,
    is_listing,
)
from vehicle_detection.course.features import (
    Image,
    Size,
    SpatialOrder,
    bin_spatial,
    check_lesson_image,
    check_range,
    check_size,
    color_hist,
    convert_color,
    get_hog_features,
    hog_blocks,
    or_default,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import COLOR_SPACES, PATCH_SIZE, SPATIAL_ORDERS, FeatureParams
from vehicle_detection.images import read_image

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Images = list[Image] | NDArray[Any]

# Number of images that are read and processed at a time.
_CHUNK = 4096
# Values of the options of a group of features that is switched off.
_UNUSED: dict[str, dict[str, Any]] = {
    "spatial_feat": {"spatial_size": (32, 32)},
    "hist_feat": {"hist_bins": 32, "hist_range": (0, 256)},
    "hog_feat": {"orient": 9, "pix_per_cell": 8, "cell_per_block": 2, "hog_channel": 0},
}
# The options of earlier calls.
_checked: dict[str, FeatureOptions] = {}
_MAX_CHECKED = 64


def _check_switch(value: Any, name: str) -> bool:
    """Return a switch as a bool; the lesson's code also passes 0 and 1."""
    check_flags(**{name: value})
    return bool(value)


def accept_cspace(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Accept ``cspace=``, the name of ``color_space=`` in two earlier quizzes.

    Each of those quizzes computes one group of features: one computes HOG, the other spatial bins and
    histograms. With ``cspace=`` and without ``spatial_feat=``, ``hist_feat=`` and ``hog_feat=``, the group
    follows from the options that are passed. The positional order of the HOG quiz raises an error.
    """

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Result:
        if _is_in_hog_quiz_order(args):
            names = ("cspace", "orient", "pix_per_cell", "cell_per_block", "hog_channel")
            named = ", ".join(f"{name}={value!r}" for name, value in zip(names, args[1:]))
            raise InvalidInputError(
                "the arguments after color_space must be spatial_size, hist_bins, orient, pix_per_cell, ...; "
                f"got those of the HOG quiz in its order. Pass them by name: {named}"
            )
        if "cspace" in kwargs:
            if "color_space" in kwargs:
                raise InvalidInputError("color_space and cspace are the same option; pass one of them")
            kwargs["color_space"] = kwargs.pop("cspace")
            color = not kwargs.keys().isdisjoint({"spatial_size", "hist_bins", "hist_range"})
            hog = not kwargs.keys().isdisjoint({"orient", "pix_per_cell", "cell_per_block", "hog_channel"})
            if color != hog and kwargs.keys().isdisjoint({"spatial_feat", "hist_feat", "hog_feat"}):
                kwargs.update(spatial_feat=color, hist_feat=color, hog_feat=hog)
        return function(*args, **kwargs)

    return call


def _is_in_hog_quiz_order(args: tuple[Any, ...]) -> bool:
    """Whether a number as `spatial_size` and a channel as `pix_per_cell` show another order of arguments."""
    if len(args) < 6 or not isinstance(args[2], (int, np.integer)):
        return False
    return isinstance(args[5], str) or (isinstance(args[5], (int, np.integer)) and int(args[5]) <= 3)


@accept_cspace
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
    transform_sqrt: bool | None = None,
    spatial_order: SpatialOrder = "interleaved",
) -> Any:
    """Feature vector of one image; the options are those of `extract_features`.

    Parameters
    ----------
    vis
        Return a picture of the HOG, too; for a single `hog_channel`.

    Returns
    -------
    numpy.ndarray, or a pair
        1-D float64, ``[spatial | histogram | HOG]``; with `vis` also the picture, ``(H, W)`` float64.

    Examples
    --------
    >>> single_img_features(np.zeros((64, 64, 3), np.uint8), "YCrCb", hog_channel="ALL").shape
    (8460,)
    """
    options, image = FeatureOptions.of(locals()), check_lesson_image(img, drop_alpha=True)
    check_flags(vis=vis)
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


@accept_cspace
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
    transform_sqrt: bool | None = None,
    spatial_order: SpatialOrder = "interleaved",
    imread: Callable[[str], Image] | None = None,
) -> list[NDArray[Any]]:
    """Feature vectors of a list of images.

    Returns a 1-D vector for each image, ``[spatial | histogram | HOG]``: float32 for 64x64 uint8 images,
    which the library's kernels compute, float64 for others. The lesson's code converts the stacked vectors to
    float64 itself.

    Parameters
    ----------
    imgs
        File names, or images ``(H, W, 3)`` RGB. A fourth channel, transparency, is dropped.
    color_space
        ``"RGB"``, ``"HSV"``, ``"LUV"``, ``"HLS"``, ``"YUV"``, ``"YCrCb"`` or ``"LAB"``. The keyword of two
        earlier quizzes, ``cspace=``, is accepted too: with HOG options only, it selects HOG alone, and with
        color options only, spatial bins and histograms alone, as in those quizzes. Their positional order is
        not accepted.
    spatial_size, hist_bins, hist_range, spatial_order
        See `bin_spatial` and `color_hist`.
    orient, pix_per_cell, cell_per_block, transform_sqrt
        See `get_hog_features`.
    hog_channel
        0, 1, 2 or ``"ALL"``.
    spatial_feat, hist_feat, hog_feat
        Switches for the three parts.
    imread
        Function that reads a file as RGB. None reads like the lesson's ``mpimg.imread``: a PNG as float 0-1,
        other files as uint8. ``vehicle_detection.read_image`` reads every file as uint8, which is faster;
        search uint8 images then, and pass ``divide_by=1`` to `find_cars`.

    Examples
    --------
    >>> images = [np.zeros((64, 64, 3), np.uint8)] * 2
    >>> [len(vector) for vector in extract_features(images, "HLS", (16, 16), 16, hog_channel=2)]
    [2580, 2580]
    >>> [len(vector) for vector in extract_features(images, cspace="HLS", orient=9)]
    [1764, 1764]
    """
    options = FeatureOptions.of(locals())
    if not is_listing(imgs):
        raise InvalidInputError(f"imgs must be a list of file names or images; got {describe(imgs)}")
    if isinstance(imgs, np.ndarray) and imgs.ndim in (2, 3) and imgs.dtype.kind in "uif":
        raise InvalidInputError(
            f"imgs must be a list of images, got {describe(imgs)}; pass [image], or use single_img_features"
        )
    if imread is not None and not callable(imread):
        raise InvalidInputError(f"imread must be a function of a file name; got {describe(imread)}")
    read = _read_like_lesson if imread is None else imread
    if isinstance(imgs, np.ndarray) and are_uint8_patches(imgs):
        return options.compute(imgs)
    items: list[Any] = list(imgs)
    vectors: list[NDArray[Any]] = []
    for start in range(0, len(items), _CHUNK):
        images = [
            read(os.fspath(item)) if isinstance(item, (str, os.PathLike)) else item
            for item in items[start : start + _CHUNK]
        ]
        vectors += options.compute(
            [
                check_lesson_image(image, f"imgs[{index}]", drop_alpha=True)
                for index, image in enumerate(images, start)
            ]
        )
    return vectors


def _read_like_lesson(path: str) -> Image:
    """Read a file like matplotlib's ``imread``: a PNG as float32 0-1, others as uint8."""
    image = read_image(path)
    if Path(path).suffix.lower() != ".png":
        return image
    return np.divide(image, 255, dtype=np.float32)


@dataclass(frozen=True, kw_only=True)
class FeatureOptions(Checked):
    """The feature options of a lesson function, checked."""

    color_space: str = choice(MISSING, COLOR_SPACES)
    spatial_size: tuple[int, int] = checked_field(MISSING, check_size)  # (width, height)
    hist_bins: int = integer(low=1)
    orient: int = integer(low=1)
    pix_per_cell: int = integer(low=1)
    cell_per_block: int = integer(low=1)
    hog_channel: int | str = choice(MISSING, (0, 1, 2, "ALL"))
    spatial_feat: bool = checked_field(MISSING, _check_switch)
    hist_feat: bool = checked_field(MISSING, _check_switch)
    hog_feat: bool = checked_field(MISSING, _check_switch)
    hist_range: tuple[float, float] | None = checked_field(MISSING, check_range)
    transform_sqrt: bool = checked_field(MISSING, _check_switch)
    spatial_order: Literal["interleaved", "channels"] = choice(MISSING, SPATIAL_ORDERS)

    def __post_init__(self) -> None:
        for switch, unused in _UNUSED.items():  # the lesson's code does not read them
            if not _check_switch(getattr(self, switch), switch):
                for name, value in unused.items():
                    object.__setattr__(self, name, value)
        super().__post_init__()
        if not (self.spatial_feat or self.hist_feat or self.hog_feat):
            raise InvalidInputError("spatial_feat, hist_feat and hog_feat are all False; switch one on")

    @classmethod
    def of(cls, arguments: dict[str, Any]) -> Self:
        """Pick the options from all arguments of a lesson function, by name.

        Programs call a function for each frame and window with the same options, which are checked once.
        """
        options = {field.name: arguments[field.name] for field in dataclasses.fields(cls)}
        options["transform_sqrt"] = or_default(options["transform_sqrt"], "transform_sqrt")
        key = f"{cls.__name__}({options})"
        if key not in _checked:
            if len(_checked) == _MAX_CHECKED:
                _checked.clear()
            _checked[key] = cls(**options)
        return _checked[key]  # type: ignore[return-value]

    @cached_property
    def blocks(self) -> int:
        """HOG block positions along a side of a 64x64 window."""
        return PATCH_SIZE // self.pix_per_cell - self.cell_per_block + 1

    @cached_property
    def length(self) -> int:
        """Length of the feature vector of a 64x64 window."""
        width, height = self.spatial_size
        channels = 3 if self.hog_channel == "ALL" else 1
        lengths = (
            3 * width * height if self.spatial_feat else 0,
            3 * self.hist_bins if self.hist_feat else 0,
            self.blocks**2 * self.cell_per_block**2 * self.orient * channels if self.hog_feat else 0,
        )
        return sum(lengths)

    @cached_property
    def has_library_range(self) -> bool:
        """Whether the histogram covers the range of the library's."""
        return not self.hist_feat or self.hist_range == (0, 256)

    @cached_property
    def params(self) -> FeatureParams | None:
        """Parameters of the library for the same vector, but for `hist_range`; None if there are none."""
        width, height = self.spatial_size
        if self.spatial_feat and width != height:
            return None
        names = [field.name for field in dataclasses.fields(FeatureOptions) if field.name != "hist_range"]
        options = {name: getattr(self, name) for name in names}
        try:
            return FeatureParams(**options | {"spatial_size": width})
        except InvalidInputError:
            return None

    def compute(self, images: Images) -> list[NDArray[Any]]:
        """Feature vectors of images in the lesson's order: float32 from the kernels, else float64."""
        params = self.params if self.has_library_range else None
        if params is None or not are_uint8_patches(images):
            return [self._compute_one(image) for image in images]
        patches = images if isinstance(images, np.ndarray) else np.stack(images)
        return list(library.extract_features(patches, params))

    def _compute_one(self, image: Image) -> NDArray[np.float64]:
        """Feature vector of one image by the lesson's steps."""
        converted = convert_color(image, self.color_space)
        parts: list[NDArray[Any]] = self.color_parts(converted)
        if self.hog_feat:
            parts.append(hog_blocks(*self.hog_arguments(converted)).ravel())
        return np.concatenate(parts).astype(np.float64)

    def color_parts(self, converted: Image) -> list[NDArray[Any]]:
        """Spatial bins and histogram of a converted image, where they are used."""
        parts: list[NDArray[Any]] = []
        if self.spatial_feat:
            parts.append(bin_spatial(converted, self.spatial_size, order=self.spatial_order))
        if self.hist_feat:
            parts.append(color_hist(converted, self.hist_bins, self.hist_range))
        return parts

    def hog_arguments(self, converted: Image) -> tuple[Any, ...]:
        """Arguments of `hog_blocks` and `hog_maps` for the selected channels of a converted image."""
        channels = slice(None) if self.hog_channel == "ALL" else [int(self.hog_channel)]
        sizes = (self.orient, self.pix_per_cell, self.cell_per_block)
        return converted[..., channels], *sizes, self.transform_sqrt


def are_uint8_patches(images: Images) -> bool:
    """Whether images are 64x64 uint8 RGB, whose features the library's kernels compute all at once."""
    shape = (PATCH_SIZE, PATCH_SIZE, 3)
    if isinstance(images, np.ndarray):
        return images.dtype == np.uint8 and images.shape[1:] == shape
    return bool(images) and all(image.dtype == np.uint8 and image.shape == shape for image in images)
