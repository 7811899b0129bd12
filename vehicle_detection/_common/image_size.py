"""Size of an image from its header, without decoding it.

OpenCV states the size only after it has decoded the image, and a small file may claim gigabytes.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

# JPEG markers that start a frame header: all SOFs, but not the tables DHT, JPG and DAC between them.
_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of an encoded image in pixels; None if the format is unknown or the header damaged.

    Formats: PNG, JPEG, TIFF, BMP, WebP, GIF, PNM and JPEG 2000.
    """
    for magic, read in _READERS.items():
        if re.match(magic, data, re.DOTALL):
            try:
                return read(data)
            except (struct.error, IndexError, ValueError):
                return None
    return None


def _png(data: bytes) -> tuple[int, int]:
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg(data: bytes) -> tuple[int, int] | None:
    # A file may hold several frame headers; the decoder allocates for the largest.
    sizes, place = [], 2
    while place + 9 <= len(data):
        if data[place] != 0xFF:
            place = data.find(b"\xff", place)
            if place < 0:
                break
            continue
        marker = data[place + 1]
        if marker in _SOF:
            height, width = struct.unpack_from(">HH", data, place + 5)
            sizes.append((width, height))
        if marker == 0xDA:  # compressed data follow
            break
        has_length = marker not in (0x00, 0x01, 0xFF) and not 0xD0 <= marker <= 0xD8
        place += 2 + struct.unpack_from(">H", data, place + 2)[0] if has_length else 1
    return max(sizes, key=lambda size: size[0] * size[1]) if sizes else None


def _tiff(data: bytes) -> tuple[int, int] | None:
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(f"{order}H", data, 2)[0] == 43
    start = struct.unpack_from(f"{order}Q" if big else f"{order}I", data, 8 if big else 4)[0]
    count = struct.unpack_from(f"{order}Q" if big else f"{order}H", data, start)[0]
    first, entry, value = (start + 8, 20, 12) if big else (start + 2, 12, 8)
    sides: dict[int, int] = {}
    for place in range(first, first + min(count, 4096) * entry, entry):
        tag, kind = struct.unpack_from(f"{order}HH", data, place)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            sides[tag] = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", data, place + value)[0]
    return (sides[_TIFF_WIDTH], sides[_TIFF_HEIGHT]) if len(sides) == 2 else None


def _bmp(data: bytes) -> tuple[int, int]:
    old = struct.unpack_from("<I", data, 14)[0] == 12
    width, height = struct.unpack_from("<HH" if old else "<ii", data, 18)
    return abs(width), abs(height)


def _webp(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        return (int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1)
    return None


def _gif(data: bytes) -> tuple[int, int]:
    width, height = struct.unpack_from("<HH", data, 6)
    return width, height


def _pnm(data: bytes) -> tuple[int, int] | None:
    found = re.match(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s", data)
    return (int(found[1]), int(found[2])) if found else None


def _jpeg_2000(data: bytes) -> tuple[int, int] | None:
    place = data.find(b"\xff\x4f\xff\x51")
    if place < 0:
        return None
    right, bottom, left, top = struct.unpack_from(">IIII", data, place + 8)
    return right - left, bottom - top


_READERS: dict[bytes, Callable[[bytes], tuple[int, int] | None]] = {
    rb"\x89PNG\r\n\x1a\n.{4}IHDR": _png,
    rb"\xff\xd8\xff": _jpeg,
    rb"II[*+]\0|MM\0[*+]": _tiff,
    rb"BM": _bmp,
    rb"RIFF.{4}WEBP": _webp,
    rb"GIF8[79]a": _gif,
    rb"P[1-6][\s#]": _pnm,
    rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51": _jpeg_2000,
}
