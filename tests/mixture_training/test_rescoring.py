import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tests.helpers import SMALL_MIXTURE, drawn
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.mixture import mirror_channels, rescoring_features
from vehicle_detection.mixture_training import FrameDataset, train_mixture
from vehicle_detection.mixture_training.rescoring import _mirror, _sample_boxes, train_rescorer
from vehicle_detection.mixture_training.sources import TrainingFrame, load_training_frames
from vehicle_detection.params import MixtureParams


def test_mirrored_features_equal_those_of_the_mirrored_image():
    image = np.random.default_rng(3).integers(0, 256, (96, 96, 3), dtype=np.uint8)
    whole = np.array([[16.0, 16.0, 80.0, 80.0]])
    seen = rescoring_features(image, whole)
    expected = rescoring_features(np.ascontiguousarray(image[:, ::-1]), whole)
    for found, wanted in zip(_mirror(seen), expected):
        np.testing.assert_allclose(found, wanted, atol=1e-4)
    channels = mirror_channels(seen[0].reshape(28, 12, 12))
    np.testing.assert_array_equal(_mirror(seen)[0].reshape(28, 12, 12), channels)


def test_a_trained_rescorer_separates_vehicles_from_clutter(small_mixture):
    rescorer = small_mixture.rescorer
    assert rescorer is not None
    assert rescorer.blend_weight == MixtureParams().blend_weight
    search, rng = small_mixture.open_search(n_jobs=1), np.random.default_rng(0)
    right, wrong = [], []
    for frame in load_training_frames([FrameDataset("others", (drawn(range(12, 18)),))]):
        vehicles, clutter = _sample_boxes(frame, search, SMALL_MIXTURE, rng)
        for boxes, values in (vehicles, right), (clutter, wrong):
            values += rescorer.decision_function(
                rescorer.project(*rescoring_features(frame.image, boxes))
            ).tolist()
    right, wrong = np.array(right), np.array(wrong)
    assert (right > 0).mean() > 0.9
    assert (wrong < 0).mean() > 0.8


def test_boxes_to_train_on_agree_with_the_labels(drawn_source, small_mixture):
    search = small_mixture.open_search(n_jobs=1)
    for frame in load_training_frames([drawn_source])[:4]:
        right, wrong = _sample_boxes(frame, search, SMALL_MIXTURE, np.random.default_rng(1))
        assert (iou_matrix(right, frame.boxes).max(axis=1, initial=0) > 0.5).all()
        assert (iou_matrix(wrong, frame.boxes).max(axis=1, initial=0) < 0.45).all()
        wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= SMALL_MIXTURE.min_width]
        np.testing.assert_array_equal(right[: len(wide)], wide)


def test_a_weight_of_zero_trains_no_rescorer(drawn_source):
    params = dataclasses.replace(SMALL_MIXTURE, blend_weight=0.0, mining_schedule=(0.5,))
    assert train_mixture([drawn_source], params, n_jobs=1).rescorer is None


def test_frames_without_vehicles_train_no_rescorer(small_mixture):
    search = small_mixture.open_search(n_jobs=1)
    empty = TrainingFrame(np.full((200, 356, 3), 90, np.uint8), np.empty((0, 4)), np.empty((0, 4)), 0.0)
    with ThreadPoolExecutor(1) as pool:
        assert train_rescorer([empty], search, SMALL_MIXTURE, np.random.default_rng(0), pool) is None
