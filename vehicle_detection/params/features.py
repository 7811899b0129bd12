"""Parameters of the features of a patch, with presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_bool, check_choice, check_number, store_integer
from vehicle_detection.errors import InvalidInputError

PATCH_SIZE = 64
"""Side length in pixels of a training patch and of a resized window."""

COLOR_SPACES = ("RGB", "HSV", "LUV", "HLS", "YUV", "YCrCb", "LAB")
SPATIAL_ORDERS = ("channels", "interleaved")
HOG_CHANNELS: tuple[int | str, ...] = (0, 1, 2, "ALL", "GRAY")
_LAB = {"color_space": "LAB", "spatial_size": 32}


@dataclass(frozen=True, kw_only=True)
class FeatureParams:
    """Features of a 64x64 patch: ``[spatial | histogram | HOG]``, each channel by channel.

    `coarse_hog` appends a second, coarser HOG: ``[spatial | histogram | HOG | coarse HOG]``.

    Attributes
    ----------
    color_space
        Color space: ``"RGB"``, ``"HSV"``, ``"LUV"``, ``"HLS"``, ``"YUV"``, ``"YCrCb"`` or ``"LAB"``.
    spatial_color_space, hist_color_space
        Color space of the spatial bins and of the histogram; None means `color_space`.
    spatial_feat, hist_feat, hog_feat
        Which of the three parts to compute.
    spatial_size
        Side length of the grid of spatial bins, which gives ``spatial_size**2 * 3`` values; a pair of equal
        numbers is accepted too.
    spatial_order
        ``"channels"``: the spatial bins of one channel after the other; ``"interleaved"``: pixel by pixel,
        as ``cv2.resize(image, size).ravel()`` orders them. A model that was trained on the other order loads
        without an error, but its scores are wrong.
    hist_bins, hist_sqrt
        Number of bins of each channel's histogram over 0-255, and whether to use the square roots of the
        counts, so that a full bin dominates less.
    orient, pix_per_cell, cell_per_block
        Number of HOG orientations over 0-180 degrees, and side lengths of a HOG cell in pixels and of a block
        in cells.
    hog_channel
        Channel of HOG: 0, 1, 2, ``"ALL"``, or ``"GRAY"`` for the gray image in any `color_space`.
    transform_sqrt, coarse_hog
        Compute HOG on the square root of the pixel values; append the HOG of cells of twice the size.
    hist_gain, coarse_gain
        Factors of the scaled histogram and the scaled coarse HOG in training. A larger factor weakens the
        regularization of these few features. The gains change the weights only, not the features.

    Raises
    ------
    InvalidInputError
        If a field is out of range, or no part is selected.

    Examples
    --------
    >>> FeatureParams.preset("ycrcb-6156").length
    6156
    >>> FeatureParams(orient=12, hog_channel=0).hog_length
    2352
    """

    color_space: str = "YCrCb"
    spatial_color_space: str | None = None
    hist_color_space: str | None = None
    spatial_feat: bool = True
    hist_feat: bool = True
    hog_feat: bool = True
    spatial_size: int = 16
    spatial_order: Literal["channels", "interleaved"] = "channels"
    hist_bins: int = 32
    orient: int = 9
    pix_per_cell: int = 8
    cell_per_block: int = 2
    hog_channel: int | Literal["ALL", "GRAY"] = "ALL"
    transform_sqrt: bool = False
    hist_sqrt: bool = False
    coarse_hog: bool = False
    hist_gain: float = 1.0
    coarse_gain: float = 1.0

    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "luv-2384": {
            "color_space": "LUV",
            "hist_bins": 16,
            "orient": 8,
            "hog_channel": 0,
            "transform_sqrt": True,
        },
        "ycrcb-6156": {},
        "ycrcb-8460": {"spatial_size": 32},
        "lab-8460": _LAB,
        "lab-9432": {**_LAB, "hist_sqrt": True, "coarse_hog": True, "hist_gain": 4.0, "coarse_gain": 3.0},
    }

    def __post_init__(self) -> None:
        check_choice(self.color_space, "color_space", COLOR_SPACES)
        check_choice(self.spatial_color_space, "spatial_color_space", (None, *COLOR_SPACES))
        check_choice(self.hist_color_space, "hist_color_space", (None, *COLOR_SPACES))
        check_choice(self.spatial_order, "spatial_order", SPATIAL_ORDERS)
        switches = ("spatial_feat", "hist_feat", "hog_feat", "transform_sqrt", "hist_sqrt", "coarse_hog")
        for name in switches:
            object.__setattr__(self, name, check_bool(getattr(self, name), name))
        if not (self.spatial_feat or self.hist_feat or self.hog_feat):
            raise InvalidInputError("spatial_feat, hist_feat and hog_feat are all False; set one to True")
        size: Any = self.spatial_size
        if isinstance(size, (tuple, list)) and len(size) == 2 and size[0] == size[1]:
            object.__setattr__(self, "spatial_size", size[0])
        store_integer(self, "spatial_size", low=1, high=PATCH_SIZE)
        store_integer(self, "hist_bins", low=1, high=256)
        store_integer(self, "orient", low=1, high=180)
        store_integer(self, "pix_per_cell", low=2, high=PATCH_SIZE)
        store_integer(self, "cell_per_block", low=1, high=PATCH_SIZE // self.pix_per_cell)
        check_choice(self.hog_channel, "hog_channel", HOG_CHANNELS)
        if not isinstance(self.hog_channel, str):
            store_integer(self, "hog_channel", low=0, high=2)
        if self.coarse_hog and self.cells // 2 < self.cell_per_block:
            raise InvalidInputError(
                f"coarse_hog must be False, because a block of {self.cell_per_block} cells of "
                f"{2 * self.pix_per_cell} pixels does not fit into a patch; got True"
            )
        for name in ("hist_gain", "coarse_gain"):
            object.__setattr__(self, name, check_number(getattr(self, name), name, low=0.01, high=100))

    @classmethod
    def preset(cls, name: str) -> FeatureParams:
        """Parameters by name: of three course projects, or ``"lab-9432"`` of the shipped model "highway"."""
        check_choice(name, "preset", cls.PRESETS)
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
        """Color spaces that an image is converted to; not the gray image of ``hog_channel="GRAY"``."""
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
        values = blocks**2 * self.cell_per_block**2 * self.orient * self.hog_channels
        return values if self.hog_feat else 0

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
