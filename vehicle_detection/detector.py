"""`VehicleDetector`: search, detection and tracking combined, with the state between a video's frames."""

from __future__ import annotations

import os
import time as clock
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_image, check_number, check_type
from vehicle_detection.boxes import Detections
from vehicle_detection.camera import Camera
from vehicle_detection.classifier import VehicleClassifier
from vehicle_detection.drawing import draw_boxes, draw_diagnostics, draw_tracks
from vehicle_detection.heatmap import HeatHistory, frame_heat, label_boxes
from vehicle_detection.images import read_image
from vehicle_detection.mixture import TemplateMixture, load_model
from vehicle_detection.params import HeatParams, PyramidParams, RegionParams, SearchParams, TrackParams
from vehicle_detection.regions import find_vehicles
from vehicle_detection.search import FrameSearch, SearchResult
from vehicle_detection.tracking import Track, Tracker

Path = str | os.PathLike[str]

CUT_DIFFERENCE = 40.0
"""Mean absolute difference of consecutive thumbnails, 0-255, above which the scene has been cut."""

# Standard error of the horizon as a fraction of the search's horizon tolerance.
_HORIZON_STD = 0.4


@dataclass(frozen=True, eq=False)
class FrameResult:
    """The result of one frame of a video.

    Attributes
    ----------
    index
        Number of the frame since the last reset, from 0.
    time
        Time of the frame in seconds; None if unknown.
    windows
        Positive windows of this frame.
    detections
        Boxes of this frame, before tracking.
    tracks
        All tracks; those with ``track.shown`` are vehicles to draw.
    seconds
        Time spent per stage: ``"search"``, ``"regions"``, ``"track"``.
    """

    index: int
    time: float | None
    windows: Detections
    detections: Detections
    tracks: tuple[Track, ...]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def shown(self) -> tuple[Track, ...]:
        """The tracks to draw."""
        return tuple(track for track in self.tracks if track.shown)


class VehicleDetector:
    """Detect the vehicles of images, and track those of a video.

    Parameters
    ----------
    model
        A name (``"default"`` for any road, ``"highway"``), the path of a model file, or a model.
    method
        ``"shared"``: the fast search, features shared by all windows. ``"windows"``: the reference, one patch
        per window; for classifiers of patches.
    search_params
        Where windows are searched: `PyramidParams` for a mixture, `SearchParams` for a classifier of patches.
    region_params
        How windows become boxes, unless the model predicts boxes: `RegionParams` for one box per group of
        agreeing windows; `HeatParams` for the course's heat map over the last frames (any model).
    track_params
        Parameters of the tracker.
    camera
        The camera, for distances and boxes; by default a dash-cam with the search's horizon, as an estimate
        that tracking refines.
    horizon
        Height of the horizon as a fraction of the frame's height; overrides that of `search_params`.
    n_jobs
        Threads of the search of one frame.
    diagnostics
        `annotate` shows the frame, its positive windows, the heat map and the tracks side by side.

    Raises
    ------
    ModelFileError
        If the model file is missing or damaged.
    InvalidInputError
        If an argument is malformed, or `search_params` or `method` do not fit the model.

    Examples
    --------
    >>> detector = VehicleDetector()
    >>> road = np.full((720, 1280, 3), 90, np.uint8)
    >>> len(detector.detect(road)), len(detector.process(road).tracks)
    (0, 0)
    """

    def __init__(
        self,
        model: Path | VehicleClassifier | TemplateMixture = "default",
        *,
        method: Literal["shared", "windows"] = "shared",
        search_params: SearchParams | PyramidParams | None = None,
        region_params: RegionParams | HeatParams | None = None,
        track_params: TrackParams | None = None,
        camera: Camera | None = None,
        horizon: float | None = None,
        n_jobs: int | None = None,
        diagnostics: bool = False,
    ) -> None:
        self.model = _load(model)
        for name, value, kind in (
            ("search_params", search_params, self.model.search_params_type),
            ("region_params", region_params, (RegionParams, HeatParams)),
            ("track_params", track_params, TrackParams),
            ("camera", camera, Camera),
        ):
            if value is not None:
                check_type(value, name, kind, "omit it for the default")
        chosen = search_params or self.model.search_params_type.default()
        self.search_params: SearchParams | PyramidParams = chosen.with_horizon(horizon)
        self.region_params = region_params or RegionParams()
        self.track_params = track_params or TrackParams()
        self.camera = camera
        self.diagnostics = diagnostics
        self._search: FrameSearch = self.model.open_search(n_jobs, method)
        self._heat_params = region_params if isinstance(region_params, HeatParams) else None
        self._heat_history = HeatHistory((self._heat_params or HeatParams()).frames)
        self.reset()

    def reset(self, *, fps: float = 25.0) -> None:
        """Forget all frames, before the first frame of another video.

        Parameters
        ----------
        fps
            Frame rate, for frames without a time.

        Raises
        ------
        InvalidInputError
            If the frame rate is not a positive number.
        """
        self._fps = check_number(fps, "fps", above=0, high=1e6)
        self._index = 0
        self._thumbnail: NDArray[np.float32] | None = None
        self._heat_history.clear()
        self._tracker: Tracker | None = None

    def search(self, frame: NDArray[np.uint8]) -> SearchResult:
        """Search one frame for windows and vehicles; needs no other frame, and is thread-safe.

        Raises
        ------
        InvalidInputError
            If the frame is not an ``(H, W, 3)`` uint8 RGB image, or is too small for a window.
        """
        check_image(frame, "frame")
        # Low scores are for the tracker, which continues confirmed tracks with them.
        track = self.track_params
        min_score = min(0.0, track.low_threshold, track.high_threshold)
        return self._search.find(frame, self.search_params, min_vehicle_score=min_score)

    def detect(self, image: NDArray[np.uint8] | Path) -> Detections:
        """Detect the vehicles of a single image; the state of a video is neither used nor changed.

        Parameters
        ----------
        image
            ``(H, W, 3)`` uint8 RGB, or the path of an image file.

        Returns
        -------
        Detections
            Boxes in pixels of the image, with scores.

        Raises
        ------
        InvalidInputError
            If the image is malformed, unreadable or too small for a window.
        """
        frame = read_image(image) if isinstance(image, (str, os.PathLike)) else image
        found = self.search(frame)
        if self._heat_params is not None:
            return self._label(frame_heat(found.shape, found.windows, self._heat_params), self._heat_params)
        return _positive(self._fit_boxes(found))

    def _fit_boxes(self, found: SearchResult) -> Detections:
        if found.vehicles is not None:
            return found.vehicles
        assert isinstance(self.region_params, RegionParams)
        return find_vehicles(found.windows, self._camera_of(found.shape), found.shape, self.region_params)

    @staticmethod
    def _label(heat: NDArray[np.float32], params: HeatParams) -> Detections:
        return label_boxes(heat, threshold=params.threshold, peak_fraction=params.peak_fraction)

    def _camera_of(self, shape: tuple[int, int]) -> Camera:
        if self.camera is not None:
            return self.camera
        params = self.search_params
        if params.horizon is None:
            return Camera.for_frame(shape)
        # The search tolerates a wrong horizon; the tracker estimates by how much it is wrong.
        std = _HORIZON_STD * params.horizon_tolerance * shape[0]
        return Camera.for_frame(shape, horizon=params.horizon, horizon_std_px=std)

    def process(self, frame: NDArray[np.uint8], time: float | None = None) -> FrameResult:
        """Search the next frame of a video and track its vehicles.

        Parameters
        ----------
        frame
            ``(H, W, 3)`` uint8 RGB.
        time
            Time of the frame in seconds; None: one frame after the last one.
        """
        return self.track(self.search(frame), time=time)

    def track(self, found: SearchResult, *, time: float | None = None) -> FrameResult:
        """Update the tracks with the search result of the next frame, in frame order.

        Parameters
        ----------
        found
            Result of `search` for this frame.
        time
            Time of the frame in seconds; None: one frame after the last one.

        Notes
        -----
        A cut to another scene, a frame of another size and a time that goes backwards end all tracks.
        """
        start = clock.perf_counter()
        if self._tracker is None:
            self._tracker = Tracker(self.track_params, fps=self._fps)
        self._tracker.set_camera(self._camera_of(found.shape))
        if self._is_cut(found):
            self._heat_history.clear()
            self._tracker.end_tracks()
        self._thumbnail = found.thumbnail
        if self._heat_params is not None:
            heat = self._heat_history.add(frame_heat(found.shape, found.windows, self._heat_params))
            detections = self._label(heat, self._heat_params)
        else:
            detections = self._fit_boxes(found)
        detected = clock.perf_counter()
        tracks = self._tracker.update(detections, found.shape, time=time)
        seconds = {
            "search": found.seconds,
            "regions": detected - start,
            "track": clock.perf_counter() - detected,
        }
        result = FrameResult(self._index, time, found.windows, _positive(detections), tracks, seconds)
        self._index += 1
        return result

    def _is_cut(self, found: SearchResult) -> bool:
        if self._thumbnail is None:
            return False
        difference = float(cv2.norm(self._thumbnail, found.thumbnail, cv2.NORM_L1))
        return difference > CUT_DIFFERENCE * found.thumbnail.size

    def annotate(self, frame: NDArray[np.uint8], result: FrameResult) -> NDArray[np.uint8]:
        """Draw the vehicles of a result on a copy of its frame."""
        if self.diagnostics:
            heat = frame_heat(frame.shape, result.windows, self._heat_params or HeatParams())
            return draw_diagnostics(frame, result.windows, heat, result.tracks)
        return draw_tracks(frame, result.tracks)

    def __call__(self, frame: NDArray[np.uint8] | Path) -> NDArray[np.uint8]:
        """Return the next frame annotated: ``clip.image_transform(detector)`` in moviepy.

        The path of an image file gives that image with the vehicles of `detect` drawn; tracks are unchanged.
        """
        if isinstance(frame, (str, os.PathLike)):
            image = read_image(frame)
            return draw_boxes(image, self.detect(image).boxes)
        return self.annotate(frame, self.process(frame))

    def warm_up(self, shape: tuple[int, int] = (720, 1280)) -> None:
        """Compile the kernels and allocate the buffers for frames of `shape`, before the first frame.

        Compiled kernels are cached on disk: only the first use after an installation takes seconds.
        """
        self.detect(np.zeros((*shape, 3), np.uint8))

    def close(self) -> None:
        """Stop the search's threads; the detector starts them again when it is used."""
        self._search.close()

    def __enter__(self) -> VehicleDetector:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


def _positive(vehicles: Detections) -> Detections:
    """Keep the vehicles to show: negative scores are for the tracker only."""
    return vehicles[vehicles.scores >= 0]


def _load(model: object) -> VehicleClassifier | TemplateMixture:
    if isinstance(model, (str, os.PathLike)):
        return load_model(model)
    kinds = VehicleClassifier, TemplateMixture
    check_type(model, "model", kinds, "pass a name, the path of a model file, or what load_model returns")
    return model  # type: ignore[return-value]
