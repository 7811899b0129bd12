"""Text of counts and names."""

from __future__ import annotations

import re


def pluralize(count: int, noun: str, ending: str = "s") -> str:
    """Format a count with its noun: "1 vehicle", "1,200 frames"."""
    return f"{count:,} {noun}{ending * (count != 1)}"


def natural_key(name: str) -> tuple[list[object], str]:
    """Sort key that puts ``image2`` before ``image10``."""
    parts = re.split(r"([0-9]+)", name)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], name


def encodable(text: str) -> str:
    r"""Return text that UTF-8 can encode: other bytes of a file name become ``\udcff`` and the like."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
