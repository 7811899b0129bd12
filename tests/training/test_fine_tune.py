import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch, the extra [train]")
pytest.importorskip("onnx", reason="export needs onnx, the extra [train]")

from tests.helpers import drawn  # noqa: E402
from tests.training.networks import shrink_samples, write_initial  # noqa: E402
from vehicle_detection.errors import InvalidInputError, ModelFileError  # noqa: E402
from vehicle_detection.evaluation import LabelledFrames  # noqa: E402
from vehicle_detection.network import load_network  # noqa: E402
from vehicle_detection.tables import TrackTable  # noqa: E402
from vehicle_detection.training import (  # noqa: E402
    FoldDetections,
    FrameDataset,
    detect_logits,
    fine_tune,
    fine_tune_network,
    fingerprint,
)
from vehicle_detection.training.fine_tune import hold_out  # noqa: E402

SOURCES = [FrameDataset("road", (drawn(range(5)),)), FrameDataset("coast", (drawn(range(5, 8), "coast"),))]


@pytest.fixture(scope="module")
def initial(tmp_path_factory):
    return write_initial(tmp_path_factory.mktemp("initial") / "initial.onnx")


@pytest.fixture(autouse=True)
def small_samples(monkeypatch):
    shrink_samples(monkeypatch)


def tune(initial, sources=SOURCES, **options):
    options = {"steps": 3, "jobs": 1, "device": "cpu"} | options
    return fine_tune_network(sources, initial=initial, **options)


def test_an_interrupted_training_continues_and_writes_the_same_file(initial, tmp_path):
    steps, checkpoint = [], tmp_path / "own.onnx.checkpoint"

    def interrupt(step, line):
        steps.append(step)
        if len(steps) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tune(initial, checkpoint=checkpoint, on_step=interrupt)
    assert checkpoint.exists()
    resumed = tune(initial, checkpoint=checkpoint, on_step=interrupt)
    assert steps == [1, 2, 2, 3]
    assert not checkpoint.exists()
    whole = tune(initial)
    assert whole.model.graph == resumed.model.graph

    assert [score.name for score in whole.after] == ["road", "coast"]
    assert [score.frames for score in whole.after] == [score.frames for score in whole.before] == [1, 1]
    facts = whole.model.metadata
    assert facts["metrics"]["held_out"]["road"] == whole.after[0].to_dict()
    assert facts["metrics"]["held_out_before"]["coast"] == whole.before[1].to_dict()
    assert facts["data"] == {"road": 5, "coast": 3, "held_out": 2, "sha256": fingerprint(SOURCES)}
    assert facts["training"].items() >= {"steps": 3, "random_state": 0, "device": "cpu"}.items()
    assert facts["versions"].keys() == {"vehicle_detection", "torch", "onnx", "onnxruntime"}
    # So few vehicles do not set the threshold.
    assert (whole.model.threshold, whole.model.slope, whole.model.input_size) == (-9.0, 1.0, 160)
    whole.model.save(tmp_path / "own.onnx")
    assert (tmp_path / "own.onnx").read_bytes() == whole.model.graph


def test_many_held_out_vehicles_set_calibration_and_threshold(initial, monkeypatch):
    monkeypatch.setattr(fine_tune, "best_threshold", lambda folds: -1.0)
    model = load_network(initial)
    folds = detect_logits(model, SOURCES, jobs=1)
    for minimum, slope, expected in (1, 2.0, (2.0, 0.5, -1.5)), (1, 99.0, None), (50, 2.0, None):
        monkeypatch.setattr(fine_tune, "_MIN_VEHICLES", minimum)
        monkeypatch.setattr(fine_tune, "fit_log_odds", lambda folds, slope=slope: (slope, 0.5))
        tuned = fine_tune._calibrate(model, folds)
        assert (tuned.slope, tuned.offset, tuned.threshold) == (expected or (1.0, 0.0, -9.0))


@pytest.mark.parametrize("right", [(1.0, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_many_held_out_vehicles_choose_the_margins(initial, monkeypatch, right):
    model = dataclasses.replace(load_network(initial), margins=(1.0, 0.0, 0.0))

    def detect(model, sources, jobs):
        boxes = numbered(60).labels.boxes + 2.0 * (model.margins != right)
        found = TrackTable(range(60), None, boxes, score=np.ones(60))
        return [FoldDetections("road", numbered(60), found)]

    monkeypatch.setattr(fine_tune, "detect_logits", detect)
    assert fine_tune._choose_margins(model, SOURCES, 1)[0].margins == right
    monkeypatch.setattr(fine_tune, "_MIN_FOR_MARGINS", 61)
    assert fine_tune._choose_margins(model, SOURCES, 1)[0].margins == model.margins


def test_one_frame_is_trained_on_and_not_evaluated(initial):
    tuned = tune(initial, [FrameDataset("road", (drawn([0]),))], steps=1)
    assert (tuned.before, tuned.after, tuned.folds) == ([], [], [])
    assert tuned.model.metadata["metrics"] == {"held_out": {}, "held_out_before": {}}
    assert tuned.model.metadata["data"]["held_out"] == 0


# --- hold_out ---


def numbered(count, vehicles=None, name="road"):
    """Frames of which those in `vehicles`, by default all, show one."""
    keys = list(range(count) if vehicles is None else vehicles)
    labels = TrackTable(keys, None, [[10, 10, 50, 40]] * len(keys), frame_keys=list(range(count)))
    return LabelledFrames(name, [np.zeros((60, 80, 3), np.uint8)] * count, labels)


def keys(sources):
    return [list(part.keys) for source in sources for part in source.sets]


def test_blocks_of_neighboring_frames_are_held_out():
    kept, held_out = hold_out([FrameDataset("road", (numbered(100),))])
    assert keys(held_out) == [[*range(20, 30), *range(70, 80)]]
    assert keys(kept) == [[key for key in range(100) if key not in keys(held_out)[0]]]
    assert len(held_out[0].sets[0].labels) == 20


def test_at_least_one_frame_is_held_out():
    assert keys(hold_out([FrameDataset("road", (numbered(2),))])[1]) == [[1]]
    many = [FrameDataset(name, (numbered(1, name=name),)) for name in "abc"]
    kept, held_out = hold_out(many)
    assert ([source.name for source in kept], [source.name for source in held_out]) == (["a", "b"], ["c"])


# --- bad input ---


def test_bad_input_is_refused_before_the_training(initial, tmp_path, monkeypatch):
    monkeypatch.setattr(fine_tune, "train_network", None)
    outside = TrackTable([1], None, [[300, 10, 350, 40]])
    beside = dataclasses.replace(numbered(2), labels=outside)
    for sources, message in (
        ([FrameDataset("road", (numbered(3, vehicles=[]),))], "sources must show at least one vehicle, got"),
        ([FrameDataset("road", (beside,))], r"road, frame 1: the box \[300.0, 10.0, .+ outside the 80x60"),
        ([], "sources must be a list of FrameDataset, one or more"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            tune(initial, sources)
    for options, message in (
        ({"steps": 0}, "steps must be an integer at least 1"),
        ({"random_state": -1}, "random_state must be an integer at least 0"),
        ({"device": "tpu"}, "device must be one of 'cpu', 'cuda'"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            tune(initial, **options)
    with pytest.raises(ModelFileError, match=r"none\.onnx"):
        tune(tmp_path / "none.onnx")


@pytest.mark.skipif(torch.cuda.is_available(), reason="has a CUDA device")
def test_cuda_needs_a_device(initial):
    with pytest.raises(InvalidInputError, match="device must be 'cpu', PyTorch finds no CUDA device"):
        tune(initial, device="cuda")
