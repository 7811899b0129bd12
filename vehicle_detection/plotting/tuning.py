"""Figures of the testing system: what a configuration reaches, and what it costs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehicle_detection.errors import InvalidInputError
from vehicle_detection.plotting.style import line_looks, new_axes
from vehicle_detection.tuning import ResultTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Greatest over least value from which a scale is logarithmic.
_WIDE = 20
# Letters that fit side by side under the x axis.
_ROOM = 60


def plot_tradeoff(
    table: ResultTable,
    *,
    quality: str = "accuracy",
    cost: str = "search_ms",
    label: str | None = "configuration",
    ax: Axes | None = None,
) -> Axes:
    """Plot what each configuration reaches against what it costs, and mark the best front.

    Parameters
    ----------
    table
        Rows of `compare_configurations` or `search_parameters`; those without either value are left out.
    quality
        Column of the y axis; more is better.
    cost
        Column of the x axis; less is better.
    label
        Column written beside the points of the front; None writes nothing.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        Its first collection holds all points; its first line is the front, cheapest first: no other point
        is better in one of the two without being worse in the other.

    Raises
    ------
    InvalidInputError
        If no row has both values, or a column does not exist.

    Examples
    --------
    >>> table = ResultTable([{"accuracy": 0.98, "search_ms": 4.0}, {"accuracy": 0.99, "search_ms": 9.0}])
    >>> plot_tradeoff(table, label=None).get_xlabel()
    'search ms'
    """
    front = table.front(quality, cost)
    if not len(front):
        raise InvalidInputError(f"table has no row with both {quality} and {cost}; measure them first")
    axes = new_axes(ax)
    x, y = table.numbers(cost), table.numbers(quality)
    shown = ~np.isnan(x) & ~np.isnan(y)
    axes.scatter(x[shown], y[shown], s=24, color="0.6", label="measured", zorder=2)
    axes.plot(front.numbers(cost), front.numbers(quality), "o-", color="C0", label="best front", zorder=3)
    if label is not None:
        for row in front:
            place = (row[cost], row[quality])
            axes.annotate(str(row.get(label)), place, (4, 6), textcoords="offset points", fontsize=8)
    axes.set_xlabel(cost.replace("_", " "))
    axes.set_ylabel(quality.replace("_", " "))
    axes.margins(0.12)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    return axes


def plot_parameter(
    table: ResultTable,
    parameter: str,
    *,
    quality: str = "accuracy",
    by: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot what a parameter does: the mean of a measurement for each of its values.

    Parameters
    ----------
    table
        Rows of `compare_configurations` or `search_parameters`; those without a measurement are left out.
    parameter
        Column of the x axis, such as ``"C"`` or ``"orient"``.
    quality
        Column of the y axis, a measurement.
    by
        A column that parts the rows into lines, such as ``"split"``; None draws one.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        One line for each value of `by`. The bars at its points are the standard deviation over the rows
        that agree in `parameter` and `by`. Numbers that span more than a factor of 20 are on a
        logarithmic scale; what holds more than numbers, at even distances.

    Raises
    ------
    InvalidInputError
        If a column does not exist, or no row was measured.

    Examples
    --------
    >>> table = ResultTable([{"C": 1e-4, "accuracy": 0.99}, {"C": 1.0, "accuracy": 0.98}])
    >>> plot_parameter(table, "C").get_xscale()
    'log'
    """
    keys = [parameter] if by is None else [by, parameter]
    means = table.summarize(keys, [quality])
    means = ResultTable([row for row in means if row.get(parameter) is not None])
    if not len(means):
        raise InvalidInputError(f"table has no row with both {parameter} and {quality}; measure them first")
    axes = new_axes(ax)
    values = means.column(parameter)
    numeric = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
    listed = sorted(set(values)) if numeric else list(dict.fromkeys(values))
    place = {value: value if numeric else index for index, value in enumerate(listed)}
    groups: dict[Any, list[Any]] = {}
    for row in means:
        groups.setdefault(None if by is None else row[by], []).append(row)
    for (name, rows), (color, dash) in zip(groups.items(), line_looks()):
        ordered = sorted(rows, key=lambda row: place[row[parameter]])
        axes.errorbar(
            [place[row[parameter]] for row in ordered],
            [row[quality] for row in ordered],
            yerr=[row[f"{quality}_std"] or np.nan for row in ordered],
            fmt="o",
            linestyle=dash,
            color=color,
            capsize=3,
            markersize=4,
            label=None if by is None else str(name),
        )
    if not numeric:
        texts = [str(value) for value in listed]
        axes.set_xticks(range(len(listed)), texts)
        if max(map(len, texts)) * len(texts) > _ROOM:
            axes.tick_params(axis="x", rotation=30)
            for label in axes.get_xticklabels():
                label.set_horizontalalignment("right")
    elif listed[0] > 0 and listed[-1] > _WIDE * listed[0]:
        axes.set_xscale("log")
    axes.set_xlabel(parameter.replace("_", " "))
    axes.set_ylabel(quality.replace("_", " "))
    axes.grid(alpha=0.3)
    if by is not None:
        axes.legend(title=by.replace("_", " "), fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    return axes
