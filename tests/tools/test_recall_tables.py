import numpy as np
import pytest

from tools.model_card import write_card
from tools.recall_tables import (
    calibration_rows,
    recall_by_visibility,
    recall_by_width,
    recall_cells,
    recall_tables,
)
from vehicle_detection import FrameBoxes, LabelledFrames
from vehicle_detection.training import FoldDetections, score_fold

IMAGE = np.zeros((200, 400, 3), np.uint8)
# A near vehicle, one behind it, a small one, one that the frame cuts, and an ignored box.
BOXES = [[100, 80, 200, 180], [170, 60, 260, 150], [300, 100, 330, 125], [0, 90, 60, 170], [340, 20, 400, 60]]


def fold(source, shown, scores):
    """Detections of the boxes `shown` in one frame, and of one that is false."""
    labels = FrameBoxes(
        [0] * 5,
        np.arange(5),
        BOXES,
        truncated=np.array([0, 0, 0, 0.4, 0]),
        ignore=np.array([0, 0, 0, 0, 1], np.bool_),
    )
    boxes = [*(BOXES[row] for row in shown), [10, 10, 40, 30]]
    found = FrameBoxes([0] * len(boxes), None, boxes, scores=np.array(scores, float))
    return FoldDetections(source, LabelledFrames(source, {0: IMAGE}, labels), found)


def test_vehicles_are_counted_by_width_and_by_what_hides_them():
    detections = fold("one", [0, 1, 3], [1.0, 0.5, -0.8, -0.2])
    assert recall_by_width(detections, -1.0) == [(0, 1), (0, 0), (1, 1), (2, 2), (0, 0)]
    assert recall_by_width(detections, 0.0) == [(0, 1), (0, 0), (0, 1), (2, 2), (0, 0)]
    assert recall_by_visibility(detections, 0.0) == [(1, 2), (1, 1), (0, 1)]
    assert recall_cells([(1, 2), (0, 0)]) == ["0.50 of 2", "-"]


def test_probabilities_are_fitted_to_the_other_sources():
    folds = [fold(name, [0, 1, 2, 3], [2.0, 1.5, 1.0, -0.5, -1.5]) for name in ("one", "two")]
    rows = calibration_rows(folds)
    assert sum(count for count, _, _ in rows) <= 10
    assert rows[-1][2] == 1.0
    assert [probability for _, probability, _ in rows] == sorted(probability for _, probability, _ in rows)
    assert calibration_rows([]) == []


def test_the_card_shows_the_tables(small_mixture, tmp_path):
    folds = [fold(name, [0, 1, 3], [1.0, 0.5, 0.1, -1.5]) for name in ("one", "two")]
    scores = [score_fold(each, 0.0) for each in folds]
    widths, kinds, _ = recall_tables(folds, scores)
    assert widths[0] == ["one", "0.00 of 1", "-", "1.00 of 1", "1.00 of 2", "-"]
    assert kinds[1] == ["two", "0.50 of 2", "1.00 of 1", "1.00 of 1"]
    write_card(tmp_path / "m.md", small_mixture, scores, [], seed=0, folds=folds)
    card = (tmp_path / "m.md").read_text()
    assert "| one | 0.00 of 1 | - | 1.00 of 1 | 1.00 of 2 | - |" in card
    assert "| set | whole | behind another vehicle | cut by the frame |" in card
    assert "| mean stated probability | right | boxes |" in card


def test_every_fold_needs_its_score():
    with pytest.raises(ValueError, match="shorter"):
        recall_tables([fold("one", [0], [1.0, -1.0])], [])
