import matplotlib.pyplot as plt
from matplotlib.figure import Figure, SubFigure

from tests.notebook.helpers import gray_image, new_axes
from vehicle_detection import notebook


def test_figures_of_several_panels_are_not_managed_by_pyplot():
    figure = notebook.show_images([gray_image()])
    assert not plt.get_fignums()
    assert figure._repr_png_().startswith(b"\x89PNG")
    given = Figure()
    assert notebook.show_images([gray_image()], figure=given) is given
    left, right = given.subfigures(1, 2)
    assert isinstance(left, SubFigure)
    assert notebook.show_images([gray_image()], figure=right) is right


def test_a_single_panel_uses_the_given_axes_or_a_pyplot_figure():
    axes = new_axes()
    assert notebook.plot_patches([gray_image()], ax=axes) is axes
    assert not plt.get_fignums()
    own = notebook.plot_patches([gray_image()])
    assert plt.get_fignums() == [own.figure.number]
