"""An explorer for notebooks: turn the parameters and see at once what they find in a frame.

`Explorer` holds the state and answers with pictures and boxes, without any widget. The scores of all windows
of a frame are computed once for each horizon and kept; everything else is chosen from them. The widgets, made
by `Explorer.widget`, are a thin layer that hands on what the sliders say.
"""

from __future__ import annotations

import dataclasses
import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_choice, check_image, check_integer, check_type, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.camera import Camera
from vehicle_detection.classifier import CLASSIFIER_REMEDY, VehicleClassifier, load_classifier
from vehicle_detection.datasets import FrameSet
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.drawing import TRACK_COLORS, draw_boxes
from vehicle_detection.errors import InvalidInputError, VehicleDetectionError
from vehicle_detection.explorer.widgets import Panel, lay_out
from vehicle_detection.heatmap import frame_heat, label_boxes
from vehicle_detection.images import read_image
from vehicle_detection.params import HeatParams, RegionParams, SearchParams
from vehicle_detection.regions import find_vehicles
from vehicle_detection.search import BandSearch

Image = NDArray[np.uint8]
Frames = Sequence[Image | str | os.PathLike[str]] | Mapping[str, Image | str | os.PathLike[str]] | FrameSet

Key = TypeVar("Key")

# Score at which a window has the brightest color.
_BRIGHTEST = 2.0


def named_sources(frames: object) -> dict[str, Callable[[], Image]]:
    """Name each frame and say how to get it; images are checked at once, files when they are read."""
    if isinstance(frames, FrameSet):
        return {name: _reader(frames.folder / name) for name in frames.names}
    if isinstance(frames, Mapping):
        pairs = [(str(name), frame) for name, frame in frames.items()]
    elif isinstance(frames, (list, tuple)):
        paths = [isinstance(frame, (str, os.PathLike)) for frame in frames]
        pairs = [
            (Path(frame).name if path else f"frame {number}", frame)
            for number, (frame, path) in enumerate(zip(frames, paths))
        ]
        if len({name for name, _ in pairs}) < len(pairs):
            pairs = [(str(frame) if path else name, frame) for (name, frame), path in zip(pairs, paths)]
    else:
        raise InvalidInputError(
            f"frames must be a list of images or paths, or a mapping from names to them; "
            f"got {describe(frames)}; wrap a single one in a list"
        )
    if not pairs:
        raise InvalidInputError("frames must hold at least one image; got none")
    return {
        name: _reader(frame) if isinstance(frame, (str, os.PathLike)) else _holder(frame, name)
        for name, frame in pairs
    }


def _reader(path: str | os.PathLike[str]) -> Callable[[], Image]:
    return lambda: read_image(path)


def _holder(image: object, name: str) -> Callable[[], Image]:
    checked = check_image(image, f"frames[{name!r}]")
    return lambda: checked


def remember(memory: OrderedDict[Key, Value], key: Key, make: Callable[[], Value], most: int) -> Value:
    """Return the value of a key, made if it is not known; the one unused for longest is forgotten."""
    if key not in memory:
        memory[key] = make()
        while len(memory) > most:
            memory.popitem(last=False)
    memory.move_to_end(key)
    return memory[key]


def _palette() -> Image:
    """Plasma from dark to bright, ``(256, 3)`` RGB."""
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.asarray(cv2.applyColorMap(ramp, cv2.COLORMAP_PLASMA)[:, 0, ::-1], np.uint8)


def put_windows(picture: Image, windows: Detections, shrink: float) -> None:
    """Draw windows by their scores into a picture, the best last."""
    order = np.argsort(windows.scores, kind="stable")
    levels = (windows.scores[order] * (255 / _BRIGHTEST)).clip(100, 255).astype(int)
    colors = _palette()[levels].tolist()
    for (x1, y1, x2, y2), color in zip((windows.boxes[order] * shrink).round().astype(int).tolist(), colors):
        cv2.rectangle(picture, (x1, y1), (x2 - 1, y2 - 1), color, 1)


def lay_heat(picture: Image, heat: NDArray[np.float32]) -> Image:
    """Blend heat over a copy of a picture, the stronger the hotter."""
    small = np.asarray(cv2.resize(heat, picture.shape[1::-1]), np.float32)
    peak = float(small.max())
    level = (small * (255 / peak if peak > 0 else 0)).clip(0, 255).astype(np.uint8)
    hot = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    return np.asarray(cv2.addWeighted(picture, 0.45, hot, 0.75, 0), np.uint8)


__all__ = ["VIEWS", "Explorer"]

Regions = Literal["fitted", "heat"]
View = Literal["boxes", "windows", "heat"]

VIEWS: tuple[View, ...] = ("boxes", "windows", "heat")
"""What the picture shows besides the boxes: nothing, the positive windows, or their heat."""

_ALL_SCORES = -1e6
_KEPT_SEARCHES, _KEPT_IMAGES = 64, 8
_BOX, _HORIZON = TRACK_COLORS[1], (255, 255, 255)
Value = TypeVar("Value")
Params = TypeVar("Params", SearchParams, HeatParams, RegionParams)


class _Scored(NamedTuple):
    """All windows of a frame, with the number of the band of each."""

    windows: Detections
    bands: NDArray[np.intp]


class Explorer:
    """The detector on chosen frames, with parameters that can be turned one by one.

    In a notebook, an explorer as the value of a cell shows its widgets.

    Parameters
    ----------
    frames
        Images ``(H, W, 3)`` uint8 RGB or paths of image files, in a list or by name; or a `FrameSet`.
    classifier
        The trained model; None loads the one that the package ships. The fast search must take its features.
    regions
        ``"fitted"`` or ``"heat"``, as in `VehicleDetector`.
    search, heat, fit, camera, horizon
        Where to begin, as in `VehicleDetector`.
    width
        Pictures are shrunk to this width, so that they are quickly shown.

    Attributes
    ----------
    names
        Names of the frames.
    search, heat, fit
        The parameters as they stand. ``search.bands`` are all bands, those that are switched off too.
    frame, bands, kind, view
        Name of the frame, numbers of the bands that are searched, ``"fitted"`` or ``"heat"``, and what is
        shown, out of `VIEWS`.

    Raises
    ------
    InvalidInputError
        If an argument is malformed.

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
        classifier: VehicleClassifier | None = None,
        *,
        regions: Regions = "fitted",
        search: SearchParams | None = None,
        heat: HeatParams | None = None,
        fit: RegionParams | None = None,
        camera: Camera | None = None,
        horizon: float | None = None,
        width: int = 960,
    ) -> None:
        self._sources = named_sources(frames)
        if classifier is not None:
            check_type(classifier, "classifier", VehicleClassifier, CLASSIFIER_REMEDY)
        for name, value, kind in (
            ("search", search, SearchParams),
            ("heat", heat, HeatParams),
            ("fit", fit, RegionParams),
            ("camera", camera, Camera),
        ):
            if value is not None:
                check_type(value, name, kind, "leave it out for the project's own")
        check_choice(regions, "regions", ("fitted", "heat"))
        self._classifier = classifier or load_classifier()
        self._searcher = BandSearch(self._classifier, n_jobs=1)
        self._camera = camera
        self._width = check_integer(width, "width", low=16, high=10_000)
        self._images: OrderedDict[str, tuple[Image, Image]] = OrderedDict()
        self._answers: OrderedDict[Any, dict[str, Any]] = OrderedDict()
        self._searches: OrderedDict[tuple[str, float], _Scored] = OrderedDict()
        self.names = tuple(self._sources)
        self.frame = self.names[0]
        self.search = (search or SearchParams.preset()).with_horizon(horizon)
        self.bands = tuple(range(len(self.search.bands)))
        self.kind: Regions = regions
        self.heat = heat or HeatParams()
        self.fit = fit or RegionParams()
        self.view: View = "windows"

    def set_frame(self, frame: int | str) -> None:
        """Look at another frame, by its name or its number."""
        if isinstance(frame, (int, np.integer)):
            self.frame = self.names[check_integer(frame, "frame", low=0, high=len(self.names) - 1)]
            return
        check_choice(frame, "frame", self.names)
        self.frame = frame

    def set_search(
        self,
        *,
        min_score: float | None = None,
        horizon: float | None = None,
        bands: Iterable[int] | None = None,
    ) -> None:
        """Change what counts as a hit, where the bands lie, and which of them are searched.

        Parameters
        ----------
        min_score
            Windows with a score above this are positive.
        horizon
            Height of the horizon as a share of the frame's height. Only this needs a new search.
        bands
            Numbers of the bands of ``search.bands``, from 0; none finds nothing.
        """
        chosen = self.bands
        if bands is not None:
            last = len(self.search.bands) - 1
            chosen = tuple(sorted({check_integer(band, "bands", low=0, high=last) for band in bands}))
        self.search = _replaced(self.search, {"min_score": min_score, "horizon": horizon})
        self.bands = chosen

    def set_regions(
        self,
        kind: Regions | None = None,
        *,
        threshold: float | None = None,
        peak_fraction: float | None = None,
        weighting: Literal["score", "count"] | None = None,
        min_peak: float | None = None,
        min_evidence: float | None = None,
    ) -> None:
        """Change how windows become boxes.

        Parameters
        ----------
        kind
            ``"fitted"``: a box from each group of agreeing windows. ``"heat"``: regions of a heat map.
        threshold, share, weighting
            Of `HeatParams`, for ``"heat"``.
        min_peak, min_evidence
            Of `RegionParams`, for ``"fitted"``.
        """
        if kind is not None:
            check_choice(kind, "kind", ("fitted", "heat"))
        heat = _replaced(
            self.heat, {"threshold": threshold, "peak_fraction": peak_fraction, "weighting": weighting}
        )
        fit = _replaced(self.fit, {"min_peak": min_peak, "min_evidence": min_evidence})
        self.kind, self.heat, self.fit = kind or self.kind, heat, fit

    def set_view(self, view: View) -> None:
        """Choose what the picture shows besides the boxes, out of `VIEWS`."""
        check_choice(view, "view", VIEWS)
        self.view = view

    def windows(self) -> Detections:
        """Positive windows of the frame, of the chosen bands."""
        return self._remembered("windows", self._choose_windows)

    def heat_map(self) -> NDArray[np.float32]:
        """Heat of the positive windows, ``(H, W)`` float32."""
        shape = self._image()[0].shape
        return self._remembered("heat", lambda: frame_heat(shape, self.windows(), self.heat))

    def boxes(self) -> Detections:
        """Boxes of the vehicles: what `VehicleDetector.detect` finds with these parameters."""
        return self._remembered("boxes", self._find_boxes)

    def detector(self, **options: Any) -> VehicleDetector:
        """Make a detector with the parameters as they stand, for a script or a video.

        Parameters
        ----------
        **options
            Further arguments of `VehicleDetector`, such as ``track``.

        Raises
        ------
        InvalidInputError
            If no band is chosen.
        """
        bands = tuple(self.search.bands[band] for band in self.bands)
        return VehicleDetector(
            self._classifier,
            search_params=dataclasses.replace(self.search, bands=bands),
            region_params=self.fit if self.kind == "fitted" else self.heat,
            camera=self._camera,
            **options,
        )

    def render(self) -> Image:
        """Draw the frame with its boxes, the horizon, and what the view shows.

        Returns
        -------
        numpy.ndarray
            ``(h, w, 3)`` uint8 RGB, not wider than `width`.
        """
        whole, small = self._image()
        shrink = small.shape[1] / whole.shape[1]
        picture = lay_heat(small, self.heat_map()) if self.view == "heat" else small.copy()
        row = min(round(self.search.horizon * small.shape[0]), small.shape[0] - 1)
        picture[row, ::4] = _HORIZON
        if self.view == "windows":
            put_windows(picture, self.windows(), shrink)
        return draw_boxes(picture, self.boxes().boxes * shrink, color=_BOX, thickness=3)

    def summary(self) -> str:
        """Say in a line what was found."""
        whole, _ = self._image()
        total, hits, found = len(self._scored().windows), len(self.windows()), len(self.boxes())
        return (
            f"{self.frame}, {whole.shape[1]}x{whole.shape[0]}: {hits:,} of {total:,} windows above "
            f"{self.search.min_score:g}, {found} box{'es' * (found != 1)}"
        )

    def widget(self) -> Any:
        """Make the sliders and the picture, an ``ipywidgets.HBox``.

        Raises
        ------
        InvalidInputError
            If ipywidgets is not installed.
        """
        panel = lay_out(
            names=self.names,
            frame=self.frame,
            views=VIEWS,
            view=self.view,
            search=self.search,
            bands=self.bands,
            kind=self.kind,
            heat=self.heat,
            fit=self.fit,
        )
        panel.watch(lambda: self._follow(panel))
        return panel.whole

    def _follow(self, panel: Panel) -> None:
        """Take over what the controls say, and show what that gives."""
        said = panel.values()
        try:
            self.set_frame(said["frame"])
            self.set_view(said["view"])
            self.set_search(min_score=said["min_score"], horizon=said["horizon"], bands=said["bands"])
            self.set_regions(
                said["kind"],
                threshold=said["threshold"],
                peak_fraction=said["peak_fraction"],
                weighting=said["weighting"],
                min_peak=said["min_peak"],
                min_evidence=said["min_evidence"],
            )
            panel.show(self.render(), self.summary())
        except VehicleDetectionError as error:
            # Raised in a callback, it would be seen by nobody.
            panel.tell(str(error))

    def _ipython_display_(self) -> None:
        from IPython.display import display

        display(self.widget())  # type: ignore[no-untyped-call]

    def _choose_windows(self) -> Detections:
        scored = self._scored()
        mask = scored.windows.scores > self.search.min_score
        return scored.windows[mask & np.isin(scored.bands, self.bands)]

    def _find_boxes(self) -> Detections:
        if self.kind == "heat":
            return label_boxes(
                self.heat_map(), threshold=self.heat.threshold, peak_fraction=self.heat.peak_fraction
            )
        shape = self._image()[0].shape[:2]
        camera = self._camera or Camera.for_frame(shape, horizon=self.search.horizon)
        return find_vehicles(self.windows(), camera, shape, self.fit)

    def _remembered(self, name: str, make: Callable[[], Value]) -> Value:
        """Return what the parameters as they stand give, made once: picture and summary ask for the same."""
        key = (self.frame, self.search, self.bands, self.kind, self.heat, self.fit)
        answers: dict[str, Any] = remember(self._answers, key, dict, 1)
        if name not in answers:
            answers[name] = make()
        return cast(Value, answers[name])

    def _image(self) -> tuple[Image, Image]:
        """Return the frame, and a copy of it in the size of the pictures."""

        def read() -> tuple[Image, Image]:
            image = self._sources[self.frame]()
            height, width = image.shape[:2]
            if width <= self._width:
                return image, image
            size = (self._width, max(1, round(height * self._width / width)))
            return image, np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

        return remember(self._images, self.frame, read, _KEPT_IMAGES)

    def _scored(self) -> _Scored:
        """Search all bands, or remember what was found."""
        key = (self.frame, self.search.horizon)
        return remember(self._searches, key, self._search_all, _KEPT_SEARCHES)

    def _search_all(self) -> _Scored:
        image, _ = self._image()
        self.search.place(image.shape)  # Raises where no band fits.
        whole = dataclasses.replace(self.search, min_score=_ALL_SCORES)
        parts, numbers = [], []
        for number, band in enumerate(whole.bands):
            if band.place(image.shape, whole.horizon, whole.horizontal_padding) is not None:
                found = self._searcher.find_windows(image, dataclasses.replace(whole, bands=(band,)))
                parts.append(found)
                numbers.append(np.full(len(found), number))
        boxes = np.concatenate([part.boxes for part in parts])
        scores = np.concatenate([part.scores for part in parts])
        return _Scored(Detections(boxes, scores), np.concatenate(numbers))


def _replaced(params: Params, changes: Mapping[str, Any]) -> Params:
    """Replace the fields that are not None."""
    return dataclasses.replace(
        params, **{name: value for name, value in changes.items() if value is not None}
    )
