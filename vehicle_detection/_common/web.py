"""Files at web addresses."""

from __future__ import annotations

import time

from vehicle_detection._common.limits import Limit
from vehicle_detection._common.text import hide_credentials
from vehicle_detection.errors import InvalidInputError

# Seconds without an answer, and for the whole file.
_TIMEOUT, _DEADLINE = 10.0, 60.0
_CHUNK_BYTES = 1 << 16


def download_bytes(url: str, limit: Limit) -> bytes:
    """Return the content of a file of limited size at an ``http`` or ``https`` address."""
    import requests

    name, begun, data = hide_credentials(url), time.monotonic(), bytearray()
    if not url.lower().startswith(("http://", "https://")):
        raise InvalidInputError(f"URL {name} must begin with http:// or https://; download the file first")
    try:
        with requests.get(url, stream=True, timeout=_TIMEOUT) as answer:
            answer.raise_for_status()
            for chunk in answer.iter_content(_CHUNK_BYTES):
                data += chunk
                if len(data) > limit.current():
                    raise InvalidInputError(
                        f"URL {name} holds more than {limit.current():,} bytes; if it is meant to, set "
                        f"{limit.variable}"
                    )
                if time.monotonic() - begun > _DEADLINE:
                    raise InvalidInputError(
                        f"URL {name} takes more than {_DEADLINE:.0f} s; download the file first"
                    )
    except requests.RequestException as error:
        reason = hide_credentials(str(error))
        raise InvalidInputError(f"URL {name} cannot be read ({reason}); check the address") from None
    return bytes(data)
