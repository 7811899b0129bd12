"""Parameter classes: their fields declare what they accept, and `Checked` checks them all.

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
from collections.abc import Callable, Collection
from dataclasses import MISSING, dataclass
from typing import Any

from vehicle_detection._common import check


def number(default: Any = MISSING, **bounds: float) -> Any:
    """Declare a number in ``[low, high]`` that is greater than `above`."""

    def convert(value: Any, name: str) -> float:
        found = check.number(value, name, **bounds)
        return value if type(value) in (int, float) else found  # a number of NumPy becomes a float

    return checked_field(default, convert)


def integer(default: Any = MISSING, *, low: int, high: int | None = None) -> Any:
    """Declare an integer in ``[low, high]``."""
    return checked_field(default, lambda value, name: check.integer(value, name, low=low, high=high))


def flag(default: bool) -> Any:
    """Declare True or False."""
    return checked_field(default, check.boolean)


def choice(default: Any, choices: Collection[Any]) -> Any:
    """Declare one of several values."""
    return checked_field(default, lambda value, name: check.choice(value, name, choices))


def checked_field(default: Any, convert: Callable[[Any, str], Any]) -> Any:
    """Declare a field with the value of ``convert(value, name)``; None passes if it is the default."""
    return dataclasses.field(default=default, metadata={"check": convert})


@dataclass(frozen=True, kw_only=True)
class Checked:
    """Base of the parameter classes: frozen, and checked when they are made."""

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):
            value = getattr(self, each.name)
            if "check" in each.metadata and not (value is None and each.default is None):
                object.__setattr__(self, each.name, each.metadata["check"](value, each.name))
