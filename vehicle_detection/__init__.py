"""Classical vehicle detection and tracking in dash-cam images and video.

Public names are listed in ``__init__.pyi`` and imported on first use, so importing the package is fast.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, _, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
