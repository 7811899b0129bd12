import typing

import cv2 as cv2
import numpy as np  # noqa: F401

from .detector import HeatmapDetector as HeatmapDetector
from .detector import process_image as process_image
from .features import bin_spatial as bin_spatial
from .features import color_hist as color_hist
from .features import convert_color as convert_color
from .features import extract_features as extract_features
from .features import extract_features_all as extract_features_all
from .features import get_hog_features as get_hog_features
from .features import single_img_features as single_img_features
from .search import find_car_windows as find_car_windows
from .search import find_cars as find_cars
from .search import search_windows as search_windows
from .smoothing import Box as Box
from .smoothing import BoxSmoother as BoxSmoother
from .smoothing import adjust_bbox as adjust_bbox
from .versions import detect_versions as detect_versions
from .versions import set_lesson_defaults as set_lesson_defaults
from .windows import add_heat as add_heat
from .windows import apply_threshold as apply_threshold
from .windows import bounding_boxes as bounding_boxes
from .windows import draw_boxes as draw_boxes
from .windows import draw_labeled_bboxes as draw_labeled_bboxes
from .windows import show_images as show_images
from .windows import slide_window as slide_window

__all__: list[str]

hog: typing.Any
mpimg: typing.Any
