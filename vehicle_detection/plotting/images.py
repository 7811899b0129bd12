"""Figures of pictures as they are: a grid of images, and an image in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_image, check_integer, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import FrameBoxes
from vehicle_detection.plotting.style import (
    SKY,
    TRUTH,
    Sheet,
    boxes_of,
    check_count,
    check_picture,
    check_sequence,
    new_figure,
    panels,
    put_boxes,
    put_image,
)

Image = NDArray[np.uint8]
Boxes = Detections | FrameBoxes | ArrayLike


@dataclass(frozen=True, kw_only=True)
class ImageFacts:
    """What an array holds, and whether the library takes it as an image.

    Attributes
    ----------
    shape, dtype
        Those of the array.
    low, high
        Its least and greatest value.
    means
        Mean of each channel; one value for an array of other than three dimensions.
    problem
        Why the library refuses it as an image, and what to do; empty where it takes it.
    """

    shape: tuple[int, ...]
    dtype: str
    low: float
    high: float
    means: tuple[float, ...]
    problem: str

    def __str__(self) -> str:
        means = ", ".join(f"{value:.4g}" for value in self.means)
        text = f"{self.dtype} array of shape {self.shape}, values {self.low:g} to {self.high:g}, mean {means}"
        return f"{text}\n{self.problem}" if self.problem else text


def describe_image(image: NDArray[Any]) -> ImageFacts:
    """Say what an array holds: shape, dtype, range and mean, and whether it is an image of this library.

    The classic trap is a PNG read as 0-1 floats and a JPEG as 0-255: here it shows.

    Parameters
    ----------
    image
        Any array of numbers with at least one value.

    Returns
    -------
    ImageFacts
        The same as attributes, and ``str`` of it in a line or two.

    Raises
    ------
    InvalidInputError
        If `image` is no array of numbers, or empty.

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
    means = image.mean(axis=(0, 1), dtype=np.float64) if image.ndim == 3 else image.mean(dtype=np.float64)
    return ImageFacts(
        shape=image.shape,
        dtype=str(image.dtype),
        low=float(image.min()),
        high=float(image.max()),
        means=tuple(np.atleast_1d(means).tolist()),
        problem=problem,
    )


def show_images(
    images: Sequence[NDArray[Any]] | Mapping[str, NDArray[Any]],
    titles: Sequence[str] | None = None,
    *,
    boxes: Sequence[Boxes | None] | None = None,
    truth: Sequence[Boxes | None] | None = None,
    columns: int | None = None,
    figure: Sheet | None = None,
) -> Sheet:
    """Show images in a row or a grid.

    Parameters
    ----------
    images
        ``(H, W, 3)`` uint8 RGB, or ``(H, W)`` numbers, which are drawn in gray; a mapping gives the titles.
    titles
        One for each image.
    boxes
        Boxes to draw on each image, or None for none: `Detections`, `FrameBoxes` or ``(N, 4)``.
    truth
        Labelled boxes in the same way, drawn with dashes.
    columns
        Images in a row; None takes up to three.
    figure
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        A panel for each image.

    Raises
    ------
    InvalidInputError
        If an image is malformed, or there is not one title or entry of `boxes` for each.

    Examples
    --------
    >>> road = np.full((72, 128, 3), 90, np.uint8)
    >>> figure = show_images({"first": road, "second": road}, boxes=[[[10, 10, 30, 30]], None])
    >>> [panel.get_title() for panel in figure.axes]
    ['first', 'second']
    """
    if isinstance(images, Mapping):
        titles = list(images) if titles is None else titles
        images = list(images.values())
    listed = check_sequence(images, "images", "images")
    shown = [check_picture(image, f"images[{index}]") for index, image in enumerate(listed)]
    names = check_count(titles, "titles", len(shown), "images")
    found = check_count(boxes, "boxes", len(shown), "images")
    true = check_count(truth, "truth", len(shown), "images")
    across = min(3, len(shown)) if columns is None else check_integer(columns, "columns", low=1, high=100)
    down = math.ceil(len(shown) / across)
    wide = max(2.0, min(12.5 / across, 6.5))
    tall = wide * float(np.median([image.shape[0] / image.shape[1] for image in shown]))
    sheet = new_figure(figure, across * wide, down * (tall + 0.3 * any(names)), layout="compressed")
    grid = panels(sheet, down, across)
    for panel in grid.flat[len(shown) :]:
        panel.remove()
    for index, (panel, image, name) in enumerate(zip(grid.flat, shown, names)):
        put_image(panel, image, "" if name is None else str(name))
        if true[index] is not None:
            put_boxes(panel, boxes_of(true[index], f"truth[{index}]"), TRUTH, linestyles="--")
        if found[index] is not None:
            put_boxes(panel, boxes_of(found[index], f"boxes[{index}]"), SKY)
    return sheet


def plot_methods(
    images: Sequence[Image] | Mapping[str, Image],
    methods: Mapping[str, Sequence[Detections]],
    *,
    truth: Sequence[Boxes | None] | None = None,
    figure: Sheet | None = None,
) -> Sheet:
    """Show what several methods find in the same images: a row for each image, a column for each method.

    Parameters
    ----------
    images
        ``(H, W, 3)`` uint8 RGB; a mapping names the rows.
    methods
        By the method's name, what it found in each image.
    truth
        Labelled boxes of each image, drawn with dashes.
    figure
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        Panels row by row; the title of each tells how many vehicles were found.

    Raises
    ------
    InvalidInputError
        If an image is malformed, or a method does not have one result for each image.

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
            'pass {"fitted": [detector.detect(image) for image in images]}'
        )
    rows = list(images) if isinstance(images, Mapping) else None
    listed = check_sequence(images.values() if isinstance(images, Mapping) else images, "images", "images")
    pictures, titles, boxes, true = [], [], [], []
    truths = check_count(truth, "truth", len(listed), "images")
    each = {
        name: check_count(found, f"methods[{name!r}]", len(listed), "images")
        for name, found in methods.items()
    }
    for index, picture in enumerate(listed):
        for name, found in each.items():
            count = len(boxes_of(found[index], f"methods[{name!r}][{index}]"))
            row = f"{rows[index]}, " if rows else ""
            pictures.append(check_image(picture, f"images[{index}]"))
            titles.append(f"{row}{name}: {count} box{'es' * (count != 1)}")
            boxes.append(found[index])
            true.append(truths[index])
    return show_images(pictures, titles, boxes=boxes, truth=true, columns=len(each), figure=figure)
