"""Text of numbers, names, URLs and YAML: messages show URLs without their passwords and signatures."""

from __future__ import annotations

import math
import re
from typing import Any
from urllib.parse import unquote_plus

import numpy as np

from vehicle_detection._common.check import describe
from vehicle_detection.errors import DatasetError

_URL = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+://")
_FILE_URL = re.compile("file://(localhost(?=/))?", re.IGNORECASE)
# A user and a password, which may hold "@", "/", "#" and spaces: the host begins after the last "@".
_CREDENTIALS = re.compile(r"(?<=://)(?:[^\s/@:]*:(?!\d{1,5}(?!\d|\S*@))(?:(?!://)[^\n])*|[^\s/?#]*)@")
_PASSWORD = re.compile(r"(?<=://)([^\s/?#:@]*):[^\s/?#]*@")
# A parameter of a query or a fragment; punctuation after a value belongs to the sentence.
_PARAMETER = re.compile(r"(?<=[?&;#])([\w.~%\[\]-]+)=([^\s&;'\"<>]*[^\s&;'\"<>).,:])")
# Parameters that are no secrets. All others may be one: each camera and service has its own names.
_HARMLESS = re.compile(
    r"cam(era)?|ch(annel)?|(sub)?stream(type)?|subtype|page|part|track|segment|clip|file(name)?|name|path|type|format|codec"
    r"|mode|profile|quality|size|resolution|width|height|fps|(frame)?rate|timeout|latency|pkt_size|transport|overrun_nonfatal"
    r"|fifo_size|localaddr|ttl|version(id)?|date|day|start|end|from|to|t|time|v|x-amz-(algorithm|date|expires|signedheaders)"
    r"|expires|s[eprv]|response-.*",
    re.IGNORECASE,
)
# Values that are too short for a secret, such as numbers of channels.
_SHORT = re.compile(r"\d{1,2}|true|false|yes|no", re.IGNORECASE)
# Names and values in the path of a camera's URL: /user=admin_password=secret_channel=1.
_PATH = re.compile(
    r"(?<=[/_,;])([a-z-]*(?:user|login|pass|psw|pw|token|secret|auth|key|sig)[a-z-]*)=[^\s/?&'\"<>),;]*?"
    r"(?=_[a-z]+=|\.sdp|[\s/?&'\"<>),;]|$)",
    re.IGNORECASE,
)
# Parameters of URLs signed by S3, Google, CloudFront or Azure; a token may instead be what names a file.
_SIGNATURE = re.compile(
    r"x-(amz|goog)-.*|awsaccesskeyid|googleaccessid|expires|signature|key-pair-id|policy", re.IGNORECASE
)
_AZURE = re.compile(r"sig|s[eprstv]|srt|spr|sip|sdd|sk(oid|tid|[estv])|saoid|suoid|scid", re.IGNORECASE)


def parse_number(cell: Any, name: str, place: str) -> float:
    """Parse a finite number, an int where it is one."""
    try:
        if isinstance(cell, bool) or "_" in str(cell):  # Python reads 1_0 as 10
            raise ValueError
        # A float would round ids above 2**53, and so join two tracks.
        is_integer = isinstance(cell, (int, np.integer)) or str(cell).strip().isdecimal()
        value: float = int(cell) if is_integer else float(cell)
        finite = math.isfinite(value)
    except (TypeError, ValueError, OverflowError):
        value, finite = math.nan, False
    if not finite:
        hint = "; use a decimal point" if re.fullmatch(r"\s*-?\d+,\d+\s*", str(cell)) else ""
        raise DatasetError(f"{place}: {name} must be a finite number, got {describe(cell)}{hint}")
    return value


def parse_yaml(text: str) -> Any:
    """Parse the first document of YAML; a ValueError says what is wrong."""
    import yaml

    try:
        return next(yaml.safe_load_all(text), None)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    # PyYAML raises the latter two for a wrong text after a tag, such as ``!!bool of``.
    except (yaml.YAMLError, LookupError, AttributeError) as error:
        raise ValueError(" ".join(str(error).split())) from None


def is_url(text: str) -> bool:
    """Whether a text is a URL rather than a path."""
    return _URL.match(text) is not None


def is_web_address(text: str) -> bool:
    """Whether a text is the URL of a web server."""
    return text[:8].lower().startswith(("http://", "https://"))


def without_query(text: str) -> str:
    """Return a web address without its query and fragment, and any other text as it is."""
    return re.split("[?#]", text)[0] if is_web_address(text) else text


def local_path(text: str) -> str:
    """Return the path of a ``file://`` URL, and any other text as it is."""
    scheme = _FILE_URL.match(text)
    if scheme is None:
        return text
    from urllib.request import url2pathname  # takes tens of milliseconds

    return url2pathname(text[scheme.end() :])


def hide_credentials(text: str) -> str:
    """Replace what may be secret in URLs by ``***``: users, passwords and unknown parameters."""
    text = _PATH.sub(r"\1=***", _CREDENTIALS.sub("***@", text))
    return _PARAMETER.sub(_hide_value, text)


def _hide_value(found: re.Match[str]) -> str:
    value, mark, fragment = found[2].partition("#")
    if not (_HARMLESS.fullmatch(found[1]) or _SHORT.fullmatch(value)):
        return f"{found[1]}=***"
    return f"{found[1]}={value}{_PARAMETER.sub(_hide_value, mark + fragment)}"


def stable_url(url: str) -> str:
    """Return a URL without its password and without the parameters of a signature, which are renewed."""
    url = _PASSWORD.sub(r"\1@", url)
    head, mark, rest = url.partition("?")
    if not mark:
        return url
    query, mark, fragment = rest.partition("#")
    named = [(unquote_plus(pair.partition("=")[0]), pair) for pair in query.split("&")]
    if any(name.lower() == "sig" for name, _ in named):
        named = [(name, pair) for name, pair in named if not _AZURE.fullmatch(name)]
    kept = "&".join(pair for name, pair in named if not _SIGNATURE.fullmatch(name))
    return head + (f"?{kept}" if kept else "") + mark + fragment


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


def spreadsheet_text(text: str) -> str:
    """Put an apostrophe before a name that a spreadsheet would take for a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text
