"""Pictures that explain a box of each vehicle, for the report."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.boxes import box_areas
from vehicle_detection.camera import truncated_edges
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.drawing import blur_boxes, draw_boxes, draw_cell_shares
from vehicle_detection.drive.history import track_histories
from vehicle_detection.drive.report_page import TrackPicture
from vehicle_detection.evaluation import Explanation, explain
from vehicle_detection.tables import TrackTable
from vehicle_detection.tracking import search_interval
from vehicle_detection.video import Source, borrow_source

# Part of an image around a window that a picture shows, as a fraction of its longer side; height of the
# picture in pixels, and color of its box.
_AROUND, _PICTURE_HEIGHT, _BOX_COLOR = 0.2, 180, (240, 228, 66)
# Largest number of tracks that are explained, each of which takes a search of a frame.
_MAX_EXPLAINED = 12


def explain_tracks(
    detector: VehicleDetector, source: Source, table: TrackTable, *, every: int | None = None
) -> list[TrackPicture]:
    """Explain a box of each of the twelve longest tracks: the largest detected one inside the frame.

    `table` holds the tracks that `detector` found in `source`, which is read again, with the option `every`
    of `process_video`. The pictures are in the order of the tracks' ids.
    """
    known = [track for track in track_histories(table) if np.isfinite(track.boxes).all(axis=1).any()]
    tracks = sorted(known, key=lambda track: -len(track.frames))[:_MAX_EXPLAINED]
    pictures = []
    with borrow_source(source) as opened:
        shape, fps = opened.info.shape[:2], float(opened.info.fps)
        offset = round((table.first_time or 0.0) * fps)
        interval = every or (1 if detector.searches_every_frame else search_interval(fps))
        for track in tracks:
            truncated = truncated_edges(track.boxes, shape).any(axis=1)
            # Predicted boxes have no detection to explain; they are the last choice.
            detected = (track.columns["time_since_update"] == 0) & (track.frames % interval == 0)
            weights = np.where(truncated, 0.01, 1.0) * np.where(detected, 1.0, 1e-9)
            row = int(np.nanargmax(weights * box_areas(track.boxes)))
            frame = int(track.frames[row])
            with opened.read(offset + frame, 1) as frames:
                for _, _, image in frames:
                    explanation = explain(detector, image, track.boxes[row])
                    picture = _draw_explanation(detector, image, explanation)
                    pictures.append(TrackPicture(track.id, frame, picture, str(explanation)))
    return sorted(pictures, key=lambda picture: picture.track)


def _draw_explanation(
    detector: VehicleDetector, image: NDArray[np.uint8], explanation: Explanation
) -> NDArray[np.uint8]:
    """Draw an explained box twice, side by side: as it is, and with the shares of its cells."""
    if detector.annotator.blur is not None:
        boxes = np.concatenate([detector.detect(image).boxes, explanation.box[None]])
        image = blur_boxes(image, boxes, region=detector.annotator.blur)
    both = np.stack([explanation.window, explanation.box])
    around = _AROUND * (both[:, 2:].max(axis=0) - both[:, :2].min(axis=0)).max()
    low, high = both[:, :2].min(axis=0) - around, both[:, 2:].max(axis=0) + around
    left, top = np.maximum(low, 0).astype(int).tolist()
    right, bottom = np.minimum(high, image.shape[1::-1]).astype(int).tolist()
    plain = np.ascontiguousarray(image[top:bottom, left:right])
    scale = _PICTURE_HEIGHT / len(plain)
    size = max(1, round(scale * plain.shape[1])), _PICTURE_HEIGHT
    plain = np.asarray(cv2.resize(plain, size, interpolation=cv2.INTER_AREA), np.uint8)
    corner = np.array([left, top, left, top])
    shares = draw_cell_shares(plain, (explanation.window - corner) * scale, explanation.cells)
    shares = draw_boxes(shares, [(explanation.box - corner) * scale], color=_BOX_COLOR, thickness=2)
    return np.hstack([plain, shares])
