"""Text of times, counts, parameter values and SVG elements."""

from __future__ import annotations

import html
from collections.abc import Mapping


def format_time(seconds: float, *, tenths: bool = True) -> str:
    """Format a time of a video, such as "0:03.2" or "1:02:06"."""
    total = round(seconds, 1 if tenths else 0)
    minutes, rest = divmod(total, 60)
    hours, minutes = divmod(int(minutes), 60)
    end = f"{rest:04.1f}" if tenths else f"{int(rest):02d}"
    return f"{hours}:{minutes:02d}:{end}" if hours else f"{minutes}:{end}"


def format_value(value: object) -> str:
    """Format a parameter or a value of a model's metadata."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}".replace("-", "\N{MINUS SIGN}")
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {format_value(each)}" for key, each in value.items())
    if isinstance(value, (tuple, list)):
        return ", ".join(map(format_value, value))
    return str(value)


def svg_element(name: str, *content: str, **attributes: object) -> str:
    """Write an SVG element around `content` (markup); attributes are escaped, underscores are hyphens."""
    pairs = (
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(str(value))}"'
        for key, value in attributes.items()
    )
    return f"<{name}{''.join(pairs)}>{''.join(content)}</{name}>"
