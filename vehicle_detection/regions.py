"""Windows to boxes without a heat map: group overlapping windows, and fit the box that each group implies.

A heat map's region is as large as the windows that formed it, not as the vehicle. But the weighted mean of
many overlapping windows is known to a fraction of their step, and the training patches show what a window
contains: the face of a vehicle (rear or front) fills a fixed part of it. A vehicle in another lane shows its
side as well, the more the farther it is to the side. The pinhole camera gives the size of the visible side,
and with it the difference between window and box.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, check, fields
from vehicle_detection.boxes import Detections, box_areas, clip_boxes, intersection_matrix, overlap_matrices
from vehicle_detection.camera import Camera


@dataclass(frozen=True, kw_only=True)
class RegionParams(fields.Checked):
    """How groups of overlapping windows become boxes; lengths are fractions of a window's side.

    Attributes
    ----------
    min_peak, min_evidence
        Minimum of the best score, and of the sum of positive scores in a group.
    min_iou
        Windows whose IoU with the best window exceeds this join its group.
    score_power
        The weight of a window in the group's mean is proportional to this power of its score.
    suppression_radius
        Windows whose center is this near to the center of a group start no group of their own.
    face_width, face_height, face_offset_y
        Size of the vehicle's face (front or rear) in a window, as on the training patches, and distance of
        its center below the window's center.
    flank_length_m, flank_shift
        Length of the visible side of a vehicle in meters, and fraction of the visible side by which the box's
        center moves towards the vanishing point.
    max_coverage
        A group is dropped if more than this fraction of its face lies inside the box of a better group.
    flank_peak_ratio
        A group whose face lies on the visible side of another vehicle is dropped even if it is the better
        one, unless the other peak is at most this fraction of its own.

    Examples
    --------
    >>> RegionParams(min_peak=1.5).min_peak
    1.5
    """

    min_peak: float = fields.number(0.7, low=0, high=1e9)
    min_evidence: float = fields.number(1.75, low=0, high=1e9)
    min_iou: float = fields.number(0.5, low=0, high=1)
    score_power: float = fields.number(2.0, low=0, high=20)
    suppression_radius: float = fields.number(0.6, above=0, high=2)
    face_width: float = fields.number(0.84, above=0, high=2)
    face_height: float = fields.number(0.79, above=0, high=2)
    face_offset_y: float = fields.number(-0.04, low=-1, high=1)
    flank_length_m: float = fields.number(6.0, low=0, high=100)
    flank_shift: float = fields.number(0.27, above=0, high=2)
    max_coverage: float = fields.number(0.5, low=0, high=1)
    flank_peak_ratio: float = fields.number(0.5, low=0, high=1)

    def with_peak(self, score: float) -> RegionParams:
        """Return parameters for another minimum of the best score, and of the evidence in proportion."""
        peak = max(score, 0.0)
        evidence = self.min_evidence * min(peak / max(self.min_peak, 1e-9), 1.0)
        return dataclasses.replace(self, min_peak=peak, min_evidence=evidence)


def find_vehicles(
    windows: Detections, camera: Camera, shape: tuple[int, ...], params: RegionParams | None = None
) -> Detections:
    """Group the positive windows of a frame and fit a box to each group.

    `windows` have scores; those at or below zero are ignored. The optical axis of the camera is the middle
    column of the frame. The boxes are clipped to the frame; a box's score is the best score in its group.

    Notes
    -----
    The grouping is one mean-shift step from the best window, in the space of positions and logarithmic sizes
    (Dalal, "Finding People in Images and Videos", 2006, chapter 5). A face of width `v` that fills
    ``face_width * window`` pixels is ``Z = focal * v / (face_width * window)`` away. A side of length `l`
    that starts at the lateral offset `X` extends from ``focal * X / Z`` towards the middle, to
    ``focal * X / (Z + l)``.

    Examples
    --------
    >>> windows = Detections([[600, 380, 680, 460], [604, 380, 684, 460]], [1.5, 1.5])
    >>> camera = Camera.for_frame((720, 1280))
    >>> find_vehicles(windows, camera, (720, 1280)).boxes.round().astype(int)
    array([[608, 385, 676, 448]])
    """
    check.instance(windows, "windows", Detections, "pass Detections(boxes, scores)")
    check.instance(camera, "camera", Camera, "pass Camera.for_frame(image.shape)")
    check.instance(params, "params", RegionParams | None, "omit it for the default")
    params, frame = params or RegionParams(), check.shape(shape)
    return fit_boxes(group_windows(windows, params), camera.for_shape(frame), frame, params)


def group_windows(windows: Detections, params: RegionParams) -> Detections:
    """Group the positive windows greedily around the best ones: mean windows and best scores, best first."""
    left = Detections(windows.boxes.astype(np.float64), windows.scores)
    left = left[(left.scores > 0) & (box_areas(left.boxes) > 0)]
    boxes, peaks = [], []
    while len(left):
        best = int(left.scores.argmax())
        peak = float(left.scores[best])
        if peak < params.min_peak:
            break
        joined = overlap_matrices(left.boxes[[best]], left.boxes)[0][0] > params.min_iou
        joined[best] = True
        # Small windows are denser. Weights proportional to the area give every size the same influence.
        group = left.boxes[joined]
        weights = (left.scores[joined] / peak) ** params.score_power * box_areas(group)
        weights = weights / weights.sum()
        # The weighted mean of centers, and that of logarithmic sizes.
        center = weights @ ((group[:, :2] + group[:, 2:]) / 2)
        half = np.exp(weights @ np.log(group[:, 2:] - group[:, :2])) / 2
        box = np.concatenate([center - half, center + half])
        if left.scores[joined].sum() >= params.min_evidence:
            boxes.append(box)
            peaks.append(peak)
        # Windows of other sizes and offsets on the same vehicle start no group of their own.
        centers = (left.boxes[:, :2] + left.boxes[:, 2:]) / 2
        middle, radius = (box[:2] + box[2:]) / 2, params.suppression_radius * (box[2:] - box[:2])
        left = left[~(joined | (np.abs(centers - middle) < radius).all(axis=1))]
    return Detections(np.array(boxes), np.array(peaks))


def fit_boxes(groups: Detections, camera: Camera, shape: tuple[int, ...], params: RegionParams) -> Detections:
    """Turn mean windows into boxes of the vehicles that they show, clipped to the frame."""
    size = groups.boxes[:, 2:] - groups.boxes[:, :2]
    center = (groups.boxes[:, 2:] + groups.boxes[:, :2]) / 2
    distance = camera.focal_px * camera.vehicle_width_m / (params.face_width * size[:, 0])
    lateral_px = center[:, 0] - shape[1] / 2
    inner_edge = np.clip(np.abs(lateral_px) - size[:, 0] / 2, 0, None)
    flank = inner_edge * params.flank_length_m / (distance + params.flank_length_m)
    face = np.stack([params.face_width * size[:, 0], params.face_height * size[:, 1]], axis=1)
    # The windows agree on a position between face and side, because the patches show a part of the side.
    shift = np.stack(
        [-np.sign(lateral_px) * params.flank_shift * flank, params.face_offset_y * size[:, 1]], axis=1
    )
    half = (face + np.stack([flank, np.zeros_like(flank)], axis=1)) / 2
    boxes = clip_boxes(np.concatenate([center + shift - half, center + shift + half], axis=1), shape)
    faces = clip_boxes(np.concatenate([center - face / 2, center + face / 2], axis=1), shape)
    kept = ~_on_other_vehicles(faces, boxes, groups.scores, params) & (box_areas(boxes) > 0)
    return Detections(boxes[kept], groups.scores[kept])


def _on_other_vehicles(
    faces: Floats, boxes: Floats, peaks: Floats, params: RegionParams
) -> NDArray[np.bool_]:
    """Mark the groups to drop whose face lies in the box of another group: windows fire on sides too.

    If two groups lie on each other, the better one stays.
    """
    areas = box_areas(faces)
    lies_on = intersection_matrix(faces, boxes) > params.max_coverage * areas[:, None]
    np.fill_diagonal(lies_on, False)
    # If peaks are equal, the first group is the better one.
    rank = np.lexsort((np.arange(len(peaks)), -peaks)).argsort()
    better = rank[None, :] < rank[:, None]
    stronger = peaks[None, :] > params.flank_peak_ratio * peaks[:, None]
    dropped = lies_on & (better | (stronger & ~lies_on.T))
    return np.asarray(dropped.any(axis=1) | (areas == 0))
