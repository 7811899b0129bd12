"""`write_video`, which draws and encodes the results of `track`, and `process_video`, which is both.

ffmpeg encodes H.264 by x264 or by a graphics processor; x264 replaces an encoder that fails.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal, Protocol, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Closing,
    atomic_write,
    call_in_thread,
    check,
    check_suffix,
    fields,
    invalid,
    temporary_folder,
)
from vehicle_detection.errors import InvalidInputError, TransientVideoError, VideoError
from vehicle_detection.tracking import FrameResult
from vehicle_detection.video.engine import TrackRun, VideoDetector, VideoReport, track
from vehicle_detection.video.ffmpeg import Process, exit_reason, run_ffmpeg
from vehicle_detection.video.opening import Source, borrow_source
from vehicle_detection.video.probe import VideoInfo, count_frames
from vehicle_detection.video.queues import ClosableQueue, QueueClosed
from vehicle_detection.video.reading import AudioSource, check_span, frame_range
from vehicle_detection.video.sources import FrameSource
from vehicle_detection.video.viewer import open_viewer
from vehicle_detection.video.yuv import planes_from_rgb

_LOGGER = logging.getLogger(__name__)

CONTAINERS = {".mp4": "mp4", ".m4v": "mp4", ".mov": "mov", ".mkv": "matroska"}
"""ffmpeg's name of the container for each suffix that can be written."""

# Codecs that are copied instead of encoded again: those that every browser plays; Matroska holds any.
_COPIED_AUDIO = {"mp4": {"aac", "mp3"}, "mov": {"aac", "mp3"}}
_COPIED_AUDIO["matroska"] = {*_COPIED_AUDIO["mp4"], "ac3", "eac3", "flac", "opus", "vorbis"}
# Fills and cuts the sound where its times and its samples differ by more than 20 ms.
_SYNCHRONIZED = "aresample=async=1:min_hard_comp=0.02"
# Seconds before the start from which the sound is decoded: after a jump into a file that was trimmed without
# encoding, ffmpeg leaves out as much of it as was trimmed.
_SOUND_BEFORE = 10.0


PRESETS = (
    "ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow", "placebo",
)  # fmt: skip
"""Presets of x264, from the fastest to the one with the smallest files."""

ENCODERS = ("x264", "auto", "nvenc", "vaapi", "videotoolbox")
"""Encoders: on the processor; the first one that works; NVIDIA; Intel and AMD on Linux; macOS."""

_USUAL_CRF = 23  # of x264


@dataclasses.dataclass(frozen=True, kw_only=True)
class Encoding(fields.Checked):
    """How a video is encoded as H.264.

    Attributes
    ----------
    preset
        Speed of x264, from ``"ultrafast"`` (large files) to ``"placebo"`` (small ones); `PRESETS`.
    crf
        Quality, from 0 (best) to 51; 6 more give about half the size. None: the encoder's usual one, 23 of
        x264. The numbers of other encoders are similar, not equal.
    encoder
        ``"x264"``; ``"nvenc"``, ``"vaapi"`` or ``"videotoolbox"`` for graphics processors, which are faster
        with larger files; ``"auto"`` for one of these that works. x264 replaces one that does not work.

    >>> Encoding(preset="fast", crf=20).encoder
    'x264'
    """

    preset: str = fields.choice("veryfast", PRESETS)
    crf: int | None = fields.integer(None, low=0, high=51)
    encoder: Literal["x264", "auto", "nvenc", "vaapi", "videotoolbox"] = fields.choice("x264", ENCODERS)

    def options(self, filters: str) -> list[str]:
        """Return the options of ffmpeg that filter and encode frames, with an encoder that works."""
        wanted = self.encoder
        tried = ENCODERS[2:] if wanted == "auto" else (wanted,)
        failures = {name: _encoder_failure(name) for name in tried if name != "x264"}
        works = next((name for name in tried if not failures.get(name)), "x264")
        if works != wanted:
            reason = failures.get(wanted, "")
            _LOGGER.log(
                logging.WARNING if reason else logging.INFO,
                "encoding with %s%s",
                works,
                f", because {wanted} does not work here ({reason})" if reason else "",
            )
        return self._options(works, filters)

    def _options(self, encoder: str, filters: str) -> list[str]:
        quality = _USUAL_CRF if self.crf is None else self.crf
        if encoder == "nvenc":
            return ["-vf", filters, "-c:v", "h264_nvenc", "-rc", "vbr", "-cq", str(quality), "-b:v", "0"]
        if encoder == "vaapi":
            upload = ["-vaapi_device", "/dev/dri/renderD128", "-vf", f"{filters},format=nv12,hwupload"]
            return [*upload, "-c:v", "h264_vaapi", "-qp", str(quality)]
        if encoder == "videotoolbox":  # its quality is 1 to 100, the best
            return ["-vf", filters, "-c:v", "h264_videotoolbox", "-q:v", str(max(1, 100 - 2 * quality))]
        crf = [] if self.crf is None else ["-crf", str(self.crf)]
        return ["-vf", filters, "-c:v", "libx264", "-preset", self.preset, *crf]


@functools.cache
def _encoder_failure(encoder: str) -> str:
    """Why a few frames cannot be encoded; empty if they can."""
    frames = ("-f", "lavfi", "-i", "color=size=320x256:rate=25:duration=0.2")
    options = Encoding()._options(encoder, "null")
    code, log = run_ffmpeg(Path(encoder), (*frames, *options, "-f", "null", "-"), level="error")
    return exit_reason(code, log) if code else ""


class FrameWriter(Closing):
    """Writer of ``(H, W, 3)`` uint8 RGB frames as H.264 at a constant rate, with the audio of another file.

    H.264 that every player supports needs even sides, so odd ones are extended by one pixel.
    """

    def __init__(
        self, path: Path, info: VideoInfo, *, name: str, encoding: Encoding, audio: AudioSource | None
    ) -> None:
        """Start ffmpeg, which writes to `path`; `name` names the video in errors."""
        container = CONTAINERS[path.suffix.lower()]
        self.frames_written = 0
        self._path, self._name, self._has_sound = path, name, audio is not None
        self._fps = info.fps
        width, height = info.width + info.width % 2, info.height + info.height % 2
        self._planes = np.empty((height * 3 // 2, width), np.uint8)
        video = ["-f", "rawvideo", "-pixel_format", "yuv420p", "-video_size", f"{width}x{height}"]
        video += ["-framerate", str(info.fps)]
        sound, mapped = list[str](), ["-map", "0:v:0"]
        if audio is not None:
            lead = audio.start - audio.audio_offset
            # Matroska has no times before 0, for the part of a packet before the first frame.
            copyable = audio.copyable and (lead <= 0 or container != "matroska")
            copied = copyable and info.audio_codec in _COPIED_AUDIO[container]
            before = 0.0 if copied else min(max(lead, 0.0), _SOUND_BEFORE)
            if lead > before:
                sound += ["-ss", f"{audio.start - before:.6f}"]
            elif lead < 0:
                sound += ["-itsoffset", f"{-lead:.6f}"]
            sound += ["-vn", *audio.input]
            end = "" if audio.length is None else f":end={before + audio.length:.6f}"
            part = f"atrim=start={before:.6f}{end},asetpts=PTS-{before:.6f}/TB"
            encoded = ["-c:a", "aac", "-b:a", "192k", "-af", f"{_SYNCHRONIZED},{part}"]
            mapped += ["-map", f"1:a:{info.audio_track}", *(["-c:a", "copy"] if copied else encoded)]
        filters = "setparams=colorspace=smpte170m:color_primaries=bt709:color_trc=bt709:range=tv"
        encoder = [*encoding.options(filters), "-fps_mode", "passthrough"]
        # Chapters and other metadata are those of the whole source, and its title and place may be private.
        self._muxer = ["-map_chapters", "-1", "-map_metadata", "-1", "-f", container]
        if container != "matroska":  # the index at the front lets a browser play while it downloads
            self._muxer += ["-movflags", "+faststart"]
        options = ["-y", *video, "-i", "pipe:0", *sound, *mapped, *encoder, *self._muxer, f"file:{path}"]
        self._process = Process(options, stdin=subprocess.PIPE)

    def kill(self) -> None:
        """End ffmpeg at once, from any thread; a thread that writes sees an error."""
        self._process.kill()

    def close(self) -> None:
        """End ffmpeg if it is still running."""
        self._process.close()
        self.cpu_seconds = self._process.cpu_seconds

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Send one frame to ffmpeg."""
        planes_from_rgb(frame, self._planes)
        self.repeat()

    def repeat(self) -> None:
        """Send the last frame once more."""
        view = self._planes.data.cast("B")
        done = 0
        try:
            while done < len(view):
                done += self._process.stdin.write(view[done:])
        except OSError as error:
            raise self._error() from error
        self.frames_written += 1

    def finish(self, *, trim_sound: bool = False) -> None:
        """Wait until ffmpeg has written the last frame, and the sound: all of it, or up to that frame."""
        if not self.frames_written:
            raise VideoError("no frame was read, so no video was written")
        self._process.stdin.close()
        self._check(self._path)
        if trim_sound and self._has_sound:
            self._trim_sound()

    def _trim_sound(self) -> None:
        """Copy the file with the sound up to the end of the last frame."""
        seconds = float(self.frames_written / self._fps)
        whole = ("-i", f"file:{self._path}")
        with temporary_folder(self._path.parent, self._path.stem) as folder:
            trimmed = folder / self._path.name
            options = [*whole, "-t", f"{seconds:.6f}", *whole, "-map", "0:v:0", "-map", "1:a:0"]
            self.close()
            self._process = Process([*options, "-c", "copy", *self._muxer, f"file:{trimmed}"])
            self._check(trimmed)
            # Not renamed: other processes recognize a file in use by its lock.
            shutil.copyfile(trimmed, self._path)

    def _check(self, path: Path) -> None:
        """Wait for the end of ffmpeg, and count the frames of its file; an error if some are missing."""
        code = self._process.wait()
        options = ("-i", f"file:{path}", "-map", "0:v:0", "-c", "copy", "-f", "null", "-")
        if code:
            raise self._error()
        frames = count_frames(run_ffmpeg(path, options, level="info")[1])
        if frames != self.frames_written:
            known = self._process.log().strip()
            reason = f" ({exit_reason(code, known)})" if known else ""
            raise TransientVideoError(
                f"{self._name} cannot be written: ffmpeg wrote {frames} of {self.frames_written} frames"
                f"{reason}; check ffmpeg and the disk; nothing of it was kept"
            )

    def _error(self) -> TransientVideoError:
        reason = exit_reason(self._process.wait(), self._process.log())
        return TransientVideoError(f"{self._name} cannot be written: {reason}; nothing of it was kept")


class VideoAnnotator(Protocol):
    """Draws the pictures of an annotated video, such as an `Annotator`."""

    def draw(self, frame: NDArray[np.uint8], result: Any, /) -> NDArray[np.uint8]:
        """Draw a result on a copy of its frame."""

    def output_shape(self, shape: tuple[int, ...], /) -> tuple[int, ...]:
        """Shape of the pictures for frames of a shape."""

    def reset(self, *, fps: float) -> None:
        """Forget all frames."""


def write_video(
    results: TrackRun,
    target: str | os.PathLike[str] | None,
    annotator: VideoAnnotator,
    *,
    audio: bool = True,
    encoding: Encoding | None = None,
    show: bool = False,
    on_result: Callable[[FrameResult], object] | None = None,
) -> VideoReport:
    """Draw the results of `track` on their frames, and write them to a video; a `VideoError` if that fails.

    The video is H.264 in yuv420p, which browsers play, with the frame rate, all frames and the sound of the
    source, upright. A varying frame rate is converted to a constant one. An odd width or height is extended
    by one pixel, which repeats the last column or row.

    Parameters
    ----------
    results
        What ``track(..., frames=True)`` returned. Ctrl-C ends a live source, and completes the target.
    target
        The file to write: .mp4, .m4v, .mov or .mkv. After an error, an existing file is unchanged. None:
        write no video.
    annotator
        An `Annotator`, such as ``detector.annotator``.
    audio
        Keep the sound. It is copied if the whole video is processed and every player supports its codec,
        otherwise it is encoded as AAC.
    encoding
        Preset, quality and encoder, an `Encoding` of `vehicle_detection.video`; None: x264, "veryfast".
    show
        Show the annotated frames in a window, or in a notebook below the cell. Closing the window, or the key
        Escape, ends the run and completes the target.
    on_result
        Function that is called with each result, without its frame, in frame order, in the calling thread.

    Examples
    --------
    >>> from vehicle_detection import VehicleDetector, track, write_video
    >>> detector = VehicleDetector("highway")
    >>> results = track("test_images/*.jpg", detector, end=0.08, frames=True)
    >>> write_video(results, None, detector.annotator).frames
    2
    """
    check.instance(results, "results", TrackRun, "pass what track(..., frames=True) returned")
    with contextlib.ExitStack() as stack:
        stack.enter_context(results)
        stack.enter_context(_name_changed_source(results.source))
        check.flags(audio=audio, show=show)
        check.instance(encoding, "encoding", Encoding | None, "omit it for the default")
        check.function(on_result, "on_result", "a result")
        started, sink, viewer = time.perf_counter(), None, None
        drawing = None if target is None and not show else _Drawing(annotator, results)
        if drawing is not None and target is not None:
            output = check_video_target(target, results.source.files)
            sound = results.sound() if audio else None
            sink = stack.enter_context(_Sink(_open_writer(output, drawing.info, encoding, sound)))
        if show:
            viewer = stack.enter_context(contextlib.closing(open_viewer(results.source.name)))
        stack.enter_context(_stop_on_interrupt(results))
        for result in results:
            if drawing is not None:
                picture, missed = drawing.draw(result)
                if sink is not None:
                    sink.put(picture, repeats=missed)
            if on_result is not None:
                on_result(result if result.frame is None else dataclasses.replace(result, frame=None))
            if viewer is not None:
                viewer.show(picture)
                if viewer.closed:
                    results.stop()
            del result
        if sink is not None:
            sink.finish(trim_sound=results.stopped)
    report = results.report()
    stages, waiting = dict(report.stages), dict(report.waiting)
    if drawing is not None:
        stages["draw"] = drawing.seconds
    if sink is not None:
        stages["search"] = max(stages["search"] - sink.thread_seconds, 0.0)
        stages["encode"], waiting["encode"] = sink.seconds, sink.waiting
    seconds = time.perf_counter() - started
    return dataclasses.replace(report, seconds=seconds, stages=stages, waiting=waiting)


class TrackOptions(TypedDict, total=False):
    """Options of `track` that `process_video` passes on."""

    start: float | None
    end: float | None
    every: int | None
    jobs: int | None


def process_video(
    source: Source,
    target: str | os.PathLike[str] | None,
    detector: VideoDetector,
    *,
    audio: bool = True,
    encoding: Encoding | None = None,
    show: bool = False,
    on_result: Callable[[FrameResult], object] | None = None,
    progress: bool = True,
    **options: Unpack[TrackOptions],
) -> VideoReport:
    """Detect and track the vehicles of a video, and write a copy with their boxes: `track` and `write_video`.

    `source`, `detector`, `progress`, ``start``, ``end``, ``every`` and ``jobs`` are those of `track`, the
    others those of `write_video`. The detector's ``annotator`` draws; without a target and `show`, nothing
    is drawn.

    >>> from vehicle_detection import VehicleDetector  # doctest: +SKIP
    >>> print(process_video("drive.mp4", "found.mp4", VehicleDetector()))  # doctest: +SKIP
    """
    draws = target is not None or show
    if target is not None:
        check_video_target(target)
    results = track(source, detector, frames=draws, progress=progress, **options)
    annotator: Any = getattr(results.detector, "annotator", None)
    return write_video(
        results, target, annotator, audio=audio, encoding=encoding, show=show, on_result=on_result
    )


class _Drawing:
    """Draws the results of a run one after the other."""

    def __init__(self, annotator: VideoAnnotator, results: TrackRun) -> None:
        if not results.has_frames:
            raise InvalidInputError("results must hold their frames; pass frames=True to track")
        if not all(hasattr(annotator, name) for name in ("draw", "output_shape", "reset")):
            must = "have the methods draw, output_shape and reset"
            raise invalid("annotator", must, annotator, "pass an Annotator, such as detector.annotator")
        annotator.reset(fps=float(results.info.fps))
        self._annotator, self._expected, self.seconds = annotator, -1, 0.0
        self._shape = annotator.output_shape(results.info.shape)
        self.info = dataclasses.replace(results.info, height=self._shape[0], width=self._shape[1])

    def draw(self, result: FrameResult) -> tuple[NDArray[np.uint8], int]:
        """Return the picture of a result, and the number of frames that were dropped before it."""
        start, frame = time.thread_time(), result.frame
        assert frame is not None
        drawn = self._annotator.draw(frame, result)
        if getattr(drawn, "shape", None) != self._shape or drawn.dtype != np.uint8:
            raise invalid(
                "annotator.draw", f"return a {self._shape} uint8 array", drawn, "draw on a copy of the frame"
            )
        missed = result.index - self._expected if self._expected >= 0 else 0
        self._expected = result.index + 1
        self.seconds += time.thread_time() - start
        return np.ascontiguousarray(drawn), missed


class _Sink(Closing):
    """Encodes pictures in a thread, which starts with the first one, and completes or removes the file.

    Python raises KeyboardInterrupt in the main thread, where it must not interrupt this work.
    """

    def __init__(self, writer: AbstractContextManager[FrameWriter]) -> None:
        self._open_writer = writer
        self._writer: FrameWriter | None = None
        self._pictures: ClosableQueue[tuple[NDArray[np.uint8], int]] = ClosableQueue(2)
        self._thread = threading.Thread(target=self._encode, name="vehicle-encode")
        self._lock = threading.Lock()
        self._aborted = self._trim_sound = False
        self.seconds = self.thread_seconds = self.waiting = 0.0
        """Processor time of the thread and ffmpeg, and of the thread; and its time without work."""

    def put(self, picture: NDArray[np.uint8], *, repeats: int = 0) -> None:
        """Append a picture after repeating the last one; raise an error of the encoder."""
        if self._thread.ident is None:
            call_in_thread(self._thread.start)
        self._pictures.put((picture, repeats))

    def finish(self, *, trim_sound: bool) -> None:
        """Complete the file; with `trim_sound`, the sound ends with the frames."""
        if self._thread.ident is None:
            raise VideoError("no frame was read, so no video was written")
        self._trim_sound = trim_sound
        self._pictures.finish()
        self._thread.join()
        for _ in self._pictures:  # raises an error of the encoder after the last picture
            pass

    def close(self) -> None:
        """Remove an incomplete file, and end the thread."""
        self._pictures.abort()
        with self._lock:
            self._aborted = True
            if self._writer is not None:
                self._writer.kill()
        if self._thread.ident is not None:
            self._thread.join()

    def _encode(self) -> None:
        started = time.perf_counter()
        try:
            with self._open_writer as writer:
                with self._lock:
                    if self._aborted:
                        raise QueueClosed
                    self._writer = writer
                for picture, repeats in self._pictures:
                    for _ in range(repeats):
                        writer.repeat()
                    writer.write(picture)
                writer.finish(trim_sound=self._trim_sound)
            self.seconds += writer.cpu_seconds
        except QueueClosed:
            return
        except BaseException as error:  # raised in the calling thread at its next picture
            self._pictures.abort(error)
        finally:
            self.thread_seconds = time.thread_time()
            self.waiting = time.perf_counter() - started - self.thread_seconds
            self.seconds += self.thread_seconds


@contextlib.contextmanager
def _name_changed_source(source: FrameSource) -> Iterator[None]:
    """Name a source that changes while it is read as the cause of an error, in place of the output."""
    try:
        yield
    except VideoError as error:
        change = source.find_change()
        if change and change not in str(error):
            raise TransientVideoError(change) from error
        raise


@contextlib.contextmanager
def _stop_on_interrupt(results: TrackRun) -> Iterator[None]:
    """Let the first Ctrl-C end a live source, which has no other end; a second one interrupts the run."""
    if not results.source.live or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: Any) -> None:
        signal.signal(signal.SIGINT, before)
        # In a thread: the handler may interrupt a thread that holds the locks which `stop` needs.
        threading.Thread(target=results.stop, name="vehicle-stop").start()

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def cut_video(
    source: Source,
    target: str | os.PathLike[str],
    *,
    start: float | None = None,
    end: float | None = None,
) -> int:
    """Copy a part of a video, with its sound, to another file; returns the number of frames."""
    start, end = check_span(start, end)
    with borrow_source(source) as opened:
        output = check_video_target(target, opened.files)
        first, count = frame_range(opened.info, start, end)
        with (
            _name_changed_source(opened),
            opened.read(first, count) as frames,
            _open_writer(output, opened.info, None, opened.audio(first, end)) as writer,
        ):
            for _, _, frame in frames:
                writer.write(frame)
            writer.finish()
    return writer.frames_written


@contextlib.contextmanager
def _open_writer(
    target: Path, info: VideoInfo, encoding: Encoding | None, audio: AudioSource | None
) -> Iterator[FrameWriter]:
    """Open a video file that is written atomically."""
    with (
        atomic_write(target) as part,
        FrameWriter(part, info, name=str(target), encoding=encoding or Encoding(), audio=audio) as writer,
    ):
        yield writer


def check_video_target(target: object, sources: Sequence[Path] = ()) -> Path:
    """Return the path of a video that can be written and is none of the sources."""
    path = check_suffix(
        check.path(target, "target", kind="the path of a video file"), "target", tuple(CONTAINERS)
    )
    if path.exists() and any(path.samefile(source) for source in sources):
        raise InvalidInputError(f"target {path} is the source; choose another name")
    return path
