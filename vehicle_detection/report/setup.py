"""The part of a report that tells with what was searched: settings of the run, camera and model."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from vehicle_detection.camera import Camera
from vehicle_detection.classifier import VehicleClassifier
from vehicle_detection.mixture import TemplateMixture
from vehicle_detection.params import FeatureParams, PyramidParams, SearchParams
from vehicle_detection.report.html import amount, table, tag, text
from vehicle_detection.training import SPLITS

_TIMES = "\N{NO-BREAK SPACE}\N{MULTIPLICATION SIGN}\N{NO-BREAK SPACE}"
_SCORES = ("accuracy", "missed", "false", "near_copies", "test")


def settings_part(detector: Any, shape: tuple[int, ...]) -> str:
    """Write the parameters of a detector, as far as it has them."""
    search = getattr(detector, "search_params", None)
    camera = getattr(detector, "camera", None)
    camera_title = "Camera"
    on_pyramid = isinstance(search, PyramidParams)
    if camera is None and isinstance(search, (SearchParams, PyramidParams)):
        known = {} if search.horizon is None else {"horizon": search.horizon}
        camera, camera_title = Camera.for_frame(shape, **known), "Camera (assumed)"
    heat = getattr(detector, "regions", None) == "heat"
    groups = {
        "Search": search,
        "Regions (heat map)": getattr(detector, "heat_params", None) if heat else None,
        "Regions (fitted boxes)": None if heat or on_pyramid else getattr(detector, "region_params", None),
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
