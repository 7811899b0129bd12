"""`ReportWriter`: collects the tracks of a video, and writes the page ``report.html.j2`` with its charts."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import math
import os
import urllib.parse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import count, pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

import vehicle_detection
from vehicle_detection._common import (
    ROUGH_DISTANCE,
    UNITS,
    Floats,
    Units,
    atomic_write,
    check,
    check_suffix,
    format_with_error,
    hide_credentials,
    is_url,
    model_terms,
    pluralize,
)
from vehicle_detection.annotator import MAX_SPEED_STD
from vehicle_detection.boxes import box_areas
from vehicle_detection.camera import Camera, truncated_edges
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.drawing import blur_boxes, color_index, draw_boxes, draw_cell_shares
from vehicle_detection.drive.counts import count_vehicles
from vehicle_detection.drive.events import KINDS, Event, check_events, find_events
from vehicle_detection.drive.motion import TrackHistory, bin_means, track_histories
from vehicle_detection.drive.own_speed import own_speeds
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import Explanation, explain
from vehicle_detection.heatmap import HeatParams
from vehicle_detection.tables import TrackTable
from vehicle_detection.video import Source, VideoReport, borrow_source

# Part of an image around a window that a picture shows, as a fraction of its longer side; height of the
# picture in pixels, and color of its box.
_AROUND, _PICTURE_HEIGHT, _BOX_COLOR = 0.2, 180, (240, 228, 66)
# Largest number of tracks that are explained, each of which takes a search of a frame.
_MAX_EXPLAINED = 12
_COUNT_SECONDS = (1, 2, 5, 10, 15, 30, 60, 120, 300)  # durations of a bar in the chart of counts
_JPEG_QUALITY = 82
_CHUNK = 3 << 18  # bytes; a multiple of 3, so that the chunks' base64 texts can be joined


@dataclass(frozen=True)
class VideoEmbed:
    """The annotated video on the page, embedded or linked."""

    path: Path
    mime_type: str
    link: str | None  # URL relative to the page; None: the video is embedded
    megabytes: float

    def base64_chunks(self) -> Iterator[str]:
        """Read the video in pieces, so that it is never in memory as a whole."""
        with self.path.open("rb") as video:
            while chunk := video.read(_CHUNK):
                yield base64.b64encode(chunk).decode("ascii")


class TrackPicture(NamedTuple):
    """A picture of a track, with its frame and a text about it."""

    track: int
    frame: int
    image: NDArray[np.uint8]  # (H, W, 3) RGB
    text: str

    def data_url(self) -> str:
        """Encode the picture as a JPEG in a URL."""
        bgr = cv2.cvtColor(self.image, cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode('ascii')}"


class ReportWriter:
    """Collect the tracks of a video while it is processed, and write a page that shows them.

    The page is one HTML file that loads nothing from elsewhere: the video and charts of its tracks over time
    that seek in it, the times of the run, the settings and the model.

    Parameters
    ----------
    path, video, source
        The page to write (.html or .htm), the annotated video (the target of `process_video`) if one is
        written, and the source video for the title.
    detector, embed_limit
        The :class:`VehicleDetector`, for settings and model; and the number of bytes from which on a video is
        linked instead of embedded: page and video must then be moved together.
    units
        ``"metric"`` (m and km/h) or ``"imperial"`` (ft and mph).

    Examples
    --------
    >>> write = ReportWriter("report.html", video="found.mp4", source="drive.mp4")
    >>> report = process_video("drive.mp4", "found.mp4", detector, on_result=write)  # doctest: +SKIP
    >>> write.finish(report)  # doctest: +SKIP
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        video: str | os.PathLike[str] | None = None,
        source: str | os.PathLike[str] | None = None,
        detector: Any = None,
        embed_limit: int = 60_000_000,
        units: Literal["metric", "imperial"] = "metric",
    ) -> None:
        check.choice(units, "units", UNITS)
        self._path = check_suffix(path, "path", (".html", ".htm"))
        for name, value in (("video", video), ("source", source)):
            if value is None:
                continue
            if not (name == "source" and isinstance(value, str) and is_url(value)):
                check.path(value, name)  # a URL may have longer parts
            if os.path.realpath(value) == os.path.realpath(self._path):
                raise InvalidInputError(f"path {self._path} is also the {name}; choose another name")
        self._video = None if video is None else Path(video)
        self._source_path = self._source = None
        if source is not None:
            text = os.fspath(source)
            self._source_path = hide_credentials(text) if is_url(text) else str(Path(text))
            self._source = Path(hide_credentials(text)).name
        self._detector, self._units = detector, units
        self._embed_limit = check.integer(embed_limit, "embed_limit", low=0)
        self.table = TrackTable()  # of the frames that were added

    def __call__(self, result: Any) -> None:
        """Add one frame's result: for ``process_video(..., on_result=...)``."""
        self.table.append(result)

    def finish(
        self,
        report: VideoReport,
        *,
        events: Iterable[Event] | None = None,
        pictures: Sequence[TrackPicture] = (),
    ) -> None:
        """Write the page, completely or not at all.

        Parameters
        ----------
        report, events
            What `process_video` returned, and what `find_events` found in `table`; None: found here.
        pictures
            `TrackPicture` objects to list below the tracks.
        """
        check.instance(report, "report", VideoReport, "pass what process_video returned")
        fps = float(report.fps)
        own = getattr(getattr(self._detector, "annotator", None), "own_speed", None)
        speeds = None if own is None else own_speeds(own, self.table, fps=fps)
        if events is None:
            camera = getattr(self._detector, "camera", None)
            camera = camera if isinstance(camera, Camera) else None
            events = find_events(self.table, fps=fps, shape=report.shape, camera=camera, own_speed_mps=speeds)
        listed = check.sequence(pictures, "pictures", "TrackPicture")
        for picture in listed:
            check.instance(picture, "pictures", TrackPicture, "omit them, or pass TrackPicture objects")
        if self._source_path and self._source:  # without its folder, as in the title
            damage = report.damage.replace(self._source_path, self._source)
            report = dataclasses.replace(report, damage=damage)
        pieces = self._render(report, check_events(events), listed, speeds)
        with (
            atomic_write(self._path, "path") as part,
            # A file name may hold bytes that are not UTF-8; they become question marks.
            part.open("w", encoding="utf-8", errors="replace", newline="\n") as file,
        ):
            file.writelines(pieces)

    def _render(
        self,
        report: VideoReport,
        events: Sequence[Event],
        pictures: Sequence[TrackPicture],
        own_speed_mps: Floats | None,
    ) -> Iterator[str]:
        """Render the page in pieces; the detector may lack settings or a model, which are then left out.

        `own_speed_mps` is the camera's speed over ground in each frame of the table, if it is known.
        """
        from jinja2 import Environment, StrictUndefined

        table, detector, units = self.table, self._detector, UNITS[self._units]
        axis = TimeAxis(max(report.frames, len(table.counts()), 1), float(report.fps))
        own = None if own_speed_mps is None else own_speed_mps * units.speed
        tracks = [_for_page(track, units, own) for track in track_histories(table)]
        bars, seconds = _count_bars(table, axis)
        data = _script_data(tracks, axis, own)
        data |= {"units": [units.distance_symbol, units.speed_symbol], "counts": bars}
        quantities = ("distance", *["speed over ground"] * (own is not None), "relative speed")
        figures = [_count_figure(bars, seconds), *(_curve_figure(each, data, units) for each in quantities)]
        folder, names = files("vehicle_detection.drive"), ("report.css", "report.js", "report.html.j2")
        css, script, template = (folder.joinpath(name).read_text(encoding="utf-8") for name in names)
        environment = Environment(
            autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
        )
        filters = {"time": format_time, "plural": pluralize, "value": format_value, "hash": _csp_hash}
        environment.filters |= filters | {"decimal": decimal, "color": color_index}
        environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
        kinds = {event.kind for event in events}
        return environment.from_string(template).generate(
            css=css,
            script=script,
            source=self._source,
            report=report,
            fps=axis.fps,
            first_time=table.first_time,
            units=units,
            notices=_notices(tracks, report, detector),
            counts=_counts(tracks, table, report, units),
            video=self._embed(),
            tracks=tracks,
            axis=axis,
            rows=assign_rows(tracks, axis),
            share_rows=len(tracks) > MAX_ROWS,
            min_labeled=MIN_LABELED,
            figures=figures if tracks else [],
            events=events,
            event_kinds={kind: name for kind, name in KINDS.items() if kind in kinds},
            pictures=pictures,
            drive=count_vehicles(events, table, fps=axis.fps),
            settings=_settings(detector, report.shape),
            model=_model_summary(getattr(detector, "model", None)),
            version=vehicle_detection.__version__,
            data=data,
        )

    def _embed(self) -> VideoEmbed | None:
        if self._video is None:
            return None
        if not self._video.is_file():
            raise InvalidInputError(
                f"video {self._video} does not exist; call finish after process_video has written it"
            )
        size = self._video.stat().st_size
        # Browsers play the .mov files of `process_video` as MP4.
        mime_type = "video/x-matroska" if self._video.suffix.lower() == ".mkv" else "video/mp4"
        link = _relative_url(self._video, self._path) if size > self._embed_limit else None
        return VideoEmbed(self._video, mime_type, link, size / 1e6)


def _relative_url(video: Path, page: Path) -> str:
    """Return the URL of a video as seen from a page."""
    try:
        relative = os.path.relpath(video.resolve(), page.parent.resolve())
    except ValueError:  # on another drive of Windows
        return video.resolve().as_uri()
    return urllib.parse.quote(os.fsencode(relative.replace(os.sep, "/")))


def explain_tracks(detector: VehicleDetector, source: Source, table: TrackTable) -> list[TrackPicture]:
    """Explain a box of each of the twelve longest tracks: the largest detected one inside the frame.

    `table` holds the tracks that `detector` found in `source`, which is read again. The pictures are in the
    order of the tracks' ids.
    """
    known = [track for track in track_histories(table) if np.isfinite(track.boxes).all(axis=1).any()]
    tracks = sorted(known, key=lambda track: -len(track.frames))[:_MAX_EXPLAINED]
    pictures = []
    with borrow_source(source) as opened:
        shape, fps = opened.info.shape[:2], float(opened.info.fps)
        offset = round((table.first_time or 0.0) * fps)
        for track in tracks:
            truncated = truncated_edges(track.boxes, shape).any(axis=1)
            # Predicted and interpolated boxes have no detection to explain; they are the last choice.
            detected = track.columns["time_since_update"] == 0
            weights = np.where(truncated, 0.01, 1.0) * np.where(detected, 1.0, 1e-9)
            row = int(np.nanargmax(weights * box_areas(track.boxes)))
            frame = int(track.frames[row])
            with opened.read(offset + frame, 1) as frames:
                for _, _, image in frames:
                    explanation = explain(detector, image, track.boxes[row])
                    picture = _draw_explanation(detector, image, explanation, table.frame(frame).boxes)
                    pictures.append(TrackPicture(track.id, frame, picture, explanation.describe()))
    return sorted(pictures, key=lambda picture: picture.track)


def _draw_explanation(
    detector: VehicleDetector, image: NDArray[np.uint8], explanation: Explanation, tracked: Floats
) -> NDArray[np.uint8]:
    """Draw an explained box twice, side by side: as it is, and with the shares of its cells.

    `tracked` are the boxes of all tracks in the frame, which may have to be blurred, too.
    """
    if detector.annotator.blur is not None:
        boxes = np.concatenate([detector.detect(image).boxes, tracked, explanation.box[None]])
        image = blur_boxes(image, boxes, region=detector.annotator.blur)
    both = np.stack([explanation.window, explanation.box])
    around = _AROUND * (both[:, 2:].max(axis=0) - both[:, :2].min(axis=0)).max()
    low, high = both[:, :2].min(axis=0) - around, both[:, 2:].max(axis=0) + around
    left, top = np.maximum(low, 0).astype(int).tolist()
    right, bottom = np.minimum(high, image.shape[1::-1]).astype(int).tolist()
    plain = np.ascontiguousarray(image[top:bottom, left:right])
    scale = _PICTURE_HEIGHT / len(plain)
    size = max(1, round(scale * plain.shape[1])), _PICTURE_HEIGHT
    plain = np.asarray(cv2.resize(plain, size, interpolation=cv2.INTER_AREA), np.uint8)
    corner = np.array([left, top, left, top])
    shares = draw_cell_shares(plain, (explanation.window - corner) * scale, explanation.cells)
    shares = draw_boxes(shares, [(explanation.box - corner) * scale], color=_BOX_COLOR, thickness=2)
    return np.hstack([plain, shares])


class Figure(NamedTuple):
    """A chart of values over time with its caption; without a label, the note is shown alone."""

    title: str
    note: str
    label: str = ""  # describes it to those who do not see it
    series: str = ""  # name of the values in the data of the script
    height: int = 150


def _csp_hash(code: str) -> str:
    """Hash by which the page's content security policy allows its own script or style."""
    return f"sha256-{base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()}"


def _for_page(track: TrackHistory, units: Units, own: Floats | None) -> TrackHistory:
    """Convert the columns to other units, hide speeds with a large standard error, as the video does.

    The column ``ground_speed`` is added, if the `own` speed is known.
    """
    imprecise = track.columns["speed_std_mps"] > MAX_SPEED_STD
    speeds = np.where(imprecise, np.nan, track.columns["speed_mps"])
    factors = {"distance_m": units.distance, "distance_std_m": units.distance}
    factors |= {"speed_mps": units.speed, "speed_std_mps": units.speed}
    columns = track.columns | {"speed_mps": speeds}
    converted = {name: factors.get(name, 1.0) * values for name, values in columns.items()}
    if own is not None:
        converted["ground_speed"] = converted["speed_mps"] + own[track.frames]
    return dataclasses.replace(track, columns=converted)


def _notices(tracks: Sequence[TrackHistory], report: VideoReport, detector: Any) -> list[str]:
    """List what limits the results: damage of the source, dropped frames and an unknown lens."""
    notices = [f"{report.damage}."] if report.damage else []
    if report.dropped:
        verb = "was" if report.dropped == 1 else "were"
        notices.append(f"{pluralize(report.dropped, 'frame')} of the live source {verb} dropped.")
    measured = any(np.isfinite(track.columns["distance_m"]).any() for track in tracks)
    camera = getattr(detector, "camera", None)
    if measured and isinstance(camera, Camera) and not camera.lens_is_known:
        notices.append("The lens is unknown: distances and speeds may be wrong by a factor of 2 or more.")
    return notices


def _counts(
    tracks: Sequence[TrackHistory], table: TrackTable, report: VideoReport, units: Units
) -> dict[str, str]:
    fps = float(report.fps)
    counts = {"Vehicles": f"{len(tracks):,}", "Frames": f"{report.frames:,}"}
    counts |= {
        "Length": format_time(max(report.frames, len(table.counts())) / fps),
        "Most at once": str(table.counts().max(initial=0)),
    }
    if tracks:
        longest = max(tracks, key=lambda track: len(track.frames))
        counts["Longest track"] = f"#{longest.id}, {len(longest.frames) / fps:.1f} s"
    nearest = [(found, track.id) for track in tracks if (found := track.closest_approach(fps))]
    if nearest:
        found, track_id = min(nearest, key=lambda each: (each[0].distance_m, each[1]))
        distance = format_with_error(found.distance_m, found.std_m)
        counts["Nearest"] = f"{distance} {units.distance_symbol}, #{track_id}"
    return counts


def _count_figure(counts: dict[str, list[float]], seconds: int) -> Figure:
    interval = "each second" if seconds == 1 else f"each {seconds} seconds"
    low, high = min(counts["heights"]), max(counts["heights"])
    label = f"Bars: most vehicles at once in {interval}, from {low:g} to {high:g}."
    return Figure("Vehicles", f"Most shown at once in {interval}", label, "count", 70)


def _count_bars(table: TrackTable, axis: TimeAxis) -> tuple[dict[str, list[float]], int]:
    """Largest number of vehicles between edges (in frames), and the seconds between them."""
    counts = table.counts()
    fitting = (each for each in _COUNT_SECONDS if axis.seconds / each <= 300 and each * axis.fps >= 1)
    seconds = next(fitting, 600)
    edges = [0.0]
    while edges[-1] < axis.frames:  # a frame belongs to the second in which it begins
        edges.append(min(math.ceil(len(edges) * seconds * axis.fps - 1e-6), axis.frames))
    heights = [float(counts[int(start) : int(stop)].max(initial=0)) for start, stop in pairwise(edges)]
    return {"edges": edges, "heights": heights}, seconds


def _curve_figure(quantity: str, data: dict[str, Any], units: Units) -> Figure:
    """Lines of the distance, the speed over ground or the relative speed of each track, and the own speed."""
    error = f"standard error at most {units.speed * MAX_SPEED_STD:.0f} {units.speed_symbol}"
    series, symbol, note = {
        "distance": (
            "distance", units.distance_name,
            f"{units.distance_name.capitalize()} along the road; the band is one standard error",
        ),
        "speed over ground": (
            "ground", units.speed_symbol,
            f"{units.speed_name.capitalize()}, below 0 for oncoming vehicles; dashed: the own speed",
        ),
        "relative speed": (
            "speed", units.speed_symbol,
            f"{units.speed_name.capitalize()} relative to the camera, above 0 when moving away; {error}",
        ),
    }[quantity]  # fmt: skip
    lines = [*(track[series] for track in data["tracks"]), data["own"] if series == "ground" else []]
    known = [value for line in lines for value in line if value is not None]
    if not known:
        return Figure(quantity.capitalize(), f"No {quantity} is known.")
    label = f"Lines: {quantity} of each track, from {min(known):.0f} to {max(known):.0f} {symbol}."
    return Figure(quantity.capitalize(), note, label, series)


def _script_data(tracks: Sequence[TrackHistory], axis: TimeAxis, own: Floats | None) -> dict[str, Any]:
    """Values that the script shows for each frame: numbers only."""

    def means(frames: NDArray[np.int64], values: Floats) -> list[float | None]:
        found = dict(zip(*bin_means(frames, values, axis.bin_width)))
        numbers = range(int(frames[0]) // axis.bin_width, int(frames[-1]) // axis.bin_width + 1)
        return [round(float(found[number]), 1) if number in found else None for number in numbers]

    listed = []
    for track in tracks:
        distances, stds = track.columns["distance_m"], track.columns["distance_std_m"]
        rough = means(track.frames, (stds > ROUGH_DISTANCE * distances).astype(np.float64))
        listed.append(
            {
                "id": track.id,
                "color": track.color,
                "spans": track.spans(),
                "first": track.first // axis.bin_width,
                "distance": means(track.frames, distances),
                "std": means(track.frames, np.where(np.isfinite(distances), stds, np.nan)),
                "speed": means(track.frames, track.columns["speed_mps"]),
                "rough": [int((share or 0.0) > 0.5) for share in rough],
            }
            | ({} if own is None else {"ground": means(track.frames, track.columns["ground_speed"])})
        )
    own_means = [] if own is None or not len(own) else means(np.arange(len(own)), own)
    return {
        "fps": axis.fps, "frames": axis.frames, "step": axis.bin_width, "min_labeled": MIN_LABELED,
        "tracks": listed, "own": own_means,
    }  # fmt: skip


def _settings(detector: Any, shape: tuple[int, ...]) -> dict[str, dict[str, Any]]:
    """Parameters of a detector, by the title of each dataclass of them."""
    part = getattr(detector, "detector", None)
    search, regions = (getattr(part, name, None) for name in ("search_params", "region_params"))
    bands = getattr(search, "bands", ())
    groups = {"Search": search}
    if isinstance(regions, HeatParams):
        groups["Regions (heat map)"] = regions
    elif bands:  # without bands, the model itself predicts boxes
        groups["Regions (fitted boxes)"] = regions
    groups["Tracks"] = getattr(detector, "track_params", None)
    camera = getattr(detector, "camera", None)
    if isinstance(camera, Camera):
        title = "Camera" if camera.lens_is_known else "Camera (assumed)"
        groups[title] = camera.for_shape(shape)
    found = {}
    for title, params in groups.items():
        if dataclasses.is_dataclass(params):
            names = (each.name for each in dataclasses.fields(params))
            found[title] = {name: getattr(params, name) for name in names if name not in ("bands", "shape")}
    return found


def _model_summary(model: Any) -> dict[str, Any] | None:
    """Describe a model by its summary and metadata; None for a model of another library."""
    if not hasattr(model, "open_search"):
        return None
    title, facts = model.summary()
    return {"title": title, "license": f"License: {model_terms(model.metadata)}.", "details": facts}


# Charts over the time of the video. Horizontal positions are percentages of the width, so that a chart fits
# any screen; text sizes and heights are pixels. ``report.js`` draws the curves from the data of the page.

MAX_ROWS = 14
"""Largest number of tracks that get a row each; more tracks share rows."""

MIN_LABELED = 0.08
"""Fraction of the video that a track must last to be labeled inside a chart."""

_TICK_STEPS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200)  # seconds


@dataclass(frozen=True)
class TimeAxis:
    """The horizontal axis: at least one frame, and the frame rate."""

    frames: int
    fps: float

    @property
    def seconds(self) -> float:
        """Duration of the video."""
        return self.frames / self.fps

    @property
    def bin_width(self) -> int:
        """Frames per point of a curve, of which there are at most 2000."""
        return math.ceil(self.frames / 2000)

    def percent(self, frame: float) -> float:
        """Position of the beginning of a frame, as a percentage of the width."""
        return frame / self.frames * 100

    def ticks(self) -> list[float]:
        """Round times in seconds from 0 on, about six or fewer."""
        hours = 3600 * math.ceil(self.seconds / 3600 / 6)
        step = next((step for step in _TICK_STEPS if self.seconds / step < 6), hours)
        return [number * step for number in range(int(self.seconds / step) + 1)]

    def marks(self) -> list[tuple[float, str]]:
        """Positions (percent) and texts of the times below a chart."""
        ticks = self.ticks()
        tenths = len(ticks) == 1 or ticks[1] < 1
        return [(self.percent(each * self.fps), format_time(each, tenths=tenths)) for each in ticks]


def assign_rows(tracks: Sequence[TrackHistory], axis: TimeAxis) -> list[int]:
    """Row of each track: its own, or if there are many, the first that is free again when it begins."""
    if len(tracks) <= MAX_ROWS:
        return list(range(len(tracks)))
    min_gap = axis.frames // 200
    ends: dict[int, int] = {}  # last frame in each row
    rows = []
    for track in tracks:
        row = next(row for row in count() if row not in ends or ends[row] + min_gap < track.first)
        rows.append(row)
        ends[row] = track.last
    return rows


def decimal(value: float) -> str:
    """Format a number with at most two decimals."""
    return f"{value:.2f}".rstrip("0").rstrip(".")


def format_time(seconds: float, *, tenths: bool = True) -> str:
    """Format a time of a video, such as "0:03.2" or "1:02:06"."""
    total = round(seconds, 1 if tenths else 0)
    minutes, rest = divmod(total, 60)
    hours, minutes = divmod(int(minutes), 60)
    end = f"{rest:04.1f}" if tenths else f"{int(rest):02d}"
    return f"{hours}:{minutes:02d}:{end}" if hours else f"{minutes}:{end}"


def format_value(value: object) -> str:
    """Format a parameter or a value of a model's metadata."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}".replace("-", "\N{MINUS SIGN}")
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {format_value(each)}" for key, each in value.items())
    if isinstance(value, (tuple, list)):
        return ", ".join(map(format_value, value))
    return str(value)
