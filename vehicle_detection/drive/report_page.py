"""The report page: data for the template ``report.html.j2``, and its rendering."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

import vehicle_detection
from vehicle_detection._common import (
    ROUGH_DISTANCE,
    UNITS,
    Floats,
    Units,
    format_with_error,
    model_terms,
    pluralize,
)
from vehicle_detection.annotator import MAX_SPEED_STD
from vehicle_detection.camera import Camera
from vehicle_detection.drive.counts import count_vehicles
from vehicle_detection.drive.events import KINDS, Event
from vehicle_detection.drive.history import TrackHistory, bin_means, track_histories
from vehicle_detection.drive.report_charts import (
    TimeAxis,
    ValueAxis,
    chart,
    count_bars,
    curve,
    curve_paths,
    end_labels,
    event_markers,
    format_time,
    format_value,
    fraction_bar,
    gantt,
    svg_element,
)
from vehicle_detection.heatmap import HeatParams
from vehicle_detection.tables import TrackTable
from vehicle_detection.video import VideoReport

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


class Figure(NamedTuple):
    """A chart with its caption; without a chart, the note is shown alone."""

    title: str
    note: str
    svg: str = ""


def render_page(
    table: TrackTable,
    report: VideoReport,
    *,
    events: Sequence[Event],
    video: VideoEmbed | None,
    source: str | None,
    detector: Any,
    units: str = "metric",
    pictures: Sequence[TrackPicture] = (),
    own_speed_mps: Floats | None = None,
) -> Iterator[str]:
    """Render the page in pieces; `detector` may lack settings or a model, which are then left out.

    `own_speed_mps` is the camera's speed over ground in each frame of the table, if it is known.
    """
    from jinja2 import Environment, StrictUndefined

    axis = TimeAxis(max(report.frames, len(table.counts()), 1), float(report.fps))
    chosen = UNITS[units]
    own = None if own_speed_mps is None else own_speed_mps * chosen.speed
    tracks = [_for_page(track, chosen, own) for track in track_histories(table)]
    folder, names = files("vehicle_detection.drive"), ("report.css", "report.js", "report.html.j2")
    css, script, template = (folder.joinpath(name).read_text(encoding="utf-8") for name in names)
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    filters = {"time": format_time, "plural": pluralize, "value": format_value, "hash": _csp_hash}
    environment.filters |= filters
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    return environment.from_string(template).generate(
        css=css,
        script=script,
        source=source,
        report=report,
        fps=axis.fps,
        first_time=table.first_time,
        units=chosen,
        notices=_notices(tracks, report, detector),
        counts=_counts(tracks, table, report, chosen),
        video=video,
        tracks=tracks,
        figures=_figures(tracks, table, events, axis, chosen, own) if tracks else [],
        events=events,
        event_kinds=KINDS,
        pictures=pictures,
        drive=count_vehicles(events, table, fps=axis.fps),
        fraction_bar=fraction_bar,
        settings=_settings(detector, report.shape),
        model=_model_summary(getattr(detector, "model", None)),
        version=vehicle_detection.__version__,
        data=_script_data(tracks, axis, own) | {"units": [chosen.distance_symbol, chosen.speed_symbol]},
    )


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


def _figures(
    tracks: Sequence[TrackHistory],
    table: TrackTable,
    events: Sequence[Event],
    axis: TimeAxis,
    units: Units,
    own: Floats | None,
) -> list[Figure]:
    label = f"Bars of {pluralize(len(tracks), 'track')}: when each was shown, as in the table of tracks."
    marked = event_markers(events, axis, units, label=f"Markers of {pluralize(len(events), 'event')}.")
    return [
        Figure("Tracks", "When each vehicle was shown", gantt(tracks, axis, label=label)),
        *([Figure("Events", "What the table of events lists", marked)] if events else []),
        _count_figure(table, axis),
        _curve_figure("distance", tracks, axis, units),
        *([_curve_figure("speed over ground", tracks, axis, units, own)] if own is not None else []),
        _curve_figure("relative speed", tracks, axis, units),
    ]


def _count_figure(table: TrackTable, axis: TimeAxis) -> Figure:
    counts = table.counts()
    seconds = next((each for each in _COUNT_SECONDS if axis.seconds / each <= 300), 600)
    edges = [0.0]
    while edges[-1] < axis.frames:  # a frame belongs to the second in which it begins
        edges.append(min(math.ceil(len(edges) * seconds * axis.fps - 1e-6), axis.frames))
    heights = [float(counts[int(start) : int(stop)].max(initial=0)) for start, stop in pairwise(edges)]
    values = ValueAxis.covering(0, max(heights), 70, integers=True, max_steps=3)
    interval = "each second" if seconds == 1 else f"each {seconds} seconds"
    label = f"Bars: most vehicles at once in {interval}, from {min(heights):g} to {max(heights):g}."
    svg = chart(count_bars(heights, edges, axis, values), axis, values, label=label)
    return Figure("Vehicles", f"Most shown at once in {interval}", svg)


def _curve_figure(
    quantity: str,
    tracks: Sequence[TrackHistory],
    axis: TimeAxis,
    units: Units,
    own: Floats | None = None,
) -> Figure:
    """Lines of the distance, the speed over ground or the relative speed of each track, and the own speed."""
    error = f"standard error at most {units.speed * MAX_SPEED_STD:.0f} {units.speed_symbol}"
    column, std, symbol, note = {
        "distance": (
            "distance_m", "distance_std_m", units.distance_name,
            f"{units.distance_name.capitalize()} along the road; the band is one standard error",
        ),
        "speed over ground": (
            "ground_speed", None, units.speed_symbol,
            f"{units.speed_name.capitalize()}, below 0 for oncoming vehicles; dashed: the own speed",
        ),
        "relative speed": (
            "speed_mps", None, units.speed_symbol,
            f"{units.speed_name.capitalize()} relative to the camera, above 0 when moving away; {error}",
        ),
    }[quantity]  # fmt: skip
    series = [bin_means(track.frames, track.columns[column], axis.bin_width)[1] for track in tracks]
    known = np.concatenate([*series, [] if own is None else own[np.isfinite(own)]])
    if not known.size:
        return Figure(quantity.capitalize(), f"No {quantity} is known.")
    low, high = float(known.min()), float(known.max())
    # The band around a line belongs to it.
    edges = [track.columns[column] + track.columns[std] for track in tracks] if std else []
    top = max([high, *(float(np.nanmax(each)) for each in edges if np.isfinite(each).any())])
    values = ValueAxis.covering(min(low, 0.0), max(top, 0.0), 150)
    curves = "".join(curve(track, column, axis, values, std=std) for track in tracks)
    if own is not None:
        paths = curve_paths(np.arange(len(own)), own, axis, values)
        curves += svg_element("g", *paths, class_="curve own")
    label = f"Lines: {quantity} of each track, from {low:.0f} to {high:.0f} {symbol}."
    svg = chart(curves, axis, values, label=label, names=end_labels(tracks, column, axis, values))
    return Figure(quantity.capitalize(), note, svg)


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
                "speed": means(track.frames, track.columns["speed_mps"]),
                "rough": [int((share or 0.0) > 0.5) for share in rough],
            }
        )
    own_means = [] if own is None or not len(own) else means(np.arange(len(own)), own)
    return {
        "fps": axis.fps, "frames": axis.frames, "step": axis.bin_width, "tracks": listed, "own": own_means
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
