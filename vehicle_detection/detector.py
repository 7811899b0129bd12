"""`VehicleDetector`: search, detection and tracking combined, with the state between a video's frames."""

from __future__ import annotations

import contextlib
import copy
import math
import os
import threading
import time as clock
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Closing,
    check_image,
    check_integer,
    check_number,
    check_sequence,
    check_shape,
    check_type,
    describe,
    pluralize,
)
from vehicle_detection.annotator import Annotator, DrawParams, OwnSpeed
from vehicle_detection.boxes import Detections, ScoreScale
from vehicle_detection.camera import (
    GIVEN_LENS_STD,
    LENSES,
    UNKNOWN_LENS_STD,
    Camera,
    check_camera_file,
    read_camera,
)
from vehicle_detection.confidence import Model, with_confidence
from vehicle_detection.drawing import (
    blur_boxes,
    draw_boxes,
)
from vehicle_detection.errors import DetectorError, InvalidInputError
from vehicle_detection.function_model import DetectorFunction, FunctionModel, FunctionParams
from vehicle_detection.heatmap import HeatHistory, HeatParams, frame_heat, label_heat
from vehicle_detection.images import is_cut, make_thumbnail, read_image
from vehicle_detection.loading import load_model, refuse_network_options
from vehicle_detection.network import Device, NetworkModel, NetworkParams
from vehicle_detection.regions import RegionParams, find_vehicles
from vehicle_detection.search import FrameSearch, SearchParams, SearchResult
from vehicle_detection.svm import VehicleClassifier
from vehicle_detection.tracking import (
    FrameResult,
    Track,
    Tracker,
    TrackParams,
    backfill_tracks,
    interpolate_tracks,
)

Path = str | os.PathLike[str]
Clip = TypeVar("Clip")

# Searches per second of a video, at least, where the frame rate decides.
_MIN_SEARCH_RATE = 12.0
# Standard error of the horizon as a fraction of the search's horizon tolerance: by default, and if given.
_HORIZON_STD, _GIVEN_HORIZON_STD = 0.4, 0.2
# Standard error of a given height of the camera (m).
_GIVEN_HEIGHT_STD = 0.05
# Frame rate that is assumed where it is unknown.
_USUAL_FPS = 25.0
# Frames: rounding error of a time times the frame rate, as in moviepy.
_FRAME_TOLERANCE = 1e-5


class VehicleDetector(Closing):
    """Detect the vehicles of images, and track those of a video.

    Parameters
    ----------
    model
        A name (``"default"`` for any road, ``"highway"``), the path of a model file, such as
        ``"own.safetensors"`` or the ``"yolo11n.onnx"`` of another library (see `load_model`), or a model. For
        a detector of your own see `detector_from`.
    classes
        Names or numbers of the classes of a network that are vehicles. Default: car, truck, bus, van and
        vehicle.
    conf
        Minimum confidence of a vehicle in a single image: its calibrated probability, 0 to 1, of which values
        outside 0.001 to 0.999 are limited to these. The search and
        the tracker follow: scores are those above this threshold. None: the model's own threshold.
    search_params
        Where to search: `NetworkParams` for a network, `SearchParams` for a classifier of patches,
        `FunctionParams` for a function.
    region_params
        How windows become boxes, unless the model predicts boxes: `RegionParams` for one box per group of
        agreeing windows; `HeatParams` for the course's heat map over the last frames (any model). Without a
        threshold in it, the threshold fits the model and its search.
    track_params
        Parameters of the tracker.
    draw_params
        What `annotate` and `process_video` draw: labels, lines, colors, a bird's-eye view.
    camera
        The camera, for distances and boxes: a `Camera`; a file of `write_camera`; or the name of a lens, as
        in `Camera.for_frame`. The pixels of a camera of known frame size are scaled to frames of the same
        aspect ratio. By default a dash-cam with the search's horizon, as an estimate that tracking refines.
        The horizon of a file is that of the search, too.
    field_of_view, camera_height_m
        Angle of view along the frame's longer side in degrees of a lens without distortion, and height of the
        lens above the road in meters, without a `Camera` or a file. If the lens is unknown, distances assume
        58 degrees and have a standard error of at least 25%.
    horizon
        Height of the horizon as a fraction of the frame's height; overrides that of `search_params` and that
        of `camera`.
    n_jobs
        Threads of the search of one frame.
    device
        Where a network runs: ``"cpu"``, or ``"cuda"`` with the package onnxruntime-gpu.
    every
        Search every n-th frame of a video, to save time. The tracks of the frames between are interpolated
        by `process_video`, which holds these frames in memory, and predicted by `process`. None:
        `process_video` searches at least 12 frames per second, but every frame for heat maps, `diagnostics`,
        `blur` and functions; `process` searches every frame.
    own_speed
        Speed of the camera's own vehicle over the time of the video (`read_own_speed`). Where it is known,
        labels state speeds over ground, without a sign; otherwise speeds relative to the camera.
    diagnostics
        `annotate` shows the frame, its positive windows, the heat map and the tracks side by side.
    blur
        `annotate` blurs the vehicles, ``"vehicles"``, or the region of their license plates, ``"plates"``:
        of every detection and track of the frame, also of tracks that are not detected or not shown. Vehicles
        that are not found are not blurred: check the result before you publish it.

    Attributes
    ----------
    model, search_params, region_params, track_params, draw_params, camera
        The arguments of these names, or their defaults.
    every, own_speed, diagnostics, blur
        The arguments of these names. Like the others, they are read-only: assigning to them has no effect, or
        only a partial one. Make another detector instead.

    Raises
    ------
    ModelFileError
        If the model file is missing or damaged.
    InvalidInputError
        If an argument is malformed, or `search_params` does not fit the model.

    Warns
    -----
    UserWarning
        If the heat threshold cannot fit the density of the search.

    Examples
    --------
    >>> detector = VehicleDetector()
    >>> road = np.full((720, 1280, 3), 90, np.uint8)
    >>> len(detector.detect(road)), len(detector.process(road).tracks)
    (0, 0)
    """

    def __init__(
        self,
        model: Path | Model = "default",
        *,
        classes: Collection[str | int] | None = None,
        conf: float | None = None,
        search_params: SearchParams | NetworkParams | FunctionParams | None = None,
        region_params: RegionParams | HeatParams | None = None,
        track_params: TrackParams | None = None,
        draw_params: DrawParams | None = None,
        camera: Camera | Path | None = None,
        field_of_view: float | None = None,
        camera_height_m: float | None = None,
        horizon: float | None = None,
        n_jobs: int | None = None,
        device: Device = "cpu",
        every: int | None = None,
        own_speed: OwnSpeed | None = None,
        diagnostics: bool = False,
        blur: Literal["vehicles", "plates"] | None = None,
    ) -> None:
        self.model = _load(model, classes, device)
        for name, value, kind in (
            ("search_params", search_params, self.model.search_params_type),
            ("region_params", region_params, (RegionParams, HeatParams)),
            ("track_params", track_params, TrackParams),
            ("camera", camera, (Camera, str, os.PathLike)),
        ):
            if value is not None:
                check_type(value, name, kind, "omit it for the default")
        heat = region_params if isinstance(region_params, HeatParams) else None
        self.annotator = Annotator(
            draw_params, heat=heat, own_speed=own_speed, blur=blur, diagnostics=diagnostics
        )
        if conf is not None:
            self.model, region_params = with_confidence(self.model, region_params, conf)
        chosen = search_params or self.model.search_params_type.default()
        self.search_params: SearchParams | NetworkParams | FunctionParams = chosen.with_horizon(horizon)
        if isinstance(region_params, HeatParams):
            region_params = region_params.for_search(self.search_params)
        self.region_params = region_params or RegionParams()
        self.track_params = track_params or TrackParams()
        self.draw_params = self.annotator.style
        self.camera = camera
        self._lens = _check_lens(camera, field_of_view, camera_height_m)
        self._cameras: dict[tuple[int, int], Camera] = {}
        self._horizon_given = horizon is not None
        self._default_horizon = horizon is None and search_params is None
        self.own_speed = own_speed
        self.diagnostics, self.blur = diagnostics, blur
        self.every = None if every is None else check_integer(every, "every", low=1, high=1000)
        self._n_jobs = n_jobs
        self._search: FrameSearch = self.model.open_search(self._n_jobs)
        self._heat_params = region_params if isinstance(region_params, HeatParams) else None
        # The heat of a region is no log-odds.
        self._calibration = self.model.calibration if self._heat_params is None else None
        self._speed_warning = True
        self._lock = threading.RLock()
        self.reset()

    @contextlib.contextmanager
    def _one_thread(self) -> Iterator[None]:
        """Refuse a second thread during a block: tracks follow the order of the frames."""
        if not self._lock.acquire(blocking=False):
            raise InvalidInputError(
                "frames must be processed one after the other, but another thread is processing one; "
                "call detect or search from several threads, or make a detector for each video"
            )
        try:
            yield
        finally:
            self._lock.release()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.model!r}, {pluralize(self._index, 'frame')} processed)"

    def __getstate__(self) -> dict[str, Any]:
        """Return everything but the threads of the search, for copies and other processes."""
        return {name: value for name, value in vars(self).items() if name not in ("_search", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._lock = threading.RLock()
        self._search = self.model.open_search(self._n_jobs)

    def __copy__(self) -> Self:
        """Return a detector with the same model and search threads, and a state of its own."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other._lock = threading.RLock()
        for name in ("_tracker", "_heat_history", "annotator"):
            setattr(other, name, copy.deepcopy(getattr(self, name)))
        return other

    def reset(self, *, fps: float | None = None) -> None:
        """Forget all frames, before the first frame of another video.

        Parameters
        ----------
        fps
            Frame rate, for frames without a time. None: unknown; 25 is assumed.

        Raises
        ------
        InvalidInputError
            If the frame rate is not a positive number.
        """
        self._fps = None if fps is None else check_number(fps, "fps", above=0, high=1e6)
        self._index = 0
        self._skipped = 0  # frames since the last search
        self._shape: tuple[int, int] | None = None  # of the last searched frame
        self._time: float | None = None
        self._first: tuple[NDArray[np.uint8], FrameResult] | None = None
        self._thumbnail: NDArray[np.float32] | None = None
        self._heat_history = HeatHistory((self._heat_params or HeatParams()).frames)
        self._heat: NDArray[np.float32] | None = None
        self._tracker: Tracker | None = None
        self.annotator.reset(fps=self._fps)

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
        params = self.search_params_of(frame.shape)
        return self._search.find(frame, params, min_vehicle_score=min_score)

    def detect(self, image: NDArray[np.uint8] | Path) -> Detections:
        """Detect the vehicles of a single image; the state of a video is neither used nor changed.

        Parameters
        ----------
        image
            ``(H, W, 3)`` uint8 RGB, or the path of an image file.

        Returns
        -------
        Detections
            Boxes in pixels of the image, with scores and, unless they come from a heat map, confidences.

        Raises
        ------
        InvalidInputError
            If the image is malformed, unreadable or too small for a window.
        """
        frame = read_image(image) if isinstance(image, (str, os.PathLike)) else check_image(image)
        found = self.search(frame)
        if self._heat_params is not None:
            return label_heat(frame_heat(found.shape, found.windows, self._heat_params), self._heat_params)
        return _positive(self._fit_boxes(found))

    def _fit_boxes(self, found: SearchResult) -> Detections:
        vehicles = found.vehicles
        if vehicles is None:
            assert isinstance(self.region_params, RegionParams)
            camera = self.camera_of(found.shape)
            vehicles = find_vehicles(found.windows, camera, found.shape, self.region_params)
        assert self._calibration is not None
        return Detections(vehicles.boxes, vehicles.scores, self._calibration.probability(vehicles.scores))

    def search_params_of(self, shape: tuple[int, ...]) -> SearchParams | NetworkParams | FunctionParams:
        """Return the parameters of the search for frames of ``(height, width, ...)``.

        They are `search_params`, with the horizon that a camera file states, unless `horizon` or
        `search_params` were given.

        Returns
        -------
        SearchParams, NetworkParams or FunctionParams
            The kind depends on the model: a classifier, a network or a function.

        Raises
        ------
        InvalidInputError
            If `shape` is malformed, or the camera file was made for frames of another aspect ratio.

        Examples
        --------
        >>> VehicleDetector().search_params_of((720, 1280)).horizon
        0.5
        """
        shape = check_shape(shape)
        # The horizon of a `Camera` that was passed may be a default, unlike that of a file.
        if not self._default_horizon or isinstance(self.camera, Camera | None) or self.camera in LENSES:
            return self.search_params
        camera = self.camera_of(shape)
        horizon = camera.horizon_px / shape[0]
        if camera.horizon_std_px or not 0 <= horizon <= 1:
            return self.search_params
        # Not `with_horizon`, which narrows the search: the road is not level everywhere.
        return replace(self.search_params, horizon=horizon)

    def camera_of(self, shape: tuple[int, ...]) -> Camera:
        """Return the camera for frames of ``(height, width, ...)``: as given, or what is assumed.

        A camera whose frame size is known is scaled to frames of the same aspect ratio, and refused for
        others with an `InvalidInputError`.

        >>> round(VehicleDetector(field_of_view=90).camera_of((720, 1280)).focal_px)
        640
        """
        shape = check_shape(shape)
        if shape not in self._cameras:
            self._cameras[shape] = self._open_camera(shape)
        return self._cameras[shape]

    def _open_camera(self, shape: tuple[int, int]) -> Camera:
        """Camera for frames of this shape, from its file or from what is known of it."""
        params, known = self.search_params, dict[str, Any]()
        if params.horizon is not None:
            # The search tolerates a wrong horizon; the tracker estimates by how much it is wrong.
            std = (_GIVEN_HORIZON_STD if self._horizon_given else _HORIZON_STD) * params.horizon_tolerance
            known = {"horizon": params.horizon, "horizon_std_px": std * shape[0]}
        if self.camera is None or self.camera in LENSES:
            return Camera.for_frame(shape, **known, **self._lens)
        given = self.camera
        camera = given.for_shape(shape) if isinstance(given, Camera) else read_camera(given, shape)
        if self._horizon_given:
            row = known["horizon"] * shape[0]
            camera = replace(camera, horizon_px=row, horizon_std_px=known["horizon_std_px"])
        return camera

    @property
    def lens_is_known(self) -> bool:
        """Whether the camera or its field of view was given; if not, distances are rough."""
        return self.camera is not None or "field_of_view" in self._lens

    def search_interval(self, fps: float) -> int:
        """Interval of the frames that `process_video` searches at a frame rate: 1 for every frame."""
        if self.every is not None:
            return self.every
        if self._heat_params or self.diagnostics or self.blur or self.model.searches_every_frame:
            return 1
        fps = check_number(fps, "fps", above=0, high=1e6)
        return max(1, int(fps / _MIN_SEARCH_RATE + 0.01))  # 23.976 counts as 24

    def process(self, frame: NDArray[np.uint8], time: float | None = None) -> FrameResult:
        """Search the next frame of a video and track its vehicles.

        Parameters
        ----------
        frame
            ``(H, W, 3)`` uint8 RGB.
        time
            Time of the frame in seconds; None: one frame after the last one, at the frame rate that `reset`
            was given (25 per second if none).

        Returns
        -------
        FrameResult
            With `every`, frames between two searched ones have predicted tracks only.

        Raises
        ------
        InvalidInputError
            If the frame is not an ``(H, W, 3)`` uint8 RGB image, or is too small for a window.
        DetectorError
            If the detector is a function that fails; the message names the frame.

        Warns
        -----
        UserWarning
            Once, if speeds are estimated although neither times nor a frame rate are known.
        """
        with self._one_thread():
            result = self._process(frame, time)
        self._warn_of_frame_rate(result)
        return result

    def _warn_of_frame_rate(self, result: FrameResult) -> None:
        """Warn the caller of a public method, once, that speeds depend on an assumed frame rate."""
        has_speed = any(track.speed_mps is not None for track in result.shown)
        if has_speed and result.time is None and self._fps is None and self._speed_warning:
            self._speed_warning = False
            warnings.warn(
                f"the speeds assume {_USUAL_FPS:g} frames per second, because the frames came without times; "
                "pass their times in seconds to process, or call detector.reset(fps=...) first; in moviepy "
                "use detector.annotate_clip(clip)",
                stacklevel=3,
            )

    def _process(self, frame: NDArray[np.uint8], time: float | None) -> FrameResult:
        start = clock.perf_counter()
        time = _check_time(time)
        thumbnail = make_thumbnail(check_image(frame, "frame"))
        follows = frame.shape[:2] == self._shape and not self._is_cut(thumbnail)
        if time is not None and self._time is not None:
            follows &= 0 < time - self._time <= self.track_params.max_gap
        if follows and self._tracker is not None and self._skipped + 1 < (self.every or 1):
            self.skip(thumbnail)
            tracks = self._tracker.predict(time=time, frames=self._skipped)
            return _unsearched(self._index - 1, time, tracks, start)
        try:
            found = self.search(frame)
        except DetectorError as error:
            raise DetectorError(f"frame {self._index}: {error}") from error
        return self._track(found, time)

    def skip(self, thumbnail: NDArray[np.float32]) -> None:
        """Count the next frame, which is not searched, given its `make_thumbnail`."""
        self._index += 1
        self._skipped += 1
        self._thumbnail = thumbnail

    def search_delay(self, fps: float) -> int:
        """Return how many searched frames `process_video` holds back, for `backfill`."""
        searches = check_number(fps, "fps", above=0, high=1e6) / self.search_interval(fps)
        return int(self.track_params.backfill * searches + 0.01)

    def backfill(self, results: Sequence[FrameResult]) -> list[FrameResult]:
        """Show the tracks that are confirmed in the last of these results in the earlier ones, too.

        Parameters
        ----------
        results
            Results of consecutive searched frames, in their order.
        """
        results = check_sequence(results, "results", "FrameResult")
        for result in results:
            check_type(result, "results", FrameResult, "pass what track returns")
        if not results:
            return []
        *earlier, last = results
        if not any(track.id for track in last.tracks):
            return list(results)
        return [
            *(replace(result, tracks=backfill_tracks(result.tracks, last.tracks)) for result in earlier),
            last,
        ]

    def interpolate(
        self, before: FrameResult, after: FrameResult | None, times: Sequence[float]
    ) -> list[FrameResult]:
        """Return the results of the frames between two searched frames, with interpolated tracks.

        Parameters
        ----------
        before, after
            Results of the searched frames; `after` is None at the end of a video.
        times
            Times of the frames between, in seconds. `before` and `after` must have times too.

        Returns
        -------
        list of FrameResult
            A result for each time.

        Raises
        ------
        InvalidInputError
            If an argument is malformed, or the times do not lie between those of `before` and `after`.
        """
        check_type(before, "before", FrameResult, "pass what track returns")
        if after is not None:
            check_type(after, "after", FrameResult, "pass what track returns")
        times = [
            check_number(each, "times", low=-1e12, high=1e12)
            for each in check_sequence(times, "times", "numbers")
        ]
        if self._shape is None or before.time is None or (after is not None and after.time is None):
            raise InvalidInputError("before and after must have times; pass time= to track")
        last = math.inf if after is None or after.time is None else after.time
        if not all(before.time < each < last for each in times):
            raise InvalidInputError(
                f"times must lie between those of before and after, {before.time:g} and {last:g} s; "
                f"got {times}"
            )
        results = []
        for number, time in enumerate(times):
            start = clock.perf_counter()
            dt_after, following = 0.0, tuple[Track, ...]()
            if after is not None and after.time is not None:
                following, dt_after = after.tracks, after.time - time
            dt = time - before.time
            tracks = interpolate_tracks(before.tracks, following, dt, dt_after, self._shape)
            results.append(_unsearched(before.index + 1 + number, time, tracks, start))
        return results

    def track(self, found: SearchResult, *, time: float | None = None) -> FrameResult:
        """Update the tracks with the search result of the next frame, in frame order.

        Parameters
        ----------
        found
            Result of `search` for this frame.
        time
            Time of the frame in seconds; None: as in `process`.

        Returns
        -------
        FrameResult
            Detections of this frame and all tracks, including those not shown.

        Raises
        ------
        InvalidInputError
            If an argument is malformed, or another thread is processing a frame.

        Warns
        -----
        UserWarning
            As in `process`.

        Notes
        -----
        A cut to another scene, a frame of another size and a time that goes backwards end all tracks.
        """
        with self._one_thread():
            result = self._track(found, time)
        self._warn_of_frame_rate(result)
        return result

    def _track(self, found: SearchResult, time: float | None) -> FrameResult:
        start = clock.perf_counter()
        check_type(found, "found", SearchResult, "pass what search returns")
        time = _check_time(time)
        camera = self.camera_of(found.shape)
        self._shape, self._time = found.shape, time
        if self._tracker is None:
            fps = self._fps or _USUAL_FPS
            self._tracker = Tracker(self.track_params, fps=fps, calibration=self._calibration)
        self._tracker.set_camera(camera)
        if self._is_cut(found.thumbnail):
            self._heat_history.clear()
            self._tracker.end_tracks()
        self._thumbnail = found.thumbnail
        if self._heat_params is not None:
            self._heat = self._heat_history.add(frame_heat(found.shape, found.windows, self._heat_params))
            detections = label_heat(self._heat, self._heat_params)
        else:
            detections = self._fit_boxes(found)
        detected = clock.perf_counter()
        tracks = self._tracker.update(detections, found.shape, time=time, frames=self._skipped + 1)
        self._skipped = 0
        seconds = {
            "search": found.seconds,
            "regions": detected - start,
            "track": clock.perf_counter() - detected,
        }
        result = FrameResult(self._index, time, found.windows, _positive(detections), tracks, seconds)
        self._index += 1
        return result

    def _is_cut(self, thumbnail: NDArray[np.float32]) -> bool:
        return self._thumbnail is not None and is_cut(self._thumbnail, thumbnail)

    def annotate(self, frame: NDArray[np.uint8], result: FrameResult) -> NDArray[np.uint8]:
        """Draw the vehicles of a result on a copy of its frame, as `draw_params` says.

        Drawn in their order, the frames of a video have labels that keep their places, and trails in the
        bird's-eye view.

        Parameters
        ----------
        frame
            ``(H, W, 3)`` uint8 RGB.
        result
            What `process` or `track` returned for this frame.

        Returns
        -------
        numpy.ndarray
            A new uint8 RGB frame of the shape that `annotated_shape` returns.

        Raises
        ------
        InvalidInputError
            If an argument is malformed.
        """
        shape = check_image(frame, "frame").shape[:2]
        self.annotator.camera = self.camera_of(shape)
        return self.annotator.draw(frame, result)

    def annotated_shape(self, shape: tuple[int, ...]) -> tuple[int, int, int]:
        """Shape of what `annotate` returns for a frame of this shape; a view beside it adds columns."""
        height, width = check_shape(shape)
        return self.annotator.output_shape((height, width))

    def __call__(self, frame: NDArray[np.uint8] | Path) -> NDArray[np.uint8]:
        """Return the next frame annotated.

        The path of an image file gives that image with the vehicles of `detect` drawn; tracks are unchanged.

        Warns
        -----
        UserWarning
            As in `process`.

        Notes
        -----
        In moviepy use `annotate_clip`. With ``clip.image_transform(detector)`` only images arrive here: times
        are those of the frame rate that `reset` was given (25 if none), a second clip continues the tracks of
        the first one unless `reset` is called, and so does a clip that is rewound. The first frame, which
        moviepy reads twice, counts once.
        """
        if isinstance(frame, (str, os.PathLike)):
            image = read_image(frame)
            boxes = self.detect(image).boxes
            image = image if self.blur is None else blur_boxes(image, boxes, region=self.blur)
            return draw_boxes(image, boxes)
        if self._first is not None and self._index == 1 and np.array_equal(frame, self._first[0]):
            return self.annotate(frame, self._first[1])
        with self._one_thread():
            result = self._process(frame, None)
        if result.index == 0:
            self._first = frame.copy(), result
        self._warn_of_frame_rate(result)
        return self.annotate(frame, result)

    def annotate_clip(self, clip: Clip, *, on_result: Callable[[FrameResult], object] | None = None) -> Clip:
        """Annotate a moviepy clip: a new clip with the same duration, frame rate and audio.

        The new clip has tracks of its own, numbered from 1; those of the detector and of other clips are
        neither used nor changed. Frames are processed when they are read, with their times in `clip`. Before
        and after, every method and effect of moviepy applies, such as ``subclipped``, ``resized`` and
        ``concatenate_videoclips``. Change the speed afterwards: the estimated speeds are those of `clip`.

        Parameters
        ----------
        clip
            A video clip of moviepy 2.
        on_result
            Function that is called with the result of each processed frame. moviepy may read a frame more
            than once: for a preview, a second rendering, or effects such as ``Loop``. A result with the index
            0 is the first one of another pass; drop the results before it.

        Returns
        -------
        moviepy.VideoClip
            Reading frames in ascending order tracks the vehicles. The frame that was read last is not
            processed again. Going back in time, as a second rendering does, forgets all frames and starts
            anew; its result equals that of the first. Skipping more than ``track_params.max_gap`` seconds
            ends all tracks.

        Raises
        ------
        InvalidInputError
            If `clip` is not a video clip of moviepy 2.

        Examples
        --------
        >>> from moviepy import VideoFileClip  # doctest: +SKIP
        >>> clip = VideoFileClip("drive.mp4").subclipped(2, 12)  # doctest: +SKIP
        >>> VehicleDetector().annotate_clip(clip).write_videofile("found.mp4")  # doctest: +SKIP
        """
        given: Any = clip
        if not all(hasattr(given, name) for name in ("transform", "get_frame", "size")):
            raise InvalidInputError(
                f"clip must be a video clip of moviepy 2, got {describe(clip)}; pass VideoFileClip(path), or "
                "use process_video for a file"
            )
        if on_result is not None and not callable(on_result):
            raise InvalidInputError(f"on_result must be a function of a result, got {describe(on_result)}")
        annotated: Clip = given.transform(_ClipAnnotator(self, getattr(given, "fps", None), on_result))
        return annotated

    def warm_up(self, shape: tuple[int, int] = (720, 1280)) -> None:
        """Compile the kernels and allocate the buffers for frames of `shape`, before the first frame.

        Compiled kernels are cached on disk: only the first use after an installation takes seconds.
        """
        self.detect(np.zeros((*check_shape(shape), 3), np.uint8))

    def close(self) -> None:
        """Stop the search's threads; the detector starts them again when it is used."""
        self._search.close()


class _ClipAnnotator:
    """The function of a moviepy clip that annotates its frames, with tracks of its own."""

    def __init__(
        self, detector: VehicleDetector, fps: float | None, on_result: Callable[[FrameResult], object] | None
    ) -> None:
        self._detector = copy.copy(detector)
        self._fps, self._on_result = fps, on_result
        self._time: float | None = None

    def __call__(self, get_frame: Callable[[float], NDArray[np.uint8]], t: float) -> NDArray[np.uint8]:
        """Return the annotated frame at `t` seconds."""
        # Times within one frame, as in slow motion, show the same frame.
        time = float(t) if not self._fps else int(t * self._fps + _FRAME_TOLERANCE) / self._fps
        if time != self._time:
            if self._time is None or time < self._time:
                self._detector.reset(fps=self._fps or _USUAL_FPS)
            frame = get_frame(time)
            if frame.dtype != np.uint8:  # effects such as FadeIn return fractions of gray levels
                frame = np.clip(frame, 0, 255).astype(np.uint8)
            result = self._detector.process(frame, time)
            self._picture, self._time = self._detector.annotate(frame, result), time
            if self._on_result is not None:
                self._on_result(result)
        return self._picture.copy()


def _check_time(time: object) -> float | None:
    return None if time is None else check_number(time, "time", low=-1e12, high=1e12)


def detector_from(
    function: DetectorFunction,
    *,
    score: ScoreScale = "probability",
    threshold: float | None = None,
    class_ids: Collection[int] | None = None,
    thread_safe: bool = False,
    name: str | None = None,
    **options: Any,
) -> VehicleDetector:
    """Make a detector of any function that finds boxes: to track, draw, evaluate and render with it.

    Parameters
    ----------
    function
        Called with an ``(H, W, 3)`` uint8 RGB image of its own. It returns ``(boxes, scores)``, ``(N, 4)``
        ``[x1, y1, x2, y2]`` in pixels and ``(N,)``, or ``(boxes, scores, classes)``; or `Detections`, or an
        object with ``xyxy``, such as ``supervision.Detections`` and the ``boxes`` of Ultralytics' results
        (see `Detections.from_supervision`). Boxes are clipped to the image. It should
        return weak boxes as well: the tracker uses them, images show only those above the threshold.
    score
        What the scores are. They are converted to log-odds above the threshold, the unit of `TrackParams`:
        ``"probability"``, 0 to 1; ``"logit"``, log-odds; ``(low, high)``, any scale, of which `low` is the
        threshold and becomes 0, and `high`, a certain vehicle, becomes 3 (95%).
    threshold
        Score from which a box is a vehicle in a single image: by default 0.5 for probabilities and 0 for
        log-odds. Pass 0.25 if that is the usual threshold of your detector.
    class_ids
        Keep only boxes of these classes, integers as the function returns them.
    thread_safe
        Whether the function may be called from several threads. `process_video` searches several frames at
        once; with False the calls wait for each other. Sessions of ONNX Runtime and the ``predict`` of
        scikit-learn are thread-safe.
    name
        Name in messages; by default that of the function.
    **options
        Further arguments of `VehicleDetector`, such as ``track_params``, ``camera`` and ``horizon``.

    Returns
    -------
    VehicleDetector
        Its `detect`, `process`, `annotate_clip` and so on work as with the shipped models.

    Raises
    ------
    InvalidInputError
        If an argument is malformed.
    DetectorError
        In the methods of the detector, if the function fails or returns something else; the message names
        the function and the frame.

    Notes
    -----
    With the defaults of `TrackParams`, scores from 0 on are vehicles in a single image; tracks start from
    -0.3 on (a probability of 0.43), are confirmed at an average of 0.2 (0.55), and are continued by boxes
    down to -1.5 (0.18). The probabilities hold for a threshold of 0.5.

    Examples
    --------
    >>> def bright_spot(image):
    ...     y, x = np.unravel_index(image.sum(axis=2).argmax(), image.shape[:2])
    ...     return [[x - 20, y - 20, x + 20, y + 20]], [0.9]
    >>> detector = detector_from(bright_spot)
    >>> image = np.zeros((90, 160, 3), np.uint8)
    >>> image[50, 100] = 255
    >>> detector.detect(image).boxes.tolist()
    [[80.0, 30.0, 120.0, 70.0]]
    """
    model = FunctionModel(
        function=function,
        score=score,
        threshold=threshold,
        class_ids=class_ids,
        thread_safe=thread_safe,
        name=name,
    )
    return VehicleDetector(model, **options)


def _unsearched(index: int, time: float | None, tracks: tuple[Track, ...], start: float) -> FrameResult:
    """Make the result of a frame that is not searched; `start` is the time before its tracking."""
    none, seconds = Detections.empty(), {"track": clock.perf_counter() - start}
    return FrameResult(index, time, none, none, tracks, seconds, searched=False)


def _check_lens(camera: object, field_of_view: float | None, camera_height_m: float | None) -> dict[str, Any]:
    """Arguments of `Camera.for_frame` that do not depend on the frame."""
    if camera is not None and field_of_view is not None:
        raise InvalidInputError(
            f"field_of_view must be omitted with a camera, which has one; got {field_of_view}"
        )
    named = camera is None or (isinstance(camera, str) and camera in LENSES)
    if not named and not isinstance(camera, Camera):
        file = str(camera)
        if not os.path.isfile(file):
            raise InvalidInputError(
                f"camera must be a Camera, a file or one of {', '.join(LENSES)}, got {describe(camera)}; "
                "omit it"
            )
        check_camera_file(file)
    if camera_height_m is not None and not named:
        raise InvalidInputError(
            f"camera_height_m must be omitted with a Camera or a file, which have one; "
            f"got {camera_height_m}; change it there"
        )
    known: dict[str, Any] = {"focal_std": UNKNOWN_LENS_STD} if camera is None else {}
    if field_of_view is not None:
        angle = check_number(field_of_view, "field_of_view", low=1, high=170)
        known = {"field_of_view": angle, "focal_std": GIVEN_LENS_STD}
    elif named and camera is not None:
        known = {"lens": camera}
    if camera_height_m is not None:
        height = check_number(camera_height_m, "camera_height_m", above=0, high=100)
        known |= {"height_m": height, "height_std_m": _GIVEN_HEIGHT_STD}
    return known


def _positive(vehicles: Detections) -> Detections:
    """Keep the vehicles to show: negative scores are for the tracker only."""
    return vehicles[vehicles.scores >= 0]


def _load(model: object, classes: Collection[str | int] | None, device: Device) -> Model:
    if isinstance(model, (str, os.PathLike)):
        return load_model(model, classes=classes, device=device)
    refuse_network_options(classes, device, "with a model that is loaded")
    if callable(model) and not isinstance(model, type):
        raise InvalidInputError(
            f"model must not be a function, got {describe(model)}; pass it to detector_from"
        )
    if hasattr(model, "predict") and not isinstance(model, VehicleClassifier):
        argument = "pipeline" if hasattr(model, "steps") else "(classifier, scaler)"
        raise InvalidInputError(
            f"model must not be an estimator of scikit-learn, got {describe(model)}; convert it with "
            f"VehicleClassifier.from_pipeline({argument}, params), or use HeatmapDetector"
        )
    if not isinstance(model, FunctionModel):
        kinds = VehicleClassifier, NetworkModel
        check_type(model, "model", kinds, "pass a name, the path of a model file, or what load_model returns")
    return model  # type: ignore[return-value]
