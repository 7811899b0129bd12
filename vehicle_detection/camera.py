"""Camera over a flat road: lens, parameters and their uncertainty, its file, and an estimate of its horizon.

The geometry is the pinhole camera (Hartley and Zisserman, *Multiple View Geometry*, chapter 6) over a flat
road, as in Stein, Mano and Shashua, *Vision-based ACC with a single camera* (IV 2003): a road point seen `d`
pixels below the horizon lies ``focal * height / d`` ahead, and a vehicle of known width seen `w` pixels wide
lies ``focal * width / w`` ahead. Boxes from a fisheye lens are first converted to those of a pinhole camera
with the model of OpenCV's ``cv2.fisheye`` (Kannala and Brandt, PAMI 2006).
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import (
    Floats,
    Limit,
    check_array,
    check_bool,
    check_boxes,
    check_choice,
    check_integer,
    check_number,
    check_path,
    check_shape,
    check_type,
    describe,
    read_regular_file,
    write_text,
)
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError

FrameShape = tuple[int, int]
"""Height and width of a frame in pixels."""

# Focal length in pixels of the reference camera, a 1280x720 dash-cam, for which pixel errors are given.
_REFERENCE_FOCAL_PX = 0.9 * 1280
# The following constants are those of `estimate_horizon`. Number of boxes required.
_MIN_BOXES = 4
# Prior of the camera's height (m), and its standard deviation.
_CAMERA_HEIGHT, _CAMERA_HEIGHT_STD = 1.35, 0.3
# Prior standard deviation of the horizon around the middle row, as a fraction of the frame's height.
_HORIZON_STD = 0.15
# Standard error of a bottom edge in pixels of a frame 1280 wide.
_EDGE_STD_PX = 3.5
# Standard deviation of vehicles' heights, as a fraction.
_RELATIVE_STD = 0.12
# Boxes with a larger residual, in standard errors, are ignored.
_BIWEIGHT = 4.7
# Number of boxes that count as one, because they show the same vehicle.
_CORRELATED_BOXES = 3.0
# 80th percentile of the absolute values of a normal distribution.
_NORMAL_80 = 1.282
# Largest angle from the optical axis (radians) at which boxes are converted to a pinhole camera.
_MAX_ANGLE = math.radians(80)

_PIXEL_FIELDS = ("focal_px", "horizon_px", "horizon_std_px")  # in pixels of the frame
# Size of frames for which a file is checked that states none.
_ANY_SHAPE = (720, 1280)

LENSES: dict[str, tuple[float, bool]] = {
    "standard-58": (58.0, False),
    "wide-90": (90.0, False),
    "fisheye-120": (120.0, True),
    "fisheye-140": (140.0, True),
    "fisheye-170": (170.0, True),
}
"""Typical lenses: field of view along the longer side in degrees, and whether the lens is a fisheye.

Their errors are those of a guess; a calibrated camera (`read_camera`) is better.
"""

LENS_STD, GIVEN_LENS_STD, UNKNOWN_LENS_STD = 0.08, 0.03, 0.25
"""Relative standard error of the focal length of a typical lens, of a given field of view, and of a guess."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A forward-looking camera over a flat road, with the uncertainty of its parameters.

    Attributes
    ----------
    focal_px
        Focal length in pixels: the frame's longer side over ``2 * tan(half the field of view along it)``.
    horizon_px, horizon_std_px
        Row of the horizon, and its standard error if the row is a guess (0 if it was measured). The tracker
        estimates the row from the vehicles it tracks, with this prior.
    height_m
        Height of the lens above the road.
    vehicle_width_m, vehicle_width_std_m
        Mean width of vehicles and its standard deviation.
    vehicle_height_m
        Mean height of vehicles.
    vehicle_length_m, vehicle_length_std_m
        Mean length of the visible side of vehicles in other lanes, and its standard deviation.
    bottom_std_px, pitch_std_px
        Standard errors of a box's bottom edge and of the horizon (pitch and hills), in pixels of a camera
        with a focal length of 1152 px. The error of the horizon is correlated over seconds.
    box_std
        Standard error of a box's edges as a fraction of its size, in addition to `bottom_std_px`.
    focal_std, height_std_m
        Standard errors of the focal length, as a fraction of it, and of the camera's height. They scale all
        distances alike.
    fisheye, k1, k2
        Whether the lens is a fisheye, and its coefficients: a ray at the angle ``a`` to the optical axis,
        which is that of the frame's middle, meets the frame at
        ``focal_px * a * (1 + k1 * a**2 + k2 * a**4)`` pixels from the middle.
    shape
        Height and width of the frames that the pixels refer to, which `for_frame` and `read_camera` set; None
        if unknown. For frames of another size, `for_shape` scales the pixels; a copy with other pixels by
        ``dataclasses.replace`` needs another `shape`, too. It is not compared.

    Examples
    --------
    >>> camera = Camera.for_frame((720, 1280), horizon=0.5)
    >>> round(camera.focal_px), camera.horizon_px
    (1155, 360.0)
    """

    focal_px: float
    horizon_px: float
    horizon_std_px: float = 0.0
    height_m: float = 1.3
    vehicle_width_m: float = 1.8
    vehicle_width_std_m: float = 0.25
    vehicle_height_m: float = 1.5
    vehicle_length_m: float = 4.5
    vehicle_length_std_m: float = 0.8
    bottom_std_px: float = 2.5
    pitch_std_px: float = 3.0
    box_std: float = 0.04
    focal_std: float = LENS_STD
    height_std_m: float = 0.1
    fisheye: bool = False
    k1: float = 0.0
    k2: float = 0.0
    shape: FrameShape | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "fisheye", check_bool(self.fisheye, "fisheye"))
        if self.shape is not None:
            object.__setattr__(self, "shape", check_shape(self.shape))
        for name in self.__dataclass_fields__.keys() - {"fisheye", "shape"}:
            low, high, above = 0.0, 1e6, -math.inf
            if name in ("k1", "k2"):
                low, high = -1, 1
            elif name in ("focal_px", "height_m", "vehicle_width_m", "vehicle_height_m"):
                low, above = -math.inf, 0
            elif name == "horizon_px":
                low = -1e6
            number = check_number(getattr(self, name), name, low=low, high=high, above=above)
            object.__setattr__(self, name, number)

    @classmethod
    def for_frame(
        cls,
        shape: tuple[int, ...],
        *,
        horizon: float = 0.56,
        field_of_view: float = 58.0,
        height_m: float = 1.3,
        lens: str | None = None,
        **known: Any,
    ) -> Camera:
        """Return a typical dash-cam for frames of this shape; pass what is known better by name.

        Parameters
        ----------
        shape, height_m
            ``(height, width, ...)``, and the height of the lens above the road in meters.
        horizon
            Row of the horizon as a fraction of the height, 0 at the top; a guess if ``horizon_std_px`` is
            passed too.
        field_of_view
            Angle of view along the frame's longer side in degrees.
        lens
            Name of a typical lens, which replaces `field_of_view`: ``"standard-58"`` or ``"wide-90"``
            (pinhole), ``"fisheye-120"``, ``"fisheye-140"`` or ``"fisheye-170"`` (``focal_px * angle``).
        **known
            Other attributes of the class, such as ``focal_std=0.01`` for a calibrated lens.

        Returns
        -------
        Camera
            In pixels of frames of this shape.

        Raises
        ------
        InvalidInputError
            If an argument is unknown or out of range, or `k1` and `k2` make the radius at the edge of the
            field of view negative or 0.
        """
        height, width = check_shape(shape)
        horizon = check_number(horizon, "horizon", low=-10, high=10)
        if lens is not None:
            check_choice(lens, "lens", LENSES)
            field_of_view, fisheye = LENSES[lens]
            known = {"fisheye": fisheye} | known
        angle = check_number(field_of_view, "field_of_view", low=1, high=170)
        derived = {"focal_px": "field_of_view", "horizon_px": "horizon"}
        unknown = sorted(known.keys() - cls.__dataclass_fields__.keys() | known.keys() & derived.keys())
        if unknown:
            raise InvalidInputError(
                f"{unknown[0]} is not an argument of Camera.for_frame; "
                f"pass {derived.get(unknown[0], 'an attribute of Camera')}, or build Camera(...)"
            )
        half = math.radians(angle) / 2
        k1, k2 = (check_number(known.get(name, 0.0), name, low=-1, high=1) for name in ("k1", "k2"))
        radius = float(_fisheye_radius(np.array(half), k1, k2)) if known.get("fisheye") else math.tan(half)
        if radius <= 0:
            raise InvalidInputError(
                f"k1 and k2 must keep the radius positive up to {angle / 2:g} degrees; got {k1:g} and {k2:g}"
            )
        focal = max(height, width) / (2 * radius)
        size = height, width
        return cls(focal_px=focal, horizon_px=horizon * height, height_m=height_m, shape=size, **known)

    def for_shape(self, shape: tuple[int, ...]) -> Camera:
        """Return the camera in pixels of frames of ``(height, width, ...)``, another size of the same video.

        Raises
        ------
        InvalidInputError
            If the aspect ratio is not that of the camera's own shape.

        Examples
        --------
        >>> round(Camera.for_frame((720, 1280)).for_shape((360, 640)).horizon_px, 1)
        201.6
        """
        size = check_shape(shape)
        if self.shape is None or self.shape == size:
            return self
        scale = _scale_between(self.shape, size)
        if scale is None:
            raise InvalidInputError(
                f"camera must be one for frames of {size[1]}x{size[0]} pixels or the same aspect ratio, got "
                f"one for {self.shape[1]}x{self.shape[0]}; use Camera.for_frame(image.shape, ...)"
            )
        scaled = {name: scale * getattr(self, name) for name in _PIXEL_FIELDS}
        return dataclasses.replace(self, shape=size, **scaled)

    @property
    def pixel_scale(self) -> float:
        """Pixels of this camera per pixel of the reference camera."""
        return self.focal_px / _REFERENCE_FOCAL_PX

    @property
    def total_horizon_std_px(self) -> float:
        """Standard error of the horizon's row in one frame: initial guess, pitch and hills together."""
        return math.hypot(self.pitch_std_px * self.pixel_scale, self.horizon_std_px)

    def width_times_distance(self, lateral_px: Floats) -> Floats:
        """Width of a vehicle's box in pixels times its distance in meters.

        A vehicle in another lane shows its side too. Its box starts with the near face at the outer edge and
        ends with the far end of the side at the inner edge, `lateral_px` from the middle of the frame.
        """
        lateral = check_array(lateral_px, "lateral_px")
        if lateral.dtype.kind not in "iuf":
            raise InvalidInputError(f"lateral_px must be numbers of pixels; got {describe(lateral_px)}")
        return np.asarray(self.focal_px * self.vehicle_width_m + self.vehicle_length_m * lateral)

    def rectify_boxes(self, boxes: Detections | ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
        """Convert boxes to those of a pinhole camera with the same focal length.

        The middles of a box's edges are converted, and points farther than 80 degrees from the optical axis
        are moved there.

        Parameters
        ----------
        boxes
            ``(N, 4)`` boxes ``[x1, y1, x2, y2]`` in pixels of the frame; or `Detections`.
        shape
            ``(height, width, ...)`` of the frame.

        Returns
        -------
        numpy.ndarray
            ``(N, 4)`` boxes around the same middle of the frame; for a pinhole camera `boxes` as they are.

        Raises
        ------
        InvalidInputError
            If the boxes are malformed, or the camera was made for frames of another aspect ratio.

        Examples
        --------
        >>> camera = Camera.for_frame((720, 1280), lens="fisheye-120")
        >>> camera.rectify_boxes(np.array([[900.0, 400, 1100, 520]]), (720, 1280)).round()
        array([[ 920.,  405., 1219.,  547.]])
        """
        boxes = check_boxes(boxes)
        if not self.fisheye or not len(boxes):
            return boxes
        camera = self.for_shape(shape)
        boxes = boxes.astype(np.float64, copy=False)  # sums of small integers overflow
        middle = (boxes[:, :2] + boxes[:, 2:]) / 2
        columns = np.concatenate([boxes[:, 0], boxes[:, 2], middle[:, 0], middle[:, 0]])
        rows = np.concatenate([middle[:, 1], middle[:, 1], boxes[:, 1], boxes[:, 3]])
        x, y = camera._rectify_points(columns, rows, shape)
        left, right, _, _ = np.split(x, 4)
        _, _, top, bottom = np.split(y, 4)
        return np.stack([left, top, right, bottom], axis=1)

    def to_pinhole(self, shape: tuple[int, ...]) -> Camera:
        """Return the pinhole camera of the boxes that `rectify_boxes` returns."""
        camera = self.for_shape(shape)
        if not camera.fisheye:
            return camera
        _, row = camera._rectify_points(np.array([shape[1] / 2]), np.array([camera.horizon_px]), shape)
        return dataclasses.replace(camera, horizon_px=float(row[0]), fisheye=False, k1=0.0, k2=0.0)

    def _rectify_points(self, x: Floats, y: Floats, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Convert points of a fisheye frame to a pinhole camera with the same focal length and middle."""
        middle_x, middle_y = shape[1] / 2, shape[0] / 2
        dx, dy = x - middle_x, y - middle_y
        radius = np.hypot(dx, dy) / self.focal_px
        angle = np.minimum(radius, _MAX_ANGLE)
        for _ in range(10):  # Newton's method
            slope = 1 + 3 * self.k1 * angle**2 + 5 * self.k2 * angle**4
            step = (_fisheye_radius(angle, self.k1, self.k2) - radius) / np.maximum(slope, 0.1)
            angle = np.clip(angle - step, 0.0, _MAX_ANGLE)
        factor = np.tan(angle) / np.maximum(radius, 1e-9)
        factor = np.where(radius < 1e-6, 1.0, factor)
        return middle_x + factor * dx, middle_y + factor * dy


def _scale_between(given: FrameShape, shape: FrameShape) -> float | None:
    """Factor from pixels of one frame size to another; None if the aspect ratios differ by more than 1%."""
    scale = shape[1] / given[1]
    return scale if abs(scale * given[0] - shape[0]) <= 0.01 * shape[0] else None


def _fisheye_radius(angle: Floats, k1: float, k2: float) -> Floats:
    """Distance from the middle of a fisheye frame in focal lengths, for rays at these angles (radians)."""
    return angle * (1 + k1 * angle**2 + k2 * angle**4)


def write_camera(camera: Camera, path: str | os.PathLike[str], shape: tuple[int, ...]) -> None:
    """Write a camera as a JSON file.

    Parameters
    ----------
    camera, path
        The camera, and the file to write, .json.
    shape
        ``(height, width, ...)`` of the frames that its pixels refer to, or are to be scaled to if the camera
        has a shape.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or the folder is missing or read-only.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "camera.json"
    >>> write_camera(Camera.for_frame((720, 1280), field_of_view=90), file, (720, 1280))
    >>> round(read_camera(file, (360, 640)).focal_px)
    320
    """
    check_type(camera, "camera", Camera, "pass Camera.for_frame(image.shape)")
    height, width = check_shape(shape)
    values = {"image_size": [width, height], **dataclasses.asdict(camera.for_shape((height, width)))}
    del values["shape"]
    write_text(path, json.dumps(values, indent=2) + "\n", "path")


def read_camera(path: str | os.PathLike[str], shape: tuple[int, ...]) -> Camera:
    """Read a camera from a JSON file, for frames of a shape.

    Parameters
    ----------
    path
        A file of `write_camera`, or one written by hand. It is an object with attributes of `Camera`, all of
        them optional. Instead of ``focal_px`` it may hold ``field_of_view`` (degrees along the longer side)
        or ``lens`` (as in `Camera.for_frame`), and instead of ``horizon_px`` ``horizon`` (a fraction of the
        height). With pixels it needs ``image_size``, ``[width, height]``; they are scaled to `shape`.
    shape
        ``(height, width, ...)`` of the frames.

    Returns
    -------
    Camera
        In pixels of frames of `shape`. A lens or horizon that the file lacks has a large standard error.

    Raises
    ------
    InvalidInputError
        If the file is missing or malformed, or was made for frames of another aspect ratio.

    Examples
    --------
    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "camera.json"
    >>> _ = file.write_text('{"field_of_view": 120, "fisheye": true, "k1": 0.02, "height_m": 1.4}')
    >>> camera = read_camera(file, (720, 1280))
    >>> round(camera.focal_px), camera.height_m
    (598, 1.4)
    """
    return _read_camera(check_path(path), check_shape(shape))


def check_camera_file(path: str | os.PathLike[str]) -> None:
    """Raise unless `read_camera` can read a file for frames of the size that it states, or of any size."""
    _read_camera(check_path(path), None)


def _read_camera(path: Path, shape: FrameShape | None) -> Camera:
    """Camera of a file for frames of a shape; None for the size that the file states."""
    values = _read_json(path)
    height, width = shape or _ANY_SHAPE
    size = values.pop("image_size", None)
    scale = 1.0
    if size is not None:
        if not isinstance(size, list) or len(size) != 2:
            raise InvalidInputError(f"{path}: image_size must be [width, height], got {describe(size)}")
        given = [check_integer(side, f"{path}: image_size", low=1) for side in size]
        if shape is None:
            width, height = given
        found = _scale_between((given[1], given[0]), (height, width))
        if found is None:
            raise InvalidInputError(
                f"{path}: image_size must have the aspect ratio of the frames, {width}x{height} pixels, got "
                f"{given[0]}x{given[1]}; calibrate again, or give field_of_view and horizon"
            )
        scale = found
    pixels = [name for name in _PIXEL_FIELDS if name in values]
    if pixels and size is None:
        raise InvalidInputError(f"{path}: {pixels[0]} needs image_size, [width, height] in pixels; add it")
    for name in pixels:
        values[name] = scale * check_number(values[name], f"{path}: {name}")
    try:
        return _build_camera(values, (height, width))
    except InvalidInputError as error:
        raise InvalidInputError(f"{path}: {error}") from None


def _read_json(path: Path) -> dict[str, Any]:
    """Read the object in a JSON file, and check its names."""
    data = read_regular_file(path, f"camera file {path}", Limit.TEXT_BYTES)
    try:
        values: Any = json.loads(data)
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else error
        raise InvalidInputError(f"camera file {path} is not JSON: {reason}; see read_camera") from None
    known = {"image_size", "field_of_view", "lens", "horizon", *Camera.__dataclass_fields__} - {"shape"}
    if not isinstance(values, dict) or values.keys() - known:
        extra = sorted(values.keys() - known)[0] if isinstance(values, dict) else describe(values)
        raise InvalidInputError(
            f"camera file {path} must be an object with the names {', '.join(sorted(known))}; got {extra}"
        )
    for first, second in (("field_of_view", "focal_px"), ("lens", "focal_px"), ("horizon", "horizon_px")):
        if first in values and second in values:
            raise InvalidInputError(f"camera file {path} must hold {first} or {second}, not both; drop one")
    return values


def _build_camera(values: dict[str, Any], shape: FrameShape) -> Camera:
    """Camera of the values of a file, in pixels of frames of this shape."""
    if "focal_px" in values:
        horizon = values.pop("horizon", None)
        if horizon is not None:
            values["horizon_px"] = check_number(horizon, "horizon", low=-10, high=10) * shape[0]
        elif "horizon_px" not in values:
            values |= {"horizon_px": 0.56 * shape[0], "horizon_std_px": 0.05 * shape[0]}
        return Camera(**values, shape=shape)
    if "lens" not in values:
        accuracy = GIVEN_LENS_STD if "field_of_view" in values else UNKNOWN_LENS_STD
        values = {"focal_std": accuracy} | values
    if "horizon_px" in values:
        values["horizon"] = values.pop("horizon_px") / shape[0]
    elif "horizon" not in values:
        values = {"horizon_std_px": 0.05 * shape[0]} | values
    return Camera.for_frame(shape, **values)


def lateral_offsets(boxes: NDArray[Any], shape: tuple[int, ...]) -> Floats:
    """Distance in pixels from the frame's middle column to each box's inner edge; 0 if the box crosses it."""
    middle = shape[1] / 2
    return np.maximum(np.maximum(boxes[:, 0] - middle, middle - boxes[:, 2]), 0.0)


def truncated_edges(boxes: NDArray[Any], shape: FrameShape) -> NDArray[np.bool_]:
    """Mark the edges of ``(N, 4)`` boxes that end at the frame's border; ``(N, 4)`` bool.

    A search may end up to one step short of the border, so the tolerance grows with the box.
    """
    margin = np.maximum(0.04 * (boxes[:, 2:] - boxes[:, :2]), 1.5)
    limit = np.array([shape[1], shape[0]], np.float64)
    return np.concatenate((boxes[:, :2] <= margin, boxes[:, 2:] >= limit - margin), axis=1)


@dataclass(frozen=True, kw_only=True)
class HorizonEstimate:
    """Estimate of the horizon from the boxes of vehicles.

    Attributes
    ----------
    horizon, horizon_std
        Row of the horizon as a fraction of the frame's height, 0 at the top, and its standard error; treat
        the estimate as a guess if it exceeds 0.05.
    camera_height_m
        Height of the camera above the road in meters, assuming that vehicles are 1.5 m high.
    n_boxes
        Number of boxes used.
    """

    horizon: float
    horizon_std: float
    camera_height_m: float
    n_boxes: int


def estimate_horizon(boxes: Detections | ArrayLike, shape: tuple[int, ...]) -> HorizonEstimate:
    """Estimate the height of the horizon from the boxes of vehicles, of one frame or of many.

    On a flat road the bottom edge of a box lies below the horizon by the box's height times the ratio of the
    camera's height to the vehicle's height: a straight line, whose value at height 0 is the horizon. The
    box's height is used, because its width includes the side of a vehicle in another lane. The height of most
    cameras is roughly known (1.35 m, standard deviation 0.3 m), so that boxes of similar sizes suffice. The
    line is fitted by iteratively reweighted least squares with Tukey's biweight, which ignores trucks and
    false boxes (Beaton and Tukey, *Technometrics*, 1974).

    Parameters
    ----------
    boxes
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``, at least 4 of them not truncated.
    shape
        ``(height, width, ...)`` of the frames.

    Returns
    -------
    HorizonEstimate
        The horizon as a fraction of the height, its standard error, and the height of the camera.

    Raises
    ------
    InvalidInputError
        If too few boxes are not truncated.

    Examples
    --------
    >>> height = np.arange(40, 200, 10)
    >>> bottom = 396 + 0.9 * height
    >>> boxes = np.stack([600 - height / 2, bottom - height, 600 + height / 2, bottom], axis=1)
    >>> found = estimate_horizon(boxes, (720, 1280))
    >>> round(found.horizon, 3), round(found.camera_height_m, 2)
    (0.55, 1.35)
    """
    frame = check_shape(shape)
    array = check_boxes(boxes).astype(np.float64)
    whole = array[~truncated_edges(array, frame).any(axis=1)]
    if len(whole) < _MIN_BOXES:
        raise InvalidInputError(
            f"boxes must contain {_MIN_BOXES} vehicles that are not truncated by the frame, got "
            f"{len(whole)}; use more frames"
        )
    mean = np.array([0.5 * frame[0], _CAMERA_HEIGHT])
    information = np.diag([1 / (_HORIZON_STD * frame[0]) ** 2, 1 / _CAMERA_HEIGHT_STD**2])
    size, bottom = (whole[:, 3] - whole[:, 1]) / Camera.vehicle_height_m, whole[:, 3]
    edge_std = _EDGE_STD_PX * max(frame) / 1280
    found = np.array([np.median(bottom - _CAMERA_HEIGHT * size), _CAMERA_HEIGHT])
    for _ in range(30):
        variance = edge_std**2 + np.square(_RELATIVE_STD * found[1] * size)
        residual = (bottom - found[0] - found[1] * size) / np.sqrt(variance)
        weight = np.square(np.maximum(1 - np.square(residual / _BIWEIGHT), 0)) / variance / _CORRELATED_BOXES
        crossed = (weight * size).sum()
        normal = information + np.array([[weight.sum(), crossed], [crossed, (weight * size * size).sum()]])
        vector = np.array([(weight * bottom).sum(), (weight * size * bottom).sum()])
        found = np.linalg.solve(normal, vector + information @ mean)
    std = math.sqrt(np.linalg.inv(normal)[0, 0])
    # Boxes that do not lie on a line are no vehicles on a flat road.
    std *= max(1.0, float(np.percentile(np.abs(residual), 80)) / _NORMAL_80)
    return HorizonEstimate(
        horizon=float(found[0]) / frame[0],
        horizon_std=std / frame[0],
        camera_height_m=float(found[1]),
        n_boxes=len(whole),
    )
