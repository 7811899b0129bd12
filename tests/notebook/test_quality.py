import numpy as np
import pandas as pd
import pytest

from tests.notebook.helpers import gray_image, legend, new_axes, texts
from vehicle_detection import TrackTable, load_frames, notebook, write_image
from vehicle_detection.evaluation import LabelledFrames, evaluate_detections, precision_recall_curve
from vehicle_detection.notebook.style import VERMILION


def labelled():
    """Three frames with a detected and two missed vehicles, two false positives and an ignored detection."""
    image = np.random.default_rng(0).integers(0, 256, (120, 200, 3), np.uint8)
    labels = TrackTable(
        ["a.png", "a.png", "b.png", "b.png"],
        None,
        [[10, 10, 60, 50], [100, 10, 130, 40], [20, 20, 110, 100], [150, 0, 200, 60]],
        ignore=[False, False, False, True],
    )
    found = TrackTable(
        ["a.png", "b.png", "b.png", "c.png"],
        None,
        [[11, 10, 60, 50], [160, 5, 190, 50], [60, 60, 110, 100], [5, 5, 45, 45]],
        score=[2.0, 3.0, 0.5, 1.0],
    )
    return LabelledFrames("road", dict.fromkeys(("a.png", "b.png", "c.png"), image), labels), found


def test_missed_vehicles_are_shown_largest_first():
    frames, found = labelled()
    scores = evaluate_detections(found, frames.labels)
    axes = notebook.plot_errors(frames, found, ax=new_axes())
    assert (scores.fn, scores.tp + scores.fn) == (2, 3)
    assert axes.get_title() == "2 of 3 vehicles missed"
    assert texts(axes.texts) == ["b\n90x80 px, IoU 0.28", "a\n30x30 px, IoU 0.00"]
    assert len(axes.images) == 2
    assert legend(axes) == ["labelled", "detected"]
    crop = axes.images[1].get_array()
    np.testing.assert_array_equal(crop, frames.frames["a.png"][0:52, 88:142][: crop.shape[0]])


def test_false_positives_are_shown_by_descending_score():
    frames, found = labelled()
    axes = notebook.plot_errors(frames, found, kind="false", ax=new_axes())
    assert axes.get_title() == "2 of 4 detections are false positives"
    assert texts(axes.texts) == ["c\nscore 1.00, 40x40 px", "b\nscore 0.50, 50x40 px"]
    colors = [tuple(lines.get_colors()[0][:3]) for lines in axes.collections]
    assert sum(color == pytest.approx(VERMILION) for color in colors) == 2
    one = notebook.plot_errors(frames, found, kind="false", count=1, ax=new_axes())
    assert len(one.images) == 1


def test_perfect_detections_have_no_errors_to_show(tmp_path):
    write_image(tmp_path / "a.png", gray_image())
    truth = TrackTable(["a.png"], None, [[10, 10, 60, 50]])
    frames = LabelledFrames("road", load_frames(tmp_path), truth)
    perfect = TrackTable(["a.png"], None, truth.boxes, score=[1.0])
    axes = notebook.plot_errors(frames, perfect, ax=new_axes())
    assert (axes.get_title(), len(axes.images)) == ("0 of 1 vehicles missed", 0)
    assert notebook.plot_errors(frames, perfect, kind="false", ax=new_axes()).get_title().startswith("0 of 1")
    nothing = TrackTable([], None, [], score=[])
    assert len(notebook.plot_errors(frames, nothing, ax=new_axes()).images) == 1  # read from the folder


def test_the_curve_marks_the_best_f1_and_the_threshold():
    frames, found = labelled()
    curve = precision_recall_curve(found, frames.labels)
    axes = notebook.plot_precision_recall({"road": curve, "again": curve}, threshold=0.9, ax=new_axes())
    lines = {line.get_label(): line for line in axes.lines}
    precision, recall, thresholds = curve
    name = next(label for label in lines if label.startswith("road"))
    np.testing.assert_array_equal(lines[name].get_xydata(), np.stack([recall, precision], axis=1))
    f1 = 2 * precision * recall / (precision + recall)
    assert name == f"road: best F1 {f1.max():.2f} at {thresholds[f1.argmax()]:.2f}"
    used = np.flatnonzero(thresholds > 0.9)[-1]
    squares = [line.get_xydata()[0].tolist() for line in axes.lines if line.get_marker() == "s"]
    assert squares == [[recall[used], precision[used]]] * 2
    assert axes.get_xlabel().startswith("recall")
    alone = notebook.plot_precision_recall(curve, ax=new_axes())
    assert legend(alone)[0].startswith("best F1")


def test_the_tradeoff_marks_the_pareto_front():
    columns = {"accuracy": [0.97, 0.96, 0.99, None], "search_ms": [4, 5, 9, 1]}
    table = pd.DataFrame({"configuration": ["a", "b", "c", "d"]} | columns)
    given = new_axes()
    assert notebook.plot_tradeoff(table, ax=given) is given
    assert given.lines[0].get_xydata().tolist() == [[4, 0.97], [9, 0.99]]
    assert given.collections[0].get_offsets().tolist() == [[4, 0.97], [5, 0.96], [9, 0.99]]
    assert texts(given.texts) == ["a", "c"]
    assert (given.get_xlabel(), given.get_ylabel()) == ("search time (ms per frame)", "accuracy on patches")
