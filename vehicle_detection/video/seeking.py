"""Where in a file decoding must start to reach a frame."""

from __future__ import annotations

import contextlib
import math
import re
from pathlib import Path

from vehicle_detection.video.ffmpeg import Process, check_resources, input_options, source_name
from vehicle_detection.video.probe import VideoInfo

# Containers with an index of their key frames. It may hold the times of decoding, which are earlier than
# those of display by this many seconds at most.
_INDEXED = ("mov", "matroska")
_REORDERING = 0.5
# Steps in seconds by which a seek is moved back until decoding begins before the wanted time; in a network,
# where each costs a connection, only some.
_STEPS = (0, 1, 4, 16, 64)
_NETWORK_STEPS = (4, 64)


def find_seek_time(path: Path | str, info: VideoInfo, wanted: float) -> float:
    """Return a time in the file from which ffmpeg decodes the frame at `wanted`, in seconds.

    In files without an index, such as MPEG-TS, ffmpeg seeks to a position near the time, and decoding begins
    with the next key frame, which may be seconds after it. Therefore the time of the first decoded frame is
    checked.
    """
    if not info.duration:  # raw streams have no times; ffmpeg's are wrong after a seek
        return info.video_offset
    indexed = info.container.startswith(_INDEXED)
    steps = _NETWORK_STEPS if isinstance(path, str) else _STEPS
    for seconds in (_REORDERING,) if indexed else steps:
        # A whole number of frames earlier, because ffmpeg may round times to frames.
        seek = wanted - float(math.ceil(seconds * info.fps) / info.fps)
        if seek <= info.video_offset:
            break
        if indexed or _first_time(path, seek) <= wanted - seek:
            return seek
    return info.video_offset


def _first_time(path: Path | str, seek: float) -> float:
    """Time of the first frame that is decoded after a seek, from there, in seconds.

    It is infinite if the frame is no key frame: some decoders begin with others, which are gray then.
    """
    options = ("-noaccurate_seek", "-ss", f"{seek:.6f}", *input_options(path), "-map", "0:V:0")
    options += ("-frames:v", "1", "-vf", "showinfo", "-f", "null", "-")
    with contextlib.closing(Process(("-nostdin", *options), level="info")) as process:
        check_resources(source_name(path), process.wait(), process.log())
        found = re.search(r"n: *0 .*?pts_time:(-?[\d.]+).*? iskey:1 ", process.log())
    return float(found[1]) if found else math.inf
