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
from dataclasses import dataclass, field, replace
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
# Containers whose files may be joined byte by byte; seconds by which that makes them longer.
_JOINABLE, _JOINED_SECONDS = ("mpegts", "mpeg"), 1.0
# Containers whose duration counts from time 0 instead of from the file's start.
_DURATION_IS_END = ("matroska,webm", "flv")
# Demuxers of streams without a container, besides those whose names end in "_pipe".
_RAW = {
    "h264", "hevc", "vvc", "mjpeg", "m4v", "mpegvideo", "h263", "h261", "cavsvideo", "dirac", "vc1", "obu",
}  # fmt: skip
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
    stream: int = 0  # ffmpeg's number of the video stream
    other_streams: str = ""  # the other video streams, such as "0 (320x180)"
    rate_stated: bool = True  # whether the file states its frame rate
    times_restart: bool = False  # whether it can only be read from its beginning, see `joined_length`
    other_index: bool = False  # whether another MP4 file follows in it, which ffmpeg does not read

    @property
    def has_audio(self) -> bool:
        """Whether there is a decodable audio track."""
        return self.audio_track is not None

    @property
    def is_raw(self) -> bool:
        """Whether it has no container, and therefore no times, such as a file of H.264."""
        return self.container in _RAW or self.container.endswith("_pipe")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a frame: ``(height, width, 3)``."""
        return (self.height, self.width, 3)


def probe(path: Path | str, stream: int | None = None) -> VideoInfo:
    """Read the properties of a video and decode its first frame; raise a VideoError if there is none.

    `stream` is ffmpeg's number of the video stream; None: that which is marked as the default, else the
    largest one, of those with more than one frame.
    """
    # Python raises KeyboardInterrupt in the main thread only; another thread cannot lose the started process.
    return call_in_thread(lambda: _probe(path, stream))


def _probe(path: Path | str, chosen: int | None) -> VideoInfo:
    header, decoded, container = _read_log(path, "0:V:0" if chosen is None else f"0:{chosen}")
    index, streams = int(_find(r"Stream #0:(\d+)", decoded, "0")), _video_streams(header)
    if chosen is None and len(streams) > 1:
        best = next((each for each in streams if _has_frames(path, each)), index)
        if best != index:
            index, (header, decoded, container) = best, _read_log(path, f"0:{best}")
    moment, width, height = _find_all(_FIRST_FRAME, decoded)
    stream = _find(rf"^(  Stream #0:{index}\b[\s\S]*?)(?=^  Stream #|\Z)", header, "")
    fps, constant = frame_rate(decoded, stream)
    if container == "matroska,webm":  # its header may state a wrong rate
        fps, constant = _rate_of_times(fps, _frame_times(path, index))
    # H.264 may state half of its rate; ffmpeg sees it by the times, which may also be those of fields.
    faster = float(_find(r"([\d.]+) tbr", stream, "0")) > 1.05 * fps
    if container in _JOINABLE and constant and faster:
        fps = _rate_of_first_frames(path, index) or fps
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
    info = VideoInfo(
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
        stream=index,
        other_index="duplicated MOOV" in header,
        other_streams=", ".join(f"{each} ({size})" for each, size in streams.items() if each != index),
    )
    return _rate_of_raw(path, info) if info.is_raw else info


def _video_streams(header: str) -> dict[int, str]:
    """Return numbers and sizes of the video streams, without covers: default ones first, then large ones."""
    lines = re.findall(r"^  Stream #0:(\d+).*: Video: .*?, (\d+)x(\d+)(.*)", header, re.MULTILINE)
    found = [line for line in lines if "(attached pic)" not in line[3]]
    found.sort(key=lambda line: ("(default)" not in line[3], -int(line[1]) * int(line[2])))
    return {int(number): f"{width}x{height}" for number, width, height, _ in found}


def _has_frames(path: Path | str, stream: int) -> bool:
    """Whether a stream has more than one frame."""
    options = (*input_options(path), "-map", f"0:{stream}", "-c", "copy", "-frames:v", "2", "-f", "null", "-")
    return count_frames(run_ffmpeg(path, options, level="info")[1]) > 1


def _rate_of_raw(path: Path | str, info: VideoInfo) -> VideoInfo:
    """Return the properties of a raw stream with its frame rate, or 25 if it states none.

    ffmpeg gives the frames of a stream without a rate that of an option, here a rate that no stream has.
    """
    _, decoded, _ = _read_log(path, f"0:{info.stream}", ("-framerate", "17"))
    length = float(_find(r"n: *0 .*?duration_time:(\d[\d.]*)", decoded, "0"))
    stated = length > 0 and abs(17 * length - 1) > 1e-4
    rate = Fraction(1 / length).limit_denominator(1001) if stated else Fraction(25)
    return replace(info, fps=rate, constant_rate=True, rate_stated=stated)


def count_frames(log: str) -> int:
    """Return the number of frames by ffmpeg's statistics."""
    return int(re.findall(r"frame= *(\d+)", log)[-1]) if "frame=" in log else 0


def _read_log(path: Path | str, stream: str, demuxer: tuple[str, ...] = ()) -> tuple[str, str, str]:
    """Decode the first frame of a stream, with square pixels; raise a VideoError if there is none.

    Returns ffmpeg's log about the file, the log about the filters and the frame, and the container's names.
    """
    # "V" excludes cover pictures. Only the showinfo filter prints the exact frame rate.
    options = ("-map", stream, "-frames:v", "1", "-vf", f"{SQUARE_PIXELS},showinfo", "-f", "null", "-")
    name = source_name(path)
    code, log = run_ffmpeg(path, (*pixel_limit(), *demuxer, *input_options(path), *options), level="info")
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
        reason = "it is empty" if isinstance(path, Path) and not path.stat().st_size else reason
        message = f"{name} is not a video that ffmpeg can read ({reason}); record or copy it again"
        raise video_error(message, path, code, log)
    if not mapped:
        known = _video_streams(header)
        raise VideoError(
            f"{name} has the video streams {', '.join(map(str, known))}, not {stream[2:]}; choose one of them"
            if known
            else f"{name} has no video track; choose a file with one"
        )
    if not _find_all(_FIRST_FRAME, decoded):
        reason = "it is incomplete" if "partial file" in log else last_line(log)
        message = f"{name} has no frame that can be decoded ({reason}); copy it again"
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


def _frame_times(path: Path | str, stream: int) -> list[float]:
    """List the times of all frames in seconds, without decoding them; of a URL those of its beginning."""
    limit = () if isinstance(path, Path) else ("-t", _REMOTE_SECONDS)
    options = (*limit, *input_options(path), "-map", f"0:{stream}", "-c", "copy")
    options += ("-f", "framecrc", "pipe:1")
    with contextlib.closing(Process(options, stdout=True)) as process:
        listing = process.stdout.read().decode()
        check_resources(source_name(path), process.wait(), process.log())
    unit = re.search(r"^#tb 0: (\d+)/(\d+)", listing, re.MULTILINE)
    ticks = re.findall(r"^0, +-?\d+, +(-?\d+),", listing, re.MULTILINE)
    return sorted(int(tick) * int(unit[1]) / int(unit[2]) for tick in ticks) if unit else []


def joined_length(path: Path, info: VideoInfo) -> float:
    """Length in seconds of recordings that were joined byte by byte, whose times begin again; otherwise 0.

    ffmpeg reads them one after the other, but jumps into any of them, and states the length of the last one.
    """
    times = _frame_times(path, info.stream) if info.container in _JOINABLE else []
    length = times[-1] + float(1 / info.fps) if times else 0.0
    return length if length > info.duration + _JOINED_SECONDS else 0.0


def with_repeats(path: Path | str, info: VideoInfo) -> VideoInfo:
    """Return the properties of an AVI file, with a varying rate if it has empty frames, which repeat others.

    ffmpeg leaves them out, so that the times have gaps. Times of files with B-frames are unknown.
    """
    times = _frame_times(path, info.stream) if info.container == "avi" and info.constant_rate else []
    if not times or times[0] < 0:
        return info
    fps, constant = _rate_of_times(info.fps, times)
    return replace(info, fps=fps, constant_rate=constant)


def _rate_of_first_frames(path: Path | str, stream: int) -> Fraction | None:
    """Frame rate by the times of the first decoded frames; None if they have none."""
    options = ("-map", f"0:{stream}", "-frames:v", "25", "-vf", "showinfo", "-f", "null", "-")
    _, log = run_ffmpeg(path, (*pixel_limit(), *input_options(path), *options), level="info")
    times = [float(each) for each in re.findall(r"n: *\d+ .*?pts_time:(-?[\d.]+)", log)]
    steps = [after - before for before, after in itertools.pairwise(times)]
    step = statistics.median(steps) if steps else 0.0
    return Fraction(1 / step).limit_denominator(1001) if step > 0 else None


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
