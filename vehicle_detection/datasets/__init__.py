"""Training patches and frames: reading, download, splits and near duplicates; and files of tracks and labels.

Names are listed in ``__init__.pyi`` and imported on first use, as those of the package.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
