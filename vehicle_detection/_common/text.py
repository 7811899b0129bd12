"""Text of counts."""

from __future__ import annotations


def pluralize(count: int, noun: str) -> str:
    """Format a count with its noun: "1 vehicle", "1,200 frames"."""
    return f"{count:,} {noun}{'s' * (count != 1)}"
