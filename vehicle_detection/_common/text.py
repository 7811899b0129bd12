"""Text of counts and names."""

from __future__ import annotations


def pluralize(count: int, noun: str) -> str:
    """Format a count with its noun: "1 vehicle", "1,200 frames"."""
    return f"{count:,} {noun}{'s' * (count != 1)}"


def encodable(text: str) -> str:
    r"""Return text that UTF-8 can encode: other bytes of a file name become ``\udcff`` and the like."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
