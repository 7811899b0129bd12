"""Environment variables: limits on files from elsewhere, and values of numba's with which kernels fail."""

from __future__ import annotations

import os
import re
import stat
from enum import Enum
from pathlib import Path

from vehicle_detection._common.check import invalid
from vehicle_detection.errors import InvalidInputError, VehicleDetectionError


class Limit(Enum):
    """A limit: its environment variable, its default, and its unit."""

    # Of an image or a video's frame, as stated in the header: checked before decoding.
    PIXELS = "VEHICLE_DETECTION_MAX_PIXELS", 120_000_000, "pixels"
    MODEL_BYTES = "VEHICLE_DETECTION_MAX_MODEL_BYTES", 256_000_000, "bytes"
    NETWORK_BYTES = "VEHICLE_DETECTION_MAX_NETWORK_BYTES", 1_000_000_000, "bytes"
    TEXT_BYTES = "VEHICLE_DETECTION_MAX_TEXT_BYTES", 1_000_000_000, "bytes"  # labels or predictions
    RECORD_BYTES = "VEHICLE_DETECTION_MAX_RECORD_BYTES", 100_000_000, "bytes"  # a record of the own speed
    IMAGE_BYTES = "VEHICLE_DETECTION_MAX_IMAGE_BYTES", 500_000_000, "bytes"  # also in an archive, unpacked

    @property
    def variable(self) -> str:
        """Name of the environment variable."""
        return str(self.value[0])

    def current(self) -> int:
        """Value of the environment variable, else the default."""
        text = os.environ.get(self.variable, "")
        if not text:
            return int(self.value[1])
        if not text.isascii() or not text.isdecimal() or len(text) > 16 or not 1 <= int(text) <= 10**15:
            raise invalid(self.variable, f"be a number of {self.value[2]} from 1 to 1e15", text)
        return int(text)

    def exceeded(self, name: str) -> str:
        """Return the message of a file that is too large."""
        return f"{name} is larger than {self.current():,} bytes; if it is meant to be, set {self.variable}"


def read_regular_file(
    path: Path, name: str, limit: Limit, *, error: type[VehicleDetectionError] = InvalidInputError
) -> bytes:
    """Read a whole file; raise an `error` that starts with `name` if it is missing, endless or too large."""
    check_regular_file(path, name, limit, error=error)
    try:
        with path.open("rb") as file:
            # As much as it holds: Python would allocate the whole limit first.
            size = os.fstat(file.fileno()).st_size
            data = file.read(size + 1)
            if len(data) > size:
                data += file.read(limit.current())
    except OSError as problem:
        raise error(f"{name} cannot be read: {problem.strerror}") from problem
    if len(data) > limit.current():  # it has grown
        raise error(limit.exceeded(name))
    return data


def check_regular_file(
    path: Path,
    name: str,
    limit: Limit | None = None,
    *,
    error: type[VehicleDetectionError] = InvalidInputError,
) -> None:
    """Raise an `error` unless `path` is a file of limited size: not a folder, a device or a pipe."""
    try:
        status = path.stat()
    except FileNotFoundError:
        is_address = re.match("[a-z][a-z0-9+.-]+:/", str(path))
        remedy = (
            "download it first, as only images and videos may be URLs" if is_address else "check the path"
        )
        raise error(f"{name} does not exist; {remedy}") from None
    except (OSError, ValueError) as problem:  # ValueError: a null byte or a lone surrogate
        raise error(f"{name} cannot be read: {getattr(problem, 'strerror', None) or problem}") from problem
    if stat.S_ISDIR(status.st_mode):
        raise error(f"{name} is a folder; choose a file in it")
    if not stat.S_ISREG(status.st_mode):
        raise error(f"{name} is a device or a pipe, which may never end; copy it to a file first")
    if limit is not None and status.st_size > limit.current():
        raise error(limit.exceeded(name))


def check_environment() -> None:
    """Raise if numba would fail, or would not compile the kernels."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        value = os.environ["NUMBA_DISABLE_JIT"]
        raise InvalidInputError(f"NUMBA_DISABLE_JIT must be unset or 0, or kernels fail; got {value!r}")
    threads = os.environ.get("NUMBA_NUM_THREADS", "")
    if threads and not (threads.isdecimal() and int(threads[:9]) >= 1):
        raise InvalidInputError(f"NUMBA_NUM_THREADS must be unset or at least 1; got {threads!r}")
