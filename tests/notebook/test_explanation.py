"""Figures of explanations."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.notebook.helpers import gray_image, texts, titles
from vehicle_detection.drawing import draw_cell_shares
from vehicle_detection.evaluation import Explanation
from vehicle_detection.notebook import plot_explanation

CELLS = np.array([[0.5, -1.0, 0.0], [0.25, 0.0, 1.0]])


def explanation(**options):
    values = {"box": np.array([20.0, 30, 60, 60]), "found": True, "window": np.array([10.0, 20, 70, 60])}
    values |= {"cells": CELLS, "terms": {"cells": 0.75, "bias": -0.5, "color histogram": 0.2}}
    return Explanation(**(values | {"score": 1.25} | options))


def test_cells_and_terms_are_drawn():
    figure = plot_explanation(gray_image(), explanation())
    assert titles(figure) == ["score 1.25", "share of each cell, orange: for a vehicle", "margin 0.45"]
    shown = figure.axes[1].images[0].get_array()
    np.testing.assert_array_equal(shown, draw_cell_shares(gray_image(), [10, 20, 70, 60], CELLS))
    bars = figure.axes[2].patches
    assert [bar.get_x() for bar in bars] == pytest.approx([0, 0.75, 0.25])
    assert [bar.get_width() for bar in bars] == pytest.approx([0.75, -0.5, 0.2])
    assert texts(figure.axes[2].get_yticklabels()) == ["cells", "bias", "color histogram"]
    # The line of the margin is behind the numbers.
    (line, *_), numbers = figure.axes[2].lines, figure.axes[2].texts
    assert all(number.get_bbox_patch() and number.get_zorder() > line.get_zorder() for number in numbers)
    low, high = figure.axes[2].get_xlim()
    assert low < 0
    assert high > 0.75


def test_a_given_figure_is_used_and_nothing_found_is_said():
    figure = Figure()
    empty = explanation(score=None, found=False, cells=np.zeros((2, 3)), terms={"cells": 0.0})
    assert plot_explanation(gray_image(), empty, figure=figure) is figure
    assert titles(figure)[0] == "not found"
