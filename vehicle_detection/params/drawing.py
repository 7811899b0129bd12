"""Parameters of the annotations in images and video."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

from vehicle_detection._common import check_choice, describe, store_integer
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.units import UNITS

LABEL_FIELDS = ("id", "score", "distance", "speed", "std")
"""Fields of a track's label; ``"std"`` adds standard errors to distance and speed."""

COLORINGS = ("id", "distance")
"""What the color of a track can stand for."""

PANELS = ("none", "corner", "side")
"""Where the bird's-eye view of a video can be drawn."""


@dataclass(frozen=True, kw_only=True)
class DrawParams:
    """How tracks are drawn.

    Attributes
    ----------
    labels
        Fields of a label: ``"id"``, ``"score"`` (the confidence, if known), ``"distance"`` (``~`` where its
        standard error exceeds 20%), ``"speed"`` (relative to the camera, positive when moving away) and
        ``"std"`` (adds standard errors). Unknown values are omitted; without a field there is no label.
    line_width
        Width of the boxes' lines in pixels; None: chosen for the size of the image.
    color_by
        ``"id"``: each track has a color of its own. ``"distance"``: from vermilion (10 m and nearer) over
        orange (20 m) and yellow (35 m) to blue (60 m and farther), gray where the distance is unknown.
    panel
        Bird's-eye view of the tracks in a video: ``"corner"``, in the frame's upper right corner; ``"side"``,
        to the right of the frame, which makes the video wider; or ``"none"``.
    units
        Units of labels and bird's-eye view: ``"metric"`` (m and km/h) or ``"imperial"`` (ft and mph).

    Examples
    --------
    >>> DrawParams(labels=("id", "distance"), color_by="distance").panel
    'none'
    """

    labels: Collection[str] = ("id", "distance", "speed")
    line_width: int | None = None
    color_by: Literal["id", "distance"] = "id"
    panel: Literal["none", "corner", "side"] = "none"
    units: Literal["metric", "imperial"] = "metric"

    def __post_init__(self) -> None:
        given: object = self.labels
        if not isinstance(given, Collection) or getattr(given, "ndim", 1) == 0:
            raise InvalidInputError(
                f"labels must be a list of fields, got {describe(given)}; pass some of {LABEL_FIELDS}"
            )
        fields = (self.labels,) if isinstance(self.labels, str) else tuple(self.labels)
        for field in fields:
            check_choice(field, "labels", LABEL_FIELDS)
        object.__setattr__(self, "labels", fields)
        if self.line_width is not None:
            store_integer(self, "line_width", low=1, high=1000)
        check_choice(self.color_by, "color_by", COLORINGS)
        check_choice(self.panel, "panel", PANELS)
        check_choice(self.units, "units", UNITS)
