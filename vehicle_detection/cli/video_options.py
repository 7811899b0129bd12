"""The options of ``video``, and what is made of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument

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
    from vehicle_detection.annotator import DrawParams
    from vehicle_detection.video import FrameSource


@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """Options of ``video``."""

    source: Annotated[
        str,
        Argument(
            metavar="SOURCE",
            help="Video file, such as drive.mp4; folder or quoted pattern of a trip's segments, or images; "
            "URL; camera, such as 0; or -.",
        ),
    ]
    output: Annotated[
        Path | None, output_option("TARGET", "Video to write: .mp4, .m4v, .mov or .mkv.", "-o", "--output")
    ] = None
    show: Annotated[
        bool, output_flag("--show", "Show the annotated frames in a window; Escape ends the run.")
    ] = False
    tracks: Annotated[
        Path | None,
        output_option("FILE", "Tracks: .csv, .jsonl, .parquet, .txt (MOT), .zip (CVAT) or .json (COCO)."),
    ] = None
    report: Annotated[Path | None, output_option("FILE.html", "Page with the video and its tracks.")] = None
    why: Annotated[
        bool, output_flag("--why", "Explain a box of each vehicle in --report: the share of each cell.")
    ] = False
    events: Annotated[
        Path | None, output_option("FILE", "Events, such as cut-ins and overtaking: .csv or .json.")
    ] = None
    clips: Annotated[
        Path | None, output_option("DIR", "Folder for a short annotated clip of each event, such as clips.")
    ] = None
    clips_of: Annotated[
        str | None,
        output_option("KINDS", "Kinds of events for --clips, such as cut_in,closing; default: all."),
    ] = None
    srt: Annotated[
        Path | None,
        output_option(
            "FILE", "Subtitles with vehicles, nearest distance and events, second by second: .srt or .ass."
        ),
    ] = None
    preset: shared.Preset = "veryfast"
    no_audio: shared.NoAudio = False
    quiet: Annotated[bool, output_flag("-q", "Print errors and warnings of damage only.", "--quiet")] = False
    profile: Annotated[bool, output_flag("--profile", "Print the time of each stage.")] = False
    start: Annotated[str | None, input_option("TIME", "Start time, such as 12.5 (seconds) or 12:30.")] = None
    end: Annotated[str | None, input_option("TIME", "End time, such as 30 (seconds) or 1:02:06.")] = None
    fps: Annotated[float, input_option("N", "Frame rate of a source of images, such as 10.")] = 25.0
    own_speed: Annotated[
        str | None,
        input_option(
            "SPEED", "Own speed in km/h, such as 100, or 62mph, for headways and speeds over ground."
        ),
    ] = None
    gpx: Annotated[
        Path | None,
        input_option(
            "FILE", "Own speed over time: a GPX track, or a .csv table with the columns time_s and speed_kmh."
        ),
    ] = None
    gpx_offset: Annotated[
        float,
        input_option(
            "S",
            "Time of the video's start in --gpx: seconds after the first point of a track, or the "
            "time_s of a table, such as 12.5 or -3.",
        ),
    ] = 0.0
    live: Annotated[
        bool,
        input_flag("--live", "Drop frames of a pipe rather than lag; default for cameras and streams."),
    ] = False
    no_reconnect: Annotated[
        bool, input_flag("--no-reconnect", "End with a network stream that breaks off.")
    ] = False
    strict: Annotated[bool, input_flag("--strict", "Fail, and write nothing, if the source is damaged.")] = (
        False
    )
    camera: shared.CameraName = None
    fov: shared.FieldOfView = None
    camera_height: shared.CameraHeight = None
    horizon: Annotated[
        str | None,
        camera_option("F|auto", f'{HORIZON_HELP} "auto": estimated from vehicles in a sample of frames.'),
    ] = None
    model: shared.Model = "default"
    classes: shared.Classes = None
    device: shared.Device = "cpu"
    conf: shared.Confidence = None
    every: shared.Every = None
    jobs: Annotated[
        int | None,
        search_option("N", "Frames searched in parallel, such as 2; default: one per core, at most 4."),
    ] = None
    labels: Annotated[
        str,
        drawing_option(
            "LIST", "Fields of the labels: some of id,distance,speed,score,std, such as id,distance; or none."
        ),
    ] = "id,distance,speed"
    line_width: shared.LineWidth = None
    color_by: Annotated[str, drawing_option("id|distance", "What the colors of the boxes stand for.")] = "id"
    panel: Annotated[
        str, drawing_option("corner|side|none", "Bird's-eye view in the frame's corner, or beside it.")
    ] = "none"
    units: Annotated[
        str, drawing_option("metric|imperial", "Labels, subtitles and report in m and km/h, or ft and mph.")
    ] = "metric"
    blur: shared.Blur = None
    diagnostics: Annotated[
        bool, drawing_flag("--diagnostics", "Show frame, positive windows, heat map and tracks side by side.")
    ] = False

    def files(self) -> dict[str, Path | None]:
        """Files to write, by their options."""
        return {
            "--output": self.output, "--tracks": self.tracks, "--report": self.report,
            "--events": self.events, "--srt": self.srt,
        }  # fmt: skip

    def span(self) -> dict[str, Any]:
        """First and last second of the source."""
        return {"start": parse_time(self.start, "--start"), "end": parse_time(self.end, "--end")}

    def stated_horizon(self) -> float | None:
        """Return the horizon that the option states; None if it states none, or is to be estimated."""
        return None if self.horizon in (None, "auto") else parse_horizon(str(self.horizon))

    def draw_params(self) -> DrawParams:
        """Parameters of the annotations."""
        from vehicle_detection.annotator import DrawParams

        fields = [field.strip() for field in self.labels.split(",")]
        style: dict[str, Any] = {"color_by": self.color_by, "panel": self.panel, "units": self.units}
        return DrawParams(labels=() if fields == ["none"] else fields, line_width=self.line_width, **style)

    def open_source(self) -> FrameSource:
        """Open the source."""
        from vehicle_detection.drive import open_trip

        return open_trip(
            self.source,
            fps=self.fps,
            live=self.live or None,
            reconnect=not self.no_reconnect,
            strict=self.strict,
        )
