"""Classical vehicle detection and tracking in dash-cam images and video.

Public names are listed in ``__init__.pyi`` and imported on first use, so importing the package is fast.
"""

import lazy_loader

__version__ = "0.1.0"

_load, _, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    try:
        return _load(name)
    except AttributeError:
        if name in __all__ or name.startswith("_"):
            raise
        import difflib

        names = {each.lower().replace("_", ""): each for each in __all__}
        close = difflib.get_close_matches(name.lower().replace("_", ""), names, n=1)
        hint = f"; did you mean {names[close[0]]}?" if close else ""
        raise AttributeError(f"No vehicle_detection attribute {name}{hint}") from None


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
