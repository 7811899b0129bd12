"""An explorer for notebooks: change the detector's parameters and see what it finds in a frame.

A frame is searched once per horizon and selection of bands; thresholds and region parameters only select from
the cached result. `Explorer.widget` adds sliders that set the same parameters.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, invalid, pluralize
from vehicle_detection.boxes import Detections, box_areas
from vehicle_detection.camera import Camera, open_camera
from vehicle_detection.datasets import FrameSet
from vehicle_detection.detector import Detector, VehicleDetector
from vehicle_detection.drawing import (
    TRACK_COLORS,
    blend,
    draw_boxes,
    draw_cell_shares,
    draw_texts,
    heat_image,
)
from vehicle_detection.errors import InvalidInputError, VehicleDetectionError
from vehicle_detection.evaluation import Explanation, explain
from vehicle_detection.heatmap import HeatParams, frame_heat, label_heat
from vehicle_detection.images import image_array
from vehicle_detection.network import NetworkModel, NetworkParams
from vehicle_detection.notebook.widgets import METHOD_CONTROLS, Panel, build_widgets
from vehicle_detection.regions import RegionParams, find_vehicles
from vehicle_detection.search import SearchParams, SearchResult
from vehicle_detection.svm import VehicleClassifier

Image = NDArray[np.uint8]
PathLike = str | os.PathLike[str]
Frames = Sequence[Image | PathLike] | Mapping[str, Image | PathLike] | FrameSet
Method = Literal["groups", "heat"]
View = Literal["boxes", "windows", "heat"]
Weighting = Literal["score", "count"]

# How windows become boxes: groups of agreeing windows (or the model's own boxes), or a heat map.
METHODS: tuple[Method, ...] = get_args(Method)
# What an image shows: the boxes alone, or also the positive windows or their heat map.
VIEWS: tuple[View, ...] = get_args(View)

_PATHS = str, os.PathLike
_ALL_SCORES = -1e6
_CACHED_SEARCHES, _CACHED_FRAMES = 64, 8
_BOX_COLOR, _HORIZON_COLOR = TRACK_COLORS[1], (255, 255, 255)
_MAX_COLOR_SCORE = 2.0  # windows of this score or more are drawn in the brightest color

Value = TypeVar("Value")
Params = TypeVar("Params", HeatParams, RegionParams)


def _cached(method: Callable[[Explorer], Value]) -> Callable[[Explorer], Value]:
    """Keep the result of a method for the current parameters."""

    @functools.wraps(method)
    def cached(self: Explorer) -> Value:
        result: Value = self._compute(method, self._state)
        return result

    return cached


class Explorer:
    """Run the detector on a few frames and change its parameters one by one.

    In a notebook, an explorer as the value of a cell shows sliders, and a click on a box explains it (needs
    ipyevents; without it, the control "explain box" takes its number).

    Parameters
    ----------
    frames, width
        ``(H, W, 3)`` uint8 RGB images or paths of image files, in a list or by name, or a `FrameSet`; and the
        width in pixels to which displayed images are reduced.
    model, search_params, region_params, camera, horizon
        As in `VehicleDetector`; `horizon` replaces that of the camera and of the search.

    Attributes
    ----------
    model, names, frame, view, box
        The model; names of the frames and of the current one; what images show; and the number of the box
        that they explain, from 1 for the best one, 0 for none.
    search_params, bands, method, group_params, heat_params
        Current parameters: those of the search, with all bands, of which those numbered in `bands` are
        searched; and ``"groups"``, boxes from groups of agreeing windows or predicted by the model, or
        ``"heat"``, from the heat map, with the parameters of both.

    Examples
    --------
    >>> from vehicle_detection import render_scene
    >>> explorer = Explorer([render_scene(shape=(360, 640)).image])
    >>> explorer.set_search(min_score=0.5, horizon=0.56)
    >>> explorer.render().shape, len(explorer.windows().scores) > 0
    ((360, 640, 3), True)
    """

    def __init__(
        self,
        frames: Frames,
        model: PathLike | VehicleClassifier | NetworkModel = "default",
        *,
        search_params: SearchParams | NetworkParams | None = None,
        region_params: RegionParams | HeatParams | None = None,
        camera: Camera | PathLike | None = None,
        horizon: float | None = None,
        width: int = 960,
    ) -> None:
        images = _name_frames(frames)
        camera = open_camera(camera, horizon=horizon)
        if isinstance(search_params, SearchParams):
            search_params = search_params.with_horizon(horizon)
        detector = Detector(model, search_params=search_params, region_params=region_params, camera=camera)
        self._width = check.integer(width, "width", low=16, high=10_000)
        self.camera = detector.camera
        self._search = detector.model.open_search()
        self._read_frame = functools.lru_cache(_CACHED_FRAMES)(lambda name: image_array(images[name]))
        self._search_frame = functools.lru_cache(_CACHED_SEARCHES)(
            lambda name, params: self._search.find(self._read_frame(name), params)
        )
        self._compute = functools.lru_cache(4)(lambda method, state: method(self))
        self.model = detector.model
        self.names = tuple(images)
        self.frame = self.names[0]
        self.view: View = "windows"
        self.box = 0
        self.search_params = detector.search_params
        self.bands = tuple(range(len(self._all_bands)))
        self.method: Method = "heat" if detector.heat_params else "groups"
        self.heat_params = detector.heat_params or HeatParams().for_search(self.search_params)
        self.group_params = region_params if isinstance(region_params, RegionParams) else RegionParams()

    @property
    def region_params(self) -> RegionParams | HeatParams:
        """Parameters of the current method."""
        return self.heat_params if self.method == "heat" else self.group_params

    @property
    def _state(self) -> tuple[Any, ...]:
        """What the cached results depend on."""
        return self.frame, self.search_params, self.bands, self.region_params

    @property
    def _all_bands(self) -> tuple[Any, ...]:
        return getattr(self.search_params, "bands", ())

    def set_frame(self, frame: int | str) -> None:
        """Select a frame by its name or number."""
        if isinstance(frame, (int, np.integer)):
            frame = self.names[check.integer(frame, "frame", low=0, high=len(self.names) - 1)]
        check.choice(frame, "frame", self.names)
        self.frame = frame

    def set_view(self, view: View) -> None:
        """Select what images show, one of `VIEWS`."""
        check.choice(view, "view", VIEWS)
        self.view = view

    def set_box(self, number: int) -> None:
        """Select the box that images explain, from 1 for the one with the highest score; 0: none."""
        self.box = check.integer(number, "number", low=0)

    def set_search(
        self,
        *,
        min_score: float | None = None,
        horizon: float | None = None,
        bands: Iterable[int] | None = None,
    ) -> None:
        """Change search parameters; None keeps a value.

        `min_score` is the minimum score of positive windows (the boxes of a network do not depend on it),
        `horizon` a fraction of the frame's height, and `bands` are the numbers of the bands of
        ``search_params.bands`` to search, from 0; an empty list finds nothing.
        """
        params, camera = self.search_params, self.camera
        if horizon is not None:
            camera = camera.with_horizon(horizon)
            params = params.with_horizon(horizon) if self._all_bands else params
        if min_score is not None:
            params = dataclasses.replace(params, min_score=min_score)
        if bands is not None:
            if not self._all_bands:
                raise InvalidInputError("bands must be None for this model; its search has no bands")
            last = len(self._all_bands) - 1
            given = check.sequence(bands, "bands", "band numbers")
            self.bands = tuple(sorted({check.integer(band, "bands", low=0, high=last) for band in given}))
        self.search_params, self.camera = params, camera

    def set_regions(
        self,
        method: Method | None = None,
        *,
        threshold: float | None = None,
        peak_fraction: float | None = None,
        weighting: Weighting | None = None,
        min_peak: float | None = None,
        min_evidence: float | None = None,
    ) -> None:
        """Change how windows become boxes; None keeps a value.

        `threshold`, `peak_fraction` and `weighting` are fields of `HeatParams`, for the method ``"heat"``;
        `min_peak` and `min_evidence` of `RegionParams`, for ``"groups"``, without effect if the model
        predicts boxes.
        """
        method = self.method if method is None else method
        check.choice(method, "method", METHODS)
        changes = {"threshold": threshold, "peak_fraction": peak_fraction, "weighting": weighting}
        heat = _replace(self.heat_params, **changes)
        groups = _replace(self.group_params, min_peak=min_peak, min_evidence=min_evidence)
        self.method, self.heat_params, self.group_params = method, heat, groups

    @_cached
    def windows(self) -> Detections:
        """Positive windows of the current frame."""
        found = self._all_windows()
        return found[found.scores > self.search_params.min_score]

    @_cached
    def heat_map(self) -> NDArray[np.float32]:
        """Heat map of the positive windows, ``(H, W)`` float32."""
        return frame_heat(self._read_frame(self.frame).shape, self.windows(), self.heat_params)

    @_cached
    def boxes(self) -> Detections:
        """Boxes of the vehicles, equal to those of `VehicleDetector.detect` with these parameters."""
        if self.method == "heat":
            return label_heat(self.heat_map(), self.heat_params)
        vehicles = None if self._all_bands else self._find().vehicles
        if vehicles is None:
            shape = self._read_frame(self.frame).shape
            vehicles = find_vehicles(self.windows(), self.camera, shape, self.group_params)
        confidences = self.model.calibration.probability(vehicles.scores)
        return Detections(vehicles.boxes, vehicles.scores, confidences)

    def explanation(self) -> Explanation | None:
        """Explain the selected box with `explain`; None if there is none."""
        if not 1 <= self.box <= len(self.boxes()):
            return None
        found: Explanation = self._compute(Explorer._explain, (*self._state, self.box))
        return found

    def _explain(self) -> Explanation:
        box = self.boxes().boxes[self._best_first()[self.box - 1]]
        with self.detector() as detector:
            return explain(detector, self._read_frame(self.frame), box)

    def _best_first(self) -> list[int]:
        """Rows of the boxes by their scores."""
        return list(np.argsort(-self.boxes().scores, kind="stable").tolist())

    def box_at(self, x: float, y: float) -> int:
        """Return the number, as in `set_box`, of the smallest box at a pixel of the frame; 0: none."""
        x, y = check.number(x, "x"), check.number(y, "y")
        boxes = self.boxes().boxes
        left, top, right, bottom = boxes.T
        inside = (left <= x) & (x < right) & (top <= y) & (y < bottom)
        if not inside.any():
            return 0
        smallest = int(np.argmin(np.where(inside, box_areas(boxes), np.inf)))
        return self._best_first().index(smallest) + 1

    def detector(self, **options: Any) -> VehicleDetector:
        """Create a detector with the current parameters, for a script or a video.

        `options` are further arguments of `VehicleDetector`, such as ``camera``, which gets the current
        horizon. An `InvalidInputError` is raised if no band is selected.
        """
        params = self._selected_params()
        camera = open_camera(options.pop("camera", self.camera))
        if self.camera.horizon_is_known and camera is not self.camera:
            camera = camera.with_horizon(self.camera.horizon)
        options["region_params"] = self.region_params
        return VehicleDetector(self.model, search_params=params, camera=camera, **options)

    def render(self) -> Image:
        """Draw the frame with boxes, horizon and the view's windows or heat map: ``(h, w, 3)`` uint8 RGB."""
        image = self._read_frame(self.frame).copy()
        height, width = image.shape[:2]
        scale = min(self._width / width, 1.0)
        if scale < 1:
            size = (self._width, max(1, round(height * self._width / width)))
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        if self.view == "heat":
            heat = np.asarray(cv2.resize(self.heat_map(), image.shape[1::-1]), np.float32)
            image = blend(image, heat_image(heat), 0.6)
        row = min(round(self.camera.horizon * len(image)), len(image) - 1)
        image[row, ::4] = _HORIZON_COLOR
        if self.view == "windows":
            _draw_windows(image, self.windows(), scale)
        explanation = self.explanation()
        if explanation is not None:
            image = draw_cell_shares(image, explanation.window * scale, explanation.cells)
        boxes = self.boxes().boxes[self._best_first()] * scale
        image = draw_boxes(image, boxes, color=_BOX_COLOR, thickness=3)
        draw_texts(image, boxes, [str(number + 1) for number in range(len(boxes))], _BOX_COLOR, 3)
        return image

    def summary(self) -> str:
        """Describe in a line what was found, and the explained box."""
        height, width = self._read_frame(self.frame).shape[:2]
        total = f" of {len(self._all_windows()):,}" if self._all_bands else ""
        explanation = self.explanation()
        return (
            f"{self.frame}, {width}x{height}: {len(self.windows()):,}{total} windows above "
            f"{self.search_params.min_score:g}, {pluralize(len(self.boxes()), 'box', 'es')}"
            + ("" if explanation is None else f"; box {self.box}: {explanation}")
        )

    def widget(self) -> Any:
        """Create the sliders and the image, an ``ipywidgets.HBox``; ipywidgets must be installed."""
        values: dict[str, Any] = {"frame": self.frame, "view": self.view, "box": self.box}
        values |= {"min_score": self.search_params.min_score, "horizon": round(self.camera.horizon, 2)}
        sizes = [tuple(map(round, band.window)) for band in self._all_bands]
        bands = [(f"{number}: {width}x{height}", number) for number, (width, height) in enumerate(sizes)]
        if bands:
            values["bands"] = self.bands
        values["method"] = self.method
        if bands:  # a network has none, and predicts the boxes itself
            values |= {name: getattr(self.group_params, name) for name in METHOD_CONTROLS["groups"]}
        values |= {name: getattr(self.heat_params, name) for name in METHOD_CONTROLS["heat"]}
        options = {"frame": self.names, "view": VIEWS, "method": METHODS, "weighting": get_args(Weighting)}
        options["bands"] = tuple(bands)
        panel = build_widgets(values, options)
        panel.watch(lambda changes: self._update(panel, changes))
        panel.on_click(lambda x, y: self._click(panel, x, y))
        return panel.root

    def _ipython_display_(self) -> None:
        from IPython.display import display

        display(self.widget())  # type: ignore[no-untyped-call]

    def _update(self, panel: Panel, changes: dict[str, Any]) -> None:
        """Apply the changed values of the controls and show the result."""

        def changed(*names: str) -> dict[str, Any]:
            return {name: changes[name] for name in names if name in changes}

        try:
            self.set_frame(changes.get("frame", self.frame))
            self.set_view(changes.get("view", self.view))
            self.set_box(changes.get("box", self.box))
            self.set_search(**changed("min_score", "horizon", "bands"))
            self.set_regions(**changed("method", *METHOD_CONTROLS["groups"], *METHOD_CONTROLS["heat"]))
            panel.show(self.render(), self.summary())
        except VehicleDetectionError as error:
            # ipywidgets does not display exceptions of callbacks.
            panel.show_error(str(error))

    def _click(self, panel: Panel, x: float, y: float) -> None:
        """Explain the box at a point of the displayed image."""
        scale = min(self._width / self._read_frame(self.frame).shape[1], 1.0)
        panel.controls["box"].value = self.box_at(x / scale, y / scale)

    def _selected_params(self) -> Any:
        """Search parameters with the selected bands."""
        if not self._all_bands:
            return self.search_params
        bands = tuple(self._all_bands[number] for number in self.bands)
        return dataclasses.replace(self.search_params, bands=bands)

    def _find(self) -> SearchResult:
        """Search the current frame with a low threshold, which serves all higher ones."""
        lowest = _ALL_SCORES if self._all_bands else min(0.0, self.search_params.min_score)
        return self._search_frame(self.frame, dataclasses.replace(self._selected_params(), min_score=lowest))

    def _all_windows(self) -> Detections:
        """Windows of any score in the selected bands."""
        return Detections.empty() if self._all_bands and not self.bands else self._find().windows


def _replace(params: Params, **changes: Any) -> Params:
    """Replace the fields whose new value is not None."""
    given = {name: value for name, value in changes.items() if value is not None}
    return dataclasses.replace(params, **given)


def _draw_windows(image: Image, windows: Detections, scale: float) -> None:
    """Draw windows into an image, colored by score, the best last."""
    gray_levels = np.arange(256, dtype=np.uint8)[:, None]
    palette = cv2.applyColorMap(gray_levels, cv2.COLORMAP_PLASMA)[:, 0, ::-1]
    order = np.argsort(windows.scores, kind="stable")
    levels = (windows.scores[order] * (255 / _MAX_COLOR_SCORE)).clip(100, 255).astype(int)
    boxes = (windows.boxes[order] * scale).round().astype(int).tolist()
    for (x1, y1, x2, y2), color in zip(boxes, palette[levels].tolist()):
        cv2.rectangle(image, (x1, y1), (x2 - 1, y2 - 1), color, 1)


def _name_frames(frames: object) -> dict[str, Any]:
    """Images or paths by name; arrays are checked now, files when they are read."""
    if isinstance(frames, FrameSet):
        frames = {name: frames.folder / name for name in frames.names}
    elif isinstance(frames, (list, tuple)):
        paths = [str(each) if isinstance(each, _PATHS) else f"frame {n}" for n, each in enumerate(frames)]
        names = [Path(path).name for path in paths]
        # Two files of the same name are named by their paths.
        frames = dict(zip(names if len(set(names)) == len(names) else paths, frames))
    if not isinstance(frames, Mapping) or not frames:
        expected = "be a list of images or paths, or a mapping from names to them, with at least one image"
        raise invalid("frames", expected, frames, "wrap a single one in a list")
    for name, frame in frames.items():
        if not isinstance(frame, _PATHS):
            check.image(frame, f"frames[{str(name)!r}]")
    return {str(name): frame for name, frame in frames.items()}
