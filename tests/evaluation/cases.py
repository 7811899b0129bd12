"""Boxes, drives and predictions for the tests of evaluation."""

import numpy as np
from hypothesis import strategies as st

from vehicle_detection.tables import TrackTable

CAR = (0.0, 0.0, 100.0, 60.0)


def moved(dx=0.0, dy=0.0, box=CAR):
    return (box[0] + dx, box[1] + dy, box[2] + dx, box[3] + dy)


def boxes_of(*rows, **columns):
    """Labels from (frame, track, box) or (frame, track, box, score) rows."""
    scores = [row[3] for row in rows] if rows and len(rows[0]) == 4 else None
    frames, tracks, boxes = ([row[index] for row in rows] for index in range(3))
    return TrackTable(frames, tracks, boxes, **{"score": scores, **columns})


@st.composite
def drives(draw):
    """Vehicles in lanes of their own over a few frames, each seen in some of them."""
    count, length = draw(st.integers(1, 3)), draw(st.integers(1, 6))
    rows = []
    for vehicle in range(count):
        width, height, speed = draw(st.integers(40, 160)), draw(st.integers(30, 90)), draw(st.integers(-9, 9))
        for frame in range(length):
            if draw(st.booleans()) or (vehicle, frame) == (0, 0):
                x, y = 500 + speed * frame, 200 * vehicle
                rows.append((frame, vehicle, (x, y, x + width, y + height)))
    return boxes_of(*rows, score=np.arange(len(rows)) / 7, frame_keys=range(length))


@st.composite
def trials(draw):
    """A drive, and tracks on it that err in place, miss, invent, and change their names."""
    labels = draw(drives())
    rows = []
    for frame, vehicle, box in zip(labels["frame"].tolist(), labels["track_id"].tolist(), labels.boxes):
        match = draw(st.sampled_from(["good", "good", "good", "shifted", "missed", "renamed"]))
        if match != "missed":
            shift = np.array(draw(st.tuples(*[st.integers(-6, 6)] * 4)))
            track = 20 + vehicle if match == "renamed" else vehicle
            rows.append((frame, track, tuple(box + shift + 200 * (match == "shifted"))))
        if draw(st.integers(0, 3)) == 0:
            rows.append((frame, 40 + vehicle, tuple(box + draw(st.integers(-20, 20)))))
    draws = st.floats(-2, 2, width=16)
    found = TrackTable(
        [row[0] for row in rows],
        [row[1] for row in rows],
        [row[2] for row in rows],
        score=draw(st.lists(draws, min_size=len(rows), max_size=len(rows))),
        frame_keys=labels.frame_keys,
    )
    return found, labels
