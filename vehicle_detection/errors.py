"""The exceptions of the library."""

from __future__ import annotations


class VehicleDetectionError(Exception):
    """Base class of the errors that the library raises for invalid input and files."""


class InvalidInputError(VehicleDetectionError, ValueError):
    """An argument is invalid; the message states the expectation, the value and the remedy."""


class ModelFileError(VehicleDetectionError):
    """A model file is missing, damaged, of another version, or inconsistent with its parameters."""


class DatasetError(VehicleDetectionError):
    """Training patches, frames or labels are missing, incomplete or malformed."""


class DetectorError(VehicleDetectionError):
    """A function passed to `detector_from` failed, or did not return boxes and scores."""


class OutputError(VehicleDetectionError, OSError):
    """An output cannot be written: the disk is full, or the folder has become read-only."""


class VideoError(VehicleDetectionError):
    """A video cannot be read or written."""


class TransientVideoError(VideoError):
    """A video cannot be read or written for a reason outside the file; the next attempt may succeed.

    Such reasons are an ffmpeg that was killed, a full disk, a network or storage that does not answer, and
    permissions or signatures that have expired.
    """
