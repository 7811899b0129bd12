"""Windows to vehicle boxes without a heat map: groups of agreeing windows, and the box a group implies.

A heat map's region is as large as the windows that were thrown on it, not as the vehicle. But where many
windows agree, their weighted mean is known to a fraction of their step, and what a window holds is known
from the training patches: the face of a vehicle, from behind or from the front, fills a fixed part of it.
A vehicle beside the camera's path shows its flank as well, the more the farther it is to the side; how much
follows from the pinhole camera. So box and window differ, and the difference is geometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection.boxes import Detections, box_areas, clip_boxes, intersection_matrix, iou_matrix
from vehicle_detection.camera import Camera
from vehicle_detection.params import RegionParams


@dataclass(frozen=True, eq=False)
class WindowGroups:
    """Groups of agreeing windows as columns.

    Attributes
    ----------
    boxes
        ``(N, 4)`` float64, the weighted mean window of each group.
    peaks
        ``(N,)`` float64, the best score in the group.
    evidence
        ``(N,)`` float64, the sum of the positive scores in the group.
    """

    boxes: NDArray[np.float64]
    peaks: NDArray[np.float64]
    evidence: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.boxes)


def group_windows(windows: Detections, params: RegionParams | None = None) -> WindowGroups:
    """Group windows around the best ones, greedily, and average each group.

    The weight of a window is a power of its score times its area: a mean shift with one step from the
    peak, in the plane of positions and logarithmic sizes (Dalal, "Finding People in Images and Videos",
    2006, chapter 5, fuses detections the same way).

    Parameters
    ----------
    windows
        Windows with scores; those at or below zero count for nothing.
    params
        Overlap that joins, power, least peak and evidence.

    Returns
    -------
    WindowGroups
        From the best peak down.

    Examples
    --------
    >>> found = Detections([[0, 0, 10, 10], [2, 0, 12, 10], [50, 0, 60, 10]], [1.0, 1.0, 0.9])
    >>> groups = group_windows(found, RegionParams(min_peak=0.5, min_evidence=0.5))
    >>> groups.boxes.round(3).astype(int).tolist()
    [[1, 0, 11, 10], [50, 0, 60, 10]]
    """
    params = params or RegionParams()
    left = windows[(windows.scores > 0) & (box_areas(windows.boxes) > 0)]
    boxes, peaks, evidence = [], [], []
    while len(left):
        best = int(left.scores.argmax())
        peak = float(left.scores[best])
        if peak < params.min_peak:
            break
        joined = iou_matrix(left.boxes[[best]], left.boxes)[0] > params.overlap
        joined[best] = True
        # Small windows lie closer together: weighed by its area, every size has the same say.
        weights = (left.scores[joined] / peak) ** params.power * box_areas(left.boxes[joined])
        box = _mean_box(left.boxes[joined], weights)
        total = float(left.scores[joined].sum())
        if total >= params.min_evidence:
            boxes.append(box)
            peaks.append(peak)
            evidence.append(total)
        # Windows of other sizes and offsets on the same vehicle do not found a group of their own.
        centers = (left.boxes[:, :2] + left.boxes[:, 2:]) / 2
        middle, reach = (box[:2] + box[2:]) / 2, params.reach * (box[2:] - box[:2])
        left = left[~(joined | (np.abs(centers - middle) < reach).all(axis=1))]
    return WindowGroups(np.array(boxes).reshape(-1, 4), np.array(peaks), np.array(evidence))


def _mean_box(boxes: NDArray[Any], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weighted mean of centers and of logarithmic sizes, as one box."""
    share = weights / weights.sum()
    center = share @ ((boxes[:, :2] + boxes[:, 2:]) / 2)
    half = np.exp(share @ np.log(boxes[:, 2:] - boxes[:, :2])) / 2
    return np.concatenate([center - half, center + half])


def fit_boxes(
    groups: WindowGroups, camera: Camera, shape: tuple[int, ...], params: RegionParams | None = None
) -> Detections:
    """Turn mean windows into boxes of the vehicles that they show.

    Parameters
    ----------
    groups
        Mean windows, peaks and evidence.
    camera
        Gives the focal length, and so the distance at which a face fills a window.
    shape
        ``(height, width, ...)`` of the frame; the camera looks along the middle column.
    params
        Share of the window that a face fills, length of a flank.

    Returns
    -------
    Detections
        Float boxes clipped to the frame, with the groups' peaks as scores.

    Notes
    -----
    A face of width `v` that fills ``face_width * window`` pixels is ``Z = focal * v / (face_width *
    window)`` away. A flank of length `l` that starts at the lateral offset `X` reaches from ``focal * X /
    Z`` towards the middle, to ``focal * X / (Z + l)``.
    """
    params = params or RegionParams()
    size = groups.boxes[:, 2:] - groups.boxes[:, :2]
    center = (groups.boxes[:, 2:] + groups.boxes[:, :2]) / 2
    distance = camera.focal_px * camera.vehicle_width_m / (params.face_width * size[:, 0])
    aside = center[:, 0] - shape[1] / 2
    edge = np.clip(np.abs(aside) - size[:, 0] / 2, 0, None)
    flank = edge * params.flank_length_m / (distance + params.flank_length_m)
    face = np.stack([params.face_width * size[:, 0], params.face_height * size[:, 1]], axis=1)
    # The windows agree on a place between the face and the flank, as the patches show a part of it.
    shift = np.stack(
        [-np.sign(aside) * params.flank_shift * flank, params.face_offset_y * size[:, 1]], axis=1
    )
    half = (face + np.stack([flank, np.zeros_like(flank)], axis=1)) / 2
    boxes = np.concatenate([center + shift - half, center + shift + half], axis=1)
    boxes = clip_boxes(boxes, shape)
    faces = clip_boxes(np.concatenate([center - face / 2, center + face / 2], axis=1), shape)
    kept = ~_on_other_vehicles(faces, boxes, groups.peaks, params) & (box_areas(boxes) > 0)
    return Detections(boxes[kept], groups.peaks[kept])


def _on_other_vehicles(
    faces: NDArray[np.float64],
    boxes: NDArray[np.float64],
    peaks: NDArray[np.float64],
    params: RegionParams,
) -> NDArray[np.bool_]:
    """Mark the groups whose face lies on another group's vehicle: a flank and a front fire too.

    Of two that lie on each other the better one stays. A group that only lies on the other's flank goes
    even if it is the better one, unless the other is much weaker.
    """
    areas = box_areas(faces)
    shared = intersection_matrix(faces, boxes)
    lies_on = shared > params.covered * areas[:, None]
    np.fill_diagonal(lies_on, False)
    # Of equals the first is the better one.
    order = np.lexsort((np.arange(len(peaks)), -peaks)).argsort()
    better = order[None, :] < order[:, None]
    stronger = peaks[None, :] > params.flank_peak * peaks[:, None]
    gone = lies_on & (better | (stronger & ~lies_on.T))
    return np.asarray(gone.any(axis=1) | (areas == 0))


def find_vehicles(
    windows: Detections, camera: Camera, shape: tuple[int, ...], params: RegionParams | None = None
) -> Detections:
    """Group the positive windows of a frame and fit a box to each group; see the two functions."""
    return fit_boxes(group_windows(windows, params), camera, shape, params)
