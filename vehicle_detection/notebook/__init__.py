"""Figures with matplotlib, and the explorer of a search with sliders.

A function that draws one panel has the parameter ``ax=None`` and returns the Axes; None creates a pyplot
figure, which ``plt.show()`` or a notebook displays. A function that draws several panels has the parameter
``figure=None`` (a Figure or SubFigure) and returns the figure; None creates one that pyplot does not manage:
a notebook displays it as the value of a cell, and ``savefig`` writes it. No state is kept between calls.
All of them raise `InvalidInputError` if an argument is malformed or there is nothing to draw.

Colors are those of Okabe and Ito, which are safe for color-blind readers, and matplotlib's perceptually
uniform colormaps.
"""

from __future__ import annotations

from vehicle_detection.notebook.explorer import Explorer
from vehicle_detection.notebook.features import (
    plot_channels,
    plot_explanation,
    plot_features,
    plot_hog,
    plot_weights,
)
from vehicle_detection.notebook.images import (
    ImageDescription,
    describe_image,
    plot_balance,
    plot_methods,
    plot_near_duplicates,
    plot_patches,
    show_images,
)
from vehicle_detection.notebook.quality import (
    plot_errors,
    plot_f1,
    plot_parameter,
    plot_precision_recall,
    plot_scores,
    plot_tradeoff,
)
from vehicle_detection.notebook.search import (
    plot_bands,
    plot_comparison,
    plot_heatmap,
    plot_speedups,
    plot_windows,
)
from vehicle_detection.notebook.tracks import plot_birds_eye, plot_stage_times, plot_tracks

__all__ = [
    "Explorer",
    "ImageDescription",
    "describe_image",
    "plot_balance",
    "plot_bands",
    "plot_birds_eye",
    "plot_channels",
    "plot_comparison",
    "plot_errors",
    "plot_explanation",
    "plot_f1",
    "plot_features",
    "plot_heatmap",
    "plot_hog",
    "plot_methods",
    "plot_near_duplicates",
    "plot_parameter",
    "plot_patches",
    "plot_precision_recall",
    "plot_scores",
    "plot_speedups",
    "plot_stage_times",
    "plot_tracks",
    "plot_tradeoff",
    "plot_weights",
    "plot_windows",
    "show_images",
]
