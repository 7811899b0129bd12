"""Steady boxes over the frames of a video, without a tracker: what the course's systems did."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, describe
from vehicle_detection.course.windows import Corners, corner_array
from vehicle_detection.errors import InvalidInputError

Floats = NDArray[np.float64]


class Box:
    """The last `n` boxes of a vehicle, of which newer ones weigh more.

    Examples
    --------
    >>> box = Box(n=2)
    >>> box.add(((0, 0), (10, 10)))
    ((0, 0), (10, 10))
    >>> box.add(((3, 0), (13, 10)))
    ((2, 0), (12, 10))
    """

    def __init__(self, n: int = 10) -> None:
        self.boxes: deque[Floats] = deque(maxlen=check.integer(n, "n", low=1))

    def add(self, box: Any) -> Corners:
        """Add the box of another frame, a pair of corners, and return the weighted mean."""
        self.boxes.append(_one_box(box, "box"))
        return _corners(np.average(self.boxes, axis=0, weights=np.arange(1, len(self.boxes) + 1)))


def adjust_bbox(bbox: Any, previous: Any, weight: float = 0.3) -> Corners:
    """Move a previous box a fraction `weight` of the way to a new one, as `BoxSmoother` does.

    Examples
    --------
    >>> adjust_bbox(((20, 0), (60, 40)), ((10, 0), (50, 40)), weight=0.5)
    ((15, 0), (55, 40))
    """
    new, old = _one_box(bbox, "bbox"), _one_box(previous, "previous")
    return _corners(old + check.number(weight, "weight", above=0, high=1) * (new - old))


def _one_box(box: Any, name: str) -> Floats:
    boxes = corner_array([box], name).astype(np.float64)
    if not len(boxes):
        raise InvalidInputError(f"{name} must be a pair of corners ((x1, y1), (x2, y2)); got {describe(box)}")
    return np.asarray(boxes[0])


def _corners(box: Floats) -> Corners:
    x1, y1, x2, y2 = np.rint(box).astype(int).tolist()
    return (x1, y1), (x2, y2)


@dataclass
class _Vehicle:
    box: Floats
    speed: Floats = field(default_factory=lambda: np.zeros(4))  # pixels a frame
    found: int = 1  # frames
    missed: int = 0  # frames since it was found


class BoxSmoother:
    """The vehicles of a video from the boxes of each frame: ``smoother(boxes)`` returns those to show.

    The nearest earlier box whose center lies in a new box belongs to the same vehicle. The course's first
    system is ``BoxSmoother(weight=0.3, hold=5)``, its third
    ``BoxSmoother(show_after=3, hold=10, estimate=True)``.

    Parameters
    ----------
    weight
        Fraction of the way that a box moves to a new one; 1 takes the new one.
    hold, estimate
        Number of frames without a new box after which a vehicle is dropped, and whether its box moves on as
        it moved before meanwhile.
    show_after
        Number of frames in which a vehicle is found before it is shown.

    Examples
    --------
    >>> smoother = BoxSmoother(hold=1, estimate=True)
    >>> [smoother(boxes) for boxes in ([((0, 0), (40, 40))], [((10, 0), (50, 40))], [], [])]
    [[((0, 0), (40, 40))], [((10, 0), (50, 40))], [((20, 0), (60, 40))], []]
    """

    def __init__(
        self, *, weight: float = 1.0, hold: int = 0, estimate: bool = False, show_after: int = 1
    ) -> None:
        self.weight = check.number(weight, "weight", above=0, high=1)
        self.hold, self.estimate = check.integer(hold, "hold", low=0), check.boolean(estimate, "estimate")
        self.show_after = check.integer(show_after, "show_after", low=1)
        self.vehicles: list[_Vehicle] = []

    def __call__(self, boxes: Any) -> list[Corners]:
        """Take the boxes of the next frame, and return those of the vehicles to show."""
        earlier, self.vehicles = self.vehicles, []
        for new in corner_array(boxes, "boxes").astype(np.float64):
            offsets = np.array([new - each.box for each in earlier]).reshape(-1, 2, 2).mean(axis=1)
            near = (2 * np.abs(offsets) <= new[2:] - new[:2]).all(axis=1)  # centers inside of the new box
            if not near.any():
                self.vehicles.append(_Vehicle(new))
                continue
            vehicle = earlier.pop(int(np.where(near, np.hypot(*offsets.T), np.inf).argmin()))
            step = self.weight * (new - vehicle.box)
            speed = (vehicle.missed * vehicle.speed + step) / (vehicle.missed + 1)
            self.vehicles.append(_Vehicle(vehicle.box + step, speed, vehicle.found + 1))
        for vehicle in earlier:
            if vehicle.missed < self.hold:
                box = vehicle.box + self.estimate * vehicle.speed
                self.vehicles.append(_Vehicle(box, vehicle.speed, vehicle.found, vehicle.missed + 1))
        return [_corners(each.box) for each in self.vehicles if each.found >= self.show_after]
