"""Figures of images: a grid of images, methods side by side, and a description of an array."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_image, check_integer, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.plotting import style
from vehicle_detection.plotting.style import SKY, TRUTH, Boxes, FigureLike, Image


@dataclass(frozen=True, kw_only=True)
class ImageDescription:
    """The contents of an array, and whether the library accepts it as an image.

    Attributes
    ----------
    shape, dtype
        Shape and dtype of the array.
    min, max
        Minimum and maximum value.
    mean
        Mean of each channel; a single value unless the array has three dimensions.
    problem
        Why the library rejects it as an image, and the remedy; empty if it is accepted.
    """

    shape: tuple[int, ...]
    dtype: str
    min: float
    max: float
    mean: tuple[float, ...]
    problem: str

    def __str__(self) -> str:
        mean = ", ".join(f"{value:.4g}" for value in self.mean)
        text = f"{self.dtype} array of shape {self.shape}, values {self.min:g} to {self.max:g}, mean {mean}"
        return f"{text}\n{self.problem}" if self.problem else text


def describe_image(image: NDArray[Any]) -> ImageDescription:
    """Describe an array: shape, dtype, range and mean, and whether the library accepts it as an image.

    Typical use: find out that a PNG was read as floats from 0 to 1 and a JPEG as integers from 0 to 255.

    Parameters
    ----------
    image
        Any array of numbers with at least one value.

    Returns
    -------
    ImageDescription
        ``print`` shows it in one or two lines.

    Raises
    ------
    InvalidInputError
        If `image` is not an array of numbers, or is empty.

    Examples
    --------
    >>> print(describe_image(np.full((2, 3, 3), 7, np.uint8)))
    uint8 array of shape (2, 3, 3), values 7 to 7, mean 7, 7, 7
    >>> describe_image(np.full((2, 3, 3), 0.5)).problem.partition("; ")[2]
    'scale a 0-1 float image with (image * 255).round().astype(numpy.uint8)'
    """
    given: object = image
    if not isinstance(given, np.ndarray) or not image.size or image.dtype.kind not in "iufb":
        raise InvalidInputError(
            f"image must be an array of numbers, got {describe(given)}; read a file with read_image"
        )
    try:
        check_image(image)
        problem = ""
    except InvalidInputError as error:
        problem = str(error)
    mean = image.mean(axis=(0, 1) if image.ndim == 3 else None, dtype=np.float64)
    return ImageDescription(
        shape=image.shape,
        dtype=str(image.dtype),
        min=float(image.min()),
        max=float(image.max()),
        mean=tuple(np.atleast_1d(mean).tolist()),
        problem=problem,
    )


def show_images(
    images: Sequence[NDArray[Any]] | Mapping[str, NDArray[Any]],
    titles: Sequence[str] | None = None,
    *,
    boxes: Sequence[Boxes | None] | None = None,
    truth: Sequence[Boxes | None] | None = None,
    columns: int | None = None,
    figure: FigureLike | None = None,
) -> FigureLike:
    """Show images in a row or a grid.

    Parameters
    ----------
    images, titles
        ``(H, W, 3)`` uint8 RGB, or ``(H, W)`` numbers, shown in gray; and one title per image, by default the
        keys if `images` is a mapping.
    boxes, truth
        Boxes to draw on each image, or None: `Detections`, `FrameBoxes` or ``(N, 4)``; and labelled boxes in
        the same form, drawn with dashed lines.
    columns
        Images per row; None for up to three.
    figure : matplotlib.figure.Figure or SubFigure, optional

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        One Axes per image.

    Raises
    ------
    InvalidInputError
        If an image is malformed, or the number of titles or boxes differs from the number of images.

    Examples
    --------
    >>> road = np.full((72, 128, 3), 90, np.uint8)
    >>> figure = show_images({"first": road, "second": road}, boxes=[[[10, 10, 30, 30]], None])
    >>> [panel.get_title() for panel in figure.axes]
    ['first', 'second']
    """
    listed, names = style.split_titles(images, titles)
    shown = [style.check_displayable(image, f"images[{index}]") for index, image in enumerate(listed)]
    count = len(shown)
    found = style.check_length(boxes, "boxes", count, "images")
    true = style.check_length(truth, "truth", count, "images")
    per_row = min(3, count) if columns is None else check_integer(columns, "columns", low=1, high=100)
    rows = math.ceil(count / per_row)
    width = max(2.0, min(12.5 / per_row, 6.5))
    height = width * float(np.median([image.shape[0] / image.shape[1] for image in shown]))
    size = per_row * width, rows * (height + 0.3 * any(names))
    figure, grid = style.new_panels(figure, size, rows, per_row, count=count, layout="compressed")
    for index, (panel, image, name) in enumerate(zip(grid.flat, shown, names)):
        style.add_image(panel, image, "" if name is None else str(name))
        if true[index] is not None:
            style.add_boxes(panel, style.box_array(true[index], f"truth[{index}]"), TRUTH, linestyles="--")
        if found[index] is not None:
            style.add_boxes(panel, style.box_array(found[index], f"boxes[{index}]"), SKY)
    return figure


def plot_methods(
    images: Sequence[Image] | Mapping[str, Image],
    methods: Mapping[str, Sequence[Detections]],
    *,
    truth: Sequence[Boxes | None] | None = None,
    figure: FigureLike | None = None,
) -> FigureLike:
    """Show the boxes that several methods find in the same images: one row per image, one column per method.

    Parameters
    ----------
    images, truth
        ``(H, W, 3)`` uint8 RGB, with the keys of a mapping as names of the rows; and labelled boxes of each
        image, drawn with dashed lines.
    methods
        For each method, its detections in each image.
    figure : matplotlib.figure.Figure or SubFigure, optional

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        One Axes per image and method, row by row; each title counts the boxes.

    Raises
    ------
    InvalidInputError
        If an image is malformed, or a method does not have one result per image.

    Examples
    --------
    >>> road = np.full((72, 128, 3), 90, np.uint8)
    >>> found = Detections([[10, 10, 30, 30]], [1.0])
    >>> figure = plot_methods([road], {"count": [Detections.empty()], "score": [found]})
    >>> [panel.get_title() for panel in figure.axes]
    ['count: 0 boxes', 'score: 1 box']
    """
    given: object = methods
    if not isinstance(given, Mapping) or not given:
        raise InvalidInputError(
            f"methods must map names to a list of Detections, got {describe(given)}; "
            'pass {"default": [detector.detect(image) for image in images]}'
        )
    listed, rows = style.split_titles(images)
    true = style.check_length(truth, "truth", len(listed), "images")
    for name, found in methods.items():
        style.check_length(found, f"methods[{name!r}]", len(listed), "images")
    shown, titles, boxes = [], [], []
    for index, (image, row) in enumerate(zip(listed, rows)):
        check_image(image, f"images[{index}]")
        for name, found in methods.items():
            count = len(style.box_array(found[index], f"methods[{name!r}][{index}]"))
            prefix = "" if row is None else f"{row}, "
            shown.append(image)
            titles.append(f"{prefix}{name}: {count} box{'es' * (count != 1)}")
            boxes.append(found[index])
    repeated = [each for each in true for _ in methods]
    return show_images(shown, titles, boxes=boxes, truth=repeated, columns=len(methods), figure=figure)
