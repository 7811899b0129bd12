"""Checks of arguments: each error names the argument, the expectation and the value.

>>> integer(0, "jobs", low=1)
Traceback (most recent call last):
vehicle_detection.errors.InvalidInputError: jobs must be an integer at least 1; got 0
"""

from __future__ import annotations

import contextlib
import math
import os
import sys
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from numbers import Real
from pathlib import Path
from typing import Any, TypeGuard, get_args

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.errors import InvalidInputError

Floats = NDArray[np.float64]

# Integers up to it are exact in every format; no count of anything is larger.
_MAX_INTEGER = 2**53
# Bytes of a path, and of each name in it: the limits of Linux, not lower than those of other systems.
_MAX_PATH, _MAX_NAME = 4096, 255


def warn(message: str) -> None:
    """Warn with the line of the user's code that called the library."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_back.f_globals.get("__name__", "").startswith(
        "vehicle_detection."
    ):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level + 1)


def describe(value: object) -> str:
    """Describe a value in a message: the shape and dtype of an array, otherwise the value itself."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and dtype {value.dtype}"
    try:
        text = " ".join(repr(value).split())
    except (ValueError, RecursionError):  # an integer of thousands of digits, or deeply nested lists
        return f"a value too long to print ({type(value).__name__})"
    text = shorten(text)
    obvious = value is None or type(value) in (str, int, float, bool)
    return text if obvious else f"{text} ({type(value).__name__})"


def shorten(text: str, length: int = 80) -> str:
    """Cut off a text that is too long for a message."""
    return text if len(text) <= length else text[: length - 3] + "..."


def invalid(name: str, must: str, got: object, remedy: str = "") -> InvalidInputError:
    """Error of an argument: its name, what it must be or have, what came, and what to do."""
    return InvalidInputError(f"{name} must {must}, got {describe(got)}{'; ' * bool(remedy)}{remedy}")


def instance(value: object, name: str, kind: Any, remedy: str) -> None:
    """Raise unless `value` is an instance of `kind`: a class, a union such as ``Camera | None``, a tuple."""
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else get_args(kind) or (kind,)
        names = " or ".join(each.__name__ for each in kinds if each is not type(None))
        article = "an" if names[0] in "AEIOU" else "a"
        raise InvalidInputError(f"{name} must be {article} {names}, got {describe(value)}; {remedy}")


def path(value: object, name: str = "path", *, kind: str = "a file name") -> Path:
    """Return a path, unless no file can have that name."""
    if not isinstance(value, (str, os.PathLike)):
        raise invalid(name, f"be {kind}", value, "pass a path")
    text = os.fspath(value)
    if not isinstance(text, str):
        raise invalid(name, f"be {kind} as text", value, "use os.fsdecode")
    try:
        too_long = len(os.fsencode(text)) > _MAX_PATH
    except UnicodeEncodeError:
        raise invalid(name, f"be {kind}", value, "drop the character that files cannot have") from None
    too_long |= any(len(os.fsencode(part)) > _MAX_NAME for part in Path(text).parts)
    if too_long or "\0" in text:
        problem = f"more than {_MAX_NAME} bytes" if too_long else "a null character"
        raise InvalidInputError(f"{name} must be {kind}, got {describe(text)} with {problem}")
    return Path(text)


def image(value: object, name: str = "image") -> NDArray[np.uint8]:
    """Return `value` if it is ``(H, W, 3)`` uint8; the error says how to convert other arrays."""
    if not isinstance(value, np.ndarray):
        remedy = "read files with vehicle_detection.read_image"
        if hasattr(value, "convert"):
            remedy = "convert it with numpy.asarray(image.convert('RGB'))"
        elif hasattr(value, "__array__"):
            remedy = "convert it with numpy.asarray(image)"
        elif isinstance(value, (list, tuple)):
            remedy = "pass one image after the other"
        elif isinstance(value, (Iterator, Mapping)):
            remedy = "pass a list of images"
        elif isinstance(value, bytes):
            remedy = "decode it with vehicle_detection.read_image(data)"
        raise invalid(name, "be an (H, W, 3) uint8 RGB array", value, remedy)
    if value.ndim == 2 or (value.ndim == 3 and value.shape[2] == 1):
        remedy = "convert a grayscale image with cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)"
    elif value.ndim == 3 and value.shape[2] == 4:
        remedy = "drop the alpha channel with image[..., :3]"
    elif value.ndim == 4:
        remedy = "pass one image after the other"
    elif value.ndim == 3 and value.shape[2] != 3 and value.shape[0] == 3:
        remedy = "put the channels last with image.transpose(1, 2, 0)"
    elif value.ndim != 3 or value.shape[2] != 3:
        remedy = "pass one image with three color channels"
    elif value.shape[0] == 0 or value.shape[1] == 0:
        remedy = "the image is empty"
    elif value.dtype != np.uint8:
        remedy = _conversion_to_uint8(value, "image")
    else:
        return value
    raise invalid(name, "be an (H, W, 3) uint8 RGB array", value, remedy)


def _conversion_to_uint8(values: NDArray[Any], name: str) -> str:
    """Say how to convert an array of another type."""
    if values.dtype.kind == "f" and not (values >= 0).all():
        return f"map its values to 0-255; they are {values.min():g} to {values.max():g}"
    if values.dtype.kind == "f" and values.max(initial=0) > 1:
        return f"convert its values 0-255 with {name}.round().astype(numpy.uint8)"
    if values.dtype.kind == "f":
        return f"scale its values 0-1 with ({name} * 255).round().astype(numpy.uint8)"
    if values.dtype == np.uint16:
        return f"scale 16-bit values with ({name} // 257).astype(numpy.uint8)"
    return f"convert it with {name}.astype(numpy.uint8) once its values lie in 0-255"


def patches(values: object, size: int, name: str = "patches") -> NDArray[np.uint8]:
    """Return `values` as an ``(N, size, size, 3)`` uint8 array; a list of such images is stacked."""
    values = getattr(values, "patches", values)  # of a PatchSet
    resize = f"resize each image with cv2.resize(image, ({size}, {size}))"
    if isinstance(values, (list, tuple)):
        images = [image(patch, f"{name}[{index}]") for index, patch in enumerate(values)]
        for index, each in enumerate(images):
            if each.shape != (size, size, 3):
                raise invalid(f"{name}[{index}]", f"be {size}x{size} pixels", each, resize)
        return np.stack(images) if images else np.empty((0, size, size, 3), np.uint8)
    remedy = "read a folder or zip with vehicle_detection.load_patches"
    if isinstance(values, np.ndarray):
        if values.ndim == 4 and values.shape[1:] == (size, size, 3):
            if values.dtype == np.uint8:
                return values
            remedy = _conversion_to_uint8(values, name)
        elif values.shape == (size, size, 3):
            remedy = f"pass a single patch as {name}[None]"
        elif values.ndim in (3, 4):
            remedy = resize
    raise invalid(name, f"be an (N, {size}, {size}, 3) uint8 RGB array or a list of images", values, remedy)


def array(values: object, name: str) -> NDArray[Any]:
    """Return `values` as an array, unless they are ragged or otherwise no array."""
    try:
        return np.asarray(values)
    except (ValueError, TypeError, OverflowError, RuntimeError) as error:
        # Errors of tensors state how to convert them, those of NumPy do not help.
        reason = "" if isinstance(error, ValueError) else f"; {error}"
        must = "be an array or a sequence of numbers of equal lengths"
        raise InvalidInputError(f"{name} must {must}, got {describe(values)}{reason}") from error


def shape(value: object) -> tuple[int, int]:
    """Return height and width of ``image.shape``, two or more positive integers."""
    if not isinstance(value, (tuple, list)) or len(value) < 2:
        raise invalid("shape", "be (height, width, ...)", value, "pass image.shape")
    return integer(value[0], "shape[0]", low=1), integer(value[1], "shape[1]", low=1)


def function(value: object, name: str, of: str) -> None:
    """Raise unless `value` is a function of what `of` names, or None."""
    if value is not None and not callable(value):
        raise invalid(name, f"be a function of {of}", value)


def flags(**values: object) -> None:
    """Raise unless each value, named by its argument, is a bool, or an integer in place of one."""
    for name, value in values.items():
        if not isinstance(value, (bool, int, np.bool_, np.integer)):
            raise InvalidInputError(f"{name} must be True or False; got {describe(value)}")


def boolean(value: object, name: str) -> bool:
    """Return `value` as a bool if it is one, of Python or of NumPy."""
    if not isinstance(value, (bool, np.bool_)):
        raise InvalidInputError(f"{name} must be True or False; got {describe(value)}")
    return bool(value)


def is_listing(values: object) -> TypeGuard[Iterable[Any]]:
    """Whether `values` is a sequence or another iterable, but neither a text nor an array of one number."""
    scalar = isinstance(values, (str, bytes)) or getattr(values, "ndim", 1) == 0
    return isinstance(values, Iterable) and not scalar


def sequence(values: object, name: str, of: str) -> tuple[Any, ...]:
    """Return the items of a sequence or another iterable, but not the characters of a text."""
    if not is_listing(values):
        raise invalid(name, f"be a sequence of {of}", values, "wrap it in a list")
    return tuple(values)


_MAX_PIXEL = 1e9  # areas of larger boxes may overflow


def boxes(values: Any, name: str = "boxes") -> NDArray[Any]:
    """Return `values` as an ``(N, 4)`` array of finite boxes with ``x1 <= x2`` and ``y1 <= y2``.

    `values` may also be `Detections`, pairs ``((x1, y1), (x2, y2))`` of opposite corners, or an object with
    an attribute ``xyxy``, such as ``supervision.Detections``.
    """
    values = getattr(values, "boxes", values)  # Detections have this attribute.
    found = array(getattr(values, "xyxy", values), name)
    if found.size == 0:
        return np.empty((0, 4), found.dtype if found.dtype.kind in "iuf" else np.float64)
    if found.shape[1:] == (2, 2) and found.dtype.kind in "iuf":
        found = np.concatenate((found.min(axis=1), found.max(axis=1)), axis=1)
    if found.ndim != 2 or found.shape[1] != 4 or found.dtype.kind not in "iuf":
        remedy = "wrap a single box in a list"
        if hasattr(found.flat[0], "box"):
            remedy = "pass [track.box for track in tracks]"
        elif hasattr(values, "astype") and found.dtype == object:
            remedy = "convert columns that may hold NA with table.astype(float)"
        must = "be an (N, 4) number array of [x1, y1, x2, y2] or corner pairs ((x1, y1), (x2, y2))"
        raise invalid(name, must, values, remedy)
    if not ((found >= -_MAX_PIXEL) & (found <= _MAX_PIXEL)).all():
        what = f"values beyond {_MAX_PIXEL:g}" if np.isfinite(found).all() else "NaN or infinity"
        raise InvalidInputError(f"{name} must be finite, got {what}; drop those rows")
    inverted = (found[:, 2] < found[:, 0]) | (found[:, 3] < found[:, 1])
    if inverted.any():
        row = int(np.argmax(inverted))
        must = "be [x1, y1, x2, y2] with x1 <= x2 and y1 <= y2"
        remedy = "boxes given as [x, y, width, height] need x + width and y + height"
        raise invalid(f"{name}[{row}]", must, found[row].tolist(), remedy)
    return found


def number(
    value: object, name: str, *, low: float = -math.inf, high: float = math.inf, above: float = -math.inf
) -> float:
    """Return `value` as a finite float in ``[low, high]`` and, if given, greater than `above`."""
    found = math.nan
    if isinstance(value, Real) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):  # an int of more than 308 digits
            found = float(value)
    if not (math.isfinite(found) and low <= found <= high and found > above):
        bounds = [f"greater than {above:g}"] if above > -math.inf else []
        bounds += [f"at least {low:g}"] if low > -math.inf else []
        bounds += [f"at most {high:g}"] if high < math.inf else []
        expected = " and ".join(bounds) or "finite"
        raise InvalidInputError(f"{name} must be a number, {expected}; got {describe(value)}")
    return found


def integer(value: object, name: str, *, low: int, high: int | None = None) -> int:
    """Return `value` as an int in ``[low, high]``."""
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    limit = _MAX_INTEGER if high is None else high
    if not is_integer or value < low or value > limit:  # type: ignore[operator]
        expected = f"at least {low}" if high is None else f"from {low} to {high}"
        raise InvalidInputError(f"{name} must be an integer {expected}; got {describe(value)}")
    return int(value)  # type: ignore[call-overload, no-any-return]


def choice(value: Any, name: str, choices: Collection[object]) -> Any:
    """Return `value` if it is one of `choices`."""
    if not (value is None or isinstance(value, (str, int, np.integer))) or value not in choices:
        listed = ", ".join(repr(choice) for choice in choices)
        raise InvalidInputError(f"{name} must be one of {listed}; got {describe(value)}")
    return value
