"""Helpers to inspect figures."""

import numpy as np
from matplotlib.figure import Figure

from vehicle_detection.features import FeatureParams

SMALL = FeatureParams(spatial_size=8, hist_bins=8, orient=6, pix_per_cell=16)


def new_axes():
    return Figure().add_subplot()


def gray_image(height=90, width=160):
    return np.full((height, width, 3), 90, np.uint8)


def drawn_boxes(collection):
    """Boxes drawn by a line collection, ``(N, 4)``."""
    lines = np.array(collection.get_segments()).reshape(-1, 5, 2)
    return np.concatenate([lines.min(axis=1), lines.max(axis=1)], axis=1)


def texts(artists):
    return [artist.get_text() for artist in artists]


def titles(figure):
    return [axes.get_title() for axes in figure.axes]


def legend(axes):
    return texts(axes.get_legend().get_texts())
