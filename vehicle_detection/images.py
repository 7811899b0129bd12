"""Reading and writing image files: every image becomes ``(H, W, 3)`` uint8 RGB."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Limit,
    atomic_write,
    check_image,
    check_path,
    describe,
    hide_credentials,
    is_url,
    read_regular_file,
)
from vehicle_detection.errors import InvalidInputError

# What a format's files begin with, and the class of Pillow that reads their header.
_HEADERS = {
    rb"\xff\xd8\xff": "JpegImagePlugin.JpegImageFile",
    rb"BM": "BmpImagePlugin.BmpImageFile",
    rb"RIFF.{4}WEBP": "WebPImagePlugin.WebPImageFile",
    rb"P[1-6][\s#]": "PpmImagePlugin.PpmImageFile",
    rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51": "Jpeg2KImagePlugin.Jpeg2KImageFile",
}


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of an encoded image in pixels; None if the format is unknown or the header damaged.

    Only the header is read: OpenCV states the size after it has decoded the image, and a small file may claim
    gigabytes. Pillow's ``Image.open`` has a limit of its own, and refuses PNG files for their metadata.
    """
    try:
        if re.match(rb"\x89PNG\r\n\x1a\n.{4}IHDR", data, re.DOTALL):
            return struct.unpack_from(">II", data, 16)
        if re.match(rb"GIF8[79]a", data):
            return struct.unpack_from("<HH", data, 6)
        file = io.BytesIO(data)
        if re.match(rb"II[*+]\0|MM\0[*+]", data):  # the tags only: Pillow knows fewer kinds of pixels
            tiff = importlib.import_module("PIL.TiffImagePlugin")
            tags = tiff.ImageFileDirectory_v2(data[: 16 if b"+" in data[2:4] else 8])
            file.seek(tags.next)
            tags.load(file)
            return int(tags[256]), int(tags[257])
        for magic, reader in _HEADERS.items():
            if re.match(magic, data, re.DOTALL):
                module, name = reader.split(".")
                width, height = getattr(importlib.import_module(f"PIL.{module}"), name)(file).size
                return int(width), int(height)
    except Exception:  # Pillow's plugins raise anything for a damaged header
        return None
    return None


def decode_image(data: bytes, name: str) -> NDArray[np.uint8]:
    """Decode an image file's bytes to ``(H, W, 3)`` uint8 RGB; `name` is the file's name for errors.

    Gray becomes three equal channels, alpha is dropped, 16 bits become 8, and the EXIF rotation is applied.
    """
    size, image = image_size(data), None
    if size is not None and size[0] * size[1] > Limit.PIXELS.current():
        raise InvalidInputError(
            f"{name} must have at most {Limit.PIXELS.current():,} pixels, got {size[0]}x{size[1]}; if the "
            f"image is meant to be so large, set {Limit.PIXELS.variable}"
        )
    # OpenCV's decoders of other formats are not used: nothing limits the memory that a file claims.
    with contextlib.suppress(cv2.error, MemoryError):
        image = None if size is None else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    if image is None or _is_truncated(data):
        raise InvalidInputError(
            f"{name} must be a complete image file (PNG, JPEG, ...); it cannot be decoded"
        )
    return np.asarray(image, np.uint8)


def _is_truncated(data: bytes) -> bool:
    """Whether a JPEG or PNG lacks its end; OpenCV fills the missing part with gray without an error."""
    if data.startswith(b"\xff\xd8"):
        # The end marker must follow the last scan; an earlier one belongs to a thumbnail in the header.
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    return data.startswith(b"\x89PNG") and b"IEND" not in data


def read_image(path: str | os.PathLike[str] | bytes) -> NDArray[np.uint8]:
    """Read an image file as ``(H, W, 3)`` uint8 RGB, whatever its format.

    `path` is a PNG, JPEG, BMP, TIFF, WebP, GIF, PNM or JPEG 2000 file, or the content of one as ``bytes``.
    Gray, RGBA and 16-bit files are converted, and the EXIF rotation is applied. A file that cannot be decoded
    completely is an `InvalidInputError`, and so is one of more than 120 million pixels; the environment
    variable ``VEHICLE_DETECTION_MAX_PIXELS`` sets another limit.

    >>> read_image("missing.png")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: image file missing.png does not exist; check the path
    """
    if isinstance(path, bytes):
        return decode_image(path, "the bytes")
    if isinstance(path, (bytearray, memoryview)) or hasattr(path, "getvalue"):
        raise InvalidInputError(
            f"path must be a file name or bytes, got {describe(path)}; pass bytes(...) or stream.getvalue()"
        )
    file = check_path(path)
    if isinstance(path, str) and is_url(path):
        raise InvalidInputError(f"image file {hide_credentials(path)} is a URL; download it first")
    name = f"image file {file}"
    return decode_image(read_regular_file(file, name, Limit.IMAGE_BYTES), name)


def write_image(path: str | os.PathLike[str], image: NDArray[np.uint8]) -> None:
    """Write an ``(H, W, 3)`` uint8 RGB image to a file, in the format of its suffix, such as ``.png``.

    The file is written atomically: after an error, an existing file is unchanged.
    """
    rgb = check_image(image)
    check_path(path)
    if not cv2.haveImageWriter(f"image{Path(path).suffix}"):
        raise InvalidInputError(
            f"path must end in .png, .jpg or another image suffix, got {Path(path).name!r}"
        )
    # Not cv2.imwrite: it ends Python if the name is not UTF-8, and does not say why it failed.
    done, data = cv2.imencode(Path(path).suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    if not done:
        raise InvalidInputError(f"image cannot be encoded as {Path(path).suffix}; choose another format")
    with atomic_write(path, "path") as part:
        part.write_bytes(data.tobytes())
