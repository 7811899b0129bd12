import numpy as np
import pytest

from vehicle_detection import Detections, LabelledFrames, TrackTable, detector_from
from vehicle_detection.training import (
    FOLD_COLUMNS,
    FoldDetections,
    FrameDataset,
    best_threshold,
    detect_in_source,
    fit_log_odds,
    format_fold,
    score_fold,
)


def fold_of(scores, hits, *, frames=4, empty=0, source="road"):
    """One vehicle in each frame but the last `empty`; boxes with these scores, on it or beside it."""
    vehicle, beside = [10.0, 10.0, 60.0, 50.0], [100.0, 10.0, 150.0, 50.0]
    images = [np.zeros((60, 160, 3), np.uint8)] * frames
    full = range(frames - empty)
    labels = TrackTable(list(full), None, [vehicle for _ in full], frame_keys=list(range(frames)))
    found = {key: [] for key in range(frames)}
    for key, (score, hit) in enumerate(zip(scores, hits)):
        found[key % frames].append((vehicle if hit else beside, score))
    detections = {key: Detections(*zip(*rows)) if rows else Detections.empty() for key, rows in found.items()}
    table = TrackTable.from_detections(detections)
    return FoldDetections(source, LabelledFrames(source, images, labels), table)


def test_fold_scores_by_hand():
    fold = fold_of([1.0, 0.5, 0.2, -0.5], [True, False, True, True], frames=5, empty=1)
    score = score_fold(fold, 0.0)
    assert (score.frames, score.vehicles) == (5, 4)
    assert (score.precision, score.recall) == (pytest.approx(2 / 3), 0.5)
    assert score.f1 == pytest.approx(4 / 7)
    assert score.best_f1 == pytest.approx(6 / 8)
    assert score.average_precision == pytest.approx(0.25 + 0.25 * 0.75 + 0.25 * 0.75)
    assert (score.mean_iou, score.false_per_frame, score.false_per_empty_frame) == (1.0, 0.2, 0.0)
    assert "false_per_empty_frame" not in score_fold(fold_of([1.0], [True]), 0.0).to_dict()
    # At IoU 0.7 the same boxes are right; log-odds of 0 state a probability of one half for each box.
    assert score.strict_average_precision == score.average_precision
    assert score_fold(fold, 0.0, (0.0, 0.0)).calibration_error == pytest.approx(0.25)


def test_a_vehicle_in_an_ignored_group_is_not_false_in_the_region_scores():
    fold = fold_of([1.0, 0.5, 0.2], [True, True, False])
    single = fold.frames.labels
    boxes = [*single.boxes, [80.0, 0.0, 160.0, 60.0]]
    labels = TrackTable([*single["frame"], 2], range(5), boxes, ignore=np.arange(5) == 4, frame_keys=range(4))
    fold = FoldDetections("road", LabelledFrames("road", fold.frames.frames, labels), fold.predictions)
    score = score_fold(fold, 0.0)
    assert (score.precision, score.f1) == (pytest.approx(2 / 3), pytest.approx(4 / 7))
    assert score.region_f1 == pytest.approx(4 / 6)
    assert score.average_precision == score.region_average_precision == 0.5


def test_the_best_threshold_of_one_fold():
    fold = fold_of([1.0, 0.5, 0.0, -0.5], [True, True, True, False])
    assert -0.5 < best_threshold([fold]) <= 0.0
    other = fold_of([0.9, 0.3], [True, False], frames=1)
    assert 0.3 < best_threshold([other]) <= 0.9
    assert best_threshold([fold_of([], []), fold_of([], [], frames=2, empty=2)]) == -4.0


def test_log_odds_increase_with_the_logit():
    rng = np.random.default_rng(0)
    logits = rng.uniform(-1, 1, 40)
    hits = rng.random(40) < 1 / (1 + np.exp(-4 * logits - 1))
    hits[np.argsort(logits)[-2:]] = True
    fold = fold_of(logits, hits, frames=40)
    slope, offset = fit_log_odds([fold])
    assert 2 < slope < 8
    assert -0.5 < offset < 2.5


def test_log_odds_give_sources_with_more_vehicles_no_more_influence():
    logits = np.tile(np.linspace(-1, 1, 20), 5)
    strict = fold_of(logits[:20], logits[:20] > 0.6, frames=20, source="strict")
    easy = fold_of(logits, logits > -0.4, frames=100, source="easy")
    slope, offset = fit_log_odds([strict, easy])
    # Half-way between the two, and not near the larger one.
    assert -offset / slope == pytest.approx(0.1, abs=0.12)
    empty = fold_of([0.9], [False], frames=1, empty=1, source="empty")
    assert fit_log_odds([strict, easy, empty]) == pytest.approx((slope, offset), rel=0.1)


@pytest.mark.parametrize("hits", [[True, True], [False, False], [False, True], []])
def test_log_odds_of_too_few_boxes(hits):
    # All right, all wrong, or the better box wrong: nothing to fit.
    assert fit_log_odds([fold_of([0.9, 0.1][: len(hits)], hits)]) == (1.0, 0.0)


def test_recall_of_vehicles_that_are_hard_to_find():
    # Whole, occluded, narrow, cut by the left, by the lower edge, beyond the edge by its label, and ignored.
    boxes = [
        [60, 20, 100, 50], [60, 60, 100, 90], [120, 20, 150, 50], [2, 20, 50, 50], [120, 60, 160, 99],
        [10, 60, 50, 90], [0, 0, 30, 10],
    ]  # fmt: skip
    columns = {"occluded": [0, 1, 0, 0, 0, 0, 1], "truncated": [0, 0, 0, 0, 0, 0.3, 0]}
    labels = TrackTable([0] * 7, range(7), boxes, ignore=np.arange(7) == 6, **columns)
    frames = LabelledFrames("road", [np.zeros((100, 200, 3), np.uint8)], labels)
    found = TrackTable([0] * 3, None, [boxes[0], boxes[3], boxes[2]], score=[1.0, 0.5, -0.5])
    score = score_fold(FoldDetections("road", frames, found), 0.0)
    assert (score.occluded, score.truncated, score.narrow) == (1, 3, 1)
    assert (score.recall_occluded, score.recall_truncated) == (0.0, pytest.approx(1 / 3))
    assert score.recall_narrow == 0.0
    assert score_fold(FoldDetections("road", frames, found), -1.0).recall_narrow == 1.0
    cells = dict(zip(FOLD_COLUMNS, format_fold(score.to_dict(), missing="-")))
    assert (cells["recall_truncated"], cells["false_per_empty_frame"]) == ("0.333", "-")


def test_false_boxes_in_frames_without_vehicles():
    # Frame 0 shows a vehicle, frame 1 an ignored box, frame 2 nothing.
    vehicle, beside = [10.0, 10.0, 60.0, 50.0], [100.0, 10.0, 150.0, 50.0]
    labels = TrackTable([0, 1], None, [vehicle, vehicle], ignore=[False, True])
    frames = LabelledFrames("road", [np.zeros((60, 160, 3), np.uint8)] * 3, labels)
    found = TrackTable(
        [0, 1, 1, 2, 2], None, [beside, vehicle, beside, vehicle, beside], score=[1, 1, 1, 1, -1]
    )
    score = score_fold(FoldDetections("road", frames, found), 0.0)
    assert (score.false_per_empty_frame, score.false_per_vehicle_free_frame) == (1.0, 1.0)
    score = score_fold(FoldDetections("road", frames, found), -2.0)
    assert (score.false_per_empty_frame, score.false_per_vehicle_free_frame) == (2.0, 1.5)


class CountedFrames(dict):
    """Frames that count how many of them have been read."""

    read = 0

    def __getitem__(self, key):
        self.read += 1
        return super().__getitem__(key)


def test_frames_are_not_read_in_advance():
    frames, read = CountedFrames.fromkeys(range(40), np.zeros((60, 160, 3), np.uint8)), []

    def find(image):
        read.append(frames.read)
        return [], []

    part = LabelledFrames("road", frames, TrackTable(frame_keys=range(40)))
    detect_in_source(detector_from(find).model, FrameDataset("road", (part,)), jobs=2)
    assert len(read) == 40
    assert all(count <= number + 2 for number, count in enumerate(read))


def test_detections_of_any_model():
    seen = []

    def find(image):
        seen.append(image.shape)
        return [[10, 10, 60, 50], [100, 10, 150, 50]], [0.9, 0.02]

    model = detector_from(find).model
    fold = fold_of([], [])
    source = FrameDataset("road", (fold.frames, fold.frames))
    first, second = detect_in_source(model, source, jobs=2)
    assert len(seen) == 8
    assert (first.source, first.predictions.frame_keys) == ("road", (0, 1, 2, 3))
    np.testing.assert_array_equal(first.predictions.boxes, second.predictions.boxes)
    assert (first.logits[0], first.logits[1]) == (first.logits.max(), pytest.approx(first.logits.min()))
    assert len(first.above(0.0)) == 4
    (strict,) = detect_in_source(model, FrameDataset("road", (fold.frames,)), min_score=0)
    assert len(strict.predictions) == 4
