"""The lesson functions of the course, for code that was written with them.

The course is project 5 of Udacity's Self-Driving Car Engineer Nanodegree
(https://github.com/udacity/CarND-Vehicle-Detection). After ``from vehicle_detection.course import *``, the
functions of its ``lesson_functions.py`` and of its HOG sub-sampling quiz, ``find_cars``, are available with
their argument order, defaults and return types. Options that the lesson does not have are keyword-only.

Images are ``(H, W, 3)`` RGB, uint8 or float, as in the lesson; windows and boxes are lists of corner pairs
``((x1, y1), (x2, y2))``. HOG is computed by the library's kernels. For uint8 images, the library's
`extract_features` computes the vectors, and its fast search runs any linear classifier of scikit-learn behind
a ``StandardScaler``. Everything else takes the lesson's own steps: features, ``scaler.transform``,
``clf.predict``. Both ways agree within float32 precision.

`vehicle_detection.course.reference` is the whole pipeline, to read. The names that ``lesson_functions.py``
imports are here as well: ``np``, ``cv2``, ``mpimg`` and ``hog``. The page ``docs/course.md`` lists the
differences from the lesson and counterparts in the main API.
"""

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehicle_detection.course.detector import HeatmapDetector, process_image
from vehicle_detection.course.features import (
    bin_spatial,
    color_hist,
    convert_color,
    extract_features,
    extract_features_all,
    get_hog_features,
    single_img_features,
)
from vehicle_detection.course.search import find_car_windows, find_cars, search_windows
from vehicle_detection.course.smoothing import Box, BoxSmoother, adjust_bbox
from vehicle_detection.course.versions import detect_versions, set_lesson_defaults
from vehicle_detection.course.windows import (
    add_heat,
    apply_threshold,
    bounding_boxes,
    draw_boxes,
    draw_labeled_bboxes,
    show_images,
    slide_window,
)

if TYPE_CHECKING:
    from matplotlib import image as mpimg
    from skimage.feature import hog

__all__ = [
    "Box",
    "BoxSmoother",
    "HeatmapDetector",
    "add_heat",
    "adjust_bbox",
    "apply_threshold",
    "bin_spatial",
    "bounding_boxes",
    "color_hist",
    "convert_color",
    "cv2",
    "detect_versions",
    "draw_boxes",
    "draw_labeled_bboxes",
    "extract_features",
    "extract_features_all",
    "find_car_windows",
    "find_cars",
    "get_hog_features",
    "hog",
    "mpimg",
    "np",
    "process_image",
    "search_windows",
    "set_lesson_defaults",
    "show_images",
    "single_img_features",
    "slide_window",
]


def __getattr__(name: str) -> Any:
    # Imported when they are used, because that takes long.
    if name == "mpimg":
        from matplotlib import image

        return image
    if name == "hog":
        from skimage.feature import hog

        return hog
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
