import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.patches import Ellipse, Rectangle

from tests.drawing.cases import track
from tests.notebook.helpers import new_axes, texts
from vehicle_detection import notebook
from vehicle_detection.boxes import Detections
from vehicle_detection.camera import Camera
from vehicle_detection.notebook.style import COLORS
from vehicle_detection.tracking import FrameResult

CAMERA = Camera(focal_px=1000.0, horizon_px=400.0)


def result(index, *tracks):
    return FrameResult(index, None, Detections.empty(), Detections.empty(), tracks)


def patches(axes, kind):
    return [patch for patch in axes.patches if isinstance(patch, kind)]


def test_vehicles_have_number_ellipse_and_motion():
    # In the own lane, as it is in the middle of the frame.
    ahead = track((590, 400, 690, 490), distance_m=20.0, distance_std_m=2.0, speed_mps=-4.0)
    away = track((900, 400, 980, 470), id=2, state="coasting", speed_mps=None)
    axes = notebook.plot_birds_eye(result(0, ahead, away), CAMERA, ax=new_axes())
    assert [text for text in texts(axes.texts) if text] == ["#1", "#2"]
    ellipse, other = patches(axes, Ellipse)
    np.testing.assert_allclose(ellipse.center, (0, 20), atol=0.01)
    assert (ellipse.width, ellipse.angle) == (4, 90)
    assert ellipse.height < ellipse.width
    assert other.angle < 90  # along the ray from the camera, to the right
    first, second, own = patches(axes, Rectangle)
    assert to_rgb(first.get_facecolor()) == pytest.approx(COLORS[0])
    assert second.get_facecolor()[3] == 0  # coasting
    assert own.get_y() + own.get_height() == 0
    arrows = [text for text in axes.texts if not text.get_text()]
    assert [arrow.xy for arrow in arrows] == [(pytest.approx(0), pytest.approx(16))]
    assert axes.get_aspect() == 1
    assert axes.get_xlabel() == "to the right (m)"


def test_trails_cover_the_last_seconds():
    results = [result(index, track(distance_m=20.0 + index)) for index in range(50)]
    axes = notebook.plot_birds_eye(results, CAMERA, fps=25, trail_seconds=1.0, ax=new_axes())
    trail = axes.lines[0].get_ydata()
    np.testing.assert_allclose(trail, 20.0 + np.arange(24, 50))
