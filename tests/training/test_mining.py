import math

import numpy as np
import pytest

from tests.training.trial_cases import SEARCH
from vehicle_detection import InvalidInputError, SearchBand, SearchParams, TrackTable, find_cars
from vehicle_detection.training import mine_negatives


def boxes_of(mined):
    """Frame and box of each mined patch, from its name."""
    parts = [name.removesuffix(".png").rsplit("/", 1)[1].rsplit("_", 3) for name in mined.names]
    corners = np.array([[int(x1), int(y1), int(side)] for _, x1, y1, side in parts]).reshape(-1, 3)
    boxes = np.concatenate([corners[:, :2], corners[:, :2] + corners[:, 2:]], axis=1)
    return [frame for frame, *_ in parts], boxes


def test_mined_windows_touch_no_label(scenes, labels, random_svm):
    images = {number: scene.image for number, scene in enumerate(scenes)}
    mined = mine_negatives(images, labels, random_svm, search_params=SEARCH, max_overlap=1.0)
    assert len(mined) > 10
    assert not mined.labels.any()
    assert set(mined.sources) == {"mined"}
    numbers, boxes = boxes_of(mined)
    for number, (left, top, right, bottom) in zip(numbers, boxes):
        for x1, y1, x2, y2 in labels.boxes[labels.rows(int(number))]:
            assert left >= x2 - 1 or right <= x1 + 1 or top >= y2 - 1 or bottom <= y1 + 1
    # Without labels, windows on vehicles are false positives as well.
    nothing = TrackTable([], None, [], frame_keys=(0, 1))
    unlabelled = mine_negatives(images, nothing, random_svm, search_params=SEARCH, max_overlap=1.0)
    assert len(unlabelled) > len(mined)
    assert len(unlabelled) == sum(len(find_cars(image, random_svm, SEARCH)) for image in images.values())


def test_a_mined_patch_is_the_window_that_was_searched(random_svm):
    # In a frame of this width, windows of 64 pixels are not resized: the patch is a crop of the frame.
    image = np.random.default_rng(3).integers(0, 256, (200, 1280, 3), np.uint8)
    search = SearchParams(bands=(SearchBand(window=(64, 64), y=(0, 100)),), horizon=0.25)
    nothing = TrackTable([], None, [], frame_keys=[0])
    mined = mine_negatives([image], nothing, random_svm, search_params=search)
    assert len(mined) > 5
    _, boxes = boxes_of(mined)
    for patch, (left, top, right, bottom) in zip(mined.patches, boxes):
        np.testing.assert_array_equal(patch, image[top:bottom, left:right])
    windows = find_cars(image, random_svm, search)
    scores = {tuple(box): score for box, score in zip(windows.boxes.astype(int).tolist(), windows.scores)}
    mined_scores = [scores[tuple(box)] for box in boxes.tolist()]
    assert mined_scores == sorted(mined_scores, reverse=True)


def test_options_limit_the_number_of_windows(frames, labels, random_svm):
    def count(**options):
        return len(mine_negatives(frames.frames, labels, random_svm, search_params=SEARCH, **options))

    assert count(max_overlap=0.0) < count() < count(max_overlap=1.0)
    assert count(min_score=1.0) < count() < count(min_score=-1.0)
    assert count(max_per_frame=2) == 4
    assert count(min_score=1e5) == 0
    everything = TrackTable([0, 1], None, [[0, 0, 640, 360]] * 2, ignore=np.array([True, True]))
    assert len(mine_negatives(frames.frames, everything, random_svm, search_params=SEARCH)) == 0


def test_invalid_arguments(frames, labels, random_svm):
    images = [image for _, image in frames]
    for arguments, message in (
        ((images, labels.renamed(str), random_svm), "must name the frames, such as 0"),
        ((images, [[0, 0, 5, 5]], random_svm), "labels must be .*, got"),
        ((7, labels, random_svm), "frames must be a list of images, a mapping .*, got 7"),
        (([images[0].astype(float)], labels, random_svm), r"frame 0 must be an \(H, W, 3\) uint8 RGB array"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            mine_negatives(*arguments)
    for options, message in (
        ({"max_overlap": 1.5}, "max_overlap must be a number, at least 0 and at most 1"),
        ({"max_per_frame": 0}, "max_per_frame must be an integer at least 1"),
        ({"min_score": math.nan}, "min_score must be a number"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            mine_negatives(images, labels, random_svm, **options)
