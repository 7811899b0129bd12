"""Images and tracks to draw."""

import numpy as np

from vehicle_detection.tracking import Track


def blank(height=720, width=1280, value=90):
    return np.full((height, width, 3), value, np.uint8)


def track(box=(600, 400, 700, 490), **changes):
    attributes = {
        "id": 1, "box": np.array(box, float), "score": 1.25, "state": "confirmed", "shown": True, "age": 2.0,
        "misses": 0, "time_since_update": 0.0, "velocity": (3.0, 0.0), "distance_m": 23.6,
        "distance_std_m": 2.2, "speed_mps": -1.75, "speed_std_mps": 0.5,
    }  # fmt: skip
    return Track(**(attributes | changes))


def changed_box(drawn, image):
    """Bounding box ``[x1, y1, x2, y2]`` of the pixels that differ; None if there are none."""
    rows, columns = np.nonzero((drawn != image).any(axis=2))
    return [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1] if len(rows) else None
