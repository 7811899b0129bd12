"""Find the vehicles of images, `Detector`, and follow them through a video, `VehicleDetector`."""

from __future__ import annotations

import copy
import dataclasses
import functools
import os
import threading
import time as clock
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, Protocol, Self, cast, overload

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Closing,
    available_cores,
    check,
    invalid,
    pluralize,
    suggest_keywords,
    warn,
)
from vehicle_detection.annotator import Annotator
from vehicle_detection.boxes import Detections, Platt
from vehicle_detection.camera import Camera, open_camera
from vehicle_detection.drawing import blur_boxes, draw_boxes
from vehicle_detection.errors import DetectorError, InvalidInputError
from vehicle_detection.heatmap import HeatHistory, HeatParams, frame_heat, label_heat
from vehicle_detection.images import image_array, list_images
from vehicle_detection.network import Device, NetworkModel, load_network
from vehicle_detection.regions import RegionParams, find_vehicles
from vehicle_detection.results import ImageDetections, image_distances
from vehicle_detection.search import FrameSearch, SearchResult
from vehicle_detection.svm import VehicleClassifier, load_classifier
from vehicle_detection.tracking import USUAL_FPS, FrameResult, SceneCuts, Tracker, TrackParams, small_gray

Image = NDArray[np.uint8]
Path = str | os.PathLike[str]

# Standard error of the horizon that the bands of a search assume, as a fraction of their tolerance.
_HORIZON_STD = 0.4
# Probabilities beyond these have no useful threshold.
_MIN_CONF, _MAX_CONF = 0.001, 0.999
# Files of PyTorch are refused with a message that says how to export them.
_NETWORK_SUFFIXES = (".onnx", ".pt", ".pth")


class Model(Protocol):
    """What finds vehicles: a network, a classifier of patches or a function."""

    search_params_type: ClassVar[type[Any]]
    """Class of the parameters of its search."""
    searches_every_frame: ClassVar[bool]
    """Whether a video should be searched frame by frame."""

    @property
    def calibration(self) -> Platt:
        """Probability of a vehicle by its score."""

    def open_search(self, jobs: int | None = None, /) -> FrameSearch:
        """Open a search with this number of threads."""


def load_model(
    path: Path = "default", *, classes: Collection[str | int] | None = None, device: Device = "cpu"
) -> NetworkModel | VehicleClassifier:
    """Load a network or a classifier of patches.

    Parameters
    ----------
    path
        ``"default"``, a network for any road; ``"highway"``, the course's classifier of patches; an ``.onnx``
        file, of this library or of another detector; or a ``.safetensors`` file.
    classes
        Names or numbers of the classes of a network that are vehicles, by default car, truck, bus, van,
        vehicle.
    device
        Where a network runs: ``"cpu"``, or ``"cuda"`` with the package onnxruntime-gpu.

    Raises
    ------
    ModelFileError
        If the file is missing, truncated, edited, of another version, or does not fit its own parameters.

    Examples
    --------
    >>> load_model("highway").params.color_space
    'LAB'
    """
    file = check.path(path, kind="a model file, 'default' or 'highway'")
    if str(path) == "default" or file.suffix.lower() in _NETWORK_SUFFIXES:
        return load_network(os.fspath(path), classes=classes, device=device)
    check.choice(device, "device", ("cpu", "cuda"))
    for name, value in ("classes", classes), ("device", None if device == "cpu" else device):
        if value is not None:
            raise invalid(name, f"be omitted for {str(path)!r}, which is no network", value)
    return load_classifier(path)


def _check_model(model: Any) -> Model:
    if isinstance(model, (str, os.PathLike)):
        return load_model(model)
    if callable(model) and not isinstance(model, type):
        raise invalid("model", "not be a function", model, "pass it to detector_from")
    if hasattr(model, "predict") and not isinstance(model, VehicleClassifier):
        argument = "pipeline" if hasattr(model, "steps") else "(classifier, scaler)"
        remedy = f"convert it with VehicleClassifier.from_pipeline({argument}, params)"
        raise invalid("model", "not be an estimator of scikit-learn", model, remedy)
    if isinstance(model, type) or not hasattr(model, "open_search"):
        remedy = "pass a function that finds boxes to detector_from"
        raise invalid("model", "be a name, a model file, or what load_model returns", model, remedy)
    return cast(Model, model)


class Detector(Closing):
    """Find the vehicles of single images; nothing is kept between them, and any thread may call it.

    Parameters
    ----------
    model
        A name (``"default"`` for any road, ``"highway"``), the path of a model file, such as
        ``"own.safetensors"`` or the ``"yolo11n.onnx"`` of another library, or what `load_model` returns.
    conf
        Minimum confidence of a vehicle in a single image: its calibrated probability, from 0.001 to 0.999.
        Scores are those above this threshold. None: the model's own.
    search_params
        Where to search: `NetworkParams`, `SearchParams` for a classifier of patches, or `FunctionParams`. By
        default the model's, with the horizon of `camera` if it is known.
    region_params
        How windows become boxes, unless the model predicts boxes: `RegionParams` for one box per group of
        agreeing windows; `HeatParams` for the course's heat map (any model), by default with a threshold that
        fits the model and its search.
    camera, jobs
        A `Camera`, or what `open_camera` accepts; and threads of the search of one image.
    low_score
        Scores from here on, below 0, are found by `search` for a tracker, which continues tracks with them.

    Raises
    ------
    ModelFileError
        If the model file is missing or damaged.

    Warns
    -----
    UserWarning
        If the heat threshold cannot fit the density of the search.

    Examples
    --------
    >>> with Detector("highway", conf=0.8) as detector:
    ...     detector.detect(np.full((720, 1280, 3), 90, np.uint8))
    Detections(0 boxes)
    """

    @suggest_keywords
    def __init__(
        self,
        model: Path | Model = "default",
        *,
        conf: float | None = None,
        search_params: Any = None,
        region_params: RegionParams | HeatParams | None = None,
        camera: Camera | Path | None = None,
        jobs: int | None = None,
        low_score: float = TrackParams.low_threshold,
    ) -> None:
        self.model = _check_model(model)
        kind, remedy = self.model.search_params_type, "omit it for the default"
        check.instance(search_params, "search_params", kind | None, remedy)
        check.instance(region_params, "region_params", RegionParams | HeatParams | None, remedy)
        if conf is not None:  # find boxes with this confidence
            limit = _check_confidence(conf, region_params)
            if isinstance(self.model, VehicleClassifier):
                peak = self.model.calibration.score(limit)
                region_params = cast(RegionParams, region_params or RegionParams()).with_peak(peak)
            else:
                self.model = cast(Any, self.model).with_confidence(limit)
        self.camera = open_camera(camera)
        self.search_params: Any = search_params or kind.default()
        if hasattr(self.search_params, "horizon"):  # bands of windows lie relative to it
            if not self.camera.horizon_is_known:
                std = _HORIZON_STD * self.search_params.horizon_tolerance
                self.camera = self.camera.with_horizon(self.search_params.horizon, std)
            elif search_params is None:
                self.search_params = self.search_params.with_horizon(round(self.camera.horizon, 9))
        self.heat_params: HeatParams | None = None
        if isinstance(region_params, HeatParams):
            self.heat_params = region_params = region_params.for_search(self.search_params)
        self.region_params = region_params or RegionParams()
        self.low_score = check.number(low_score, "low_score", high=0)
        self._jobs = jobs
        self._search = self.model.open_search(jobs)
        self._cameras: dict[tuple[int, int], Camera] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Return everything but the threads of the search, for copies and other processes."""
        return {name: value for name, value in vars(self).items() if name != "_search"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._search = self.model.open_search(self._jobs)

    @property
    def calibration(self) -> Platt | None:
        """Probability of a vehicle by its score; None for the heat of a region."""
        return None if self.heat_params else self.model.calibration

    @property
    def searches_every_frame(self) -> bool:
        """Whether each frame of a video should be searched: with a heat map, and with a function."""
        return self.heat_params is not None or self.model.searches_every_frame

    def search(self, frame: Image) -> SearchResult:
        """Search an ``(H, W, 3)`` uint8 RGB image, not too small for a window, for windows and vehicles."""
        return self._search.find(frame, self.search_params, min_vehicle_score=self.low_score)

    def reduction(self, shape: tuple[int, ...]) -> int:
        """Whole factor by which the search reduces frames of this shape first.

        For a frame that was reduced before, ``search(frame).enlarged(factor)`` is the same result.
        """
        return self._search.reduction(shape, self.search_params)

    def fit(self, found: SearchResult) -> Detections:
        """Return the vehicles of a search with confidences, including scores below 0."""
        check.instance(found, "found", SearchResult, "pass what search returns")
        return self._fit(found, self.region_params)

    def _fit(self, found: SearchResult, regions: RegionParams | HeatParams) -> Detections:
        if self.heat_params is not None:
            return label_heat(frame_heat(found.shape, found.windows, self.heat_params), self.heat_params)
        vehicles = found.vehicles
        if vehicles is None:
            if found.shape not in self._cameras:
                self._cameras[found.shape] = self.camera.for_shape(found.shape)
            assert isinstance(regions, RegionParams)
            vehicles = find_vehicles(found.windows, self._cameras[found.shape], found.shape, regions)
        return vehicles.with_columns(confidences=self.model.calibration.probability(vehicles.scores))

    @overload
    def detect(self, image: Image | bytes, *, conf: float | None = None) -> ImageDetections: ...
    @overload
    def detect(self, image: list[Any], *, conf: float | None = None) -> list[ImageDetections]: ...
    @overload
    def detect(self, image: Any, *, conf: float | None = None) -> Any: ...
    def detect(self, image: Any, *, conf: float | None = None) -> Any:
        """Detect the vehicles of an image, or of each of several images, which are searched in parallel.

        Parameters
        ----------
        image
            An ``(H, W, 3)`` uint8 RGB array, the path or URL of an image file, its content as bytes, or an
            image of Pillow. A list of these, a folder, or a pattern such as ``"frames/*.jpg"`` gives a list.
        conf
            Minimum confidence in this call, instead of that of the detector.

        Returns
        -------
        ImageDetections
            Boxes (px), scores, confidences unless from a heat map, and distances if `camera` has a lens.
        """
        limit = None if conf is None else _check_confidence(conf, self.region_params)
        if limit is not None and not isinstance(self.model, VehicleClassifier):
            cast(Any, self.model).with_confidence(limit)  # refuses scores on a scale of their own
        images = list_images(image)
        if images is None:
            return self._detect_image(image, limit)
        with ThreadPoolExecutor(min(available_cores(), 4), thread_name_prefix="vehicle-detect") as pool:
            return list(pool.map(lambda each: self._detect_image(each, limit), images))

    def _detect_image(self, image: Any, limit: float | None) -> ImageDetections:
        """Detect the vehicles of one image, with another minimum confidence unless `limit` is None."""
        regions, lowest = self.region_params, 0.0
        if limit is not None:  # scores are relative to the threshold
            lowest = self.model.calibration.score(limit)
            if isinstance(regions, RegionParams):
                regions = regions.with_peak(lowest)
        frame, low_score = image_array(image), min(self.low_score, lowest)
        result = self._search.find(frame, self.search_params, min_vehicle_score=low_score)
        vehicles = self._fit(result, regions)
        vehicles = vehicles[vehicles.scores >= lowest]
        if not isinstance(self.model, VehicleClassifier):
            vehicles = vehicles.with_columns(scores=vehicles.scores - lowest)
        found = ImageDetections.from_columns(vehicles.boxes, vehicles.scores)
        found = found.with_columns(**vars(vehicles), source=image)
        if not self.camera.lens_is_known:
            return found
        distances, stds = image_distances(found, frame.shape, self.camera)
        return found.with_columns(distances_m=distances, distance_stds_m=stds)

    def close(self) -> None:
        """Stop the search's threads; they start again when it is used."""
        self._search.close()


def _check_confidence(conf: object, regions: RegionParams | HeatParams | None) -> float:
    """Return a minimum confidence within the range that a calibration can tell apart."""
    limit = min(max(check.number(conf, "conf", low=0, high=1), _MIN_CONF), _MAX_CONF)
    if isinstance(regions, HeatParams):
        remedy = "set the threshold of HeatParams"
        raise invalid("conf", "be None with a heat map, whose heat is no probability", conf, remedy)
    return limit


@functools.lru_cache(maxsize=4)
def _shared_detector(model: str) -> Detector:
    """Return the detector of a model that calls of `detect` share."""
    return Detector(model)


@suggest_keywords
def detect(image: Any, model: Path | Model = "default", *, conf: float | None = None) -> Any:
    """Detect the vehicles of images in one line, as `Detector.detect`.

    A model is loaded in the first call that names it, and kept for the next ones. Use a `Detector` to set a
    camera, regions or the number of threads, and `VehicleDetector` or `track` for video.

    >>> found = detect("test_images/road1.jpg", conf=0.5)
    >>> len(found), found.to_pandas().columns.tolist()
    (2, ['x1', 'y1', 'x2', 'y2', 'score', 'confidence', 'label', 'class_id'])
    """
    if isinstance(model, (str, os.PathLike)):
        return _shared_detector(os.fspath(model)).detect(image, conf=conf)
    with Detector(model) as detector:
        return detector.detect(image, conf=conf)


class _OneThread:
    """A lock, not shared by copies, that refuses a second thread: tracks follow the order of the frames."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __reduce__(self) -> tuple[Any, ...]:
        return _OneThread, ()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise InvalidInputError(
                "frames must be processed one after the other, but another thread is processing one; "
                "call detect or search from several threads, or make a detector for each video"
            )

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class VehicleDetector(Closing):
    """Detect the vehicles of images, and follow those of a video: a `Detector` and a `Tracker`.

    Parameters
    ----------
    model
        As in `Detector`; or a `Detector`, which replaces the arguments `conf` to `region_params` and `jobs`.
        For a function of your own see `detector_from`.
    conf, search_params, region_params, jobs
        Arguments of the `Detector`. The heat map of `HeatParams` is the mean over the last frames.
    camera
        The camera, for distances and boxes: a `Camera`, a file of `write_camera`, or the name of a lens, as
        in `Camera.for_frame`. By default a dash-cam, whose horizon is estimated from the vehicles, and whose
        distances have a standard error of at least 25%.
    track_params, annotator
        Parameters of the tracker; and what draws labels, lines, colors, a bird's-eye view, blurred vehicles.

    Attributes
    ----------
    detector, tracker, annotator, camera, track_params
        The parts. Make another detector instead of replacing them.
    heat
        Mean heat over the last frames, ``(H, W)``; None without a heat map.

    Examples
    --------
    >>> detector = VehicleDetector()
    >>> road = np.full((720, 1280, 3), 90, np.uint8)
    >>> len(detector.detect(road)), len(detector.process(road).tracks)
    (0, 0)
    """

    @suggest_keywords
    def __init__(
        self,
        model: Path | Model | Detector = "default",
        *,
        conf: float | None = None,
        camera: Camera | Path | None = None,
        search_params: Any = None,
        region_params: RegionParams | HeatParams | None = None,
        track_params: TrackParams | None = None,
        annotator: Annotator | None = None,
        jobs: int | None = None,
    ) -> None:
        check.instance(track_params, "track_params", TrackParams | None, "omit it for the default")
        check.instance(annotator, "annotator", Annotator | None, "pass Annotator(DrawParams(...))")
        self.track_params = track_params or TrackParams()
        options: dict[str, Any] = {"conf": conf, "search_params": search_params, "camera": camera}
        options |= {"region_params": region_params, "jobs": jobs}
        if not isinstance(model, Detector):
            low_score = min(0.0, self.track_params.low_threshold, self.track_params.high_threshold)
            model = Detector(model, **options, low_score=low_score)
        elif given := [name for name, value in options.items() if value is not None]:
            raise InvalidInputError(f"{given[0]} must be omitted with a Detector; pass it to the Detector")
        self.detector, self.camera = model, model.camera
        annotator = annotator or Annotator()
        self.annotator = annotator.with_defaults(camera=self.camera, heat=self.detector.heat_params)
        self._one_thread = _OneThread()
        self._warned = False
        self.reset()

    def reset(self, *, fps: float | None = None) -> None:
        """Forget all frames, before another video; `fps` is for frames without times, 25 if unknown."""
        self._fps = None if fps is None else check.number(fps, "fps", above=0, high=1e6)
        self.tracker = Tracker(
            self.track_params,
            camera=self.camera,
            fps=self._fps or USUAL_FPS,
            calibration=self.detector.calibration,
        )
        self.annotator.reset(fps=self._fps)
        self.heat: NDArray[np.float32] | None = None
        self._heat_history = HeatHistory((self.detector.heat_params or HeatParams()).frames)
        self._cuts = SceneCuts()
        self._index = -1  # of the last searched frame
        self._skipped = 0  # frames since then
        self._first: tuple[Image, FrameResult] | None = None

    def __repr__(self) -> str:
        frames = pluralize(self._index + self._skipped + 1, "frame")
        return f"{type(self).__name__}({self.model!r}, {frames} processed)"

    def __copy__(self) -> Self:
        """Return a detector with the same `Detector`, and tracks and drawing of its own."""
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        for name in ("tracker", "annotator", "_heat_history", "_cuts", "_one_thread"):
            setattr(other, name, copy.deepcopy(getattr(self, name)))
        return other

    @property
    def model(self) -> Any:
        """The model of the detector."""
        return self.detector.model

    @property
    def searches_every_frame(self) -> bool:
        """Whether each frame of a video should be searched, for the detector or for what is drawn."""
        return self.detector.searches_every_frame or self.annotator.needs_every_frame

    def search(self, frame: Image) -> SearchResult:
        """Search a frame, as `Detector.search`; needs no other frame, and is thread-safe."""
        return dataclasses.replace(self.detector.search(frame), gray=small_gray(frame))

    def reduction(self, shape: tuple[int, ...]) -> int:
        """Whole factor by which the search reduces frames of this shape first, as `Detector.reduction`."""
        own = type(self).search is VehicleDetector.search  # another one gets whole frames
        return self.detector.reduction(shape) if own else 1

    @overload
    def detect(self, image: Image | bytes, *, conf: float | None = None) -> ImageDetections: ...
    @overload
    def detect(self, image: list[Any], *, conf: float | None = None) -> list[ImageDetections]: ...
    @overload
    def detect(self, image: Any, *, conf: float | None = None) -> Any: ...
    def detect(self, image: Any, *, conf: float | None = None) -> Any:
        """Detect the vehicles of images, as `Detector.detect`; tracks are neither used nor changed."""
        return self.detector.detect(image, conf=conf)

    def process(self, frame: Image, time: float | None = None, *, search: bool = True) -> FrameResult:
        """Search the next frame of a video and track its vehicles.

        Parameters
        ----------
        frame, time
            ``(H, W, 3)`` uint8 RGB, and its time in seconds, by default one frame after the last one, at the
            frame rate that `reset` was given (25 per second if none).
        search
            False predicts the tracks instead of searching the frame, to save time, unless it begins a scene.

        Raises
        ------
        InvalidInputError
            If an argument is malformed, or another thread is processing a frame.
        DetectorError
            If the detector is a function that fails; the message names the frame.

        Warns
        -----
        UserWarning
            Once, if speeds are estimated although neither times nor a frame rate are known.
        """
        with self._one_thread:
            start, time = clock.thread_time(), _check_time(time)
            shape = check.image(frame, "frame").shape
            found = self._search_next(frame) if check.boolean(search, "search") else None
            cut = self._cuts.update(frame)
            if found is None and not cut and self.tracker.follows(shape, time):
                self._skipped += 1
                tracks = self.tracker.predict(time=time, frames=self._skipped)
                return FrameResult.unsearched(self._index + self._skipped, time, tracks, start)
            found = found or self._search_next(frame)
            return self._track(found, time, self._skipped + 1, cut)

    def _search_next(self, frame: Image) -> SearchResult:
        try:
            return self.search(frame)
        except DetectorError as error:
            raise DetectorError(f"frame {self._index + self._skipped + 1}: {error}") from error

    def track(
        self, found: SearchResult, *, time: float | None = None, frames: int = 1, cut: bool = False
    ) -> FrameResult:
        """Update the tracks with the search result of the next frame, in frame order.

        `found` is the result of `search` for this frame, and `time` as in `process`. `frames` is the number
        of frames since the last one, of which the others were not searched. A `cut` to another scene
        (`tracking.SceneCuts`) ends all tracks.
        """
        check.instance(found, "found", SearchResult, "pass what search returns")
        with self._one_thread:
            return self._track(found, _check_time(time), frames, check.boolean(cut, "cut"))

    def _track(self, found: SearchResult, time: float | None, frames: int, cut: bool) -> FrameResult:
        start, heat_params = clock.thread_time(), self.detector.heat_params
        if heat_params is None:
            detections = self.detector.fit(found)
        else:
            if cut:
                self._heat_history.clear()
            self.heat = self._heat_history.add(frame_heat(found.shape, found.windows, heat_params))
            detections = label_heat(self.heat, heat_params)
        detected = clock.thread_time()
        when: Any = {"time": time, "frames": frames, "cut": cut}
        tracks = self.tracker.update(detections, found.shape, gray=found.gray, **when)
        tracked = clock.thread_time()
        seconds = {"search": found.seconds, "regions": detected - start, "track": tracked - detected}
        self._index, self._skipped = self._index + frames, 0
        shown = detections[detections.scores >= 0]  # lower scores are for the tracker only
        result = FrameResult(self._index, time, found.windows, shown, tracks, seconds)
        if time is None and self._fps is None and not self._warned:
            self._warn_of_frame_rate(result)
        return result

    def _warn_of_frame_rate(self, result: FrameResult) -> None:
        """Warn the caller of `process` or `track`, once, that speeds depend on an assumed frame rate."""
        if any(track.speed_mps is not None for track in result.shown):
            self._warned = True
            warn(
                f"the speeds assume {USUAL_FPS:g} frames per second, because the frames came without times; "
                "pass their times in seconds to process, or call detector.reset(fps=...) first; in moviepy "
                "use annotate_clip(clip, detector)"
            )

    def annotate(self, frame: Image, result: FrameResult) -> Image:
        """Draw a result of `process` or `track` on a copy of its frame, as the `annotator` does."""
        return self.annotator.draw(frame, result)

    def __call__(self, frame: Image | Path) -> Image:
        """Return the next frame of a video annotated; for single images use `detect`.

        The path of an image file gives that image with its vehicles. In moviepy use `annotate_clip`:
        ``clip.image_transform(detector)`` knows no times, and a second clip continues the tracks of the first
        one. The first frame, which moviepy reads twice, counts once.
        """
        if isinstance(frame, (str, os.PathLike)):
            image, blur = image_array(frame), self.annotator.blur
            boxes = self.detect(image).boxes
            return draw_boxes(image if blur is None else blur_boxes(image, boxes, region=blur), boxes)
        if self._first is not None and self._index == 0 and np.array_equal(frame, self._first[0]):
            return self.annotate(frame, self._first[1])
        result = self.process(frame)
        if result.index == 0:
            self._first = frame.copy(), result
        return self.annotate(frame, result)

    def close(self) -> None:
        """Stop the search's threads; they start again when the detector is used."""
        self.detector.close()


def _check_time(time: object) -> float | None:
    return None if time is None else check.number(time, "time", low=-1e12, high=1e12)
