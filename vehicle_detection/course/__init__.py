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

from typing import Any

import cv2 as cv2
import lazy_loader
import numpy as np

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ = [*__all__, "cv2", "hog", "mpimg", "np"]


def __getattr__(name: str) -> Any:
    if name == "mpimg":
        from matplotlib import image

        return image
    if name == "hog":
        from skimage.feature import hog

        return hog
    return _load(name)
