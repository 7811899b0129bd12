"""The options of ``video``, and what is made of them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typer import Argument

import vehicle_detection as vd
from vehicle_detection.cli import options as shared
from vehicle_detection.cli.horizon import parse_horizon
from vehicle_detection.cli.options import (
    HORIZON_HELP,
    camera_option,
    drawing_flag,
    drawing_option,
    input_flag,
    input_option,
    output_flag,
    output_option,
    parse_time,
    search_option,
)

if TYPE_CHECKING:
    from vehicle_detection.video import Encoding, FrameSource


@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """Options of ``video``."""

    source: str = Argument(
        ...,
        metavar="SOURCE",
        help="Video file, such as drive.mp4; folder or quoted pattern of a trip's segments, or images; "
        "URL; camera, such as 0; or -.",
    )
    output: Path | None = output_option(
        None,
        "TARGET",
        "Video to write: .mp4, .m4v, .mov or .mkv; default: beside the source, such as drive_tracked.mp4.",
        "-o",
        "--output",
    )
    show: bool = output_flag("--show", "Show the annotated frames in a window; Escape ends the run.")
    tracks: Path | None = output_option(
        None, "FILE", "Tracks: .csv, .jsonl, .parquet, .txt (MOT), .zip (CVAT) or .json (COCO)."
    )
    report: Path | None = output_option(None, "FILE.html", "Page with the video and its tracks.")
    why: bool = output_flag("--why", "Explain a box of each vehicle in --report: the share of each cell.")
    events: Path | None = output_option(
        None, "FILE", "Events, such as cut-ins and overtaking: .csv or .json."
    )
    clips: Path | None = output_option(
        None, "DIR", "Folder for a short annotated clip of each event, such as clips."
    )
    clips_of: str | None = output_option(
        None, "KINDS", "Kinds of events for --clips, such as cut_in,closing; default: all."
    )
    srt: Path | None = output_option(
        None, "FILE", "Subtitles with vehicles, nearest distance and events, second by second: .srt or .ass."
    )
    preset: str = shared.PRESET
    crf: int | None = output_option(None, "N", "Quality of the video, 0 (best) to 51; default: 23.")
    encoder: str = output_option(
        "x264", "NAME", "x264, nvenc, vaapi, videotoolbox, or auto: a graphics processor's if one works."
    )
    no_audio: bool = shared.NO_AUDIO
    quiet: bool = output_flag("-q", "Print errors and warnings of damage only.", "--quiet")
    profile: bool = output_flag("--profile", "Print the processor time and the waiting of each stage.")
    start: str | None = input_option(None, "TIME", "Start time, such as 12.5 (seconds) or 12:30.")
    end: str | None = input_option(None, "TIME", "End time, such as 30 (seconds) or 1:02:06.")
    fps: float | None = input_option(
        None, "N", "Frame rate of images, a raw stream such as .h264, a pipe or a camera, such as 10."
    )
    stream: int | None = input_option(
        None, "N", "Video stream of a file with several, by ffmpeg's number, such as 1."
    )
    own_speed: str | None = input_option(
        None, "SPEED", "Own speed in km/h, such as 100, or 62mph, for headways and speeds over ground."
    )
    gpx: Path | None = input_option(
        None,
        "FILE",
        "Own speed over time: a GPX track, NMEA sentences, or a .csv table with time_s and speed_kmh.",
    )
    gpx_offset: float = input_option(
        0.0,
        "S",
        "Time of the video's start in --gpx: seconds after the first point of a track, or the "
        "time_s of a table, such as 12.5 or -3.",
    )
    live: bool = input_flag(
        "--live", "Drop frames of a pipe rather than lag; default for cameras and streams."
    )
    no_reconnect: bool = input_flag("--no-reconnect", "End with a network stream that breaks off.")
    strict: bool = input_flag("--strict", "Fail, and write nothing, if the source is damaged.")
    camera: str | None = shared.CAMERA
    fov: float | None = shared.FIELD_OF_VIEW
    camera_height: float | None = shared.CAMERA_HEIGHT
    horizon: str | None = camera_option(
        None, "F|auto", f'{HORIZON_HELP} "auto": estimated from vehicles in a sample of frames.'
    )
    model: str = shared.MODEL
    classes: str | None = shared.CLASSES
    device: str = shared.DEVICE
    conf: float | None = shared.CONFIDENCE
    every: int | None = shared.EVERY
    jobs: int | None = search_option(
        None, "N", "Frames searched in parallel, such as 2; default: one per core, at most 4."
    )
    labels: str = drawing_option(
        "id,distance,speed",
        "LIST",
        "Fields of the labels: some of id,distance,speed,score,std, such as id,distance; or none.",
    )
    line_width: int | None = shared.LINE_WIDTH
    color_by: str = drawing_option("id", "id|distance", "What the colors of the boxes stand for.")
    panel: str = drawing_option(
        "none", "corner|side|none", "Bird's-eye view in the frame's corner, or beside it."
    )
    units: str = drawing_option(
        "metric", "metric|imperial", "Labels, subtitles and report in m and km/h, or ft and mph."
    )
    blur: str | None = shared.BLUR
    diagnostics: bool = drawing_flag(
        "--diagnostics", "Show frame, positive windows, heat map and tracks side by side."
    )

    def files(self) -> dict[str, Path | None]:
        """Files to write, by their options."""
        return {f"--{name}": getattr(self, name) for name in ("output", "tracks", "report", "events", "srt")}

    def with_target(self) -> VideoOptions:
        """Name the video to write if one is needed and none or a folder is named; it replaces no file."""
        from vehicle_detection._common import is_url

        source, folder = Path(self.source), self.output
        if self.source.isdecimal() or "*" in self.source or self.source == "-" or is_url(self.source):
            return self
        if folder is None:
            alone = not self.show and all(path is None for path in self.files().values())
            if not alone and self.report is None and self.clips is None:
                return self
            folder = source.parent
        elif not folder.is_dir():
            return self
        numbers = itertools.chain([""], (f"_{number}" for number in itertools.count(2)))
        targets = (folder / f"{source.stem}_tracked{number}.mp4" for number in numbers)
        return replace(self, output=next(target for target in targets if not target.exists()))

    def span(self) -> dict[str, Any]:
        """First and last second of the source."""
        return {"start": parse_time(self.start, "--start"), "end": parse_time(self.end, "--end")}

    def encoding(self) -> Encoding:
        """How the copy is encoded."""
        from vehicle_detection.video import Encoding

        options: dict[str, Any] = {"preset": self.preset, "crf": self.crf, "encoder": self.encoder}
        return Encoding(**options)

    def stated_horizon(self) -> float | None:
        """Return the horizon that the option states; None if it states none, or is to be estimated."""
        return None if self.horizon in (None, "auto") else parse_horizon(str(self.horizon))

    def draw_params(self) -> vd.DrawParams:
        """Parameters of the annotations."""
        fields = [field.strip() for field in self.labels.split(",")]
        style: dict[str, Any] = {"color_by": self.color_by, "panel": self.panel, "units": self.units}
        return vd.DrawParams(labels=() if fields == ["none"] else fields, line_width=self.line_width, **style)

    def open_source(self) -> FrameSource:
        """Open the source."""
        options: dict[str, Any] = {"live": self.live or None, "reconnect": not self.no_reconnect}
        options |= {"fps": self.fps, "stream": self.stream, "strict": self.strict}
        return vd.open_trip(self.source, **options)
