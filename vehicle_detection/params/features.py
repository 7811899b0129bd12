"""What a patch is turned into: the features, and the presets of the course systems and the models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_choice, check_integer, check_number, describe
from vehicle_detection.errors import InvalidInputError

PATCH_SIZE = 64
"""Width and height in pixels of a training patch and of a window once it is resized."""

COLOR_SPACES = ("RGB", "HSV", "LUV", "HLS", "YUV", "YCrCb", "LAB")
HOG_CHANNELS: tuple[int | str, ...] = (0, 1, 2, "ALL", "GRAY")


@dataclass(frozen=True, kw_only=True)
class FeatureParams:
    """What a 64x64 patch is turned into: ``[spatial | histogram | HOG]``, each channel by channel.

    With `coarse_hog` a second, coarser HOG stands at the end: ``[spatial | histogram | HOG | coarse HOG]``.

    Attributes
    ----------
    color_space
        Space of the spatial bins, the histograms and HOG: one of ``COLOR_SPACES``.
    spatial_feat, hist_feat, hog_feat
        Switches for the three parts.
    spatial_size
        Side of the grid of spatial bins; ``spatial_size**2 * 3`` values.
    hist_bins
        Bins of each channel's histogram over 0-255.
    hist_sqrt
        Square roots of the histogram's counts: a full bin drowns the others less.
    orient
        HOG orientations over 0-180 degrees.
    pix_per_cell
        Side of a HOG cell in pixels.
    cell_per_block
        Side of a HOG block in cells.
    hog_channel
        0, 1, 2, ``"ALL"``, or ``"GRAY"`` (HOG of the gray image, whatever `color_space`).
    transform_sqrt
        HOG of the square root of the pixel values.
    coarse_hog
        HOG of cells twice as large, too, as ``2 * pix_per_cell`` would give it: each is four of the cells.
    hist_gain, coarse_gain
        What the scaled histogram and the scaled coarse HOG are multiplied by in training, so that the SVM's
        regularisation holds the few of them back less than the many other values. They change the weights
        alone, not the features and not the time of a search.

    Examples
    --------
    >>> FeatureParams.preset("ycrcb-6156").length
    6156
    >>> FeatureParams(orient=12, hog_channel=0).hog_length
    2352
    """

    color_space: str = "YCrCb"
    spatial_feat: bool = True
    hist_feat: bool = True
    hog_feat: bool = True
    spatial_size: int = 16
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
        "lab-8460": {"color_space": "LAB", "spatial_size": 32},
        "lab-9432": {
            "color_space": "LAB",
            "spatial_size": 32,
            "hist_sqrt": True,
            "coarse_hog": True,
            "hist_gain": 4.0,
            "coarse_gain": 3.0,
        },
    }

    def __post_init__(self) -> None:
        check_choice(self.color_space, "color_space", COLOR_SPACES)
        switches = ("spatial_feat", "hist_feat", "hog_feat", "transform_sqrt", "hist_sqrt", "coarse_hog")
        for name in switches:
            if not isinstance(getattr(self, name), bool):
                raise InvalidInputError(f"{name} must be True or False; got {describe(getattr(self, name))}")
        if not (self.spatial_feat or self.hist_feat or self.hog_feat):
            raise InvalidInputError("spatial_feat, hist_feat and hog_feat are all False; switch one on")
        self._check_integer("spatial_size", 1, PATCH_SIZE)
        self._check_integer("hist_bins", 1, 256)
        self._check_integer("orient", 1, 180)
        self._check_integer("pix_per_cell", 2, PATCH_SIZE)
        self._check_integer("cell_per_block", 1, PATCH_SIZE // self.pix_per_cell)
        check_choice(self.hog_channel, "hog_channel", HOG_CHANNELS)
        if not isinstance(self.hog_channel, str):
            self._check_integer("hog_channel", 0, 2)
        if self.coarse_hog and self.cells // 2 < self.cell_per_block:
            raise InvalidInputError(
                f"coarse_hog must be False where no block of {self.cell_per_block} cells of "
                f"{2 * self.pix_per_cell} pixels fits into a patch; got True"
            )

        for name in ("hist_gain", "coarse_gain"):
            gain = check_number(getattr(self, name), name, low=0.01, high=100)
            object.__setattr__(self, name, float(gain))

    def _check_integer(self, name: str, low: int, high: int) -> None:
        # A plain int replaces one of numpy, which the JSON of a model file does not take.
        object.__setattr__(self, name, check_integer(getattr(self, name), name, low=low, high=high))

    @classmethod
    def preset(cls, name: str) -> FeatureParams:
        """Parameters of a course system or of the shipped model.

        ``"luv-2384"``, ``"ycrcb-6156"`` and ``"ycrcb-8460"`` are the three systems' of the course;
        ``"lab-9432"`` is the shipped highway model's: roots of the histogram and a coarse HOG beside what
        ``"lab-8460"`` has.
        """
        check_choice(name, "preset", cls.PRESETS)
        return cls(**cls.PRESETS[name])

    @property
    def hog_channels(self) -> int:
        """Number of channels that HOG sees."""
        return 3 if self.hog_channel == "ALL" else 1

    @property
    def cells(self) -> int:
        """HOG cells along a side of the patch."""
        return PATCH_SIZE // self.pix_per_cell

    @property
    def blocks(self) -> int:
        """HOG block positions along a side of the patch."""
        return self.cells - self.cell_per_block + 1

    @property
    def coarse_blocks(self) -> int:
        """Block positions of the coarse HOG along a side of the patch, 0 without it."""
        return self.cells // 2 - self.cell_per_block + 1 if self.coarse_hog else 0

    @property
    def spatial_length(self) -> int:
        """Values from spatial bins."""
        return self.spatial_size**2 * 3 if self.spatial_feat else 0

    @property
    def hist_length(self) -> int:
        """Values from color histograms."""
        return self.hist_bins * 3 if self.hist_feat else 0

    @property
    def hog_length(self) -> int:
        """Values from HOG, the coarse ones included."""
        values = self.blocks**2 * self.cell_per_block**2 * self.orient * self.hog_channels
        return values + self.coarse_length if self.hog_feat else 0

    @property
    def coarse_length(self) -> int:
        """Values from the coarse HOG, at the end of the vector."""
        values = self.coarse_blocks**2 * self.cell_per_block**2 * self.orient * self.hog_channels
        return values if self.hog_feat else 0

    @property
    def length(self) -> int:
        """Length of the feature vector."""
        return self.spatial_length + self.hist_length + self.hog_length

    @property
    def gains(self) -> NDArray[np.float64]:
        """What each scaled value is multiplied by in training, ``(length,)`` float64."""
        gains = np.ones(self.length)
        gains[self.spatial_length :][: self.hist_length] = self.hist_gain
        gains[self.length - self.coarse_length :] = self.coarse_gain
        return gains
