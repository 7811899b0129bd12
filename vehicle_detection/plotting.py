"""Figures with matplotlib; every function takes ``ax=None`` and returns the Axes it drew on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tuning import ResultTable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_tradeoff"]


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
    axes: Axes = _axes(ax)
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


def _axes(ax: Any) -> Any:
    """Return the given Axes, or those of a new figure."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=(7, 4.5), layout="constrained")[1]
