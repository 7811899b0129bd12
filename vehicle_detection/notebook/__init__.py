"""Figures with matplotlib, and the explorer of a search with sliders.

A function that draws one panel has the parameter ``ax=None`` and returns the Axes; None creates a pyplot
figure, which ``plt.show()`` or a notebook displays. A function that draws several panels has the parameter
``figure=None`` (a Figure or SubFigure) and returns the figure; None creates one that pyplot does not manage:
a notebook displays it as the value of a cell, and ``savefig`` writes it. No state is kept between calls.
All of them raise `InvalidInputError` if an argument is malformed or there is nothing to draw.

Colors are those of Okabe and Ito, which are safe for color-blind readers, and matplotlib's perceptually
uniform colormaps. Names are listed in ``__init__.pyi`` and imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
