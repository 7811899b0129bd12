"""What all figures share: where they are drawn, colors, pictures, boxes and grids of tiles."""

from __future__ import annotations

import functools
import io
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_boxes, check_image, check_type, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.drawing import TRACK_COLORS
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import FrameBoxes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure, SubFigure

Sheet: TypeAlias = Union["Figure", "SubFigure"]
"""What figures of several panels are drawn on."""

Paint = tuple[float, float, float]

COLORS: tuple[Paint, ...] = tuple((r / 255, g / 255, b / 255) for r, g, b in TRACK_COLORS)
"""Okabe and Ito's colors as matplotlib takes them, in the order of the tracks'."""

LINE_COLORS: tuple[Paint, ...] = tuple(COLORS[index] for index in (4, 5, 2, 6, 0, 1))
"""The same for lines on white, on which yellow is not seen."""

ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = COLORS
VEHICLE, OTHER = VERMILION, BLUE
"""Colors of the two classes."""

TRUTH = (1.0, 1.0, 1.0)
"""Color of labelled boxes on a picture; their dashes have a dark edge."""

DASHES = ("-", "--", "-.", ":")

_PIXELATED = 200


def line_looks() -> Iterator[tuple[Paint, str]]:
    """Colors and dashes of one line after the other: lines of one color differ in their dashes."""
    looks = [(color, dash) for dash in DASHES for color in LINE_COLORS]
    return itertools.cycle(looks)


@functools.cache
def _sheet_class() -> type[Figure]:
    from matplotlib.figure import Figure

    class ShownFigure(Figure):
        """A figure that pyplot knows nothing of, and that a notebook shows all the same."""

        def _repr_png_(self) -> bytes:
            picture = io.BytesIO()
            self.savefig(picture, format="png", dpi=100, bbox_inches="tight")
            return picture.getvalue()

    return ShownFigure


def new_figure(
    figure: Sheet | None,
    width: float,
    height: float,
    *,
    layout: Literal["constrained", "compressed"] = "constrained",
) -> Sheet:
    """Return the given figure, or a new one of this size in inches that pyplot does not keep."""
    if figure is None:
        return _sheet_class()(figsize=(width, height), layout=layout)
    from matplotlib.figure import FigureBase

    check_type(figure, "figure", FigureBase, "pass a Figure, a SubFigure, or None for a new one")
    return figure


def new_axes(ax: Axes | None, width: float = 7.0, height: float = 4.5) -> Axes:
    """Return the given Axes, or those of a new figure of this size in inches."""
    if ax is None:
        import matplotlib.pyplot as plt

        axes: Axes = plt.subplots(figsize=(width, height), layout="constrained")[1]
        return axes
    from matplotlib.axes import Axes as AxesClass

    check_type(ax, "ax", AxesClass, "pass one panel, or None for a new figure")
    return ax


def panels(sheet: Sheet, rows: int, columns: int, **options: Any) -> NDArray[Any]:
    """Make a grid of panels, ``(rows, columns)`` objects."""
    return np.asarray(sheet.subplots(rows, columns, squeeze=False, **options))


def check_picture(image: object, name: str) -> NDArray[Any]:
    """Return an RGB image, or any array of two dimensions."""
    if isinstance(image, np.ndarray) and image.ndim == 2 and image.size and image.dtype.kind in "iufb":
        return image
    return check_image(image, name)


def check_sequence(values: object, name: str, kind: str) -> list[Any]:
    """Return a list of at least one; `kind` says of what."""
    one = isinstance(values, np.ndarray) and values.ndim < 4
    if one or isinstance(values, (str, bytes)) or not hasattr(values, "__iter__"):
        raise InvalidInputError(
            f"{name} must be a list of {kind}, got {describe(values)}; wrap a single one in a list"
        )
    listed = list(values)
    if not listed:
        raise InvalidInputError(f"{name} must hold at least one of {kind}; got none")
    return listed


def check_count(values: Sequence[object] | None, name: str, count: int, of: str) -> list[Any]:
    """Return one value for each of `count` things, None for each if there are none."""
    if values is None:
        return [None] * count
    if len(values) != count:
        raise InvalidInputError(
            f"{name} must be one for each of the {count} {of}, got {len(values)}; pass as many"
        )
    return list(values)


def boxes_of(boxes: Detections | FrameBoxes | ArrayLike, name: str = "boxes") -> NDArray[Any]:
    """Boxes of detections, of labels that are not ignored, or as they are."""
    if isinstance(boxes, Detections):
        return boxes.boxes
    if isinstance(boxes, FrameBoxes):
        return boxes.boxes[~boxes.ignore]
    return check_boxes(boxes, name)


def put_image(ax: Axes, image: NDArray[Any], title: str = "", *, ticks: bool = False, **options: Any) -> None:
    """Show a picture so that the half-open pixels of boxes are the panel's coordinates.

    With `ticks` the axes count pixels, without them there are none.
    """
    height, width = image.shape[:2]
    if image.ndim == 2:
        options.setdefault("cmap", "gray")
    if max(height, width) <= _PIXELATED:
        options.setdefault("interpolation", "nearest")
    ax.imshow(image, extent=(0, width, height, 0), **options)
    if title:
        ax.set_title(title, fontsize=9)
    if ticks:
        ax.set_xlabel("x (px)")
        ax.set_ylabel("y (px)")
    else:
        ax.set_xticks([])
        ax.set_yticks([])


def outline(boxes: NDArray[Any]) -> NDArray[np.float64]:
    """Corners of boxes as closed lines, ``(N, 5, 2)`` float64."""
    corners = np.asarray(boxes, np.float64)[:, [0, 1, 2, 1, 2, 3, 0, 3, 0, 1]]
    return corners.reshape(-1, 5, 2)


def put_boxes(
    ax: Axes, boxes: NDArray[Any], color: Any = None, *, halo: bool = True, **options: Any
) -> LineCollection:
    """Draw boxes as one collection of lines, each with a thin dark edge so that any ground will do."""
    from matplotlib.collections import LineCollection
    from matplotlib.patheffects import withStroke

    width = options.setdefault("linewidths", 1.6)
    lines = LineCollection(list(outline(boxes)), colors=color, **options)
    if halo:
        lines.set_path_effects([withStroke(linewidth=width + 1.2, foreground="black", alpha=0.5)])
    ax.add_collection(lines, autolim=False)
    return lines


def spread(count: int, wanted: int) -> NDArray[np.intp]:
    """Row numbers of `wanted` out of `count`, evenly spread; all where there are no more."""
    if count <= wanted:
        return np.arange(count)
    return np.linspace(0, count - 1, wanted).round().astype(np.intp)


def tile_axes(ax: Axes | None, count: int, columns: int, *, inches: float, lines: int) -> Axes:
    """Axes for tiles of this size, with so many lines of caption under each."""
    rows = math.ceil(count / columns)
    axes = new_axes(ax, max(3.5, columns * inches + 0.1), rows * (inches + 0.17 * lines) + 0.35)
    axes.set_axis_off()
    axes.set_aspect("equal")
    pitch = _pitch(inches, lines)
    axes.set_xlim(-0.02, columns + 0.02)
    axes.set_ylim(rows * pitch, -0.02)
    return axes


def _pitch(inches: float, lines: int) -> float:
    """Height of a tile with its caption, where its width is 1."""
    return (inches + 0.17 * lines) / inches


def put_tiles(
    ax: Axes,
    images: Sequence[NDArray[Any]],
    captions: Sequence[str],
    colors: Sequence[Any],
    columns: int,
    *,
    inches: float,
    lines: int,
) -> list[tuple[float, float, float]]:
    """Draw pictures on a grid, captions under them, edges in `colors` (None: no edge).

    Returns
    -------
    list of tuple
        Left and top of each picture, and the size of its pixel, in the coordinates of the axes.
    """
    places = []
    pitch = _pitch(inches, lines)
    for index, (image, caption, color) in enumerate(zip(images, captions, colors)):
        height, width = image.shape[:2]
        pixel = 0.94 / max(height, width)
        left = index % columns + (1 - width * pixel) / 2
        top = index // columns * pitch + (1 - height * pixel) / 2
        # Pictures of a grid are drawn on one panel: dozens of panels take seconds.
        ax.imshow(
            image,
            extent=(left, left + width * pixel, top + height * pixel, top),
            interpolation="nearest" if max(height, width) <= _PIXELATED else None,
            cmap="gray" if image.ndim == 2 else None,
        )
        if color is not None:
            box = np.array([[left, top, left + width * pixel, top + height * pixel]])
            put_boxes(ax, box, color, halo=False, linewidths=2.0)
        if caption:
            middle = index % columns + 0.5
            ax.text(middle, index // columns * pitch + 1.0, caption, ha="center", va="top", fontsize=7)
        places.append((left, top, pixel))
    # imshow takes the limits of its own picture.
    ax.set_xlim(-0.02, columns + 0.02)
    ax.set_ylim(math.ceil(len(images) / columns) * pitch, -0.02)
    return places
