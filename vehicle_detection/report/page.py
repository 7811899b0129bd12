"""The page of a report: what a run over a video found, how fast, with which settings and model."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

import vehicle_detection
from vehicle_detection.camera import Camera
from vehicle_detection.classifier import VehicleClassifier
from vehicle_detection.mixture import TemplateMixture
from vehicle_detection.params import FeatureParams, HeatParams, PyramidParams, SearchParams
from vehicle_detection.report.assets import SCRIPT, STYLE
from vehicle_detection.report.charts import (
    COLORS,
    Clock,
    Scale,
    chart,
    curve,
    end_label,
    gantt,
    share_bar,
    steps,
)
from vehicle_detection.report.history import TrackHistory, TrackLog, binned
from vehicle_detection.report.html import amount, clock, facts, file_name, table, tag, text
from vehicle_detection.training import SPLITS
from vehicle_detection.video import VideoReport

_TIMES = "\N{NO-BREAK SPACE}\N{MULTIPLICATION SIGN}\N{NO-BREAK SPACE}"
_SCORES = ("accuracy", "false_negative_rate", "false_positive_rate", "near_duplicates", "test")


def settings_part(detector: Any, shape: tuple[int, ...]) -> str:
    """Write the parameters of a detector, as far as it has them."""
    search = getattr(detector, "search_params", None)
    camera = getattr(detector, "camera", None)
    camera_title = "Camera"
    on_pyramid = isinstance(search, PyramidParams)
    if camera is None and isinstance(search, (SearchParams, PyramidParams)):
        known = {} if search.horizon is None else {"horizon": search.horizon}
        camera, camera_title = Camera.for_frame(shape, **known), "Camera (assumed)"
    regions = getattr(detector, "region_params", None)
    heat = isinstance(regions, HeatParams)
    groups = {
        "Search": search,
        "Regions (heat map)": regions if heat else None,
        "Regions (fitted boxes)": None if heat or on_pyramid else regions,
        "Tracks": getattr(detector, "track_params", None),
        camera_title: camera,
    }
    parts = [
        tag("details", tag("summary", text(name)), _bands(value), _lines(_fields(value)))
        for name, value in groups.items()
        if dataclasses.is_dataclass(value)
    ]
    return tag("section", tag("h2", "Settings"), *parts) if parts else ""


def model_part(classifier: Any) -> str:
    """Write what a model's file tells of it, and under which terms it may be used."""
    if isinstance(classifier, TemplateMixture):
        return _mixture_part(classifier)
    if not isinstance(classifier, VehicleClassifier):
        return ""
    params, metadata = classifier.params, classifier.metadata
    preset = next((name for name in FeatureParams.PRESETS if FeatureParams.preset(name) == params), None)
    lengths = (
        f"{params.spatial_length:,} spatial bins, {params.hist_length:,} histogram, {params.hog_length:,} HOG"
    )
    about = (
        f"Features {preset or 'of its own'}: {params.length:,} values ({lengths}); "
        f"{amount(len(classifier.templates), 'template')}."
    )
    parts = [tag("p", text(about)), tag("p", text(_licence(metadata)))]
    metrics = metadata.get("metrics")
    scores = metrics.get("splits") if isinstance(metrics, Mapping) else None
    if isinstance(scores, Mapping) and scores.keys() <= SPLITS.keys():
        parts.append(_accuracy(scores))
    parts.append(tag("details", tag("summary", "Features"), _lines(_fields(params))))
    return tag("section", tag("h2", "Model"), *parts, *_facts(metadata, "splits"))


def _mixture_part(mixture: TemplateMixture) -> str:
    """Write what the file of a mixture of templates tells of it."""
    shapes = ", ".join(_TIMES.join(_short(side) for side in each.box_cells) for each in mixture.templates)
    about = (
        f"{amount(len(mixture.templates), 'template')}, for boxes of {shapes} cells. "
        f"A vehicle is shown from log-odds {_short(mixture.threshold)} on."
    )
    licence = "Licence: the model inherits the terms of the frames it was trained on."
    parts = [tag("p", text(about)), tag("p", text(licence))]
    metrics = mixture.metadata.get("metrics")
    scores = metrics.get("left_out") if isinstance(metrics, Mapping) else None
    if isinstance(scores, Mapping) and all(isinstance(each, Mapping) for each in scores.values()):
        parts.append(_left_out(scores))
    return tag("section", tag("h2", "Model"), *parts, *_facts(mixture.metadata, "left_out"))


def _facts(metadata: Mapping[str, Any], shown_already: str) -> list[str]:
    """Write the rest of what a model file tells, a fold for each part."""
    parts = []
    for name, values in metadata.items():
        shown = values if isinstance(values, Mapping) else {name: values}
        shown = {key: value for key, value in shown.items() if key != shown_already or name != "metrics"}
        if shown:
            parts.append(tag("details", tag("summary", text(name.capitalize())), _lines(shown)))
    return parts


def _left_out(scores: Mapping[str, Any]) -> str:
    columns = ("f1", "average_precision", "precision", "recall", "mean_iou")
    rows = [
        (text(name), *(text(_plain(values.get(column, ""))) for column in columns))
        for name, values in scores.items()
    ]
    note = "On frames of sources that were left out of training, single frames, IoU 0.5."
    heads = ("Frames", *(column.replace("_", " ").capitalize() for column in columns))
    return tag("p", note, class_="soft") + table(heads, rows, label="Quality of the model")


def _licence(metadata: Mapping[str, Any]) -> str:
    """Say under which terms a model stands: those of the patches it is made of."""
    data = metadata.get("data")
    sources = data.get("sources") if isinstance(data, Mapping) else None
    if isinstance(sources, Mapping) and any(name.startswith(("GTI", "KITTI")) for name in sources):
        return (
            "Licence: the model is made of patches from the GTI vehicle image database and the KITTI "
            "benchmark, both CC BY-NC-SA 3.0, and inherits the note: non-commercial use, with attribution."
        )
    return "Licence: the model inherits the terms of the patches it is made of."


def _accuracy(scores: Mapping[str, Any]) -> str:
    rows = [
        (text(title), *(_score(scores[split], column) for column in _SCORES))
        for split, title in SPLITS.items()
        if isinstance(scores.get(split), Mapping)
    ]
    note = (
        "Share of right answers on patches, by what was tested; vehicles in whole frames are another matter."
    )
    heads = ("Tested on", *(name.replace("_", " ").capitalize() for name in _SCORES))
    return tag("p", note, class_="soft") + table(heads, rows, label="Accuracy of the model")


def _score(values: Mapping[str, Any], name: str) -> str:
    value = values.get(name)
    if isinstance(value, float):
        return text(f"{value:.4f}" if name == "accuracy" else f"{value:.2%}")
    return text(f"{value:,}" if isinstance(value, int) else "" if value is None else value)


def _bands(value: object) -> str:
    """Write a search's bands as a table."""
    if not isinstance(value, SearchParams):
        return ""
    rows = [
        (
            _TIMES.join(_short(side) for side in band.window),
            " to ".join(_short(row) for row in band.y),
            " to ".join(_short(share) for share in band.x),
            ", ".join(f"{share:.3g}" for share in band.overlap),
        )
        for band in value.bands
    ]
    note = "In pixels of a frame 1280 wide; rows count from the horizon, columns and overlap are shares."
    heads = ("Window", "Rows", "Columns", "Overlap")
    return tag("p", note, class_="soft") + table(heads, rows, label="Bands of the search")


def _short(value: float) -> str:
    return f"{round(value, 1):g}".replace("-", "\N{MINUS SIGN}")


def _fields(value: Any) -> dict[str, Any]:
    names = (field.name for field in dataclasses.fields(value))
    return {name: getattr(value, name) for name in names if name != "bands"}


def _lines(values: Mapping[str, Any]) -> str:
    rows = (
        tag("div", tag("dt", text(str(name).replace("_", " "))), tag("dd", text(_plain(value))))
        for name, value in values.items()
    )
    return tag("dl", *rows, class_="lines")


def _plain(value: Any) -> str:
    """Write a value of a parameter or of a model's metadata."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}".replace("-", "\N{MINUS SIGN}")
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_plain(each)}" for key, each in value.items())
    if isinstance(value, (tuple, list)):
        return ", ".join(map(_plain, value))
    return str(value)


VAGUE_SPEED = 3.0
"""A speed with a greater standard error, in meters a second, is not drawn, as in the video."""

_HEIGHT = 150
_COUNT_STEPS = (1, 2, 5, 10, 15, 30, 60, 120, 300)
_MOST_COUNTS = 300


class Film(NamedTuple):
    """The video on the page.

    Attributes
    ----------
    kind
        Its MIME type.
    link
        Its address beside the page; None where it stands in the page itself.
    name
        Its file's name.
    megabytes
        Its size.
    """

    kind: str
    link: str | None
    name: str
    megabytes: float


def page(
    log: TrackLog, report: VideoReport, *, film: Film | None, source: str | None, detector: Any
) -> tuple[str, str]:
    """Write the page as two parts, between which the embedded video's base64 text belongs.

    Parameters
    ----------
    log
        The vehicles of each frame.
    report
        What `process_video` returned.
    film
        The annotated video, None where there is none.
    source
        Name of the source, for the title.
    detector
        A `VehicleDetector`, for settings and model; None, or one without them, leaves them out.
    """
    axis = Clock(max(report.frames, len(log.counts), 1), float(report.fps))
    tracks = [_without_vague_speeds(track) for track in log.histories()]
    title = "Vehicles" if source is None else f"Vehicles in {source}"
    before, after = _film_part(film)
    top = [
        tag("h1", text("Vehicles in "), file_name(source)) if source is not None else tag("h1", "Vehicles"),
        tag("p", _summary(report, log), class_="soft"),
        _counts(tracks, log, report),
        '<div class="stage">',
        before,
    ]
    rest = [
        after,
        tag(
            "section",
            tag("h2", "Over time", id_="time"),
            *_charts(tracks, log, axis, has_video=film is not None),
        ),
        "</div>",
        tag("section", tag("h2", "Tracks"), _track_table(tracks, axis.fps)),
        tag("section", tag("h2", "Time spent"), _stages(report)),
        settings_part(detector, report.shape),
        model_part(getattr(detector, "model", None)),
    ]
    version = f"Written by vehicle_detection {vehicle_detection.__version__}."
    end = [
        "</main>",
        tag("footer", text(version)),
        f'<script type="application/json" id="data">{_json(tracks, axis)}</script>',
        f"<script>{SCRIPT}</script></body></html>\n",
    ]
    return _head(title) + "<main>" + "".join(top), "".join(rest + end)


def _head(title: str) -> str:
    """Write what stands before the page's body; its policy forbids to load or run anything else."""
    policy = (
        f"default-src 'none'; script-src {_hash(SCRIPT)}; style-src {_hash(STYLE)}; "
        "media-src data: blob: file: 'self'; img-src data:; base-uri 'none'; form-action 'none'"
    )
    parts = [
        tag("meta", charset="utf-8"),
        tag("meta", name_="viewport", content="width=device-width, initial-scale=1"),
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        tag("link", rel="icon", href="data:,"),
        tag("title", text(title)),
        f"<style>{STYLE}</style>",
    ]
    return f'<!DOCTYPE html>\n<html lang="en"><head>{"".join(parts)}</head>\n<body>'


def _hash(code: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()}'"


def _summary(report: VideoReport, log: TrackLog) -> str:
    height, width = report.shape[:2]
    words = (
        f"{amount(report.frames, 'frame')} of {width}\N{MULTIPLICATION SIGN}{height} at "
        f"{float(report.fps):.6g} frames/s, processed at {report.frames_per_second:.1f} frames/s, "
        f"{report.frames_per_second / float(report.fps):.1f} times real time."
    )
    if log.first_time:
        words += f" Times count from {clock(log.first_time)} of the source."
    return text(words)


def _counts(tracks: Sequence[TrackHistory], log: TrackLog, report: VideoReport) -> str:
    fps = float(report.fps)
    values = {
        "Vehicles": f"{len(tracks):,}",
        "Frames": f"{report.frames:,}",
        "Length": clock(report.frames / fps),
        "Most at once": str(max(log.counts, default=0)),
    }
    if tracks:
        longest = max(tracks, key=lambda track: len(track.frames))
        values["Longest track"] = f"#{longest.id}, {len(longest.frames) / fps:.1f} s"
    near = [(found.meters, track.id) for track in tracks if (found := track.nearest(fps)) is not None]
    if near:
        values["Nearest"] = "{:.0f} m, #{}".format(*min(near))
    return facts({name: text(value) for name, value in values.items()})


def _film_part(film: Film | None) -> tuple[str, str]:
    """Write the video up to its data, and what follows; with a link or no video nothing stands between."""
    head = tag("h2", "Video")
    told = tag("p", class_="told")
    start = '<section class="film">'
    if film is None:
        return f"{start}{head}{tag('p', 'No video was written.', class_='soft')}{told}</section>", ""
    notes = []
    if film.link is not None:
        name = tag("a", file_name(film.name), href=film.link)
        notes.append(
            f"The video of {film.megabytes:.0f} MB is too large to be part of this page, which plays the "
            f"file {name}: move the two together."
        )
    if film.kind == "video/x-matroska":
        notes.append("Not every browser plays Matroska; a video written as .mp4 plays in all.")
    below = "".join(tag("p", note, class_="soft") for note in notes)
    loaded = "auto" if film.link is None else "metadata"
    words = f'controls playsinline preload="{loaded}" aria-label="The video with a box around each vehicle"'
    opened = f'{start}{head}<video {words}><source type="{film.kind}" src="'
    closed = f'"></video>{told}{below}</section>'
    if film.link is not None:
        return f"{opened}{text(film.link)}{closed}", ""
    return f"{opened}data:{film.kind};base64,", closed


def _charts(tracks: Sequence[TrackHistory], log: TrackLog, axis: Clock, *, has_video: bool) -> list[str]:
    if not tracks:
        return [tag("p", "No vehicle was shown.")]
    hint = "Click or drag in a chart, or choose a bar, to go to that time in the video."
    return [
        tag("p", hint, class_="soft") if has_video else "",
        _tracks_chart(tracks, axis),
        _count_chart(log, axis),
        _distance_chart(tracks, axis),
        _speed_chart(tracks, axis),
    ]


def _figure(title: str, note: str, graph: str, *, class_: str | None = None) -> str:
    return tag(
        "figure", tag("figcaption", tag("h3", text(title)), tag("p", text(note))), graph, class_=class_
    )


def _tracks_chart(tracks: Sequence[TrackHistory], axis: Clock) -> str:
    label = f"Bars of {amount(len(tracks), 'track')}: when each was shown. The table of tracks says the same."
    graph = gantt(tracks, axis, label=label)
    return _figure("Tracks", "When each vehicle was shown", graph)


def _count_chart(log: TrackLog, axis: Clock) -> str:
    counts = np.array(log.counts, np.int64)
    seconds = next((step for step in _COUNT_STEPS if axis.seconds / step <= _MOST_COUNTS), 600)
    edges = [0.0]
    while edges[-1] < axis.frames:  # a frame belongs to the second in which it begins
        edges.append(min(math.ceil(len(edges) * seconds * axis.fps - 1e-6), axis.frames))
    parts = (counts[int(start) : int(stop)] for start, stop in pairwise(edges))
    heights = [float(part.max(initial=0)) for part in parts]
    scale = Scale.around(0, max(heights), 70, whole=True, most=3)
    span = "each second" if seconds == 1 else f"each {seconds} seconds"
    label = f"Bars: most vehicles at once in {span}, from {min(heights):g} to {max(heights):g}."
    graph = chart(steps(heights, edges, axis, scale), axis, scale, label=label)
    return _figure("Vehicles", f"Most shown at once in {span}", graph)


def _distance_chart(tracks: Sequence[TrackHistory], axis: Clock) -> str:
    name, band = "distance_m", "distance_std_m"
    values = [track.columns[name] for track in tracks]
    known = np.concatenate([column[np.isfinite(column)] for column in values])
    if not known.size:
        return tag("p", "No distance is known.")
    scale = Scale.around(0, float(known.max()), _HEIGHT)
    curves = "".join(curve(track, name, axis, scale, band=band) for track in tracks)
    label = f"Lines: distance of each track, from {known.min():.0f} to {known.max():.0f} meters."
    ends = [end for track in tracks if (end := end_label(track, name, axis, scale)) is not None]
    graph = chart(
        curves, axis, scale, label=f"{label} The table of tracks has the nearest ones.", labels=ends
    )
    return _figure("Distance", "Metres along the road; the band is one standard error", graph)


def _speed_chart(tracks: Sequence[TrackHistory], axis: Clock) -> str:
    name = "speed_mps"
    values = [binned(track.frames, track.columns[name], axis.step)[1] for track in tracks]
    known = np.concatenate(values)
    if not known.size:
        return tag("p", "No relative speed is known.")
    scale = Scale.around(min(float(known.min()), 0.0), max(float(known.max()), 0.0), _HEIGHT)
    curves = "".join(curve(track, name, axis, scale) for track in tracks)
    label = (
        f"Lines: relative speed of each track, from {known.min():.1f} to {known.max():.1f} meters a second."
    )
    ends = [end for track in tracks if (end := end_label(track, name, axis, scale)) is not None]
    note = f"Metres a second, above 0 when moving away; known to {VAGUE_SPEED:g} m/s or better"
    return _figure("Relative speed", note, chart(curves, axis, scale, label=label, labels=ends))


def _without_vague_speeds(track: TrackHistory) -> TrackHistory:
    vague = track.columns["speed_std_mps"] > VAGUE_SPEED
    speeds = np.where(vague, np.nan, track.columns["speed_mps"])
    return dataclasses.replace(track, columns={**track.columns, "speed_mps": speeds})


def _track_table(tracks: Sequence[TrackHistory], fps: float) -> str:
    if not tracks:
        return tag("p", "No vehicle was shown.")
    rows = []
    for track in tracks:
        near = track.nearest(fps)
        meters, when = "\N{EN DASH}", "\N{EN DASH}"
        if near is not None:
            error = f" \N{PLUS-MINUS SIGN} {near.error:.1f}" if math.isfinite(near.error) else ""
            meters, when = f"{near.meters:.1f}{error} m", _seek(near.frame, fps, track)
        scores = track.columns["score"][np.isfinite(track.columns["score"])]
        rows.append(
            (
                tag("span", class_=f"dot c{(track.id - 1) % COLORS}") + f"#{track.id}",
                _seek(track.first, fps, track),
                text(clock((track.last + 1) / fps)),
                f"{len(track.frames):,}",
                meters,
                when,
                f"{scores.mean():.2f}" if scores.size else "\N{EN DASH}",
            )
        )
    heads = ("Track", "From", "To", "Frames", "Nearest", "At", "Mean score")
    note = (
        "The nearest approach is the least distance, as a median over a third of a second, with its standard "
        "error. Frames are those that show the track."
    )
    return tag("p", note, class_="soft") + table(heads, rows, label="Tracks")


def _seek(frame: int, fps: float, track: TrackHistory) -> str:
    when = clock(frame / fps)
    label = f"Track {track.id} at {when}: show in the video"
    return tag("button", text(when), type_="button", data_frame=frame, aria_label=label)


def _stages(report: VideoReport) -> str:
    shares = report.shares
    each = 1e3 / max(report.frames, 1)
    rows = [
        (text(name), f"{seconds:.2f}", f"{seconds * each:.2f}", f"{share:.1%}{share_bar(share)}")
        for (name, seconds), share in zip(report.stages.items(), shares.values())
    ]
    note = (
        f"The run took {report.seconds:.1f} s. Stages run side by side, so that their sum may be more; "
        "decode and encode are processor time."
    )
    heads = ("Stage", "Seconds", "ms a frame", "Share")
    return tag("p", text(note), class_="soft") + table(heads, rows, label="Time of each stage")


def _json(tracks: Sequence[TrackHistory], axis: Clock) -> str:
    """Write what the script shows of a frame; it holds no text, and nothing that could end its element."""
    listed = []
    for track in tracks:
        first = track.first // axis.step
        count = track.last // axis.step - first + 1
        listed.append(
            {
                "id": track.id,
                "color": (track.id - 1) % COLORS,
                "spans": track.spans(),
                "first": first,
                "distance": _points(track, "distance_m", axis.step, first, count),
                "speed": _points(track, "speed_mps", axis.step, first, count),
            }
        )
    whole: Mapping[str, Any] = {
        "fps": axis.fps,
        "frames": axis.frames,
        "step": axis.step,
        "tracks": listed,
    }
    return json.dumps(whole, separators=(",", ":"))


def _points(track: TrackHistory, name: str, step: int, first: int, count: int) -> list[float | None]:
    bins, values = binned(track.frames, track.columns[name], step)
    points: list[float | None] = [None] * count
    for number, value in zip(bins.tolist(), values.tolist()):
        points[number - first] = round(value, 1)
    return points
