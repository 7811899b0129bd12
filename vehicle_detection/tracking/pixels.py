"""What the pixels of two frames tell a tracker: whether the scene is cut, and how much vehicles grow.

The edges of a detector's boxes vary by a few percent from frame to frame. Points on a vehicle can be followed
to a few hundredths of a pixel (Lucas and Kanade, "An iterative image registration technique", IJCAI 1981), so
that their spread gives the growth of the vehicle ten times more exactly, as in the median-flow tracker of
Kalal, Mikolajczyk and Matas (ICPR 2010).
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, check
from vehicle_detection.camera import Camera

Gray = NDArray[np.uint8]
Thumbnail = NDArray[np.float32]

# Longer side of a thumbnail, each pixel of which is the mean of `_SAMPLES` x `_SAMPLES` pixels of the frame.
_THUMBNAIL_SIDE, _SAMPLES = 64, 4
# Standard deviation (pixels of a thumbnail) of the Gaussian whose result is subtracted, so that a change of
# brightness does not matter.
_BLUR = 4.0
# Blocks in rows and columns, and the part of a block on each side by which its content may move.
_BLOCKS, _BLOCK_MARGIN = (2, 4), 0.5
# The limits of a cut: the mean absolute difference of two thumbnails (gray values), and the mean correlation
# of their blocks, which is `_BASE` plus `_SLOPE` times the difference, but at most `_MAX_CORRELATION`.
# Measured by ``python -m benchmarks cuts`` on real drives and on pairs of frames of different roads.
_MIN_DIFFERENCE, _BASE, _SLOPE, _MAX_CORRELATION = 12.0, 0.5, 0.01, 0.78
# Standard deviation of a thumbnail's details (gray values) below which nothing can be recognized.
_MIN_DETAIL = 2.0


class SceneCuts:
    """Finds the frames with which a new scene begins, given the frames of a video in their order.

    Frames of a drive are similar block by block, each of which may have moved, also when the camera turns
    fast or the brightness changes. A frame without any detail (a flash, a fade) belongs to the scene before,
    and the frame after it is compared with the last one that has details.

    Examples
    --------
    >>> cuts, random = SceneCuts(), np.random.default_rng(0)
    >>> scenes = random.integers(0, 200, (2, 9, 16, 3), np.uint8)
    >>> first, second = scenes.repeat(10, axis=1).repeat(10, axis=2)
    >>> [cuts.update(frame) for frame in (first, first + 50, first, second, second)]
    [False, False, False, True, False]
    """

    def __init__(self) -> None:
        self._last: tuple[Thumbnail, Thumbnail] | None = None  # the last frame's, and its details

    @staticmethod
    def sample_size(shape: tuple[int, ...]) -> tuple[int, int]:
        """Height and width to which a frame of this shape may be sampled before, with the same result."""
        scale = _THUMBNAIL_SIDE / max(shape[:2])
        height, width = (max(8, round(side * scale)) * _SAMPLES for side in shape[:2])
        return height, width

    def update(self, frame: NDArray[np.uint8]) -> bool:
        """Whether the next ``(H, W, 3)`` frame, of any size, belongs to another scene than the one before."""
        check.image(frame, "frame")
        height, width = self.sample_size(frame.shape)
        sampled = cv2.resize(frame, (width, height), interpolation=cv2.INTER_NEAREST)
        size = width // _SAMPLES, height // _SAMPLES
        shrunk = cv2.resize(sampled, size, interpolation=cv2.INTER_AREA)
        thumbnail: Thumbnail = np.asarray(shrunk.mean(axis=2, dtype=np.float32))
        details = thumbnail - cv2.GaussianBlur(thumbnail, (0, 0), _BLUR)
        if self._last is not None and details.std() < _MIN_DETAIL:
            return False
        before, self._last = self._last, (thumbnail, details)
        if before is None:
            return False
        last, last_details = before
        if last.shape != thumbnail.shape:
            return True
        # Most frames need the first comparison only.
        difference = float(np.abs(last - thumbnail).mean())
        if difference <= _MIN_DIFFERENCE:
            return False
        limit = min(_BASE + _SLOPE * difference, _MAX_CORRELATION)
        return _correlate_blocks(last_details, details) < limit


def _correlate_blocks(first: Thumbnail, second: Thumbnail) -> float:
    """Mean over the blocks of `second` of the best correlation with a place near them in `first`."""
    rows, columns = (
        [(index * side // count, (index + 1) * side // count) for index in range(count)]
        for side, count in zip(first.shape, _BLOCKS)
    )
    best = []
    for (top, bottom), (left, right) in itertools.product(rows, columns):
        inner_y, inner_x = (bottom - top) // 5, (right - left) // 5
        block = second[top + inner_y : bottom - inner_y, left + inner_x : right - inner_x]
        margin_y, margin_x = int(_BLOCK_MARGIN * (bottom - top)), int(_BLOCK_MARGIN * (right - left))
        near = first[max(0, top - margin_y) : bottom + margin_y, max(0, left - margin_x) : right + margin_x]
        best.append(cv2.matchTemplate(near, block, cv2.TM_CCOEFF_NORMED).max())
    return float(np.mean(best))


# Longer side of the gray images.
_SIDE = 640
# Points on each side of a grid, and margin of the grid as a fraction of the vehicle's end.
_GRID, _MARGIN = 6, 0.12
# Width of a vehicle's end relative to its height; the rest of a wider box is its side, which is farther away.
_FACE_ASPECT = 1.25
# Smallest width of a box (pixels of the gray image), and smallest fraction of points that agree.
_MIN_WIDTH, _MIN_AGREEING = 10.0, 0.25
# Standard error from which on the points do not fit a growth: a vehicle that turns, or another one.
_MAX_STD = 0.02
# Relative error of the growth by a turn of the camera, as a vehicle may move sideways, too.
_TURN_STD = 0.3
# Pixels around the vehicles that are used, too.
_BORDER = 24
# Residuals of points, in standard errors, from which on their weight falls (Cauchy's).
_OUTLIER, _ITERATIONS = 2.0, 5
# Least standard error of a growth, and factor of the standard error of its fit, as neighboring points share
# their errors; both measured on rendered drives.
_MIN_STD, _STD_FACTOR = 0.001, 1.5
# Options of the search for a point: window, pyramid levels, end of its iterations, least texture.
_REACH = 4
_SEARCH: dict[str, Any] = {
    "winSize": (2 * _REACH + 1, 2 * _REACH + 1),
    "maxLevel": 2,
    "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.02),
    "minEigThreshold": 1e-4,
    "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
}


def small_gray(frame: NDArray[np.uint8]) -> Gray:
    """Return the frame in gray, with a longer side of at most 640 pixels."""
    height, width = frame.shape[:2]
    scale = min(_SIDE / max(height, width), 1.0)
    size = max(round(scale * width), 1), max(round(scale * height), 1)
    resized = cv2.resize(frame, size, interpolation=cv2.INTER_AREA) if scale < 1 else frame
    return np.asarray(cv2.cvtColor(resized, cv2.COLOR_RGB2GRAY), np.uint8)


def measure_growth(
    before: Gray, after: Gray, boxes: Floats, new_boxes: Floats, camera: Camera
) -> tuple[Floats, Floats]:
    """Logarithm of the growth of each vehicle, and its standard error, infinite where it cannot be measured.

    `boxes` and `new_boxes` are ``(N, 4)`` in pixels of the gray images `before` and `after`, and `camera` is
    that of these. What the camera's own turning adds to the growth is subtracted.
    """
    if not len(boxes):
        return np.empty(0), np.empty(0)
    grid = _grid(boxes, before.shape[1])
    # Where the points are expected: at the same place in the box.
    places = (grid - boxes[:, None, :2]) / (boxes[:, None, 2:] - boxes[:, None, :2])
    start = new_boxes[:, None, :2] + places * (new_boxes[:, None, 2:] - new_boxes[:, None, :2])
    # Only the part of the images with the vehicles is used, as its pyramids take most of the time.
    corners = np.concatenate([boxes.reshape(-1, 2), new_boxes.reshape(-1, 2)])
    x1, y1 = np.maximum(corners.min(axis=0).astype(int) - _BORDER, 0)
    x2, y2 = corners.max(axis=0).astype(int) + _BORDER
    part = np.s_[y1:y2, x1:x2]
    flat, found = ((each - (x1, y1)).reshape(-1, 1, 2).astype(np.float32) for each in (grid, start))
    shift, status, _ = cv2.calcOpticalFlowPyrLK(before[part], after[part], flat, found, **_SEARCH)
    valid = status.reshape(grid.shape[:2]) > 0
    points = _centers_of_gradient(before, grid)
    moved = points + (shift - flat).reshape(grid.shape).astype(np.float64)
    fit = _fit(_rectify(points, camera, before), _rectify(moved, camera, before), valid)
    growth, std = _without_turn(fit, before.shape[1] / 2, camera.focal_px)
    narrow = np.minimum(boxes[:, 2] - boxes[:, 0], new_boxes[:, 2] - new_boxes[:, 0]) < _MIN_WIDTH
    unknown = narrow | (fit.agreeing < _MIN_AGREEING) | (fit.scale <= 0) | (std > _MAX_STD)
    return np.where(unknown, 0.0, growth), np.where(unknown, np.inf, std)


def _grid(boxes: Floats, frame_width: int) -> Floats:
    """``(N, K, 2)`` points on the near ends of vehicles, which are at the outer sides of their boxes."""
    steps = np.linspace(_MARGIN, 1 - _MARGIN, _GRID)
    width, height = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
    face = np.minimum(width, _FACE_ASPECT * height)
    middle = (boxes[:, 0] + boxes[:, 2]) / 2
    left = np.where(middle > frame_width / 2, boxes[:, 2] - face, boxes[:, 0])
    x = left[:, None] + face[:, None] * steps
    y = boxes[:, 1, None] + height[:, None] * steps
    grid = np.stack(np.broadcast_arrays(x[:, None, :], y[:, :, None]), axis=-1)
    return np.asarray(grid.reshape(len(boxes), -1, 2))


def _centers_of_gradient(gray: Gray, points: Floats) -> Floats:
    """Where the shifts of points are measured: the means of their windows, weighted by squared gradients.

    A point beside the outline of a vehicle moves with the outline.
    """
    steps = np.arange(-_REACH - 1, _REACH + 2)
    height, width = gray.shape
    x = (points[:, :, 0].round().astype(int)[:, :, None] + steps).clip(0, width - 1)
    y = (points[:, :, 1].round().astype(int)[:, :, None] + steps).clip(0, height - 1)
    window = gray[y[:, :, :, None], x[:, :, None, :]].astype(np.float64)
    centers = np.empty_like(points)
    for axis, places in ((0, x[:, :, None, 1:-1]), (1, y[:, :, 1:-1, None])):
        if axis == 0:
            gradient = window[:, :, 1:-1, 2:] - window[:, :, 1:-1, :-2]
        else:
            gradient = window[:, :, 2:, 1:-1] - window[:, :, :-2, 1:-1]
        energy = np.square(gradient) + 1e-3
        centers[:, :, axis] = (energy * places).sum(axis=(2, 3)) / energy.sum(axis=(2, 3))
    return centers


def _rectify(points: Floats, camera: Camera, image: Gray) -> Floats:
    """Points as seen by a pinhole camera."""
    if not camera.fisheye:
        return points
    flat = points.reshape(-1, 2)
    return camera.rectify_boxes(np.concatenate([flat, flat], axis=1), image.shape)[:, :2].reshape(
        points.shape
    )


class _Fit(NamedTuple):
    """``moved = scale * points + shift`` for each vehicle, ``(N,)`` each."""

    scale: Floats
    std: Floats  # standard error of the scale's logarithm
    agreeing: Floats  # fraction of points that agree
    middle: Floats  # column of the middle of the points, and how far it moves
    shift: Floats


def _fit(points: Floats, moved: Floats, valid: NDArray[np.bool_]) -> _Fit:
    """Fit points ``(N, K, 2)`` by iteratively reweighted least squares."""
    weight = valid.astype(np.float64)
    for _ in range(_ITERATIONS):
        total = np.maximum(weight.sum(axis=1), 1e-9)[:, None]
        means = [(weight[:, :, None] * each).sum(axis=1) / total for each in (points, moved)]
        x, y = points - means[0][:, None], moved - means[1][:, None]
        spread = np.maximum((weight[:, :, None] * x * x).sum(axis=(1, 2)), 1e-9)
        scale = (weight[:, :, None] * x * y).sum(axis=(1, 2)) / spread
        squares = np.square(y - scale[:, None, None] * x).sum(axis=2)
        # The median of the squared residuals of two coordinates is 1.386 variances.
        ranked, half = np.sort(np.where(valid, squares, np.inf), axis=1), valid.sum(axis=1) // 2
        variance = np.maximum(np.take_along_axis(ranked, half[:, None], axis=1) / 1.386, 1e-6)
        weight = valid / (1 + squares / (_OUTLIER**2 * variance))
    count = weight.sum(axis=1)
    mean_square = (weight * np.where(valid, squares, 0.0)).sum(axis=1) / np.maximum(2 * count - 3, 1)
    std = np.sqrt(mean_square / spread) / np.maximum(scale, 1e-9)
    return _Fit(scale, std, count / weight.shape[1], means[0][:, 0], (means[1] - means[0])[:, 0])


def _without_turn(fit: _Fit, middle: float, focal_px: float) -> tuple[Floats, Floats]:
    """Logarithm of the growth without what a turn of the camera adds, and its standard error.

    A turn by ``w`` moves a point at ``t = x / focal`` by ``focal * (1 + t**2) * w``, and stretches what is
    there by ``2 * t * w`` horizontally and ``t * w`` vertically. An approach moves it by ``x * growth``.
    """
    growth, t = np.log(np.maximum(fit.scale, 1e-9)), (fit.middle - middle) / focal_px
    stretch = 1.5 * t / (1 + t * t)  # the mean of both directions, for a shift of one
    # Far from the middle, a turn and an approach look the same.
    part = np.maximum(1 - stretch * t, 0.1)
    straight = (growth - stretch * fit.shift / focal_px) / part
    turn_std = _TURN_STD * np.abs(growth - straight)
    return straight, np.hypot(_STD_FACTOR * fit.std / part, np.hypot(turn_std, _MIN_STD))
