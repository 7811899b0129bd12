import copy
import dataclasses
import pickle
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from sklearn.pipeline import make_pipeline
from sklearn.svm import LinearSVC

from tests.helpers import find_red
from tests.video.clips import write_clip
from vehicle_detection import Explorer, HeatParams, TrackTable, VehicleDetector, process_video
from vehicle_detection.errors import DetectorError, InvalidInputError
from vehicle_detection.evaluation import evaluate_tracks
from vehicle_detection.function_model import FunctionModel, FunctionParams, detector_from

SHAPE = (120, 200)
BOX = [40, 50, 80, 80]


def frame_with(*boxes, shape=SHAPE):
    frame = np.full((*shape, 3), 90, np.uint8)
    for x1, y1, x2, y2 in boxes:
        frame[y1:y2, x1:x2] = (240, 15, 15)
    return frame


def moved(step):
    return [BOX[0] + 2 * step, BOX[1], BOX[2] + 2 * step, BOX[3]]


def returning(boxes, scores=None):
    return lambda image: boxes if scores is None else (boxes, scores)


def test_a_function_detects_tracks_and_draws():
    detector = detector_from(find_red)
    frame = frame_with(BOX)
    found = detector.detect(frame)
    assert found.boxes.tolist() == [BOX]
    assert found.scores.tolist() == pytest.approx([np.log(9)])
    assert len(detector.detect(frame_with())) == 0
    results = [detector.process(frame_with(moved(step)), step / 25) for step in range(12)]
    truth = TrackTable(range(12), [1] * 12, [moved(step) for step in range(12)])
    scores = evaluate_tracks(TrackTable.from_results(results), truth)
    assert (scores.tp, scores.id_switches) == (12, 0)
    assert (detector.annotate(frame, results[-1]) != frame).any()


@pytest.mark.parametrize("jobs", [1, 3])
def test_a_function_annotates_a_video(tmp_path, jobs):
    clip = write_clip(tmp_path / "clip.mp4", [frame_with(moved(step)) for step in range(15)], fps="25")
    results = []
    options = {"jobs": jobs, "on_result": results.append}
    report = process_video(clip, tmp_path / "out.mp4", detector_from(find_red), **options)
    assert (report.frames, report.tracks) == (15, 1)
    assert [track.id for track in results[-1].shown] == [1]


@pytest.mark.parametrize(
    ("options", "scores", "expected"),
    [
        ({}, [0.5, 0.75, 0.18], [0, np.log(3), np.log(0.18 / 0.82)]),
        ({"threshold": 0.25}, [0.25, 0.5], [0, np.log(3)]),
        ({"score": "logit"}, [-1, 0, 7.5], [-1, 0, 7.5]),
        ({"score": "logit", "threshold": 1}, [1, 3], [0, 2]),
        ({"score": (10, 20)}, [10, 20, 5, 30], [0, 3, -1.5, 6]),
        ({"score": [0.3, 0.9]}, [0.3, 0.9], [0, 3]),
    ],
)
def test_scores_become_log_odds_above_the_threshold(options, scores, expected):
    boxes = [[10 * row, 0, 10 * row + 10, 10] for row in range(len(scores))]
    detector = detector_from(returning(boxes, scores), **options)
    found = detector.model.find(frame_with())
    np.testing.assert_allclose(found.scores, expected, atol=1e-9)
    # Still images show vehicles from 0 on; the tracker gets weaker boxes too.
    shown = np.array(expected) >= -1e-9
    assert len(detector.detect(frame_with())) == shown.sum()
    assert len(detector.search(frame_with()).vehicles) == (np.array(expected) >= -1.5).sum()


@pytest.mark.parametrize("class_ids", [[2], (2, 5), {2}, np.array([2, 7])])
def test_boxes_of_other_classes_are_dropped(class_ids):
    boxes = [BOX, [0, 0, 9, 9]]
    supervision = SimpleNamespace(xyxy=boxes, confidence=[0.9, 0.8], class_id=[2, 0])
    ultralytics = SimpleNamespace(xyxy=boxes, conf=[0.9, 0.8], cls=np.array([2.0, 0.0], np.float32))
    for result in (supervision, ultralytics, (boxes, [0.9, 0.8], [2, 0])):
        found = detector_from(returning(result), class_ids=class_ids).detect(frame_with())
        assert found.boxes.tolist() == [BOX]
        assert found.scores[0] == pytest.approx(np.log(9))
        assert len(detector_from(returning(result)).detect(frame_with())) == 2
    assert len(detector_from(returning([], []), class_ids=class_ids).detect(frame_with())) == 0


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (None, r"it must be \(boxes, scores\), .* with xyxy, as .*, got None; for an image without"),
        (([BOX], [0.9], ["car"]), "class_ids must be one number for .*; pass names of classes as labels"),
        (([[50, 50, 20, 20]], [0.5]), "boxes given as .x, y, width, height. need x"),
        (([BOX], [7.2]), 'got 7.2 to 7.2; pass score="logit"'),
    ],
)
def test_invalid_results_name_the_function_and_the_frame(result, message):
    detector = detector_from(returning(result), name="my_detector")
    start = "the function my_detector returned an invalid result for a frame of 200x120 pixels: "
    with pytest.raises(DetectorError, match=start + ".*" + message):
        detector.detect(frame_with())
    with pytest.raises(DetectorError, match=r"^frame 0: the function my_detector"):
        detector.process(frame_with())


def test_a_failing_function_is_named_with_its_frame(tmp_path):
    calls = []

    def failing(image):
        calls.append(None)
        if len(calls) > 4:
            raise RuntimeError("out of memory")
        return [], []

    detector = detector_from(failing)
    for _ in range(4):
        detector.process(frame_with())
    message = "^frame 4: the function failing failed on a frame of 200x120 .*: RuntimeError: out of memory"
    with pytest.raises(DetectorError, match=message) as caught:
        detector.process(frame_with())
    assert isinstance(caught.value.__cause__.__cause__, RuntimeError)
    clip = write_clip(tmp_path / "clip.mp4", [frame_with()] * 10, fps="25")
    calls.clear()
    with pytest.raises(DetectorError, match=r"^at 0.16 s: the function failing failed"):
        process_video(clip, tmp_path / "out.mp4", detector, jobs=1)
    assert not (tmp_path / "out.mp4").exists()


@pytest.mark.parametrize("thread_safe", [False, True])
def test_calls_wait_for_each_other_unless_the_function_is_thread_safe(thread_safe):
    running, most, lock = 0, 0, threading.Lock()
    together = threading.Barrier(4)

    def slow(image):
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        if thread_safe:
            together.wait(60)
        else:
            time.sleep(0.05)
        with lock:
            running -= 1
        return [], []

    detector = detector_from(slow, thread_safe=thread_safe)
    threads = [threading.Thread(target=detector.search, args=(frame_with(),)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == (4 if thread_safe else 1)


def test_a_function_has_the_interface_of_a_model():
    model = FunctionModel(function=find_red, score=(0, 8))
    assert model.summary() == ("function find_red", {"scores": "0 to 8", "threshold": "default"})
    with VehicleDetector(model) as detector:
        assert detector.detector.search_params == FunctionParams()
        assert detector.detector.searches_every_frame
    heat = detector_from(find_red, region_params=HeatParams(weighting="count", peak_fraction=0))
    assert heat.detect(frame_with(BOX)).boxes.tolist() == [BOX]
    explorer = Explorer([frame_with(BOX)], FunctionModel(function=find_red))
    assert explorer.boxes().boxes.tolist() == [BOX]
    explorer.set_search(min_score=5.0)
    assert len(explorer.windows()) == 0
    assert explorer.render().shape == (*SHAPE, 3)


def test_boxes_as_fractions_of_the_frame_are_rejected():
    detector = detector_from(returning([[0.1, 0.2, 0.4, 0.5], [0.5, 0.5, 1, 1]], [0.9, 0.8]))
    with pytest.raises(DetectorError, match=r"boxes must be in pixels, got 0\.1 to 1, .* multiply x by"):
        detector.detect(frame_with(BOX))
    for boxes in ([[0, 0, 0, 0]], [[0.1, 0.2, 0.4, 9]]):
        detector_from(returning(boxes, [0.9])).detect(frame_with(BOX))


@pytest.mark.parametrize(
    ("model", "remedy"),
    [
        (find_red, "model must not be a function, .*; pass it"),
        (LinearSVC(), "not be an estimator of scikit-learn.*from_pipeline"),
        (make_pipeline(LinearSVC()), r"VehicleClassifier.from_pipeline\(pipeline, params\)"),
    ],
)
def test_what_must_be_converted_to_a_model(model, remedy):
    with pytest.raises(InvalidInputError, match=remedy):
        VehicleDetector(model)


def test_copies_share_the_function_and_other_processes_get_it():
    detector = detector_from(find_red, score="probability")
    frame = frame_with(BOX)
    assert copy.deepcopy(detector).model is copy.copy(detector.model) is detector.model
    assert VehicleDetector(detector.model, conf=0.4).model._lock is detector.model._lock
    safe = dataclasses.replace(detector.model, thread_safe=True)
    assert type(dataclasses.replace(safe, thread_safe=False)._lock) is type(detector.model._lock)
    assert type(safe._lock) is not type(detector.model._lock)
    other = pickle.loads(pickle.dumps(detector))
    assert other.detect(frame).boxes.tolist() == detector.detect(frame).boxes.tolist() == [BOX]
    assert other.model.function is find_red
