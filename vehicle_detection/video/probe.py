"""Properties of a video file.

moviepy's own probe (2.2) rounds 59.94 frames/s and, with a current ffmpeg, ignores the rotation of phone
videos. This one reads the log of ffmpeg's filter graph, which has the exact rate and the upright size.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

from vehicle_detection._common import call_in_thread
from vehicle_detection.errors import VideoError
from vehicle_detection.video.ffmpeg import (
    SQUARE_PIXELS,
    Process,
    check_frame_size,
    check_resources,
    exit_reason,
    input_options,
    last_line,
    pixel_limit,
    run_ffmpeg,
    seconds_of,
    source_name,
    video_error,
)
from vehicle_detection.video.yuv import ColorEncoding

# Containers in which ffmpeg's time 0 is the start of the only stream that is read, not that of the file.
_OWN_STARTS = ("mpegts", "mpeg", "hls", "ogg")
_STREAM_START = r", start (-?[\d.]+)"
_FIRST_FRAME = r"n: *0 .*?pts_time:(\S+).*? s:(\d+)x(\d+)"
# Containers whose duration counts from time 0 instead of from the file's start.
_DURATION_IS_END = ("matroska,webm", "flv")
# Rate in Hz above which a rate may be that of a clock, or of frames that arrive in bursts.
_MAX_RATE = 60
# Length of the beginning of a remote file whose times are read.
_REMOTE_SECONDS = "30"


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """Properties of a video file.

    Attributes
    ----------
    width, height
        Size of a frame in pixels, after the rotation stored in the file. The width of anamorphic video, whose
        stored pixels are not square, is that of frames with square pixels.
    fps, constant_rate
        Exact frame rate, such as 30000/1001, and whether it is the file's; if the file's rate varies, it is
        the constant rate to which its frames are converted.
    frames, duration
        Number of frames, estimated from the length in seconds; 0 if unknown.
    rotation
        Clockwise rotation in degrees from the stored frames to upright ones.
    start_time
        Time of the first frame in seconds after the file's start, if the sound starts earlier; otherwise 0.0.
    pixel_format, container
        ffmpeg's names, such as ``"yuv420p"`` and ``"matroska,webm"``; empty if unknown.
    audio_track, audio_codec
        Index and codec (such as ``"aac"``) of the first audio track that can be decoded; None without one.

    Examples
    --------
    >>> info = VideoInfo(width=1280, height=720, fps=Fraction(30000, 1001), frames=60, duration=2.002)
    >>> info.shape, info.has_audio
    ((720, 1280, 3), False)
    """

    width: int
    height: int
    fps: Fraction
    frames: int
    duration: float
    rotation: int = 0
    constant_rate: bool = True
    start_time: float = 0.0
    pixel_format: str = ""
    color_encoding: ColorEncoding = field(default_factory=ColorEncoding)
    container: str = ""
    first_timestamp: float = 0.0  # of the first frame in seconds, as stored in the file
    # ffmpeg's time 0 in seconds after the file's start, if it reads only that stream: the start of the stream
    # in MPEG-TS and similar containers, 0 in others.
    video_offset: float = 0.0
    audio_offset: float = 0.0
    audio_track: int | None = None
    audio_codec: str | None = None
    audio_format: tuple[str, ...] = ()  # stream number, codec, rate and channels, as ffmpeg prints them

    @property
    def has_audio(self) -> bool:
        """Whether there is a decodable audio track."""
        return self.audio_track is not None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a frame: ``(height, width, 3)``."""
        return (self.height, self.width, 3)


def probe(path: Path | str) -> VideoInfo:
    """Read the properties of a video and decode its first frame; raise a VideoError if there is none."""
    # Python raises KeyboardInterrupt in the main thread only; another thread cannot lose the started process.
    return call_in_thread(lambda: _probe(path))


def _probe(path: Path | str) -> VideoInfo:
    header, decoded, container = _read_log(path)
    moment, width, height = _find_all(_FIRST_FRAME, decoded)
    index = int(_find(r"Stream #0:(\d+)", decoded, "0"))
    stream = _find(rf"^(  Stream #0:{index}\b[\s\S]*?)(?=^  Stream #|\Z)", header, "")
    fps, constant = frame_rate(decoded, stream)
    if container == "matroska,webm":  # its header may state a wrong rate
        fps, constant = _rate_of_times(fps, _frame_times(path))
    begin = float(_find(r"^  Duration: .*?, start: (-?[\d.]+)", header, "0"))
    duration = seconds_of(_find(r"^  Duration: ([\d:.]+)", header, "0:0:0"))
    if container in _DURATION_IS_END:
        duration = max(duration - begin, 0.0)
    audio = re.findall(r"^  Stream #0:(\d+).*?: Audio: (\w+)(.*)", header, re.MULTILINE)
    track = next((number for number, (_, codec, _) in enumerate(audio) if codec != "none"), None)
    audio_index, audio_codec, audio_text = ("", None, "") if track is None else audio[track]
    video_offset, audio_offset = 0.0, 0.0
    if container in _OWN_STARTS:
        video_offset = float(_find(_STREAM_START, stream, str(begin))) - begin
        audio_offset = float(_find(_STREAM_START, audio_text, str(begin))) - begin
    # With a varying rate, the gap before the first frame is filled with copies of it.
    start_time = video_offset + (float(moment) if constant and moment[-1].isdigit() else 0.0)
    # The duration in AVI files is that of the frames.
    length = duration if container == "avi" else max(duration - start_time, 0.0)
    sound = _find_all(r", (\d+) Hz, ([^,]+)", audio_text)
    colors = _find_all(r"color_range:(\w+) color_space:(\w+)", decoded)
    return VideoInfo(
        width=int(width),
        height=int(height),
        fps=fps,
        frames=round(length * fps),
        duration=duration,
        rotation=round(-float(_find(r"rotation of (-?[\d.]+) degrees", stream, "0"))) % 360,
        constant_rate=constant,
        start_time=start_time,
        pixel_format=_find(r"n: *0 .*? fmt:(\w+)", decoded, ""),
        color_encoding=ColorEncoding(colors[1], colors[0] == "pc") if colors else ColorEncoding(),
        container=container,
        first_timestamp=begin + start_time,
        video_offset=video_offset,
        audio_offset=audio_offset,
        audio_track=track,
        audio_codec=audio_codec,
        audio_format=() if audio_codec is None else (audio_index, audio_codec, *sound),
    )


def _read_log(path: Path | str) -> tuple[str, str, str]:
    """Decode the first frame of a video, with square pixels; raise a VideoError if there is none.

    Returns ffmpeg's log about the file, the log about the filters and the frame, and the container's names.
    """
    # "V" excludes cover pictures. Only the showinfo filter prints the exact frame rate.
    options = ("-map", "0:V:0", "-frames:v", "1", "-vf", f"{SQUARE_PIXELS},showinfo", "-f", "null", "-")
    name = source_name(path)
    code, log = run_ffmpeg(path, (*pixel_limit(), *input_options(path), *options), level="info")
    if code < 0:
        raise video_error(f"{name} cannot be read: {exit_reason(code, log)}", path, code, log)
    check_frame_size(name, log)
    header, mapped, decoded = log.partition("\nStream mapping:\n")  # not a title in the metadata
    container = _find(r"^Input #0, (\S+),", header, "")
    if not container:
        if _is_text(Path(path)):
            raise VideoError(f"{name} is a text file, not a video; choose the video")
        truncated = "moov atom not found" in log
        reason = "its index is missing: the recording or copy is incomplete" if truncated else last_line(log)
        message = f"{name} is not a video that ffmpeg can read ({reason}); record or copy it again"
        raise video_error(message, path, code, log)
    if not mapped:
        raise VideoError(f"{name} has no video track; choose a file with one")
    if not _find_all(_FIRST_FRAME, decoded):
        message = f"{name} has no frame that can be decoded ({last_line(log)}); copy it again"
        raise video_error(message, path, code, log)
    return header, decoded, container


def _find_all(pattern: str, text: str) -> tuple[str, ...]:
    """Return what a pattern's groups find first; empty if they find nothing."""
    found = re.search(pattern, text, re.MULTILINE)
    return found.groups() if found else ()


def _find(pattern: str, text: str, default: str) -> str:
    """Return what a pattern's group finds first."""
    return next(iter(_find_all(pattern, text)), default)


def _is_text(path: Path) -> bool:
    """Whether a file starts with UTF-8 text, such as a saved web page or a pointer to large-file storage."""
    try:
        with path.open("rb") as file:
            start = file.read(512)
    except OSError:
        return False
    text = start.decode("utf-8", "ignore")
    control = sum(ord(letter) < 32 and letter not in "\t\n\r\f" for letter in text)
    return bool(start) and not control and len(text.encode()) >= len(start) - 3


def frame_rate(decoded: str, stream: str) -> tuple[Fraction, bool]:
    """Frame rate, and whether it is constant, from ffmpeg's log."""
    exact, printed = _find_all(r"frame_rate: (\d+)/(\d+)", decoded), _find_all(r"([\d.]+)(k?) fps", stream)
    mean = Fraction(printed[0]) * (1000 if printed[1] else 1) if printed else Fraction(0)
    rate = Fraction(int(exact[0]), int(exact[1])) if exact and int(exact[0]) and int(exact[1]) else mean
    if not rate:
        return Fraction(25), False
    # Tolerance: ffmpeg prints the mean rate with two decimals.
    constant = not mean or abs(rate - mean) <= Fraction(6, 1000)
    return (rate if constant else _resampling_rate(rate, mean)), constant


def _frame_times(path: Path | str) -> list[float]:
    """List the times of all frames in seconds, without decoding them; of a URL those of its beginning."""
    limit = () if isinstance(path, Path) else ("-t", _REMOTE_SECONDS)
    options = (*limit, *input_options(path), "-map", "0:V:0", "-c", "copy")
    options += ("-f", "framecrc", "pipe:1")
    with contextlib.closing(Process(options, stdout=True)) as process:
        listing = process.stdout.read().decode()
        check_resources(source_name(path), process.wait(), process.log())
    unit = re.search(r"^#tb 0: (\d+)/(\d+)", listing, re.MULTILINE)
    ticks = re.findall(r"^0, +-?\d+, +(-?\d+),", listing, re.MULTILINE)
    return sorted(int(tick) * int(unit[1]) / int(unit[2]) for tick in ticks) if unit else []


def _rate_of_times(rate: Fraction, times: Sequence[float]) -> tuple[Fraction, bool]:
    """Frame rate, and whether it is constant, from a nominal rate and the times of all frames."""
    if all(abs((moment - times[0]) * float(rate) - n) < 0.75 for n, moment in enumerate(times)):
        return rate, True
    mean = Fraction((len(times) - 1) / ((times[-1] - times[0]) or 1.0))
    # A nominal rate that is the mean over gaps would drop frames between them.
    steps = [after - before for before, after in itertools.pairwise(times)]
    usual = [step for step in steps if step < 1.5 * statistics.median(steps)]
    without_gaps = Fraction(len(usual) / (sum(usual) or 1.0))
    if Fraction(101, 100) * rate < without_gaps <= _MAX_RATE:
        return without_gaps.limit_denominator(1001), False
    return _resampling_rate(rate, mean), False


def _resampling_rate(rate: Fraction, mean: Fraction) -> Fraction:
    """Choose the constant rate for a varying one; screen recorders state their 1000 Hz clock as the rate."""
    return mean.limit_denominator(1001) if rate > _MAX_RATE and rate > 2 * mean else rate
