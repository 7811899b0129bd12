"""Damage of a video file: missing frames, and errors of the decoder.

ffmpeg skips what it cannot decode and ends with exit code 0, so its frames and its log must be checked.
"""

from __future__ import annotations

import contextlib
import math
import re
import sys
from fractions import Fraction
from pathlib import Path

from vehicle_detection._common import pluralize
from vehicle_detection.video.ffmpeg import (
    Process,
    check_resources,
    input_options,
    last_line,
    seconds_of,
    source_name,
)
from vehicle_detection.video.probe import VideoInfo

# Error of a frame rate that ffmpeg has derived from the file's times.
_RATE_ERROR = Fraction(6, 1000)
_REPEATED = re.compile(r"Last message repeated (\d+) times")


def find_damage(path: Path | str, info: VideoInfo, end: int, log: str, *, stop: int | None = None) -> str:
    """Say what is damaged, or return an empty text.

    `end` is the number of the file's frames up to the last decoded one, `stop` that up to the last one
    wanted, which may lie after the file's end. `log` holds ffmpeg's errors.
    """
    parts = []
    count, message = _decode_errors(log)
    announced = end if end == stop else _announced_frames(path, info, end, exact=count > 0)
    expected = min(announced, stop or sys.maxsize)
    if expected > end:
        parts.append(f"{expected - end} of {expected} frames cannot be decoded")
    if count:
        parts.append(f"ffmpeg reports {pluralize(count, 'decoding error')} ({message})")
    return f"{source_name(path)} is damaged: {', and '.join(parts)}; copy or record it again" if parts else ""


def _decode_errors(log: str) -> tuple[int, str]:
    """Count the decoder's errors, and return the last one; the demuxer's concern other streams, too."""
    count, last = 0, ""
    for line in log.splitlines():
        repeated = _REPEATED.search(line)
        if repeated:
            count += int(repeated[1]) if last else 0
        elif line.startswith("[") and not line.startswith("[in#"):
            count, last = count + 1, line
    return count, last_line(last)


def _announced_frames(path: Path | str, info: VideoInfo, end: int, *, exact: bool) -> int:
    """Return the number of frames that a file announces; `end` if unknown, or if only rounding differs.

    `exact` allows for no rounding.
    """
    if info.frames <= end + (0 if exact else 1):
        return end
    # The file's duration is that of its longest stream, which may be the sound.
    duration = stream_duration(path, info)
    if duration is None:
        duration = 0.0 if info.has_audio else float(info.frames / info.fps)
    expected = round(duration * info.fps)
    # With a varying rate, the duration of the last frame is unknown.
    tolerance = (0 if exact else 1) + duration * float(_RATE_ERROR)
    tolerance += 0 if info.constant_rate else float(info.fps)
    return expected if expected - end > math.floor(tolerance) else end


def stream_duration(path: Path | str, info: VideoInfo) -> float | None:
    """Duration of the video stream in seconds; None if the file does not state it."""
    options = ("-nostdin", *input_options(path), "-map", "0:V:0", "-c", "copy", "-frames:v", "1")
    with contextlib.closing(Process((*options, "-f", "null", "-"), level="trace")) as process:
        code, log = process.wait(), process.log()
    check_resources(source_name(path), code, log)
    mapped = re.search(r"Stream #0:(\d+) -> #0:0", log)
    index = mapped[1] if mapped else "0"
    exact = re.search(rf"stream {index}: start_time: \S+ duration: ([\d.]+)", log)
    if exact:
        return float(exact[1])
    # Matroska states the stream's end in a tag, which the log repeats for the output.
    ends = re.findall(r"DURATION +: (\d+:\d+:[\d.]+)", log)
    return seconds_of(ends[-1]) - info.first_timestamp if ends else None
