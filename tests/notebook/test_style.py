import itertools

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure, SubFigure

from tests.notebook.helpers import gray_image, new_axes
from vehicle_detection import notebook
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.notebook.style import evenly_spaced, line_styles


def test_every_public_name_is_exported():
    assert sorted(notebook.__all__) == notebook.__all__
    for name in notebook.__all__:
        assert getattr(notebook, name).__name__ == name


def test_figures_of_several_panels_are_not_managed_by_pyplot():
    figure = notebook.show_images([gray_image()])
    assert not plt.get_fignums()
    assert figure._repr_png_().startswith(b"\x89PNG")
    given = Figure()
    assert notebook.show_images([gray_image()], figure=given) is given
    left, right = given.subfigures(1, 2)
    assert isinstance(left, SubFigure)
    assert notebook.plot_heatmap(gray_image(), Detections.empty(), figure=right) is right
    with pytest.raises(InvalidInputError, match="figure must be a FigureBase, got 3; pass a Figure"):
        notebook.show_images([gray_image()], figure=3)


def test_a_single_panel_uses_the_given_axes_or_a_pyplot_figure():
    axes = new_axes()
    assert notebook.plot_windows(gray_image(), [[1, 2, 30, 40]], ax=axes) is axes
    assert not plt.get_fignums()
    own = notebook.plot_windows(gray_image(), [[1, 2, 30, 40]])
    assert plt.get_fignums() == [own.figure.number]
    with pytest.raises(InvalidInputError, match="ax must be an Axes, got 'here'"):
        notebook.plot_windows(gray_image(), [], ax="here")


def test_inputs_are_not_modified(patch_set):
    image, windows = gray_image(), Detections([[0.0, 0, 64, 64]], [1.0])
    before = image.copy(), windows.boxes.copy(), patch_set.fingerprint
    notebook.plot_heatmap(image, windows)
    notebook.plot_windows(image, windows, ax=new_axes())
    notebook.plot_patches(patch_set, ax=new_axes())
    np.testing.assert_array_equal(image, before[0])
    np.testing.assert_array_equal(windows.boxes, before[1])
    assert patch_set.fingerprint == before[2]


@given(count=st.integers(0, 300), max_rows=st.integers(1, 50))
def test_chosen_rows_are_evenly_spaced(count, max_rows):
    rows = evenly_spaced(count, max_rows)
    assert len(rows) == min(count, max_rows)
    assert len(set(rows.tolist())) == len(rows)
    if count > max_rows > 1:
        assert (rows[0], rows[-1]) == (0, count - 1)


def test_line_styles_repeat_only_after_all_combinations():
    styles = list(itertools.islice(line_styles(), 25))
    assert len(set(styles)) == 24
    assert styles[24] == styles[0]
