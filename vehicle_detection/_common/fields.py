"""Fields of parameter classes: each declares what it accepts, and `Checked` checks them all.

>>> @dataclass(frozen=True, kw_only=True)
... class Params(Checked):
...     size: int | None = integer(None, low=1)
...     overlap: float = number(0.5, low=0, high=1)
>>> Params(overlap=2)
Traceback (most recent call last):
vehicle_detection.errors.InvalidInputError: overlap must be a number, at least 0 and at most 1; got 2
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection
from dataclasses import MISSING, dataclass
from typing import Any

from vehicle_detection._common.checks import check_bool, check_choice, check_integer, check_number


def number(
    default: Any = MISSING,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    above: float = -math.inf,
    optional: bool = False,
) -> Any:
    """Declare a number in ``[low, high]`` that is greater than `above`; if `optional`, it may be None."""

    def check(value: Any, name: str) -> float | None:
        if optional and value is None:
            return None
        found = check_number(value, name, low=low, high=high, above=above)
        return value if type(value) in (int, float) else found  # a number of NumPy becomes a float

    return checked_field(default, check)


def integer(default: Any = MISSING, *, low: int, high: int | None = None) -> Any:
    """Declare an integer in ``[low, high]``."""
    return checked_field(default, lambda value, name: check_integer(value, name, low=low, high=high))


def flag(default: bool) -> Any:
    """Declare True or False."""
    return checked_field(default, check_bool)


def choice(default: Any, choices: Collection[Any]) -> Any:
    """Declare one of several values."""

    def check(value: Any, name: str) -> Any:
        check_choice(value, name, choices)
        return value

    return checked_field(default, check)


def checked_field(default: Any, check: Callable[[Any, str], Any]) -> Any:
    """Declare a field with the value of ``check(value, name)``; None passes if it is the default."""
    return dataclasses.field(default=default, metadata={"check": check})


@dataclass(frozen=True, kw_only=True)
class Checked:
    """Base of the parameter classes: frozen, and checked when they are made."""

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):
            value = getattr(self, each.name)
            if "check" in each.metadata and not (value is None and each.default is None):
                object.__setattr__(self, each.name, each.metadata["check"](value, each.name))
