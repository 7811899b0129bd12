"""The exceptions of the library, each a :class:`VehicleDetectionError`."""

from __future__ import annotations


class VehicleDetectionError(Exception):
    """Base of every error that the library raises on purpose."""


class InvalidInputError(VehicleDetectionError, ValueError):
    """An argument is not what the function takes; the message says what it was and what to do."""


class ModelFileError(VehicleDetectionError):
    """A model file is missing, damaged, of another version, or does not fit its own parameters."""


class DatasetError(VehicleDetectionError):
    """Training patches, frames or labels are missing, incomplete or malformed."""


class VideoError(VehicleDetectionError):
    """A video cannot be read or written."""
