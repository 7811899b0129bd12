import multiprocessing
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper

from tests.network.graphs import PARAMS, echo_network, own_network, serialize
from tests.network.test_runtime import NO_OPENVINO, RUNTIMES
from vehicle_detection.boxes import iou_matrix, logit
from vehicle_detection.errors import ModelFileError
from vehicle_detection.network import NetworkParams, load_network
from vehicle_detection.network.model import to_log_odds, to_probability

IMAGE = np.random.default_rng(0).integers(0, 256, (360, 640, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "own.onnx"
    path.write_bytes(own_network())
    return path


@pytest.fixture(scope="module")
def model(file):
    return load_network(file, runtime="onnxruntime")


def find(model, image=IMAGE, params=None, *, jobs=1, score=0.0):
    with model.open_search(jobs=jobs) as search:
        return search.find(image, params, min_vehicle_score=score)


def check_equal(one, other):
    for name in ("windows", "vehicles"):
        np.testing.assert_array_equal(getattr(one, name).boxes, getattr(other, name).boxes)
        np.testing.assert_array_equal(getattr(one, name).scores, getattr(other, name).scores)


def test_a_file_of_the_library(model):
    assert (model.slope, model.offset, model.threshold, model.nms_iou) == (0.5, -0.25, -0.5, 0.6)
    assert model.metadata == {"frames": 12}
    assert model.classes == {0: "vehicle"}
    title, facts = model.summary()
    assert title == "network, threshold at a probability of 0.38"
    assert facts["input"] == "640 px"
    assert "0.38" in repr(model)


def test_windows_and_vehicles(model):
    found = find(model, score=-1.0)
    assert len(found.windows) > 10
    assert (found.windows.scores >= 0).all()
    assert (found.vehicles.scores >= -1).all()
    assert (found.vehicles.scores < 0).any()
    assert (np.diff(found.vehicles.scores) <= 0).all()
    overlap = iou_matrix(found.vehicles, found.vehicles)
    assert (overlap[~np.eye(len(overlap), dtype=bool)] <= model.nms_iou).all()
    few = find(model, params=NetworkParams(min_score=0.5))
    assert 0 < len(few.windows) < len(found.windows)
    assert (few.windows.scores >= 0.5).all()
    assert (few.vehicles.scores >= 0).all()


def test_the_probability_of_a_score(model):
    probabilities = np.array([0.2, 0.5, 0.99])
    scores = model.scores(probabilities)
    expected = 0.5 * np.array([logit(p) for p in probabilities]) - 0.25 + 0.5
    np.testing.assert_allclose(scores, expected)
    np.testing.assert_allclose([model.network_probability(each) for each in scores], probabilities, atol=1e-5)
    confidences = model.calibration.probability(scores)
    np.testing.assert_allclose(confidences, 1 / (1 + np.exp(-(expected - 0.5))))
    assert np.isfinite(to_log_odds(np.array([0.0, 1.0]))).all()
    assert to_probability(-1e6) == 0
    assert to_probability(1e6) == 1


def test_the_result_depends_on_nothing_but_the_frame(model):
    one = find(model)
    for jobs in (1, 2, 3):
        check_equal(one, find(model, jobs=jobs))
    image = IMAGE.copy()
    check_equal(one, find(model, image[::1]))
    np.testing.assert_array_equal(image, IMAGE)
    with model.open_search(jobs=1) as search:
        search.find(IMAGE[:100, :50])
        check_equal(one, search.find(IMAGE))
        search.close()
        check_equal(one, search.find(np.asfortranarray(IMAGE)))


@pytest.mark.skipif(NO_OPENVINO, reason="openvino is not installed")
def test_both_libraries_find_the_same(file, model):
    found = [find(model).windows, find(load_network(file, runtime="openvino")).windows]
    for one, other in found, found[::-1]:
        # Those with scores next to the threshold may be below it in the other one.
        boxes, scores = one.boxes[one.scores > 0.1], one.scores[one.scores > 0.1]
        distances = np.abs(boxes[:, None] - other.boxes).max(-1)
        assert len(boxes) > 100
        assert distances.min(1).max() <= 0.5
        first, second = map(model.calibration.probability, (scores, other.scores[distances.argmin(1)]))
        np.testing.assert_allclose(first, second, atol=0.02)


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_threads(file, runtime):
    images = [np.roll(IMAGE, 40 * shift, axis=1)[: 300 + 20 * (shift % 4)] for shift in range(8)]
    with load_network(file, runtime=runtime).open_search(jobs=2) as search, ThreadPoolExecutor(4) as pool:
        expected = [search.find(image) for image in images]
        for one, other in zip(expected * 3, pool.map(search.find, images * 3)):
            check_equal(one, other)


SEARCH = None


def search_in_child(_):
    return SEARCH.find(IMAGE).vehicles.boxes


@pytest.mark.skipif(sys.platform != "linux", reason="fork is safe on Linux only")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_a_forked_process(file, runtime):
    global SEARCH
    with load_network(file, runtime=runtime).open_search(jobs=2) as SEARCH:
        expected = SEARCH.find(IMAGE).vehicles.boxes
        with multiprocessing.get_context("fork").Pool(1) as pool:
            (boxes,) = pool.map_async(search_in_child, [0]).get(timeout=60)
            np.testing.assert_array_equal(boxes, expected)
        np.testing.assert_array_equal(SEARCH.find(IMAGE).vehicles.boxes, expected)


@given(st.integers(1, 400), st.integers(1, 400), st.integers(1, 10))
def test_boxes_are_inside_the_frame(model, height, width, steps):
    image = np.random.default_rng(height).integers(0, 256, (height, width, 3), dtype=np.uint8)
    found = find(model, image, NetworkParams(input_size=32 * steps), score=-9.0)
    for boxes in (found.windows.boxes, found.vehicles.boxes):
        assert (boxes[:, :2] >= 0).all()
        assert (boxes[:, 2:] <= (width, height)).all()
        assert (boxes[:, 2:] > boxes[:, :2]).all()


def test_a_file_that_is_too_large(file, monkeypatch):
    monkeypatch.setenv("VEHICLE_DETECTION_MAX_NETWORK_BYTES", "5000")
    with pytest.raises(ModelFileError, match="set VEHICLE_DETECTION_MAX_NETWORK_BYTES"):
        load_network(file)


def test_margins_of_boxes_are_trimmed_inside_the_frame(tmp_path):
    found = []
    for margins in ((0, 0, 0), (0.5, 0.01, 1)):
        (tmp_path / "own.onnx").write_bytes(own_network(params=PARAMS | {"margins": margins}))
        search = load_network(tmp_path / "own.onnx").open_search(jobs=1)
        found.append(search.find_candidates(IMAGE, search.params_type(), -9.0))
    both = np.isin(found[0].probabilities, found[1].probabilities)  # a box may have been a margin alone
    boxes = found[0].boxes[both]
    moved = found[1].boxes - boxes
    height, width = IMAGE.shape[:2]
    whole = ((boxes > 2) & (boxes < [width - 2, height, width - 2, height])).all(1)
    assert whole.sum() > 10
    assert (moved[whole] @ np.diag([1, 1, -1, 1]) >= 0).all()
    assert (moved[whole, :3] != 0).all()
    at_edge = boxes == [0, 0, width, height]
    assert at_edge.any()
    assert not moved[at_edge].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "format version 2, this release reads 1"),
        ({"params": PARAMS | {"slope": -1}}, "slope"),
        ({"params": PARAMS | {"slope": "steep"}}, "steep"),
        ({"params": PARAMS | {"nms_iou": 2}}, "nms_iou"),
        ({"params": PARAMS | {"margins": [1, -2, 0]}}, "margins"),
        ({"params": PARAMS | {"input_size": 100}}, "multiple of 32"),
        ({"size": (64, "width")}, "both sides fixed"),
    ],
)
def test_a_file_that_does_not_fit_itself(tmp_path, change, message):
    file = tmp_path / "own.onnx"
    file.write_bytes(own_network(**change))
    with pytest.raises(ModelFileError, match=message) as raised:
        load_network(file)
    assert "own.onnx" in str(raised.value)


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_invalid_weights(tmp_path, runtime):
    file = tmp_path / "own.onnx"
    file.write_bytes(own_network(weights=np.nan))
    with pytest.raises(ModelFileError, match=r"own.onnx computes invalid values: scores are not finite"):
        find(load_network(file, runtime=runtime))


@pytest.mark.parametrize("dtype", ["uint8", "float32", "float16"])
@pytest.mark.parametrize("layout", ["NCHW", "NHWC"])
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_input_layouts(tmp_path, dtype, layout, runtime):
    # The box has the means of red and green as its center: 0.2 and 0.4 of 255, or of 1.
    frame = np.full((64, 64, 3), (20, 30, 24), np.uint8)
    file = tmp_path / "echo.onnx"
    file.write_bytes(echo_network(dtype=dtype, layout=layout))
    model = load_network(file, runtime=runtime)
    found = model.open_search(jobs=1).find(frame)
    center = np.array([20, 30]) / (1 if dtype == "uint8" else 255)
    sides = np.array([24 / (1 if dtype == "uint8" else 255), 10])
    corners = np.concatenate([center - sides / 2, center + sides / 2]).clip(0, 64)
    np.testing.assert_allclose(found.vehicles.boxes, [corners], atol=0.02)


@pytest.mark.parametrize(
    "inputs",
    [
        [],
        [("images", "float32", [8, 3, 64, 64])],
        [("images", "float32", [1, 1, 64, 64])],
        [("images", "float32", [1, 3, 64])],
        [("images", TensorProto.INT32, [1, 3, 64, 64])],
        [("images", "float32", [1, 3, 64, 64]), ("mask", "float32", [1, 64, 64])],
    ],
)
def test_other_inputs(tmp_path, inputs):
    file = tmp_path / "other.onnx"
    node = helper.make_node("Identity", ["values"], ["output0"])
    values = np.zeros((1, 84, 84), np.float32)
    output = ("output0", "float32", values.shape)
    file.write_bytes(serialize([node], inputs, [output], [("values", values)]))
    with pytest.raises(ModelFileError, match=r"other\.onnx must have one input, float32, float16 or uint8"):
        load_network(file)


def test_a_reduced_frame_has_the_same_vehicles_in_pixels_of_the_whole_frame(model):
    whole = IMAGE.repeat(2, axis=0).repeat(2, axis=1)
    with model.open_search(jobs=1) as search:
        factor = search.reduction(whole.shape, NetworkParams())
        expected = search.find(whole, min_vehicle_score=-1.0)
        found = search.find(IMAGE, min_vehicle_score=-1.0).enlarged(factor)
    assert (factor, found.shape) == (2, (720, 1280))
    assert len(found.vehicles)
    check_equal(found, expected)
