"""Figures with matplotlib, of what the other rooms hand out; the drawing itself is done in ``_plot_*``.

A function that draws one panel takes ``ax=None`` and returns the Axes; None makes a figure of pyplot's, which
``plt.show()`` and a notebook's cell show. A function that draws several takes ``figure=None``, a Figure or
SubFigure, and returns it; None makes a figure that pyplot does not keep: a notebook shows it as the value of
its cell, and ``savefig`` writes it. Nothing else is kept from one call to the next.

The colors are Okabe and Ito's, which stay apart for color-blind eyes, and matplotlib's perceptually
uniform maps.
"""

from __future__ import annotations

from vehicle_detection.plotting.features import plot_channels, plot_features, plot_hog
from vehicle_detection.plotting.images import ImageFacts, describe_image, plot_methods, show_images
from vehicle_detection.plotting.patches import plot_balance, plot_near_duplicates, plot_patches
from vehicle_detection.plotting.quality import (
    plot_errors,
    plot_f1,
    plot_parameter,
    plot_precision_recall,
    plot_tradeoff,
)
from vehicle_detection.plotting.search import (
    plot_bands,
    plot_comparison,
    plot_heatmap,
    plot_speedups,
    plot_windows,
)
from vehicle_detection.plotting.tracks import plot_stage_times, plot_tracks
from vehicle_detection.plotting.training import plot_scores, plot_split_scores, plot_weights

__all__ = [
    "ImageFacts",
    "describe_image",
    "plot_balance",
    "plot_bands",
    "plot_channels",
    "plot_comparison",
    "plot_errors",
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
    "plot_split_scores",
    "plot_stage_times",
    "plot_tracks",
    "plot_tradeoff",
    "plot_weights",
    "plot_windows",
    "show_images",
]
