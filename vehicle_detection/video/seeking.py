"""Where in a file decoding must start to reach a frame."""

from __future__ import annotations

import math
from pathlib import Path

from vehicle_detection.video.ffmpeg import VideoInfo, packet_times

# Their index leads to the key frame before any time.
_INDEXED = ("mov", "matroska")
# Seconds before the wanted time at which a seek may reach an earlier key frame.
_EARLIER = (0, 1, 4, 16, 64)


def find_seek_time(path: Path | str, info: VideoInfo, wanted: float) -> float:
    """Return the latest known time in the file from which ffmpeg decodes the frame at `wanted`, in seconds.

    In files without an index, such as MPEG-TS, ffmpeg seeks to a position near the time, and decoding begins
    with the next key frame, which may be seconds after it. So seeks are tried, without decoding.
    """
    if info.container.startswith(_INDEXED):
        return max(wanted, info.pictures_from)
    for seconds in _EARLIER:
        # A whole number of frames earlier, because ffmpeg may round times to frames.
        seek = wanted - float(math.ceil(seconds * info.fps) / info.fps)
        if seek <= info.pictures_from:
            break
        times = packet_times(path, seek=seek, count=1)
        if times and times[0] <= wanted - seek:
            return seek
    return info.pictures_from
