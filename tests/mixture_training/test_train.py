import dataclasses

import numpy as np
import pytest

from tests.helpers import SMALL_MIXTURE, drawn
from vehicle_detection.boxes import intersection_matrix, iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import FrameBoxes, LabelledFrames, evaluate_detections
from vehicle_detection.mixture import N_CHANNELS, MixtureSearch, MixtureTemplate, mirror_channels
from vehicle_detection.mixture_training import FrameDataset, train_mixture
from vehicle_detection.mixture_training import train as mixture_training
from vehicle_detection.mixture_training.negatives import (
    Frame,
    Negatives,
    cut_labels,
    frames_of,
    is_negative,
    mine_windows,
    random_windows,
    with_mirrored,
)
from vehicle_detection.params import PyramidParams


def found_in(model, frames, threshold=0.0):
    search = MixtureSearch(dataclasses.replace(model, threshold=threshold), n_jobs=1)
    sizes = PyramidParams(min_width=28)
    return FrameBoxes.from_detections({key: search.find(image, sizes).vehicles for key, image in frames})


# Training.


def test_drawn_vehicles_are_found_in_frames_that_were_not_trained_on(small_mixture):
    frames = drawn(range(100, 108))
    scores = evaluate_detections(found_in(small_mixture, frames, -0.3), frames.labels)
    assert scores.tp + scores.fn >= 12
    assert scores.average_precision > 0.9
    assert scores.mean_iou > 0.7


def test_the_same_seed_gives_the_same_file_for_any_number_of_threads(tmp_path, drawn_source, small_mixture):
    one, two = tmp_path / "one.safetensors", tmp_path / "two.safetensors"
    small_mixture.save(one)
    train_mixture([drawn_source], SMALL_MIXTURE, n_jobs=2).save(two)
    assert one.read_bytes() == two.read_bytes()


def test_another_seed_gives_another_model(drawn_source, small_mixture):
    other = train_mixture([drawn_source], SMALL_MIXTURE, n_jobs=1, random_state=1)
    assert (other.templates[0].weights != small_mixture.templates[0].weights).any()


def test_a_template_that_shows_a_side_gets_a_mirrored_one(drawn_source):
    params = dataclasses.replace(SMALL_MIXTURE, shapes=((6, 5), (8, 5)), facing=(False, True), rounds=(0.2,))
    lines = []
    found = train_mixture([drawn_source], params, n_jobs=1, on_step=lines.append)
    assert [template.box_cells for template in found.templates] == [(6, 5), (8, 5), (8, 5)]
    _, side, mirrored = found.templates
    expected = mirror_channels(side.weights.transpose(2, 0, 1)).transpose(1, 2, 0)
    np.testing.assert_array_equal(mirrored.weights, expected)
    assert mirrored.bias == side.bias
    assert lines[0].endswith(" vehicles")
    assert lines[1].startswith("round 1: ")


def test_vehicles_at_the_border_have_templates_of_their_own(drawn_source):
    params = dataclasses.replace(SMALL_MIXTURE, border_shapes=((4, 5), (6, 5)), rounds=(1.0,))
    found = train_mixture([drawn_source], params, n_jobs=1)
    assert [template.border for template in found.templates] == [False, True, True]
    assert [template.box_cells for template in found.templates] == [(6, 5), (4, 5), (6, 5)]
    other = train_mixture([drawn_source], dataclasses.replace(params, border_bias=0.5), n_jobs=1)
    added = [two.bias - one.bias for one, two in zip(found.templates, other.templates)]
    assert added == pytest.approx([0, 0.8, 0.8])
    # Vehicles that it does not know, in frames that end in their middle.
    values = []
    for frame in frames_of([FrameDataset("other", (drawn(range(100, 108)),))]):
        for box in frame.boxes:
            end = round((box[0] + box[2]) / 2)
            if box[2] - box[0] > 70 and end > 60:
                search = MixtureSearch(found, n_jobs=1)
                seen = search.candidates(np.ascontiguousarray(frame.image[:, :end]), PyramidParams())
                shown = np.array([[box[0], box[1], end, box[3]]])
                hit = (seen.templates > 0) & (iou_matrix(seen.boxes, shown)[:, 0] > 0.5)
                values.append(seen.scores[hit].max(initial=-2))
    assert len(values) > 2
    assert min(values) > -0.7


def test_the_solver_reaches_the_least_loss():
    from sklearn.svm import LinearSVC

    rng = np.random.default_rng(0)
    positives = rng.normal(0.3, 1, (80, 20)).astype(np.float32)
    negatives = rng.normal(-0.3, 1, (300, 20)).astype(np.float32)
    found = mixture_training._solve(positives, negatives, 0.01, 160.0, np.zeros(21), 500)
    # A large constant feature leaves the bias of scikit-learn's solver nearly free.
    svm = LinearSVC(C=0.01, intercept_scaling=30.0, tol=1e-6, max_iter=50_000, class_weight={1: 2.0, 0: 1.0})
    svm.fit(np.concatenate([positives, negatives]), [1] * 80 + [0] * 300)
    np.testing.assert_allclose(found[:20], svm.coef_[0], atol=2e-3)
    assert found[20] == pytest.approx(svm.intercept_[0], abs=5e-3)


# Negatives.


def frames_with_ignored():
    frames = frames_of([FrameDataset("drawn", (drawn(range(4)),), min_labelled_width=35.0)])
    assert any(len(frame.ignored) for frame in frames)
    assert any(len(frame.boxes) for frame in frames)
    return frames


@pytest.mark.parametrize("facing", [False, True])
def test_negatives_show_no_vehicle(facing):
    params = dataclasses.replace(SMALL_MIXTURE, facing=(facing,))
    weights = np.random.default_rng(0).normal(0, 0.05, (7, 8, N_CHANNELS))
    views = with_mirrored([MixtureTemplate(weights, 0.0, (1.0, 1.0))], params.facing)
    total = 0
    for frame in frames_with_ignored():
        for mined in (random_windows(frame, 1, views, params), mine_windows(frame, views, params)):
            total += len(mined)
            assert len(mined) <= params.per_frame * len(views)
            assert len({place for _, place, _ in mined}) == len(mined)
            assert all(index == 0 and features.shape == (weights.size,) for index, _, features in mined)
    assert total > 20


def test_negatives_at_the_border_show_no_part_of_a_vehicle():
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


def test_a_frame_that_ends_earlier_shows_less():
    frame = Frame(
        np.zeros((90, 160, 3), np.uint8),
        np.array([[10.0, 20, 50, 60], [70, 20, 120, 60], [130, 10, 160, 50]]),
        np.array([[60.0, 0, 100, 90]]),
        0.0,
    )
    left, right = cut_labels(frame, 90, left=False), cut_labels(frame, 90, left=True)
    assert left.boxes.tolist() == [[10, 20, 50, 60], [70, 20, 90, 60]]
    assert right.boxes.tolist() == [[90, 20, 120, 60], [130, 10, 160, 50]]
    assert (left.ignored.tolist(), right.ignored.tolist()) == ([[60, 0, 90, 90]], [[90, 0, 100, 90]])


def test_what_is_negative_is_told_by_the_labels():
    frame = frames_with_ignored()[0]
    rng = np.random.default_rng(2)
    corners = rng.uniform(0, 300, (500, 2))
    boxes = np.hstack([corners, corners + rng.uniform(20, 90, (500, 2))])
    sure = boxes[is_negative(boxes, frame)]
    assert 0 < len(sure) < 500
    assert (sure[:, 2] - sure[:, 0] >= 35).all()
    if len(frame.boxes):
        assert iou_matrix(sure, frame.boxes).max() < 0.3
    if len(frame.ignored):
        areas = np.prod(sure[:, 2:] - sure[:, :2], axis=1)
        assert (intersection_matrix(sure, frame.ignored).max(axis=1) < 0.3 * areas).all()
    for truth in (*frame.boxes, *frame.ignored):
        assert not is_negative(truth[None], dataclasses.replace(frame, min_labelled_width=0.0))[0]


def test_a_small_window_in_a_region_to_ignore_is_no_negative():
    labels = FrameBoxes([0], None, [[0.0, 0.0, 100.0, 50.0]], ignore=[True])
    frames = LabelledFrames("region", [np.zeros((90, 160, 3), np.uint8)], labels)
    (frame,) = frames_of([FrameDataset("region", (frames,))])
    windows = np.array([[40.0, 20.0, 60.0, 40.0], [90.0, 10.0, 120.0, 40.0], [85.0, 40.0, 135.0, 90.0]])
    assert is_negative(windows, frame).tolist() == [False, False, True]
    assert is_negative(np.empty((0, 4)), frame).tolist() == []


def test_a_negative_is_kept_once():
    negatives = Negatives([2, 3])
    one, two = np.ones(2, np.float32), np.full(3, 5, np.float32)
    assert negatives.add([(0, [(0, (0, 1, 2, 3), one), (1, (1, 1, 2, 3), two)])]) == 2
    assert negatives.add([(0, [(0, (0, 1, 2, 3), one)]), (1, [(0, (0, 1, 2, 3), 2 * one)])]) == 1
    assert [rows.tolist() for rows in negatives.rows] == [[[1, 1], [2, 2]], [[5, 5, 5]]]


def test_the_easiest_negatives_go_for_good():
    template = MixtureTemplate(np.ones((1, 1, N_CHANNELS)), 0.0, (0.0, 0.0))
    negatives = Negatives([N_CHANNELS])
    windows = [(0, (0, 0, 0, number), np.full(N_CHANNELS, number, np.float32)) for number in (3, 1, 4, 2)]
    negatives.add([(0, windows)])
    negatives.trim([template], 2)
    assert negatives.rows[0][:, 0].tolist() == [3, 4]
    assert negatives.add([(0, windows)]) == 0


# What is refused.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shapes": ()}, "shapes must be a tuple of at least one entry; got"),
        ({"shapes": (6, 5)}, r"shapes must be \(columns, rows\) of cells each, such as .*; got 6"),
        ({"shapes": ((6, 1),)}, "shapes must be a number, at least 2"),
        (
            {"facing": (True, False)},
            r"facing must be True or False for each of 1 shapes; got \(True, False\)",
        ),
        ({"facing": (1,)}, "facing must be True or False"),
        ({"border_shapes": None}, "border_shapes must be a tuple; got None"),
        ({"border_shapes": (4, 7)}, r"border_shapes must be \(columns, rows\) of cells each"),
        ({"border_shapes": ((1, 7),)}, "border_shapes must be a number, at least 2"),
        ({"cuts": (0.5, 1.5)}, "cuts must be a number, greater than 0 and at most 1"),
        ({"border_bias": np.nan}, "border_bias must be a number"),
        ({"size_prior_weight": "much"}, "size_prior_weight must be a number"),
        ({"vote_weight": -0.1}, "vote_weight must be a number, at least 0"),
        ({"n_iterations": 0}, "looks must be an integer from 1"),
        ({"margin": -1}, "margin must be a number"),
        ({"C": 0}, "C must be a number, greater than 0"),
        ({"border_C": 0}, "border_C must be a number, greater than 0"),
        ({"border_jitter": 0}, "border_jitter must be an integer from 1"),
        ({"vehicles": 0}, "vehicles must be a number, greater than 0"),
        ({"min_width": 2}, "min_width must be a number, at least 8"),
        ({"near": -0.1}, "near must be a number"),
        ({"jitter": 0}, "jitter must be an integer from 1"),
        ({"shake": 0.5}, "shake must be a number"),
        ({"exposures": -1}, "exposures must be an integer from 0"),
        ({"rounds": ()}, "rounds must be a tuple of at least one entry"),
        ({"rounds": (0.5, 1.5)}, "rounds must be a number, greater than 0 and at most 1"),
        ({"per_frame": 0}, "per_frame must be an integer"),
        ({"max_negatives": 2.5}, "max_negatives must be an integer"),
        ({"search": None}, "search must be a PyramidParams, got None"),
    ],
)
def test_parameters_that_make_no_sense(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(SMALL_MIXTURE, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": ""}, "name must be a word for the source, got ''"),
        ({"name": 5}, "name must be a word for the source"),
        ({"sets": ()}, "sets must be a tuple of at least one entry"),
        ({"sets": None}, "sets must be a tuple of at least one entry; got None"),
        ({"sets": ("road",)}, "sets must be a LabelledFrames, got 'road'"),
        ({"min_labelled_width": -1}, "min_labelled_width must be a number, at least 0"),
    ],
)
def test_sources_that_make_no_sense(drawn_source, changes, message):
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(drawn_source, **changes)


def test_training_that_cannot_be(drawn_source):
    with pytest.raises(InvalidInputError, match="sources must be one or more; got 0: add labelled frames"):
        train_mixture([])
    with pytest.raises(InvalidInputError, match="sources must be a list of FrameDataset, got"):
        train_mixture(drawn_source)
    with pytest.raises(InvalidInputError, match="sources must be a FrameDataset, got LabelledFrames"):
        train_mixture([drawn_source.sets[0]])
    with pytest.raises(InvalidInputError, match="sources must have different names, got 'drawn' twice"):
        train_mixture([drawn_source, drawn_source])
    with pytest.raises(InvalidInputError, match="random_state must be an integer from 0"):
        train_mixture([drawn_source], random_state=-1)
    with pytest.raises(InvalidInputError, match="params must be a MixtureParams"):
        train_mixture([drawn_source], PyramidParams())
    odd = dataclasses.replace(SMALL_MIXTURE, shapes=((6, 5), (20, 3)), facing=(False, False))
    with pytest.raises(
        InvalidInputError, match="hold vehicles of every shape, got none like 20x3 that is 28"
    ):
        train_mixture([drawn_source], odd, n_jobs=1)
    empty = LabelledFrames(
        "empty", [np.zeros((90, 160, 3), np.uint8)], FrameBoxes([], None, [], frame_keys=[0])
    )
    with pytest.raises(InvalidInputError, match="sources must hold vehicles of every shape"):
        train_mixture([FrameDataset("empty", (empty,))], SMALL_MIXTURE, n_jobs=1)
