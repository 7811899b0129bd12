"""HTML and SVG as text: elements whose texts and attributes are escaped in this one place."""

from __future__ import annotations

import html
import os
from collections.abc import Iterable, Mapping, Sequence

_VOID = {"link", "meta", "source"}


def text(value: object) -> str:
    """Escape a value for HTML; what UTF-8 cannot hold, as in the name of a file, becomes a question mark."""
    plain = str(value).encode("utf-8", "replace").decode("utf-8")
    return html.escape(plain)


def tag(name: str, *content: str, **attributes: object) -> str:
    """Write an element.

    Parameters
    ----------
    name
        Its name.
    *content
        What it holds: HTML, already escaped.
    **attributes
        Values of any kind, escaped here; None leaves one out and True writes its name alone. A trailing
        underscore keeps clear of Python's words, others become hyphens.

    Examples
    --------
    >>> tag("p", text("a < b"), class_="note", aria_label='say "hi"')
    '<p class="note" aria-label="say &quot;hi&quot;">a &lt; b</p>'
    >>> tag("video", controls=True, poster=None)
    '<video controls></video>'
    """
    words = [name]
    for key, value in attributes.items():
        label = key.rstrip("_").replace("_", "-")
        if value is True:
            words.append(label)
        elif value is not None:
            words.append(f'{label}="{text(value)}"')
    start = f"<{' '.join(words)}>"
    return start if name in _VOID else f"{start}{''.join(content)}</{name}>"


def file_name(path: str | os.PathLike[str]) -> str:
    """Write the name of a file; letters that turn the direction of writing stay inside it."""
    return tag("bdi", text(os.path.basename(path)))


def facts(values: Mapping[str, str], *, class_: str = "facts") -> str:
    """Write names and values (HTML) side by side."""
    rows = (tag("div", tag("dt", text(name)), tag("dd", value)) for name, value in values.items())
    return tag("dl", *rows, class_=class_)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], *, label: str, id_: str | None = None) -> str:
    """Write a table of HTML cells, of which the first of a row is its head; it scrolls if it is too large."""
    head = tag("tr", *(tag("th", text(name), scope="col") for name in heads))
    body = (tag("tr", tag("th", row[0], scope="row"), *(tag("td", cell) for cell in row[1:])) for row in rows)
    whole = tag("table", tag("thead", head), tag("tbody", *body), id_=id_)
    return tag("div", whole, class_="scroll", role="region", aria_label=label, tabindex=0)


def clock(seconds: float, *, tenths: bool = True) -> str:
    """Write a time of a video.

    Examples
    --------
    >>> clock(3.24), clock(75, tenths=False), clock(3725.96)
    ('0:03.2', '1:15', '1:02:06.0')
    """
    whole = round(seconds, 1 if tenths else 0)
    minutes, rest = divmod(whole, 60)
    hours, minutes = divmod(int(minutes), 60)
    end = f"{rest:04.1f}" if tenths else f"{int(rest):02d}"
    return f"{hours}:{minutes:02d}:{end}" if hours else f"{minutes}:{end}"


def amount(count: int, noun: str) -> str:
    """Write a number of things.

    Examples
    --------
    >>> amount(1, "vehicle"), amount(1200, "frame")
    ('1 vehicle', '1,200 frames')
    """
    return f"{count:,} {noun}{'s' * (count != 1)}"
