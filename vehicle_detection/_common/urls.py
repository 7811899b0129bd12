"""URLs among paths, and messages without their passwords."""

from __future__ import annotations

import re

_URL = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+://")
# A password may hold an "@": the host begins after the last one.
_CREDENTIALS = re.compile(r"(?<=://)[^\s/?#]*@")


def is_url(text: str) -> bool:
    """Whether a text is a URL rather than a path."""
    return _URL.match(text) is not None


def hide_credentials(text: str) -> str:
    """Replace the user and password of each URL in a text by ``***``."""
    return _CREDENTIALS.sub("***@", text)
