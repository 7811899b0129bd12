"""Compiled numba kernels: HOG, color, correlation and the SVM solver.

Names are listed in ``__init__.pyi`` and imported on first use, because numba takes a second.
"""

import lazy_loader

import vehicle_detection._common  # noqa: F401 - checks the environment variables of numba first

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
