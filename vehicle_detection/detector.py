"""`VehicleDetector`: search, regions and tracking put together; the only state that outlives a frame."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_choice, check_image, check_number, check_type
from vehicle_detection.boxes import Detections
from vehicle_detection.camera import Camera
from vehicle_detection.classifier import VehicleClassifier
from vehicle_detection.drawing import draw_diagnostics, draw_tracks
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.heatmap import HeatHistory, frame_heat, label_boxes
from vehicle_detection.mixture import MixtureSearch, TemplateMixture, load_model
from vehicle_detection.params import HeatParams, PyramidParams, RegionParams, SearchParams, TrackParams
from vehicle_detection.regions import find_vehicles
from vehicle_detection.search import BandSearch
from vehicle_detection.tracking import Track, Tracker
from vehicle_detection.windows import band_windows, search_windows

_THUMBNAIL = (32, 18)

# By how much of the frame's height the horizon of search bands may be wrong, and the share of such an error
# that is its standard error.
_BAND_ERROR, _DOUBT = 0.1, 0.4

CUT_DIFFERENCE = 40.0
"""Mean change of a thumbnail's values, 0-255, from one frame to the next that is another scene."""


@dataclass(frozen=True, eq=False)
class FoundWindows:
    """What the search of one frame hands to the sequential pass; it needs no other frame.

    Attributes
    ----------
    windows
        Windows that score above the search's least score.
    vehicles
        Boxes of the vehicles, where the model tells them, and of what may be some: scores below 0 are for the
        tracker alone. None where they follow from the windows.
    shape
        ``(height, width)`` of the frame.
    thumbnail
        ``(18, 32)`` float32 gray copy of the frame, by which a cut is noticed.
    seconds
        Time the search took.
    """

    windows: Detections
    vehicles: Detections | None
    shape: tuple[int, int]
    thumbnail: NDArray[np.float32]
    seconds: float


@dataclass(frozen=True, eq=False)
class FrameResult:
    """What was found in one frame of a video.

    Attributes
    ----------
    index
        Number of the frame since the last reset, from 0.
    time
        Time of the frame in seconds, None where it is not known.
    windows
        Positive windows of this frame.
    regions
        Boxes of this frame, before tracking.
    tracks
        All tracks; those with ``track.shown`` are vehicles to draw.
    seconds
        Time spent by stage: ``"search"``, ``"regions"``, ``"track"``.
    """

    index: int
    time: float | None
    windows: Detections
    regions: Detections
    tracks: tuple[Track, ...]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def shown(self) -> tuple[Track, ...]:
        """The tracks to draw."""
        return tuple(track for track in self.tracks if track.shown)


class VehicleDetector:
    """Find the vehicles of stills, and follow those of a video.

    Parameters
    ----------
    classifier
        The trained model: a `TemplateMixture`, for any road, or a `VehicleClassifier` of patches, such as
        ``load_model("highway")``; None loads ``load_model("default")``.
    method
        ``"shared"``: the fast search, features shared by all windows. ``"windows"``: the reference, each
        window by its own patch, any step; for classifiers of patches.
    regions
        ``"fitted"``: a box from each group of agreeing windows. ``"heat"``: the course's way, regions of a
        heat map over the last frames.
    search
        `PyramidParams` for a mixture, `SearchParams` for a classifier of patches.
    heat, fit, track
        Parameters of the stages; by default those of the project.
    camera
        The camera, for distances and boxes; by default a dash-cam with the search's horizon, as a guess that
        the vehicles of a video correct.
    horizon
        Height of the horizon as a share of the frame's height; overrides the one of `search`.
    n_jobs
        Threads of the search of one frame.
    diagnostics
        `annotate` shows the frame, its positive windows, the heat map and the tracks side by side.

    Examples
    --------
    >>> detector = VehicleDetector()
    >>> road = np.full((720, 1280, 3), 90, np.uint8)
    >>> len(detector.detect(road)), len(detector.process(road).tracks)
    (0, 0)
    """

    def __init__(
        self,
        classifier: VehicleClassifier | TemplateMixture | None = None,
        *,
        method: Literal["shared", "windows"] = "shared",
        regions: Literal["fitted", "heat"] = "fitted",
        search: SearchParams | PyramidParams | None = None,
        heat: HeatParams | None = None,
        fit: RegionParams | None = None,
        track: TrackParams | None = None,
        camera: Camera | None = None,
        horizon: float | None = None,
        n_jobs: int | None = None,
        diagnostics: bool = False,
    ) -> None:
        check_choice(method, "method", ("shared", "windows"))
        check_choice(regions, "regions", ("fitted", "heat"))
        for name, value, kind in (
            ("heat", heat, HeatParams),
            ("fit", fit, RegionParams),
            ("track", track, TrackParams),
            ("camera", camera, Camera),
        ):
            if value is not None:
                check_type(value, name, kind, "leave it out for the project's own")
        self.classifier = load_model() if classifier is None else classifier
        self.method = method
        self.regions = regions
        self.search_params = _search_params(self.classifier, search).with_horizon(horizon)
        self.heat_params = heat or HeatParams()
        self.region_params = fit or RegionParams()
        self.track_params = track or TrackParams()
        self.camera = camera
        self.diagnostics = diagnostics
        self._n_jobs = n_jobs
        self._engine = self._open_engine()
        self._history = HeatHistory(self.heat_params.frames)
        self.reset()

    def _open_engine(self) -> MixtureSearch | BandSearch | None:
        """Search of the model's kind; None where windows are looked at one by one."""
        if isinstance(self.classifier, TemplateMixture):
            if self.method == "windows":
                raise InvalidInputError(
                    "method must be 'shared' for a mixture of templates, got 'windows'; "
                    'pass load_model("highway")'
                )
            return MixtureSearch(self.classifier, n_jobs=self._n_jobs)
        return BandSearch(self.classifier, n_jobs=self._n_jobs) if self.method == "shared" else None

    def reset(self, *, fps: float = 25.0) -> None:
        """Forget all frames, before the first frame of another video.

        Parameters
        ----------
        fps
            Frame rate, for frames that come without a time.

        Raises
        ------
        InvalidInputError
            If the frame rate is not a positive number.
        """
        self._fps = check_number(fps, "fps", above=0, high=1e6)
        self._index = 0
        self._thumbnail: NDArray[np.float32] | None = None
        self._history.clear()
        self._tracker: Tracker | None = None

    def search(self, frame: NDArray[np.uint8]) -> FoundWindows:
        """Search one frame for windows that look like vehicles: needs no other frame, and any thread may.

        Raises
        ------
        InvalidInputError
            If the frame is no ``(H, W, 3)`` uint8 RGB image or too small for a window.
        """
        began = clock.perf_counter()
        check_image(frame, "frame")
        vehicles = None
        params = self.search_params
        if isinstance(params, PyramidParams):
            assert isinstance(self._engine, MixtureSearch)
            least = min(0.0, self.track_params.low_threshold, self.track_params.high_threshold)
            found = self._engine.find(frame, params, least=least)
            windows, vehicles = found.windows, found.vehicles
        elif isinstance(self._engine, BandSearch):
            windows = self._engine.find(frame, params)
        else:
            windows = self._search_one_by_one(frame, params)
        height, width = frame.shape[:2]
        # Every n-th pixel is enough to notice a cut, and costs nothing.
        rows = np.linspace(0, height - 1, _THUMBNAIL[1]).astype(int)
        columns = np.linspace(0, width - 1, _THUMBNAIL[0]).astype(int)
        thumbnail = frame[np.ix_(rows, columns)].mean(axis=2, dtype=np.float32)
        seconds = clock.perf_counter() - began
        return FoundWindows(windows, vehicles, (height, width), thumbnail, seconds)

    def _search_one_by_one(self, frame: NDArray[np.uint8], search: SearchParams) -> Detections:
        assert isinstance(self.classifier, VehicleClassifier)
        bands = [band_windows(band) for band in search.place(frame.shape)]
        # Windows of an overhang need pixels beyond the frame; the reference does without them.
        windows = np.concatenate(bands)
        windows = windows[(windows[:, 0] >= 0) & (windows[:, 2] <= frame.shape[1])]
        return search_windows(
            frame, windows, self.classifier, min_score=search.min_score, n_jobs=self._n_jobs
        )

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the vehicles of a still; the state of a video is neither used nor changed.

        Parameters
        ----------
        image
            ``(H, W, 3)`` uint8 RGB.

        Returns
        -------
        Detections
            Boxes in pixels of the image, with scores.

        Raises
        ------
        InvalidInputError
            If the image is malformed or too small for a window.
        """
        found = self.search(image)
        if self.regions == "heat":
            return self._label(frame_heat(found.shape, found.windows, self.heat_params))
        return _sure(self._fit(found))

    def _fit(self, found: FoundWindows) -> Detections:
        if found.vehicles is not None:
            return found.vehicles
        return find_vehicles(found.windows, self._camera_of(found.shape), found.shape, self.region_params)

    def _label(self, heat: NDArray[np.float32]) -> Detections:
        return label_boxes(
            heat, threshold=self.heat_params.threshold, peak_fraction=self.heat_params.peak_fraction
        )

    def _camera_of(self, shape: tuple[int, int]) -> Camera:
        if self.camera is not None:
            return self.camera
        search = self.search_params
        if search.horizon is None:
            return Camera.for_frame(shape)
        # The search allows for a horizon that is off; the tracker learns by how much.
        error = search.horizon_error if isinstance(search, PyramidParams) else _BAND_ERROR
        return Camera.for_frame(shape, horizon=search.horizon, horizon_std_px=_DOUBT * error * shape[0])

    def process(self, frame: NDArray[np.uint8], time: float | None = None) -> FrameResult:
        """Search the next frame of a video and follow its vehicles.

        Parameters
        ----------
        frame
            ``(H, W, 3)`` uint8 RGB.
        time
            Time of the frame in seconds; None: one frame after the last one.
        """
        found = self.search(frame)
        return self.follow(found, found.shape, time=time)

    def follow(
        self, found: FoundWindows, shape: tuple[int, ...], *, time: float | None = None
    ) -> FrameResult:
        """Take the searched windows of the next frame: regions and tracks, strictly in the frames' order.

        Parameters
        ----------
        found
            Result of `search` for this frame.
        shape
            ``(height, width, ...)`` of the frame.
        time
            Time of the frame in seconds; None: one frame after the last one.

        Notes
        -----
        A cut to another scene, a frame of another size and a time that goes back end all tracks.
        """
        began = clock.perf_counter()
        if self._tracker is None:
            self._tracker = Tracker(self.track_params, fps=self._fps)
        self._tracker.set_camera(self._camera_of(found.shape))
        if self._is_cut(found):
            self._history.clear()
            self._tracker.end_tracks()
        self._thumbnail = found.thumbnail
        if self.regions == "heat":
            heat = self._history.add(frame_heat(found.shape, found.windows, self.heat_params))
            regions = self._label(heat)
        else:
            regions = self._fit(found)
        fitted = clock.perf_counter()
        tracks = self._tracker.update(regions, shape, time=time)
        seconds = {
            "search": found.seconds,
            "regions": fitted - began,
            "track": clock.perf_counter() - fitted,
        }
        result = FrameResult(self._index, time, found.windows, _sure(regions), tracks, seconds)
        self._index += 1
        return result

    def _is_cut(self, found: FoundWindows) -> bool:
        if self._thumbnail is None:
            return False
        return (
            float(cv2.norm(self._thumbnail, found.thumbnail, cv2.NORM_L1))
            > CUT_DIFFERENCE * found.thumbnail.size
        )

    def annotate(self, frame: NDArray[np.uint8], result: FrameResult) -> NDArray[np.uint8]:
        """Draw the vehicles of a result on a copy of its frame."""
        if self.diagnostics:
            heat = frame_heat(frame.shape, result.windows, self.heat_params)
            return draw_diagnostics(frame, result.windows, heat, result.tracks)
        return draw_tracks(frame, result.tracks)

    def __call__(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Process the next frame and return it annotated: ``clip.image_transform(detector)`` in moviepy."""
        return self.annotate(frame, self.process(frame))

    def warm_up(self, shape: tuple[int, int] = (720, 1280)) -> None:
        """Compile the kernels and set up the buffers for frames of `shape`, so that no frame waits for it.

        Compiled kernels are kept on disk: only the first use after an installation takes seconds.
        """
        self.detect(np.zeros((*shape, 3), np.uint8))

    def close(self) -> None:
        """End the search's threads; the detector starts them again when it is used."""
        if self._engine is not None:
            self._engine.close()

    def __enter__(self) -> VehicleDetector:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


def _sure(vehicles: Detections) -> Detections:
    """Leave out what is for the tracker alone."""
    return vehicles[vehicles.scores >= 0]


def _search_params(
    model: VehicleClassifier | TemplateMixture, search: SearchParams | PyramidParams | None
) -> SearchParams | PyramidParams:
    """Check that model and search belong together, or choose the search of the model's kind."""
    if isinstance(model, TemplateMixture):
        if search is not None:
            check_type(
                search,
                "search",
                PyramidParams,
                "leave it out: a mixture of templates is searched for on a pyramid",
            )
        return search or PyramidParams()
    check_type(model, "classifier", VehicleClassifier, "load_model and load_classifier load one")
    if search is not None:
        check_type(
            search, "search", SearchParams, "leave it out: a classifier of patches is searched for in bands"
        )
    return search or SearchParams.preset()
