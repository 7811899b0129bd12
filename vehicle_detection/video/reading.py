"""Properties and frames of one video file, and ranges of time."""

from __future__ import annotations

import math
import os
from fractions import Fraction

from vehicle_detection._common import check_number
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video.files import check_file
from vehicle_detection.video.probe import VideoInfo, probe
from vehicle_detection.video.streams import FrameReader


def probe_video(path: str | os.PathLike[str]) -> VideoInfo:
    """Read the properties of a video file: frame size, exact frame rate, length, sound and rotation.

    Parameters
    ----------
    path
        A file that ffmpeg can read.

    Returns
    -------
    VideoInfo
        The properties; ``frames`` is an estimate, because counting requires decoding the whole video.

    Raises
    ------
    InvalidInputError
        If the file is missing, a folder, or not readable.
    VideoError
        If the file is not a video, or its first frame cannot be decoded.

    Examples
    --------
    >>> probe_video("missing.mp4")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: source missing.mp4 does not exist; check the path
    """
    return probe(check_file(path))


def read_frames(
    source: str | os.PathLike[str],
    *,
    start: float | None = None,
    end: float | None = None,
    strict: bool = False,
) -> FrameReader:
    """Read the frames of a video file, one at a time; for other sources see `open_source`.

    Parameters
    ----------
    source
        A file that ffmpeg can read.
    start, end
        Time range in seconds: frames with ``start <= time < end`` are read. None: no limit.
    strict
        Raise an error after the last frame if the file is damaged: frames are missing, or ffmpeg reports
        decoding errors. Otherwise a warning is logged, and the reader's ``damage`` says it.

    Returns
    -------
    FrameReader
        An iterator of ``(index, time, frame)``: the frame's number in the file from 0, its time in seconds,
        and an upright ``(H, W, 3)`` uint8 RGB array. Its ``info`` is the file's `VideoInfo`. ffmpeg ends
        after the last frame, and at the end of a ``with`` block.

    Raises
    ------
    InvalidInputError
        If the file is missing, or there is no frame between `start` and `end`.
    VideoError
        If the file is not a video.

    Examples
    --------
    >>> with read_frames("missing.mp4", end=2.0) as frames:  # doctest: +IGNORE_EXCEPTION_DETAIL
    ...     means = [frame.mean() for index, time, frame in frames]
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: source missing.mp4 does not exist; check the path
    """
    path = check_file(source)
    start, end = check_span(start, end)
    info = probe(path)
    first, count = frame_range(info, start, end)
    return FrameReader(path, info, first=first, count=count, strict=strict)


def check_span(start: float | None, end: float | None) -> tuple[float | None, float | None]:
    """Return a time range in seconds if it is valid."""
    start, end = (
        None if value is None else check_number(value, name, low=0, high=1e7)
        for name, value in (("start", start), ("end", end))
    )
    if end is not None and (start or 0) >= end:
        raise InvalidInputError(
            f"end must be later than the start; got {start or 0:g} s to {end:g} s, choose a later end"
        )
    return start, end


def frame_range(info: VideoInfo, start: float | None, end: float | None) -> tuple[int, int | None]:
    """Convert seconds to the index of the first frame and the number of frames."""
    if start is not None and info.duration and start >= info.duration:
        raise InvalidInputError(
            f"start must be less than the video's length of {info.duration:g} s; got {start:g} s"
        )
    # Tolerance: a frame's rounded time selects that frame.
    first, last = (
        None if value is None else math.ceil(Fraction(float(value)) * info.fps - Fraction(1, 100))
        for value in (start, end)
    )
    first = first or 0
    if last is not None and last <= first:
        raise InvalidInputError(
            f"end must be at least one frame later than the start, at {float(info.fps):g} frames/s; "
            f"got {start or 0:g} s to {end:g} s, choose a later end"
        )
    return first, None if last is None else last - first
