import dataclasses

import numpy as np
import pytest

from tests.helpers import SMALL_MIXTURE, drawn
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import FrameBoxes, LabelledFrames, evaluate_detections
from vehicle_detection.mixture import mirror_channels
from vehicle_detection.mixture_training import FrameDataset, train_mixture
from vehicle_detection.mixture_training.sources import load_training_frames
from vehicle_detection.mixture_training.train import _fit_svm
from vehicle_detection.params import PyramidParams


def found_in(model, frames, threshold=0.0):
    search = dataclasses.replace(model, threshold=threshold).open_search(n_jobs=1)
    sizes = PyramidParams(min_width=28)
    return FrameBoxes.from_detections({key: search.find(image, sizes).vehicles for key, image in frames})


def test_vehicles_are_found_in_new_frames(small_mixture):
    frames = drawn(range(100, 108))
    scores = evaluate_detections(found_in(small_mixture, frames, -0.3), frames.labels)
    assert scores.tp + scores.fn >= 12
    assert scores.average_precision > 0.9
    assert scores.mean_iou > 0.7


def test_the_same_seed_gives_the_same_file_for_any_number_of_threads(tmp_path, drawn_source, monkeypatch):
    monkeypatch.setattr("vehicle_detection.mixture_training.rescoring._EPOCHS", 1)
    params = dataclasses.replace(SMALL_MIXTURE, blend_weight=0.1)
    files = [tmp_path / f"{n_jobs}.safetensors" for n_jobs in (1, 2)]
    for n_jobs, file in enumerate(files, 1):
        train_mixture([drawn_source], params, n_jobs=n_jobs).save(file)
    one, two = (file.read_bytes() for file in files)
    assert one == two


def test_another_seed_gives_another_model(drawn_source):
    one, two = (train_mixture([drawn_source], SMALL_MIXTURE, n_jobs=1, random_state=seed) for seed in (0, 1))
    assert (one.templates[0].weights != two.templates[0].weights).any()


def test_a_mirrored_template_is_added(drawn_source):
    params = dataclasses.replace(
        SMALL_MIXTURE, shapes=((6, 5), (8, 5)), mirrored=(False, True), mining_schedule=(0.2,)
    )
    lines = []
    found = train_mixture([drawn_source], params, n_jobs=1, on_step=lines.append)
    assert [template.box_cells for template in found.templates] == [(6, 5), (8, 5), (8, 5)]
    _, side, mirrored = found.templates
    expected = mirror_channels(side.weights.transpose(2, 0, 1)).transpose(1, 2, 0)
    np.testing.assert_array_equal(mirrored.weights, expected)
    assert mirrored.bias == side.bias
    assert lines[0].startswith("vehicles per template: ")
    assert lines[1].startswith("round 1: ")


def test_border_templates(drawn_source):
    params = dataclasses.replace(SMALL_MIXTURE, border_shapes=((4, 5), (6, 5)), mining_schedule=(1.0,))
    found = train_mixture([drawn_source], params, n_jobs=1)
    assert [template.border for template in found.templates] == [False, True, True]
    assert [template.box_cells for template in found.templates] == [(6, 5), (4, 5), (6, 5)]
    other = train_mixture([drawn_source], dataclasses.replace(params, border_bias=0.5), n_jobs=1)
    added = [two.bias - one.bias for one, two in zip(found.templates, other.templates)]
    assert added == pytest.approx([0, 0.8, 0.8])
    # Vehicles of other frames, which end in the middle of each vehicle.
    margins = []
    search = found.open_search(n_jobs=1)
    for frame in load_training_frames([FrameDataset("other", (drawn(range(100, 108)),))]):
        for box in frame.boxes:
            end = round((box[0] + box[2]) / 2)
            if box[2] - box[0] > 70 and end > 60:
                _, seen = search.score_windows(np.ascontiguousarray(frame.image[:, :end]), PyramidParams())
                shown = np.array([[box[0], box[1], end, box[3]]])
                hit = (seen.templates > 0) & (iou_matrix(seen.boxes, shown)[:, 0] > 0.5)
                margins.append(seen.margins[hit].max(initial=-2))
    assert len(margins) > 2
    assert min(margins) > -0.7


def test_the_svm_solver_agrees_with_scikit_learn():
    from sklearn.svm import LinearSVC

    rng = np.random.default_rng(0)
    positives = rng.normal(0.3, 1, (80, 20)).astype(np.float32)
    negatives = rng.normal(-0.3, 1, (300, 20)).astype(np.float32)
    found = _fit_svm(positives, negatives, 0.01, 160.0, start=np.zeros(21), iterations=500)
    # A large constant feature leaves the bias of scikit-learn's solver nearly free.
    svm = LinearSVC(C=0.01, intercept_scaling=30.0, tol=1e-6, max_iter=50_000, class_weight={1: 2.0, 0: 1.0})
    svm.fit(np.concatenate([positives, negatives]), [1] * 80 + [0] * 300)
    np.testing.assert_allclose(found[:20], svm.coef_[0], atol=2e-3)
    assert found[20] == pytest.approx(svm.intercept_[0], abs=5e-3)


def test_invalid_training_arguments(drawn_source):
    with pytest.raises(
        InvalidInputError, match="sources must hold at least 1 data set, got 0; add labelled frames"
    ):
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
    empty = LabelledFrames(
        "empty", [np.zeros((90, 160, 3), np.uint8)], FrameBoxes([], None, [], frame_keys=[0])
    )
    with pytest.raises(InvalidInputError, match="sources must hold labelled vehicles that are whole"):
        train_mixture([FrameDataset("empty", (empty,))], SMALL_MIXTURE, n_jobs=1)


def test_shapes_that_no_vehicle_has_are_left_out(drawn_source):
    shapes = {"shapes": ((6, 5), (3, 9)), "mirrored": (False, True), "border_shapes": ((2, 9),)}
    params = dataclasses.replace(SMALL_MIXTURE, **shapes, aspect_tolerance=0.01)
    # Each vehicle belongs to the shape that is closest.
    steps: list[str] = []
    model = train_mixture([drawn_source], params, on_step=steps.append, n_jobs=1)
    assert (6.0, 5.0) in [template.box_cells for template in model.templates]
    assert (3.0, 9.0) not in [template.box_cells for template in model.templates]
    assert steps[0].startswith("no labelled vehicle has the proportions 3x9")


def test_frames_without_a_vehicle_that_is_wide_enough(drawn_source):
    params = dataclasses.replace(SMALL_MIXTURE, min_width=1000)
    with pytest.raises(
        InvalidInputError, match="must hold labelled vehicles that are whole and at least 1000"
    ):
        train_mixture([drawn_source], params, n_jobs=1)
