import numpy as np
from matplotlib.colors import to_rgb

from tests.notebook.helpers import texts
from vehicle_detection import Detections, FrameResult, Track, TrackTable, notebook, render_drive
from vehicle_detection.notebook.style import COLORS


def track(number, x, **changes):
    known = {
        "id": number, "box": np.array([x, 40.0, x + 50, 80.0]), "score": 1.0, "state": "confirmed",
        "shown": True, "age": 1.0, "misses": 0, "time_since_update": 0.0, "velocity": (0.0, 0.0),
        "distance_m": 20.0 + x, "distance_std_m": 2.0, "speed_mps": 3.0, "speed_std_mps": 0.5,
    }  # fmt: skip
    return Track(**{**known, **changes})


def result(index, *tracks, time=None):
    return FrameResult(index, time, Detections.empty(), Detections.empty(), tracks)


def test_tracks_are_plotted_over_time():
    results = [
        result(0, track(1, 10.0), track(0, 90.0, shown=False, state="tentative")),
        result(1, track(1, 12.0), track(9, 100.0, distance_m=None, distance_std_m=None)),
        result(2, track(9, 101.0)),
        result(3, track(1, 16.0), track(9, 102.0)),
    ]
    figure = notebook.plot_tracks(results, fps=10)
    assert [axes.get_ylabel().split("(")[-1] for axes in figure.axes] == ["px)", "px)", "m)", "m/s)"]
    assert figure.axes[-1].get_xlabel() == "time (s)"
    assert texts(figure.legends[0].get_texts()) == ["#1", "#9"]
    middle, other = figure.axes[0].lines
    # the line is interrupted where the track is missing
    np.testing.assert_allclose(middle.get_ydata(), [35, 37, np.nan, 41])
    np.testing.assert_allclose(middle.get_xdata(), [0, 0.1, 0.2, 0.3])
    assert to_rgb(middle.get_color()) == COLORS[0]
    assert to_rgb(other.get_color()) == COLORS[1]
    assert (middle.get_linestyle(), other.get_linestyle()) == ("-", "--")
    np.testing.assert_allclose(figure.axes[2].lines[1].get_ydata(), [np.nan, 121, 122])
    band = figure.axes[2].collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == (28, 34)  # one standard error


def test_frames_may_have_times_and_short_tracks_are_left_out():
    results = [result(0, track(1, 10.0), track(2, 50.0), time=3.0), result(1, track(1, 11.0), time=3.5)]
    figure = notebook.plot_tracks(results, min_frames=2)
    assert len(figure.axes[0].lines) == 1
    assert figure.axes[0].lines[0].get_xdata().tolist() == [3.0, 3.5]


def test_tracks_of_a_file_are_compared_with_the_truth_of_a_drive():
    drive = render_drive(frames=30, shape=(180, 320), scenario="overtaking", random_state=3)
    labels = drive.labels[~drive.labels["ignore"]]
    figure = notebook.plot_tracks(labels, truth=drive.labels)
    count = len(set(labels["track_id"].tolist()))
    assert len(figure.axes[0].lines) == 2 * count
    found, true = figure.axes[2].lines[0], figure.axes[2].lines[count]
    shown = ~np.isnan(found.get_ydata())
    np.testing.assert_allclose(found.get_ydata()[shown], true.get_ydata())
    assert true.get_color() == "k"
    assert texts(figure.legends[0].get_texts())[-1] == "truth"
    assert not figure.axes[2].collections  # a file has no standard errors
    ignored = TrackTable([0, 1], [1, 2], [[0, 0, 9, 9]] * 2, ignore=[False, True])
    both = notebook.plot_tracks(labels, truth=ignored)
    assert len(both.axes[0].lines) == count + 1
