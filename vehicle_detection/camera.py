"""Distances from one camera: a box's foot on a flat road and its width, each with a standard error.

Both follow from the pinhole camera (Hartley and Zisserman, *Multiple View Geometry*, chapter 6) over a flat
road, as in Stein, Mano and Shashua, *Vision-based ACC with a single camera* (IV 2003): a point on the road
that is seen `d` pixels below the horizon lies ``focal * height / d`` ahead, and a vehicle of a known width
that is seen `w` pixels wide ``focal * width / w``.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_boxes, check_integer, check_number, describe
from vehicle_detection.errors import InvalidInputError

Floats = NDArray[np.float64]

REFERENCE_FOCAL = 0.9 * 1280
"""Pixel errors are given for a 1280x720 dash-cam of this focal length, and grow with the focal length."""

BORDER_PX, BORDER_SHARE = 1.5, 0.04
"""A box that ends this near to the frame's border, or within this share of its size, may go on beyond."""


class Distance(NamedTuple):
    """Distances ahead of the camera and their standard errors, arrays of one shape.

    Attributes
    ----------
    meters
        Distance along the road in meters; NaN where it is unknown.
    error
        Standard error in meters; infinite where the distance is unknown.
    """

    meters: Floats
    error: Floats


def check_shape(shape: object, name: str = "shape") -> tuple[int, int]:
    """Return height and width of ``image.shape``, a tuple of two or more positive integers."""
    if not isinstance(shape, tuple) or len(shape) < 2:
        raise InvalidInputError(
            f"{name} must be (height, width, ...), got {describe(shape)}; pass image.shape"
        )
    return check_integer(shape[0], f"{name}[0]", low=1), check_integer(shape[1], f"{name}[1]", low=1)


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A forward-looking camera over a flat road, and how well it is known.

    Attributes
    ----------
    focal_px
        Focal length in pixels: the frame's width over ``2 * tan(half the horizontal field of view)``.
    horizon_px
        Row of the horizon.
    horizon_std_px
        Standard error of `horizon_px` where it is a guess, in pixels of the frame; 0 where it was measured.
        The tracker learns the row from the vehicles it follows as far as this lets it.
    height_m
        Height of the lens above the road.
    vehicle_width_m, vehicle_width_std_m
        Width of a vehicle that is not known any better, and its spread.
    vehicle_length_m, vehicle_length_std_m
        Length of the flank that a vehicle shows beside the camera's path, as far as it widens the box, and
        its spread.
    bottom_std_px, horizon_error_px
        Standard errors of a box's lower edge and of the horizon (pitch, hills), in pixels of a camera with
        a focal length of ``REFERENCE_FOCAL``. The horizon's stays alike for seconds.
    box_error
        Standard error of a box's edges as a share of its size, on top of `bottom_std_px`.
    focal_std, height_std_m
        Standard errors of the focal length, as a share, and of the camera's height; they scale all distances.

    Examples
    --------
    >>> camera = Camera.for_frame((720, 1280), horizon=0.5, focal_std=0.0, height_std_m=0.0)
    >>> round(camera.focal_px), camera.horizon_px
    (1155, 360.0)
    >>> near = distance_from_foot([460.0, 360.0], camera)
    >>> near.meters.round(1), near.error.round(1)
    (array([15., nan]), array([0.6, inf]))
    """

    focal_px: float
    horizon_px: float
    horizon_std_px: float = 0.0
    height_m: float = 1.3
    vehicle_width_m: float = 1.8
    vehicle_width_std_m: float = 0.25
    vehicle_length_m: float = 4.0
    vehicle_length_std_m: float = 0.8
    bottom_std_px: float = 2.5
    horizon_error_px: float = 3.0
    box_error: float = 0.04
    focal_std: float = 0.08
    height_std_m: float = 0.1

    def __post_init__(self) -> None:
        for name in ("focal_px", "height_m", "vehicle_width_m"):
            check_number(getattr(self, name), name, above=0, high=1e6)
        check_number(self.horizon_px, "horizon_px", low=-1e6, high=1e6)
        errors = ("vehicle_width_std_m", "bottom_std_px", "horizon_error_px", "box_error", "focal_std")
        lengths = ("vehicle_length_m", "vehicle_length_std_m")
        for name in (*errors, *lengths, "height_std_m", "horizon_std_px"):
            check_number(getattr(self, name), name, low=0, high=1e6)

    @classmethod
    def for_frame(
        cls,
        shape: tuple[int, ...],
        *,
        horizon: float = 0.56,
        field_of_view: float = 58.0,
        height_m: float = 1.3,
        **known: float,
    ) -> Camera:
        """Guess the camera of a dash-cam frame; what is known better goes in by name.

        Parameters
        ----------
        shape
            ``(height, width, ...)``, as ``image.shape``.
        horizon
            Row of the horizon as a share of the height, 0 at the top; with ``horizon_std_px`` as a guess.
        field_of_view
            Angle in degrees that the frame's longer side sees.
        height_m
            Height of the lens above the road in meters.
        **known
            Other attributes of the class, such as ``focal_std=0.01`` for a calibrated lens.

        Raises
        ------
        InvalidInputError
            If a value is out of range or no attribute has that name.
        """
        height, width = check_shape(shape)
        share = check_number(horizon, "horizon", low=-10, high=10)
        angle = check_number(field_of_view, "field_of_view", low=1, high=170)
        unknown = sorted(known.keys() - cls.__dataclass_fields__.keys() | known.keys() & {"focal_px"})
        if unknown:
            raise InvalidInputError(
                f"{unknown[0]} is no argument of Camera.for_frame; pass field_of_view, or build Camera(...)"
            )
        focal = max(height, width) / (2 * math.tan(math.radians(angle) / 2))
        return cls(focal_px=focal, horizon_px=share * height, height_m=height_m, **known)

    @property
    def pixel_scale(self) -> float:
        """Size of this camera's pixel errors in those of the reference camera."""
        return self.focal_px / REFERENCE_FOCAL

    @property
    def tilt_error_px(self) -> float:
        """Standard error of the horizon's row in pixels of the frame: the doubt, pitch and hills together."""
        return math.hypot(self.horizon_error_px * self.pixel_scale, self.horizon_std_px)

    @property
    def foot_scale_error(self) -> float:
        """Standard error, as a share, that all distances from the foot have in common."""
        return math.hypot(self.focal_std, self.height_std_m / self.height_m)


def distance_from_foot(
    y_foot: ArrayLike, camera: Camera, *, bottom_std_px: ArrayLike | None = None
) -> Distance:
    """Distance of points on the road from their rows: ``focal * height / (row - horizon)``.

    Parameters
    ----------
    y_foot
        Rows in pixels, any shape: the lower edges of boxes.
    camera
        The camera.
    bottom_std_px
        Standard error of the rows in pixels; by default the camera's own.

    Returns
    -------
    Distance
        Unknown (NaN, infinite error) where the row is at or above the horizon, or below it by less than the
        row's and the horizon's error: the road is out of sight there.
    """
    rows = np.asarray(y_foot, np.float64)
    own = camera.bottom_std_px * camera.pixel_scale if bottom_std_px is None else bottom_std_px
    row_error = np.hypot(own, camera.tilt_error_px)
    below = rows - camera.horizon_px
    known = below > row_error
    drop = np.where(known, below, 1.0)
    meters = np.where(known, camera.focal_px * camera.height_m / drop, np.nan)
    error = np.where(known, meters * np.hypot(row_error / drop, camera.foot_scale_error), np.inf)
    return Distance(meters, error)


def distance_from_width(
    width: ArrayLike,
    camera: Camera,
    *,
    width_std_px: ArrayLike | None = None,
    aside_px: ArrayLike = 0.0,
) -> Distance:
    """Distance of vehicles from their boxes' width: ``focal * vehicle width / width`` straight ahead.

    A vehicle beside the camera's path shows its flank too. Its face begins at the outer edge of the box, the
    flank ends at the inner one, `aside_px` from the middle of the frame and ``length`` farther away: so it
    is ``(focal * vehicle width + aside_px * length) / width`` ahead.

    Parameters
    ----------
    width
        Widths in pixels, any shape.
    camera
        The camera, with the width of a vehicle and its spread.
    width_std_px
        Standard error of the widths in pixels; by default the camera's, for two edges.
    aside_px
        How far the boxes' inner edges lie from the middle of the frame; 0 for boxes across it.

    Returns
    -------
    Distance
        Unknown where the width is less than a pixel.
    """
    widths = np.asarray(width, np.float64)
    known = widths >= 1
    seen = np.where(known, widths, 1.0)
    own = camera.bottom_std_px * camera.pixel_scale
    edge = np.hypot(own, camera.box_error * seen) * math.sqrt(2)
    width_error = edge if width_std_px is None else np.asarray(width_std_px, np.float64)
    aside = np.asarray(aside_px, np.float64)
    unit = width_times_distance(camera, aside)
    varied = np.hypot(camera.focal_px * camera.vehicle_width_std_m, aside * camera.vehicle_length_std_m)
    spread = np.hypot(varied / unit, camera.focal_std)
    meters = np.where(known, unit / seen, np.nan)
    error = np.where(known, meters * np.hypot(width_error / seen, spread), np.inf)
    return Distance(meters, error)


def width_times_distance(camera: Camera, aside_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Width in pixels times distance in meters of a vehicle, whose flank shows if it is aside."""
    return camera.focal_px * camera.vehicle_width_m + camera.vehicle_length_m * aside_px


def inner_edges(boxes: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """How far the nearer side edge of each box lies from the frame's middle column; 0 if it is across it."""
    middle = shape[1] / 2
    return np.maximum(np.maximum(boxes[:, 0] - middle, middle - boxes[:, 2]), 0.0)


def join_distances(first: Distance, second: Distance) -> Distance:
    """Join two independent measurements, each weighted by the inverse of its variance.

    Where they differ by more than their errors allow, the joint error grows by as much (the Birge ratio of
    the Particle Data Group's averages): one of the two is wrong there, and nobody knows which.

    Examples
    --------
    >>> one, two = (Distance(np.array([z]), np.array([e])) for z, e in ((20.0, 1.0), (23.0, 2.0)))
    >>> joined = join_distances(one, two)
    >>> joined.meters.round(2), joined.error.round(2)
    (array([20.6]), array([1.2]))
    """
    weights = [
        np.where(np.isfinite(d.error), 1 / np.square(np.maximum(d.error, 1e-9)), 0.0) for d in (first, second)
    ]
    values = [np.where(np.isfinite(d.error), d.meters, 0.0) for d in (first, second)]
    total = weights[0] + weights[1]
    known = total > 0
    safe = np.where(known, total, 1.0)
    meters = (weights[0] * values[0] + weights[1] * values[1]) / safe
    chi_square = sum(w * np.square(v - meters) for w, v in zip(weights, values))
    error = np.sqrt(np.maximum(chi_square, 1.0) / safe)
    return Distance(np.where(known, meters, np.nan), np.where(known, error, np.inf))


def estimate_distance(boxes: ArrayLike, camera: Camera, shape: tuple[int, ...]) -> Distance:
    """Distance of each box from its foot and its width together.

    Parameters
    ----------
    boxes
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``.
    camera
        The camera.
    shape
        ``(height, width, ...)`` of the frame: an edge at the frame's border tells nothing.

    Returns
    -------
    Distance
        ``(N,)`` meters and errors; unknown where neither foot nor width is to be had.

    Raises
    ------
    InvalidInputError
        If boxes or shape are malformed.

    Examples
    --------
    >>> camera = Camera.for_frame((720, 1280))
    >>> estimate_distance([[600, 400, 700, 490], [0, 300, 90, 719]], camera, (720, 1280)).meters.round(1)
    array([18.1,  nan])
    """
    array = check_boxes(boxes).astype(np.float64)
    cut = truncated_edges(array, check_shape(shape))
    # Foot and width share the focal length: its error is left out of their weights and added at the end.
    exact = dataclasses.replace(camera, focal_std=0.0)
    height_error = camera.box_error * (array[:, 3] - array[:, 1])
    foot = distance_from_foot(
        np.where(cut[:, 3], -np.inf, array[:, 3]),
        exact,
        bottom_std_px=np.hypot(camera.bottom_std_px * camera.pixel_scale, height_error),
    )
    seen = np.where(cut[:, 0] | cut[:, 2], 0.0, array[:, 2] - array[:, 0])
    width = distance_from_width(seen, exact, aside_px=inner_edges(array, shape))
    meters, error = join_distances(foot, width)
    shared = np.where(np.isfinite(error), camera.focal_std * meters, 0.0)
    return Distance(meters, np.hypot(error, shared))


def truncated_edges(boxes: NDArray[Any], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Which edges of ``(N, 4)`` boxes end at the frame's border, as a bool each: there may be more beyond.

    A search ends up to a step short of the border, so "at" grows with the box.
    """
    sides = boxes[:, 2:] - boxes[:, :2]
    margin = np.maximum(BORDER_SHARE * sides, BORDER_PX)
    limit = np.array([shape[1], shape[0]], np.float64)
    return np.concatenate((boxes[:, :2] <= margin, boxes[:, 2:] >= limit - margin), axis=1)


_LEAST_BOXES = 12
_MOST_BOXES = 250
_RESAMPLES = 60
_VEHICLE_WIDTH_M = 1.8


@dataclass(frozen=True, kw_only=True)
class HorizonEstimate:
    """Where the horizon is, as far as the vehicles tell.

    Attributes
    ----------
    horizon
        Height as a share of the frame's height, 0 at the top.
    error
        Its standard error, in the same unit: above 0.05 it is a guess.
    camera_height_m
        Height of the camera over the road in meters, if vehicles are 1.8 m wide.
    boxes
        Number of boxes that it rests on.
    """

    horizon: float
    error: float
    camera_height_m: float
    boxes: int


def estimate_horizon(boxes: ArrayLike, shape: tuple[int, ...], *, random_state: int = 0) -> HorizonEstimate:
    """Estimate the height of the horizon from the boxes of vehicles, of one frame or of many.

    On a flat road a foot lies below the horizon by the width in pixels times the camera's height over the
    vehicle's width: a straight line, whose value for the width 0 is the horizon. Side views, false boxes and
    hills lie off the line; the median of the slopes between all pairs of boxes does not mind up to 29% of
    them (Theil, 1950; Sen, *Journal of the American Statistical Association*, 1968).

    Parameters
    ----------
    boxes
        ``(N, 4)`` boxes ``[x1, y1, x2, y2]``, 12 or more of them whole and of different widths.
    shape
        ``(height, width, ...)`` of the frames.
    random_state
        Seed of the resampling that tells the error.

    Raises
    ------
    InvalidInputError
        If there are too few whole boxes, or all of them are about as wide.

    Examples
    --------
    >>> width = np.arange(40, 200, 10)
    >>> foot = 396 + 0.7 * width
    >>> boxes = np.stack([600 - width / 2, foot - width, 600 + width / 2, foot], axis=1)
    >>> found = estimate_horizon(boxes, (720, 1280))
    >>> round(found.horizon, 3), round(found.camera_height_m, 2)
    (0.55, 1.26)
    """
    frame = check_shape(shape)
    array = check_boxes(boxes).astype(np.float64)
    whole = array[~truncated_edges(array, frame).any(axis=1)]
    width = whole[:, 2] - whole[:, 0]
    if len(whole) < _LEAST_BOXES:
        raise InvalidInputError(
            f"boxes must hold {_LEAST_BOXES} vehicles that the frame does not cut, got {len(whole)}; "
            "take more frames"
        )
    low, high = np.percentile(width, [10, 90])
    if high < 1.3 * low:
        raise InvalidInputError(
            f"boxes must differ in width, got {low:.0f} to {high:.0f} pixels; take frames with near and far "
            "vehicles"
        )
    rng = np.random.default_rng(random_state)
    if len(whole) > _MOST_BOXES:
        rows = rng.permutation(len(whole))[:_MOST_BOXES]
        whole, width = whole[rows], width[rows]
    foot = whole[:, 3]
    horizon, slope = _fit_line(width, foot)
    again = []
    for _ in range(_RESAMPLES):
        rows = rng.integers(len(width), size=len(width))
        again.append(_fit_line(width[rows], foot[rows])[0])
    return HorizonEstimate(
        horizon=horizon / frame[0],
        error=float(np.std(again)) / frame[0],
        camera_height_m=slope * _VEHICLE_WIDTH_M,
        boxes=len(whole),
    )


def _fit_line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Value at 0 and slope of the line through points, robustly."""
    first, second = np.triu_indices(len(x), 1)
    apart = x[second] - x[first]
    # Pairs that are nearly as wide tell nothing about the slope.
    far = np.abs(apart) > 0.1 * np.maximum(x[first], x[second])
    slope = float(np.median((y[second] - y[first])[far] / apart[far])) if far.any() else 0.0
    return float(np.median(y - slope * x)), slope
