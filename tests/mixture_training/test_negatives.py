import dataclasses

import numpy as np
import pytest

from tests.helpers import SMALL_MIXTURE, drawn
from vehicle_detection.boxes import intersection_matrix, iou_matrix
from vehicle_detection.evaluation import FrameBoxes, LabelledFrames
from vehicle_detection.mixture import N_CHANNELS, MixtureTemplate
from vehicle_detection.mixture_training import FrameDataset
from vehicle_detection.mixture_training.negatives import (
    NegativePool,
    is_negative,
    mine_windows,
    random_windows,
    truncate_labels,
    with_mirrored,
)
from vehicle_detection.mixture_training.sources import TrainingFrame, load_training_frames


def frames_with_ignored():
    frames = load_training_frames([FrameDataset("drawn", (drawn(range(4)),), min_labelled_width=35.0)])
    assert any(len(frame.ignored) for frame in frames)
    assert any(len(frame.boxes) for frame in frames)
    return frames


@pytest.mark.parametrize("mirrored", [False, True])
def test_negatives_show_no_vehicle(mirrored):
    params = dataclasses.replace(SMALL_MIXTURE, mirrored=(mirrored,))
    weights = np.random.default_rng(0).normal(0, 0.05, (7, 8, N_CHANNELS))
    views = with_mirrored([MixtureTemplate(weights, 0.0, (1.0, 1.0))], params.mirrored)
    total = 0
    for frame in frames_with_ignored():
        for mined in (random_windows(frame, 1, views, params), mine_windows(frame, views, params)):
            total += len(mined)
            assert len(mined) <= params.max_per_frame * len(views)
            assert len({place for _, place, _ in mined}) == len(mined)
            assert all(index == 0 and features.shape == (weights.size,) for index, _, features in mined)
    assert total > 20


def test_negatives_of_border_templates():
    weights = np.random.default_rng(0).normal(0, 0.05, (7, 6, N_CHANNELS))
    views = with_mirrored([MixtureTemplate(weights, 0.0, (1.0, 1.0), True)], (False,))
    total = 0
    for frame in frames_with_ignored():
        mined = mine_windows(frame, views, SMALL_MIXTURE)
        total += len(mined)
        assert len({place for _, place, _ in mined}) == len(mined)
        assert all(index == 0 and features.shape == (weights.size,) for index, _, features in mined)
        ends = {place[3] for _, place, _ in mined}
        assert ends <= {2 * end + left for left in (0, 1) for end in (0, 107, 178, 249, 356)}
    assert total > 20


def test_truncated_labels():
    frame = TrainingFrame(
        np.zeros((90, 160, 3), np.uint8),
        np.array([[10.0, 20, 50, 60], [70, 20, 120, 60], [130, 10, 160, 50]]),
        np.array([[60.0, 0, 100, 90]]),
        0.0,
    )
    left, right = truncate_labels(frame, 90, left=False), truncate_labels(frame, 90, left=True)
    assert left.boxes.tolist() == [[10, 20, 50, 60], [70, 20, 90, 60]]
    assert right.boxes.tolist() == [[90, 20, 120, 60], [130, 10, 160, 50]]
    assert (left.ignored.tolist(), right.ignored.tolist()) == ([[60, 0, 90, 90]], [[90, 0, 100, 90]])


def test_negatives_follow_from_the_labels():
    frame = frames_with_ignored()[0]
    rng = np.random.default_rng(2)
    corners = rng.uniform(0, 300, (500, 2))
    boxes = np.hstack([corners, corners + rng.uniform(20, 90, (500, 2))])
    negative = boxes[is_negative(boxes, frame)]
    assert 0 < len(negative) < 500
    assert (negative[:, 2] - negative[:, 0] >= 35).all()
    if len(frame.boxes):
        assert iou_matrix(negative, frame.boxes).max() < 0.3
    if len(frame.ignored):
        areas = np.prod(negative[:, 2:] - negative[:, :2], axis=1)
        assert (intersection_matrix(negative, frame.ignored).max(axis=1) < 0.3 * areas).all()
    for truth in (*frame.boxes, *frame.ignored):
        assert not is_negative(truth[None], dataclasses.replace(frame, min_labelled_width=0.0))[0]


def test_a_small_window_in_an_ignored_region_is_not_negative():
    labels = FrameBoxes([0], None, [[0.0, 0.0, 100.0, 50.0]], ignore=[True])
    frames = LabelledFrames("region", [np.zeros((90, 160, 3), np.uint8)], labels)
    (frame,) = load_training_frames([FrameDataset("region", (frames,))])
    windows = np.array([[40.0, 20.0, 60.0, 40.0], [90.0, 10.0, 120.0, 40.0], [85.0, 40.0, 135.0, 90.0]])
    assert is_negative(windows, frame).tolist() == [False, False, True]
    assert is_negative(np.empty((0, 4)), frame).tolist() == []


def test_a_negative_is_added_once():
    negatives = NegativePool([2, 3])
    one, two = np.ones(2, np.float32), np.full(3, 5, np.float32)
    assert negatives.add([(0, [(0, (0, 1, 2, 3), one), (1, (1, 1, 2, 3), two)])]) == 2
    assert negatives.add([(0, [(0, (0, 1, 2, 3), one)]), (1, [(0, (0, 1, 2, 3), 2 * one)])]) == 1
    assert [rows.tolist() for rows in negatives.rows] == [[[1, 1], [2, 2]], [[5, 5, 5]]]


def test_trimmed_negatives_are_not_added_again():
    template = MixtureTemplate(np.ones((1, 1, N_CHANNELS)), 0.0, (0.0, 0.0))
    negatives = NegativePool([N_CHANNELS])
    windows = [(0, (0, 0, 0, number), np.full(N_CHANNELS, number, np.float32)) for number in (3, 1, 4, 2)]
    negatives.add([(0, windows)])
    negatives.trim([template], 2)
    assert negatives.rows[0][:, 0].tolist() == [3, 4]
    assert negatives.add([(0, windows)]) == 0
