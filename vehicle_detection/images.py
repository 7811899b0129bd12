"""Reading and writing image files: every image becomes ``(H, W, 3)`` uint8 RGB."""

from __future__ import annotations

import contextlib
import glob
import importlib
import io
import logging
import os
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Limit,
    atomic_write,
    check,
    download_bytes,
    hide_credentials,
    invalid,
    is_hidden,
    is_url,
    local_path,
    natural_key,
    read_regular_file,
    walk_files,
)
from vehicle_detection.errors import InvalidInputError

_LOGGER = logging.getLogger(__name__)

IMAGE_SUFFIXES = (
    ".jpg", ".jpeg", ".jfif", ".png", ".bmp", ".tif", ".tiff", ".webp", ".heic", ".heif", ".jp2", ".ppm",
    ".pgm",
)  # fmt: skip
"""Suffixes of the images that a folder is searched for."""

# What a format's files begin with, and the class of Pillow that reads their header.
_HEADERS = {
    rb"\xff\xd8\xff": "JpegImagePlugin.JpegImageFile",
    rb"BM": "BmpImagePlugin.BmpImageFile",
    rb"RIFF.{4}WEBP": "WebPImagePlugin.WebPImageFile",
    rb"P[1-6][\s#]": "PpmImagePlugin.PpmImageFile",
    rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51": "Jpeg2KImagePlugin.Jpeg2KImageFile",
}
_TIFF = re.compile(rb"II[*+]\0|MM\0[*+]")
# What begins a segment of a JPEG, or ends it: not the bytes and restarts that occur inside compressed data.
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
# Largest 8-bit value of a file whose 16 bits hold 14 or fewer.
_DARK = 64
# Why a file is no image, by how it begins.
_NOT_READ = {
    rb"\Z": "it is empty",
    rb"version https://git-lfs": "it is the pointer of a file in Git LFS, run git lfs pull",
    rb"\s*<(!DOCTYPE|html)": "it is a web page",
    rb".{4}ftypavi[fs]": "it is AVIF, convert it to PNG or JPEG",
    rb".{4}ftyp|RIFF.{4}AVI |\x1aE\xdf\xa3|G.{187}G": "it is a video, which vehicle_detection.track reads",
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
        if size := _jpeg_size(data):
            return size
        file = io.BytesIO(data)
        if _TIFF.match(data):  # the tags only: Pillow knows fewer kinds of pixels
            tags = _tiff_tags(data)
            size = int(tags[256]), int(tags[257])
            return size[::-1] if tags.get(274, 1) > 4 else size  # turned by a quarter when it is decoded
        for magic, reader in _HEADERS.items():
            if re.match(magic, data, re.DOTALL):
                module, name = reader.split(".")
                width, height = getattr(importlib.import_module(f"PIL.{module}"), name)(file).size
                return int(width), int(height)
    except Exception:  # Pillow's plugins raise anything for a damaged file
        return None
    return None


def _tiff_tags(data: bytes) -> Any:
    """Tags of the first picture in a TIFF file, and as ``next`` where those of the second one begin, or 0."""
    tiff, file = importlib.import_module("PIL.TiffImagePlugin"), io.BytesIO(data)
    tags = tiff.ImageFileDirectory_v2(data[: 16 if b"+" in data[2:4] else 8])
    file.seek(tags.next)
    tags.load(file)
    return tags


def _is_raw(tags: Any) -> bool:
    """Whether a TIFF file, such as DNG or NEF, begins with a preview, and has the photo in another place."""
    return bool(tags.get(254, 0) & 1) or 50706 in tags  # NewSubfileType and DNGVersion


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the frame header of a usual JPEG file, without the import of Pillow."""
    at = 2
    while data[:2] == b"\xff\xd8" and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in (0xC0, 0xC1, 0xC2):
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if marker < 0xC0 or 0xC5 <= marker <= 0xDA:  # not a segment that precedes the frame
            break
        at += 2 + int(struct.unpack_from(">H", data, at + 2)[0])
    return None


def decode_image(data: bytes, name: str) -> NDArray[np.uint8]:
    """Decode an image file's bytes to ``(H, W, 3)`` uint8 RGB; `name` is the file's name for errors.

    Gray becomes three equal channels, alpha is dropped, 16 bits become 8, and the EXIF rotation is applied.
    """
    size, image = image_size(data), None
    _check_pixels(size, name)
    if size is not None and _TIFF.match(data) and _is_raw(_tiff_tags(data)):
        raise InvalidInputError(
            f"{name} must be no raw photo, which holds a small preview; convert it to JPEG"
        )
    if re.match(rb".{4}ftyp(hei[cxms]|hev[cx]|mif1|msf1)", data, re.DOTALL):
        return _decode_heif(data, name)
    # OpenCV's decoders of other formats are not used: nothing limits the memory that a file claims.
    with contextlib.suppress(cv2.error, MemoryError):
        image = None if size is None else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    if image is None or _is_truncated(data):
        reasons = (reason for magic, reason in _NOT_READ.items() if re.match(magic, data, re.DOTALL))
        reason = next(reasons, "it cannot be decoded")
        raise InvalidInputError(f"{name} must be a complete image file (PNG, JPEG, ...); {reason}")
    if _has_several(data):
        _LOGGER.warning(
            "%s holds several pictures, of which the first is read; track reads all of a GIF or MP4", name
        )
    if _is_deep(data) and image.max() <= _DARK:
        _LOGGER.warning(
            "%s is nearly black: its values use few of their 16 bits, such as the lower 12 or 14; scale them "
            "to 0-65535",
            name,
        )
    return np.asarray(image, np.uint8)


def _check_pixels(size: tuple[int, int] | None, name: str) -> None:
    """Raise if an image has too many pixels; its width and height may be unknown."""
    if size is not None and size[0] * size[1] > Limit.PIXELS.current():
        raise InvalidInputError(
            f"{name} must have at most {Limit.PIXELS.current():,} pixels, got {size[0]}x{size[1]}; if the "
            f"image is meant to be so large, set {Limit.PIXELS.variable}"
        )


def _decode_heif(data: bytes, name: str) -> NDArray[np.uint8]:
    """Decode a picture of a phone with the package pillow-heif, if it is installed."""
    try:
        open_heif = importlib.import_module("pillow_heif").open_heif
    except ImportError:
        raise InvalidInputError(
            f"{name} is HEIC, which needs the package pillow-heif; run pip install pillow-heif, or convert "
            "it to JPEG"
        ) from None
    try:
        picture = open_heif(data, convert_hdr_to_8bit=True)
        _check_pixels(picture.size, name)
        return image_array(picture.to_pillow())
    except InvalidInputError:
        raise
    except (OSError, ValueError, RuntimeError, MemoryError) as error:
        raise InvalidInputError(f"{name} must be a complete HEIC file; it cannot be read: {error}") from None


def _is_truncated(data: bytes) -> bool:
    """Whether a JPEG or PNG lacks its end; OpenCV fills the missing part with gray without an error."""
    if not data.startswith(b"\xff\xd8"):
        return data.startswith(b"\x89PNG") and b"IEND" not in data
    # From segment to segment: a thumbnail in one of them has an end marker, too, and phones append a video.
    marker = _JPEG_MARKER.search(data, 2)
    while marker and marker[0] != b"\xff\xd9":
        length = int.from_bytes(data[marker.end() : marker.end() + 2], "big")
        marker = _JPEG_MARKER.search(data, marker.end() + length)
    return marker is None


def _has_several(data: bytes) -> bool:
    """Whether a PNG, WebP or GIF file is animated, or a TIFF file has pages."""
    if data.startswith(b"\x89PNG"):
        return b"acTL" in data.partition(b"IDAT")[0]
    if data.startswith(b"GIF"):
        with contextlib.suppress(Exception):  # Pillow's plugins raise anything for a damaged file
            gif = importlib.import_module("PIL.GifImagePlugin")
            return bool(gif.GifImageFile(io.BytesIO(data)).is_animated)
    if _TIFF.match(data):
        return bool(_tiff_tags(data).next)
    return data[12:16] == b"VP8X" and bool(data[20] & 2)


def _is_deep(data: bytes) -> bool:
    """Whether a PNG or TIFF file has 16 bits for each value."""
    if _TIFF.match(data):
        return bool(np.max(_tiff_tags(data).get(258, 1)) == 16)
    return data.startswith(b"\x89PNG") and data[24] == 16


def read_image(path: str | os.PathLike[str] | bytes) -> NDArray[np.uint8]:
    """Read an image file as ``(H, W, 3)`` uint8 RGB, whatever its format.

    `path` is a PNG, JPEG, BMP, TIFF, WebP, GIF, PNM or JPEG 2000 file, its address on the web, or the content
    of one as ``bytes``; HEIC needs the package pillow-heif. Gray, RGBA and 16-bit files are converted, and
    the EXIF rotation is applied. A file that cannot be decoded completely is an `InvalidInputError`, and so
    is one of more than 120 million pixels; the environment variable ``VEHICLE_DETECTION_MAX_PIXELS`` sets
    another limit.

    >>> read_image("missing.png")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: image file missing.png does not exist; check the path
    """
    if isinstance(path, bytes):
        return decode_image(path, "the bytes")
    if isinstance(path, (bytearray, memoryview)) or hasattr(path, "getvalue"):
        raise invalid("path", "be a file name or bytes", path, "pass bytes(...) or stream.getvalue()")
    if isinstance(path, str) and is_url(path := local_path(path)):
        return decode_image(download_bytes(path, Limit.IMAGE_BYTES), f"image {hide_credentials(path)}")
    name = f"image file {(file := check.path(path))}"
    return decode_image(read_regular_file(file, name, Limit.IMAGE_BYTES), name)


def image_array(image: Any) -> NDArray[np.uint8]:
    """Return the ``(H, W, 3)`` uint8 RGB array of an image: an array, a file or its content, or Pillow's."""
    if isinstance(image, (str, os.PathLike, bytes)):
        return read_image(image)
    if hasattr(image, "mode") and hasattr(image, "convert"):
        return _from_pillow(image)
    return check.image(image)


def _from_pillow(image: Any) -> NDArray[np.uint8]:
    """Convert an image of Pillow, which itself cuts the values of 16 bits off at 255."""
    from PIL.ImageOps import exif_transpose

    upright = exif_transpose(image)
    if upright.mode in ("I", "F"):
        raise InvalidInputError(
            f"image must have a range of values that is known, got one of Pillow with mode {upright.mode}; "
            "scale its values to 0-255 and convert it to RGB"
        )
    if upright.mode.startswith("I;16"):
        gray = (np.asarray(upright, np.uint16) // 257).astype(np.uint8)
        return np.repeat(gray[:, :, None], 3, axis=2)
    return np.array(upright.convert("RGB"), np.uint8)


def list_images(source: Any) -> Sequence[Any] | None:
    """List the images of a folder or a pattern by their names, or those of a list; None for a single image.

    Folders are searched below, too; hidden files are left out.
    """
    if isinstance(source, (list, tuple)):
        return source
    if not isinstance(source, (str, os.PathLike)) or (isinstance(source, str) and is_url(source)):
        return None
    path = check.path(source)
    if path.is_dir():
        files = list(walk_files(path, "image"))
    elif not path.exists() and glob.has_magic(str(path)):
        files = [Path(file) for file in glob.iglob(str(path), recursive=True)]
    else:
        return None
    named = (each for each in files if each.suffix.lower() in IMAGE_SUFFIXES and not is_hidden(each.name))
    found = [each for each in named if each.is_file()]
    if not found:
        raise InvalidInputError(f"image {path} holds no image file, such as .jpg or .png; check the path")
    return sorted(found, key=lambda each: natural_key(str(each)))


def write_image(path: str | os.PathLike[str], image: NDArray[np.uint8]) -> None:
    """Write an ``(H, W, 3)`` uint8 RGB image to a file, in the format of its suffix, such as ``.png``.

    The file is written atomically: after an error, an existing file is unchanged.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_image(f"{folder}/black.png", np.zeros((4, 6, 3), np.uint8))
    ...     read_image(f"{folder}/black.png").shape
    (4, 6, 3)
    """
    rgb = check.image(image)
    check.path(path)
    if not cv2.haveImageWriter(f"image{Path(path).suffix}"):
        raise invalid("path", "end in .png, .jpg or another image suffix", Path(path).name)
    # Not cv2.imwrite: it ends Python if the name is not UTF-8, and does not say why it failed.
    done, data = cv2.imencode(Path(path).suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    if not done:
        raise InvalidInputError(f"image cannot be encoded as {Path(path).suffix}; choose another format")
    with atomic_write(path, "path") as part:
        part.write_bytes(data.tobytes())
