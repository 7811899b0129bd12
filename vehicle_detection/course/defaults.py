"""Defaults in which published versions of the lesson functions differ, for the whole program."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

from vehicle_detection._common import check_choice, check_flags

Formula = Literal["old", "new"]
FORMULAS = ("old", "new")


@dataclasses.dataclass(frozen=True)
class _Defaults:
    transform_sqrt: bool = False
    formula: Formula = "old"


_defaults = _Defaults()


def set_lesson_defaults(*, transform_sqrt: bool | None = None, formula: Formula | None = None) -> None:
    """Set the defaults in which published versions of ``lesson_functions.py`` differ.

    They hold for all later calls in this process that do not pass the option. A `HeatmapDetector` keeps those
    of its construction. None leaves a default as it is.

    Parameters
    ----------
    transform_sqrt
        Default of all functions that compute HOG, initially False. True if your own file calls
        scikit-image's ``hog`` with ``transform_sqrt=True``, as most published ones do.
    formula
        Default of `slide_window`, initially ``"old"``. ``"new"`` if your own ``slide_window`` computes
        ``nx_buffer``. `find_cars` keeps its own default.

    Raises
    ------
    InvalidInputError
        If a value is invalid; no default changes then.

    Examples
    --------
    >>> import numpy as np
    >>> from vehicle_detection.course import slide_window
    >>> image = np.zeros((64, 128, 3), np.uint8)
    >>> set_lesson_defaults(formula="new")
    >>> len(slide_window(image, xy_overlap=(0.5, 0)))
    3
    >>> set_lesson_defaults(formula="old")
    """
    global _defaults
    given: dict[str, Any] = {}
    if transform_sqrt is not None:
        check_flags(transform_sqrt=transform_sqrt)
        given["transform_sqrt"] = bool(transform_sqrt)
    if formula is not None:
        check_choice(formula, "formula", FORMULAS)
        given["formula"] = formula
    _defaults = dataclasses.replace(_defaults, **given)


def or_default(value: Any, name: str) -> Any:
    """Return an option's value, or its default if it is None."""
    return getattr(_defaults, name) if value is None else value
