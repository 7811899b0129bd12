"""Helpers shared by all figures: figures and axes, colors, images, boxes and grids of tiles."""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check, invalid
from vehicle_detection.boxes import Detections
from vehicle_detection.drawing import TRACK_COLORS
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tables import TrackTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D

FigureLike: TypeAlias = Union["Figure", "SubFigure"]
Image = NDArray[np.uint8]
Boxes = Detections | TrackTable | ArrayLike
Color = tuple[float, float, float]

COLORS: tuple[Color, ...] = tuple((r / 255, g / 255, b / 255) for r, g, b in TRACK_COLORS)
"""The track colors (Okabe and Ito), as RGB in [0, 1]."""

_, SKY, _, YELLOW, BLUE, VERMILION, _ = COLORS
VEHICLE, OTHER = VERMILION, BLUE
TRUTH = (1.0, 1.0, 1.0)
LINESTYLES = ("-", "--", "-.", ":")

# Images whose longer side has at most this many pixels are shown without interpolation.
_MAX_PIXELATED = 200


@functools.cache
def _notebook_figure_class() -> type[Figure]:
    from matplotlib.figure import Figure

    class NotebookFigure(Figure):
        """A figure that pyplot does not manage, but that a notebook displays as the value of a cell."""

        def _repr_png_(self) -> bytes:
            png = io.BytesIO()
            self.savefig(png, format="png", dpi=100, bbox_inches="tight")
            return png.getvalue()

    return NotebookFigure


def new_panels(
    figure: FigureLike | None,
    size: tuple[float, float],
    rows: int,
    columns: int,
    *,
    count: int | None = None,
    layout: Literal["constrained", "compressed"] = "constrained",
    sharex: bool = False,
) -> tuple[FigureLike, NDArray[Any]]:
    """Create ``(rows, columns)`` Axes, the first `count` visible, in `figure` or a new one (inches)."""
    from matplotlib.figure import FigureBase

    if figure is None:
        figure = _notebook_figure_class()(figsize=size, layout=layout)
    check.instance(figure, "figure", FigureBase, "pass a Figure, a SubFigure, or None for a new figure")
    grid = np.asarray(figure.subplots(rows, columns, squeeze=False, sharex=sharex))
    for unused in grid.flat[grid.size if count is None else count :]:
        unused.remove()
    return figure, grid


def new_axes(ax: Axes | None, width: float = 7.0, height: float = 4.5) -> Axes:
    """Return `ax`, or the Axes of a new pyplot figure (size in inches)."""
    from matplotlib.axes import Axes as AxesClass

    if ax is None:
        import matplotlib.pyplot as plt

        ax = plt.subplots(figsize=(width, height), layout="constrained")[1]
    check.instance(ax, "ax", AxesClass, "pass matplotlib Axes, or None for a new figure")
    return ax


def legend_above(axes: Axes, columns: int = 1, *, fontsize: int = 9) -> Legend:
    """Place the legend centered above the Axes."""
    return axes.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=columns, fontsize=fontsize, frameon=False
    )


def legend_lines(*entries: tuple[str, Any, Any]) -> list[Line2D]:
    """Legend handles from (label, color, line style)."""
    from matplotlib.lines import Line2D

    return [Line2D([], [], color=color, linestyle=style, label=label) for label, color, style in entries]


def check_displayable(image: object, name: str) -> NDArray[Any]:
    """Return an ``(H, W, 3)`` uint8 RGB image or a non-empty ``(H, W)`` array of numbers."""
    if isinstance(image, np.ndarray) and image.ndim == 2 and image.size and image.dtype.kind in "iufb":
        return image
    return check.image(image, name)


def check_list(values: object, name: str, kind: str) -> list[Any]:
    """Return `values` as a list with at least one entry; `kind` names the entries in the message."""
    single = isinstance(values, (str, bytes)) or (isinstance(values, np.ndarray) and values.ndim < 4)
    listed = list(values) if isinstance(values, Iterable) and not single else []
    if not listed:
        raise invalid(name, f"be a list of {kind}, at least one", values, "wrap a single one in a list")
    return listed


def check_length(values: object, name: str, count: int, entries: str) -> list[Any]:
    """Return `values` as a list of `count` entries; None stands for `count` times None."""
    if values is None:
        return [None] * count
    listed = list(check.sequence(values, name, "values"))
    if len(listed) != count:
        raise InvalidInputError(
            f"{name} must have one value for each of the {count} {entries}, got {len(listed)}"
        )
    return listed


def split_titles(images: object, titles: Sequence[str] | None = None) -> tuple[list[Any], list[Any]]:
    """List of images, and a title or None for each: from `titles` or the keys of a mapping."""
    if isinstance(images, Mapping):
        titles, images = list(images) if titles is None else titles, images.values()
    listed = check_list(images, "images", "images")
    texts = check_length(titles, "titles", len(listed), "images")
    return listed, [None if text is None else str(text) for text in texts]


def box_array(boxes: Boxes, name: str = "boxes") -> NDArray[Any]:
    """Boxes as ``(N, 4)``; ignored boxes of `TrackTable` are left out."""
    if isinstance(boxes, Detections):
        return boxes.boxes
    if isinstance(boxes, TrackTable):
        return np.asarray(boxes.boxes[~boxes["ignore"]])
    return check.boxes(boxes, name)


def add_image(ax: Axes, image: NDArray[Any], title: str = "", **options: Any) -> None:
    """Show an image, by default with half-open pixels as coordinates; `options` are those of ``imshow``."""
    height, width = image.shape[:2]
    options.setdefault("extent", (0, width, height, 0))
    if image.ndim == 2:
        options.setdefault("cmap", "gray")
    if max(height, width) <= _MAX_PIXELATED:
        options.setdefault("interpolation", "nearest")
    ax.imshow(image, **options)
    if title:
        ax.set_title(title, fontsize=9)
    ax.set(xticks=[], yticks=[])


def add_boxes(
    ax: Axes, boxes: ArrayLike, color: Any = None, *, halo: bool = True, **options: Any
) -> LineCollection:
    """Draw ``(N, 4)`` boxes as one line collection; `halo` adds a dark edge for contrast."""
    from matplotlib.collections import LineCollection
    from matplotlib.patheffects import withStroke

    width = options.setdefault("linewidths", 1.6)
    corners = np.asarray(boxes, np.float64)[:, [0, 1, 2, 1, 2, 3, 0, 3, 0, 1]].reshape(-1, 5, 2)
    lines = LineCollection(list(corners), colors=color, **options)
    if halo:
        lines.set_path_effects([withStroke(linewidth=width + 1.2, foreground="black", alpha=0.5)])
    ax.add_collection(lines, autolim=False)
    return lines


def add_tiles(
    ax: Axes | None,
    tiles: Sequence[tuple[NDArray[Any] | None, str]],
    *,
    columns: int,
    inches: float,
    caption_lines: int = 1,
    colors: Sequence[Any] | None = None,
) -> tuple[Axes, list[tuple[float, float, float]]]:
    """Draw images with captions below on a grid in one Axes; None leaves a tile empty.

    `colors` draws an edge around each image. Returns the Axes, and for each image its left and top and the
    size of a pixel in data coordinates.
    """
    columns = max(min(check.integer(columns, "columns", low=1, high=100), len(tiles)), 1)
    rows = max(math.ceil(len(tiles) / columns), 1)
    # Height of a tile with its caption; its width is 1.
    pitch = (inches + 0.17 * caption_lines) / inches
    axes = new_axes(ax, max(3.5, columns * inches + 0.1), rows * pitch * inches + 0.35)
    axes.set_axis_off()
    axes.set_aspect("equal")
    places = []
    for index, (image, caption) in enumerate(tiles):
        if image is None:
            continue
        row, column = divmod(index, columns)
        height, width = image.shape[:2]
        pixel = 0.94 / max(height, width)
        left = column + (1 - width * pixel) / 2
        top = row * pitch + (1 - height * pixel) / 2
        right, bottom = left + width * pixel, top + height * pixel
        # All images share one Axes: creating dozens of Axes takes seconds.
        add_image(axes, image, extent=(left, right, bottom, top))
        if colors:
            add_boxes(axes, [[left, top, right, bottom]], colors[index], halo=False, linewidths=2.0)
        if caption:
            axes.text(column + 0.5, row * pitch + 1.0, caption, ha="center", va="top", fontsize=7)
        places.append((left, top, pixel))
    # imshow changes the limits to those of its image.
    axes.set_xlim(-0.02, columns + 0.02)
    axes.set_ylim(rows * pitch, -0.02)
    return axes, places
