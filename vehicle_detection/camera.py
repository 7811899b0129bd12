"""Camera over a flat road: its lens, height and horizon, with their uncertainty, and its file.

The geometry is the pinhole camera (Hartley and Zisserman, *Multiple View Geometry*, chapter 6) over a flat
road, as in Stein, Mano and Shashua, *Vision-based ACC with a single camera* (IV 2003): a road point seen `d`
pixels below the horizon lies ``focal * height / d`` ahead, and a vehicle of known width seen `w` pixels wide
lies ``focal * width / w`` ahead. Boxes from a fisheye lens are first converted to those of a pinhole camera
with the model of OpenCV's ``cv2.fisheye`` (Kannala and Brandt, PAMI 2006).
"""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import (
    Floats,
    Limit,
    check,
    describe,
    fields,
    invalid,
    parse_yaml,
    read_regular_file,
    suggest_keywords,
    write_text,
)
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError

_LOGGER = logging.getLogger(__name__)

FrameShape = tuple[int, int]
"""Height and width of a frame in pixels."""

# Frame to which the numbers of a camera without a shape refer, and focal length in pixels (0.9 times the
# width) for which pixel errors are given.
_REFERENCE_SHAPE, _REFERENCE_FOCAL_PX = (720, 1280), 0.9 * 1280
# Relative standard error of the focal length of a typical lens, of a given field of view, of a calibrated
# lens, and of a guess.
_LENS_STD, _GIVEN_LENS_STD, _CALIBRATED_LENS_STD, _UNKNOWN_LENS_STD = 0.08, 0.03, 0.01, 0.25
# Fractions of the frame by which the middle of a lens may differ, and of a radius that is no distortion.
_MAX_SHIFT, _NEGLIGIBLE = 0.05, 0.003
# Standard errors of a given height of the camera, and of a guess, as cars, vans and trucks have cameras (m).
_GIVEN_HEIGHT_STD, _UNKNOWN_HEIGHT_STD = 0.05, 0.2
# Horizon of an unknown camera, its standard error, that of a given horizon, and the largest one of a horizon
# that counts as known; fractions of the frame's height. The first is that of a level camera.
_HORIZON, _HORIZON_STD, _GIVEN_HORIZON_STD, _KNOWN_HORIZON_STD = 0.5, 0.06, 0.004, 0.02
# Field of view (degrees) from which on lenses distort, and usual heights of cameras in cars and trucks (m).
_MAX_PINHOLE_FOV, _HEIGHTS = 120.0, (0.6, 3.5)
# Largest angle from the optical axis (radians) at which boxes are converted to a pinhole camera.
_MAX_ANGLE = math.radians(80)

_CALIBRATIONS = {".yaml": "YAML", ".yml": "YAML", ".xml": "XML"}  # of OpenCV and ROS, besides JSON
_PIXEL_FIELDS = ("focal_px", "horizon_px", "horizon_std_px")  # in pixels of the frame

LENSES: dict[str, tuple[float, bool]] = {
    "standard-58": (58.0, False),
    "wide-90": (90.0, False),
    "fisheye-120": (120.0, True),
    "fisheye-140": (140.0, True),
    "fisheye-170": (170.0, True),
}
"""Typical lenses: field of view along the longer side in degrees, and whether the lens is a fisheye.

Their focal lengths have an error of 8%; a calibrated camera (`read_camera`) is better.
"""


@dataclass(frozen=True, kw_only=True)
class Camera(fields.Checked):
    """A forward-looking camera over a flat road, with the uncertainty of its parameters.

    Attributes
    ----------
    focal_px
        Focal length in pixels: the frame's longer side over ``2 * tan(half the field of view along it)``.
    horizon_px, horizon_std_px
        Row of the horizon and its standard error; 0 means exact. The tracker estimates the row from the
        vehicles it tracks, with this prior.
    height_m
        Height of the lens above the road.
    vehicle_width_m, vehicle_width_std_m, mean_width_std_m
        Mean width of vehicles, its standard deviation, and the standard error of the mean, which differs
        between countries and which the tracker estimates from the vehicles of a video.
    vehicle_height_m
        Mean height of vehicles.
    overhang_m, overhang_std_m
        Mean distance between a vehicle's nearest part and its tires, where its box ends, and its standard
        deviation.
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
        Height and width of the frames that the pixels refer to; the camera then fits frames of this aspect
        ratio. None: it fits all frames, and the pixels are those of a frame of 1280x720. `for_shape` scales
        them; a copy with other pixels by ``dataclasses.replace`` needs another `shape`, too.

    Examples
    --------
    >>> camera = Camera.for_frame((720, 1280), horizon=0.5)
    >>> round(camera.focal_px), camera.horizon_px
    (1155, 360.0)
    """

    focal_px: float = fields.number(above=0, high=1e6)
    horizon_px: float = fields.number(low=-1e6, high=1e6)
    horizon_std_px: float = fields.number(0.0, low=0, high=1e6)
    height_m: float = fields.number(1.3, above=0, high=1e6)
    vehicle_width_m: float = fields.number(1.78, above=0, high=1e6)
    vehicle_width_std_m: float = fields.number(0.2, low=0, high=1e6)
    mean_width_std_m: float = fields.number(0.14, low=0, high=1e6)
    vehicle_height_m: float = fields.number(1.5, above=0, high=1e6)
    overhang_m: float = fields.number(0.85, low=0, high=1e6)
    overhang_std_m: float = fields.number(0.2, low=0, high=1e6)
    vehicle_length_m: float = fields.number(4.5, low=0, high=1e6)
    vehicle_length_std_m: float = fields.number(0.8, low=0, high=1e6)
    bottom_std_px: float = fields.number(2.5, low=0, high=1e6)
    pitch_std_px: float = fields.number(3.0, low=0, high=1e6)
    box_std: float = fields.number(0.04, low=0, high=1e6)
    focal_std: float = fields.number(_LENS_STD, low=0, high=1e6)
    height_std_m: float = fields.number(0.1, low=0, high=1e6)
    fisheye: bool = fields.flag(False)
    k1: float = fields.number(0.0, low=-1, high=1)
    k2: float = fields.number(0.0, low=-1, high=1)
    shape: FrameShape | None = fields.checked_field(None, lambda value, _: check.shape(value))  # noqa: RUF009

    @classmethod
    def for_frame(
        cls,
        shape: tuple[int, ...],
        *,
        horizon: float = 0.56,
        fov: float = 58.0,
        height_m: float = 1.3,
        lens: str | None = None,
        **known: Any,
    ) -> Camera:
        """Return a typical dash-cam, in pixels of frames of this shape; pass what is known better by name.

        Parameters
        ----------
        shape, height_m
            ``(height, width, ...)``, and the height of the lens above the road in meters.
        horizon
            Row of the horizon as a fraction of the height, 0 at the top; a guess if ``horizon_std_px`` is
            passed too.
        fov
            Angle of view along the frame's longer side in degrees.
        lens
            Name of a typical lens, which replaces `fov`: ``"standard-58"`` or ``"wide-90"``
            (pinhole), ``"fisheye-120"``, ``"fisheye-140"`` or ``"fisheye-170"`` (``focal_px * angle``).
        **known
            Other attributes of the class, such as ``focal_std=0.01`` for a calibrated lens. `k1` and `k2`
            must keep the radius positive up to the edge of the field of view.
        """
        height, width = check.shape(shape)
        # The default is about 400/720, the horizon of the course's video.
        horizon = check.number(horizon, "horizon", low=-10, high=10)
        if lens is not None:
            check.choice(lens, "lens", LENSES)
            fov, fisheye = LENSES[lens]
            known = {"fisheye": fisheye} | known
        angle = check.number(fov, "fov", low=1, high=170)
        derived = {"focal_px": "fov", "horizon_px": "horizon"}
        unknown = sorted(known.keys() - cls.__dataclass_fields__.keys() | known.keys() & derived.keys())
        if unknown:
            remedy = f"pass {derived.get(unknown[0], 'an attribute of Camera')}, or build Camera(...)"
            raise InvalidInputError(f"{unknown[0]} is not an argument of Camera.for_frame; {remedy}")
        half = math.radians(angle) / 2
        k1, k2 = (check.number(known.get(name, 0.0), name, low=-1, high=1) for name in ("k1", "k2"))
        radius = float(_fisheye_radius(np.array(half), k1, k2)) if known.get("fisheye") else math.tan(half)
        if radius <= 0:
            must = f"keep the radius positive up to {angle / 2:g} degrees"
            raise InvalidInputError(f"k1 and k2 must {must}; got {k1:g} and {k2:g}")
        focal = max(height, width) / (2 * radius)
        size = height, width
        return cls(focal_px=focal, horizon_px=horizon * height, height_m=height_m, shape=size, **known)

    @classmethod
    @suggest_keywords
    def dashcam(
        cls,
        *,
        fov: float | None = None,
        height_m: float | None = None,
        horizon: float | None = None,
        lens: str | None = None,
    ) -> Camera:
        """Return a dash-cam for frames of any size; what is not given is a guess with a large standard error.

        The arguments are those of `for_frame`; a `fov` is that of a lens without distortion. By default 58
        degrees with an error of 25%, a height of 1.3 m, and a horizon in the middle, from where the tracker
        estimates it.

        >>> camera = Camera.dashcam(fov=90)
        >>> round(camera.for_shape((480, 640)).focal_px), camera.lens_is_known, camera.horizon_is_known
        (320, True, False)
        """
        known: dict[str, Any] = {"focal_std": _UNKNOWN_LENS_STD}
        if lens is not None:
            known = {"lens": lens}
        elif fov is not None:
            known = {"fov": fov, "focal_std": _GIVEN_LENS_STD}
        if fov is not None or lens is not None:  # else the error of the lens covers that of the height
            known["height_std_m"] = _UNKNOWN_HEIGHT_STD
        if height_m is not None:
            height = check.number(height_m, "height_m", above=0, high=100)
            known |= {"height_m": height, "height_std_m": _GIVEN_HEIGHT_STD}
        camera = dataclasses.replace(cls.for_frame(_REFERENCE_SHAPE, **known), shape=None)
        if horizon is None:
            return camera.with_horizon(_HORIZON, _HORIZON_STD)
        return camera.with_horizon(horizon)

    def with_horizon(self, horizon: float, std: float = _GIVEN_HORIZON_STD) -> Camera:
        """Return the camera with another horizon and standard error, as fractions of the frame's height."""
        height = (self.shape or _REFERENCE_SHAPE)[0]
        row = check.number(horizon, "horizon", low=0, high=1) * height
        return dataclasses.replace(
            self, horizon_px=row, horizon_std_px=check.number(std, "std", low=0) * height
        )

    def for_shape(self, shape: tuple[int, ...]) -> Camera:
        """Return the camera in pixels of frames of ``(height, width, ...)``, another size of the same video.

        An `InvalidInputError` is raised if the aspect ratio is not that of the camera's own shape.

        >>> round(Camera.for_frame((720, 1280)).for_shape((360, 640)).horizon_px, 1)
        201.6
        """
        size = check.shape(shape)
        if self.shape == size:
            return self
        height, width = self.shape or _REFERENCE_SHAPE
        focal_scale, row_scale = max(size) / max(height, width), size[0] / height
        if self.shape is not None:
            focal_scale = row_scale = size[1] / width
            if abs(row_scale * height - size[0]) > 0.01 * size[0]:
                raise InvalidInputError(
                    f"camera must be one for frames of {size[1]}x{size[0]} pixels or the same aspect ratio, "
                    f"got one for {width}x{height}; use Camera.for_frame(image.shape, ...)"
                )
        return self.with_values(
            focal_px=focal_scale * self.focal_px,
            horizon_px=row_scale * self.horizon_px,
            horizon_std_px=row_scale * self.horizon_std_px,
            shape=size,
        )

    def with_values(self, **values: Any) -> Camera:
        """Return a copy with values that the library has computed, which are not checked."""
        other = object.__new__(type(self))
        vars(other).update(vars(self), **values)
        return other

    @property
    def horizon(self) -> float:
        """Row of the horizon as a fraction of the frame's height, 0 at the top."""
        return self.horizon_px / (self.shape or _REFERENCE_SHAPE)[0]

    @property
    def horizon_is_known(self) -> bool:
        """Whether the horizon was given or measured, so that a search may rely on it."""
        std = self.horizon_std_px / (self.shape or _REFERENCE_SHAPE)[0]
        return std <= _KNOWN_HORIZON_STD and 0 <= self.horizon <= 1

    @property
    def lens_is_known(self) -> bool:
        """Whether the lens was given; if not, distances are rough."""
        return self.focal_std < _UNKNOWN_LENS_STD

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
        lateral = check.array(lateral_px, "lateral_px")
        if lateral.dtype.kind not in "iuf":
            raise InvalidInputError(f"lateral_px must be numbers of pixels; got {describe(lateral_px)}")
        return np.asarray(self.focal_px * self.vehicle_width_m + self.vehicle_length_m * lateral)

    def rectify_boxes(self, boxes: Detections | ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
        """Convert boxes to those of a pinhole camera with the same focal length and middle.

        The middles of a box's edges are converted, and points farther than 80 degrees from the optical axis
        are moved there. `boxes` are ``(N, 4)`` in pixels of frames of `shape`; a pinhole camera returns them
        unchanged.

        >>> camera = Camera.for_frame((720, 1280), lens="fisheye-120")
        >>> camera.rectify_boxes(np.array([[900.0, 400, 1100, 520]]), (720, 1280)).round()
        array([[ 920.,  405., 1219.,  547.]])
        """
        boxes = check.boxes(boxes)
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


def _fisheye_radius(angle: Floats, k1: float, k2: float) -> Floats:
    """Distance from the middle of a fisheye frame in focal lengths, for rays at these angles (radians)."""
    return angle * (1 + k1 * angle**2 + k2 * angle**4)


@suggest_keywords
def open_camera(
    camera: Camera | str | os.PathLike[str] | None = None,
    *,
    fov: float | None = None,
    height_m: float | None = None,
    horizon: float | None = None,
) -> Camera:
    """Return the camera that a user has stated, of which any part may be unknown.

    `camera` is a `Camera`, a file of `read_camera`, or the name of a lens. The other arguments are those of
    `Camera.dashcam`: `fov` for an unknown lens, `height_m` also for a named one and a file; `horizon`
    replaces that of the camera.

    >>> open_camera("wide-90", horizon=0.55).horizon_px
    396.00000000000006
    """
    named = camera is None or (isinstance(camera, str) and camera in LENSES)
    if isinstance(fov, (int, float)) and _MAX_PINHOLE_FOV <= fov <= 170:
        _LOGGER.warning(
            "distances may be a third too short with a field of view of %g degrees: such lenses distort, and "
            "makers state the diagonal; choose a fisheye lens, or state the angle along the longer side",
            fov,
        )
    if isinstance(height_m, (int, float)) and (0 < height_m < _HEIGHTS[0] or _HEIGHTS[1] < height_m <= 100):
        _LOGGER.warning("a camera height of %g m is unusual; distances are proportional to it", height_m)
    for name, value, allowed in (
        ("fov", fov, camera is None),
        ("height_m", height_m, not isinstance(camera, Camera)),
    ):
        if value is not None and not allowed:
            raise InvalidInputError(f"{name} must be omitted with a camera, which has one; got {value}")
    if named:
        lens = None if camera is None else str(camera)
        return Camera.dashcam(fov=fov, height_m=height_m, horizon=horizon, lens=lens)
    if not isinstance(camera, Camera):
        check.instance(camera, "camera", (Camera, str, os.PathLike), "omit it for the default")
        if not os.path.isfile(camera):  # type: ignore[arg-type]
            raise invalid("camera", f"be a Camera, a file or one of {', '.join(LENSES)}", camera, "omit it")
        camera = read_camera(camera)  # type: ignore[arg-type]
        if height_m is not None:
            height = check.number(height_m, "height_m", above=0, high=100)
            camera = dataclasses.replace(camera, height_m=height, height_std_m=_GIVEN_HEIGHT_STD)
    return camera if horizon is None else camera.with_horizon(horizon)


def write_camera(camera: Camera, path: str | os.PathLike[str], shape: tuple[int, ...] | None = None) -> None:
    """Write a camera as a JSON file, in pixels of frames of `shape`, by default of its own shape.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "camera.json"
    >>> write_camera(Camera.for_frame((720, 1280), fov=90), file)
    >>> round(read_camera(file).for_shape((360, 640)).focal_px)
    320
    """
    check.instance(camera, "camera", Camera, "pass Camera.for_frame(image.shape)")
    height, width = check.shape((camera.shape or _REFERENCE_SHAPE) if shape is None else shape)
    values = {"image_size": [width, height], **dataclasses.asdict(camera.for_shape((height, width)))}
    del values["shape"]
    write_text(path, json.dumps(values, indent=2) + "\n", "path")


def read_camera(path: str | os.PathLike[str]) -> Camera:
    """Read a camera from a JSON file, of `write_camera` or by hand, or from a calibration of OpenCV or ROS.

    A calibration (``.yaml``, ``.xml`` or ``.json`` with ``camera_matrix``, ``distortion_coefficients`` and
    the size of the images) states the lens, not the height or the horizon. Its distortion, of a pinhole or a
    fisheye, is converted to that of `Camera`. Tangential distortion, and a principal point that is not the
    middle, are left out.

    Any other file is an object with attributes of `Camera`, all of them optional. Instead of ``focal_px`` it
    may hold ``fov`` (degrees along the longer side) or ``lens`` (as in `Camera.for_frame`), and instead of
    ``horizon_px`` ``horizon`` (a fraction of the height). With pixels it needs ``image_size``, ``[width,
    height]``. A lens, height or horizon that it lacks gets a large standard error.

    >>> import tempfile
    >>> file = Path(tempfile.mkdtemp()) / "camera.json"
    >>> _ = file.write_text('{"fov": 120, "fisheye": true, "k1": 0.02, "height_m": 1.4}')
    >>> camera = read_camera(file)
    >>> round(camera.focal_px), camera.height_m
    (598, 1.4)
    """
    path = check.path(path)
    values = _read_values(path)
    if "camera_matrix" in values or path.suffix.lower() in _CALIBRATIONS:
        return _from_calibration(path, values)
    known = {"image_size", "fov", "lens", "horizon", *Camera.__dataclass_fields__} - {"shape"}
    if values.keys() - known:
        extra = min(values.keys() - known, key=str)
        names = ", ".join(sorted(known))
        raise InvalidInputError(f"camera file {path} must be an object with the names {names}; got {extra}")
    for pair in (("fov", "lens"), ("fov", "focal_px"), ("lens", "focal_px"), ("horizon", "horizon_px")):
        if values.keys() >= {*pair}:
            raise InvalidInputError(f"camera file {path} must hold {' or '.join(pair)}, not both; drop one")
    size = values.pop("image_size", None)
    if size is not None and (not isinstance(size, list) or len(size) != 2):
        raise InvalidInputError(f"{path}: image_size must be [width, height], got {describe(size)}")
    pixels = [name for name in _PIXEL_FIELDS if name in values]
    if pixels and size is None:
        raise InvalidInputError(f"{path}: {pixels[0]} needs image_size, [width, height] in pixels; add it")
    try:
        shape = _REFERENCE_SHAPE
        if size is not None:
            shape = check.integer(size[1], "image_size", low=1), check.integer(size[0], "image_size", low=1)
        if "horizon" not in values and "horizon_px" not in values:
            values = {"horizon": _HORIZON, "horizon_std_px": _HORIZON_STD * shape[0]} | values
        if "focal_px" not in values and "lens" not in values:
            values = {"focal_std": _GIVEN_LENS_STD if "fov" in values else _UNKNOWN_LENS_STD} | values
        if "height_m" not in values and values.keys() & {"fov", "lens", "focal_px"}:
            values = {"height_std_m": _UNKNOWN_HEIGHT_STD} | values
        # A `focal_px` without `focal_std` keeps the default error: the file does not say how it was measured.
        derived = {name: values.pop(name) for name in _PIXEL_FIELDS[:2] if name in values}
        camera = Camera.for_frame(shape, **values)
        return dataclasses.replace(camera, **derived, shape=None if size is None else shape)
    except InvalidInputError as error:
        raise InvalidInputError(f"{path}: {error}") from None


def _read_values(path: Path) -> dict[str, Any]:
    """Read the object in a JSON file, or that of a calibration in YAML or XML."""
    data = read_regular_file(path, f"camera file {path}", Limit.TEXT_BYTES)
    kind = _CALIBRATIONS.get(path.suffix.lower(), "JSON")
    try:
        text = data.decode("utf-8-sig")
        if kind == "YAML":  # without the first line and the tags of OpenCV
            text = re.sub(r"^%YAML:.*|!!opencv-matrix", "", text)
        values: Any = {"YAML": parse_yaml, "XML": _parse_xml}.get(kind, json.loads)(text)
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else error
        raise InvalidInputError(f"camera file {path} is not {kind}: {reason}; see read_camera") from None
    if not isinstance(values, dict):
        raise invalid(f"camera file {path}", "be an object with the names of read_camera", values)
    return values


def _parse_xml(text: str) -> dict[str, Any]:
    """Parse XML of OpenCV; it needs no document type, whose entities can expand to any size."""
    from xml.etree import ElementTree

    try:
        root: Any = [] if "<!DOCTYPE" in text else ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(str(error)) from None
    return {part.tag: {each.tag: (each.text or "").split() for each in part} or part.text for part in root}


def _from_calibration(path: Path, values: dict[str, Any]) -> Camera:
    """Return the camera of a calibration."""
    try:
        width, height = (max(int(float(values[f"image_{side}"])), 1) for side in ("width", "height"))
        matrix = np.array(values["camera_matrix"]["data"], np.float64).reshape(3, 3)
        stated = values.get("distortion_coefficients") or {"data": []}
        distortion = np.array(stated["data"], np.float64).reshape(-1)
        fisheye = bool(int(values.get("fisheye_model") or 0))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InvalidInputError(
            f"camera file {path} must hold image_width, image_height, camera_matrix and perhaps "
            f"distortion_coefficients, as OpenCV and ROS write them ({error}); calibrate again"
        ) from None
    fisheye |= values.get("distortion_model") in ("equidistant", "fisheye")
    (fx, _, cx), (_, fy, cy) = matrix[:2].tolist()
    focal, finite = (fx + fy) / 2, all((np.abs(each) < 1e6).all() for each in (matrix, distortion))
    if not (finite and 0.1 < focal / max(width, height) < 20 and 0.95 * fy < fx < 1.05 * fy):
        raise InvalidInputError(
            f"camera file {path} must have finite values, and focal lengths in pixels that fit the image and "
            f"agree within 5%; got {fx:g} and {fy:g}"
        )
    shift = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
    if shift > _MAX_SHIFT:
        _LOGGER.warning(
            "%s: the principal point is %.0f%% from the middle, where it is assumed", path, 100 * shift
        )
    angles = np.linspace(0.01, _MAX_ANGLE, 200)
    radii = _distorted_radii(angles, distortion, fisheye=fisheye)
    # Up to the corner of the frame.
    known = np.cumprod((np.diff(radii, prepend=0) > 0) & (radii < np.hypot(width, height) / 2 / focal)) > 0
    angles, radii = angles[known], radii[known]
    lens: dict[str, Any] = {}
    if not len(radii) or np.abs(radii / np.tan(angles) - 1).max() > _NEGLIGIBLE:
        terms = np.stack([angles**3, angles**5], axis=1)
        (k1, k2), *_ = np.linalg.lstsq(terms, radii - angles, rcond=None)
        misfit = np.abs(_fisheye_radius(angles, k1, k2) - radii).max(initial=0.0)
        if not len(radii) or misfit > 0.01 or max(abs(k1), abs(k2)) > 1:
            raise InvalidInputError(
                f"camera file {path} has a distortion that no lens of Camera fits within 1%; calibrate again "
                "with fewer coefficients"
            )
        lens = {"fisheye": True, "k1": float(k1), "k2": float(k2)}
    camera = Camera.dashcam().for_shape((height, width))
    lens |= {"focal_px": float(focal), "focal_std": _CALIBRATED_LENS_STD}
    return dataclasses.replace(camera, height_std_m=_UNKNOWN_HEIGHT_STD, **lens)


def _distorted_radii(angles: Floats, distortion: Floats, *, fisheye: bool) -> Floats:
    """Distance from the middle in focal lengths of rays, by the models of ``cv2.fisheye`` and OpenCV."""
    if fisheye:
        powers = angles[:, None] ** (2 * np.arange(1, len(distortion) + 1))
        return np.asarray(angles * (1 + powers @ distortion))
    k1, k2, _, _, k3, k4, k5, k6 = np.pad(distortion, (0, max(8 - len(distortion), 0)))[:8]
    tangent = np.tan(angles)
    square = tangent**2
    above = 1 + square * (k1 + square * (k2 + square * k3))
    return np.asarray(tangent * above / (1 + square * (k4 + square * (k5 + square * k6))))


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
