import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch, the extra [train]")
onnx = pytest.importorskip("onnx", reason="export needs onnx, the extra [train]")

from tests.training.networks import random_network  # noqa: E402
from vehicle_detection.errors import ModelFileError  # noqa: E402
from vehicle_detection.network import load_network, open_session  # noqa: E402
from vehicle_detection.training import (  # noqa: E402
    TrainingFrame,
    export,
    export_network,
    load_content,
    read_weights,
    set_metadata,
)
from vehicle_detection.training.pixel_groups import narrow, widen  # noqa: E402

PARAMS = {"input_size": 640, "slope": 1.5, "offset": -0.5, "threshold": 0.25, "nms_iou": 0.6}
IMAGE = np.random.default_rng(0).integers(0, 256, (96, 160, 3), np.uint8)
FRAMES = [TrainingFrame(IMAGE, np.zeros((0, 4)), np.zeros((0, 4)), "road")]


@pytest.fixture(scope="module")
def network():
    return random_network()


@pytest.fixture(scope="module")
def files(network):
    return {
        quantize: export_network(network, FRAMES, PARAMS, {"note": "random"}, quantize=quantize)
        for quantize in (False, True)
    }


def run(content):
    session = open_session(content, "test", jobs=1)
    (rows,) = session.run({"image": IMAGE[None]})
    session.close()
    return rows[0]


def run_torch(network):
    """The rows of the file, computed by PyTorch."""
    with torch.no_grad():
        (logits,), (boxes,) = network(torch.from_numpy(IMAGE)[None])
    corners = boxes.numpy()
    centers, sizes = (corners[:, :2] + corners[:, 2:]) / 2, corners[:, 2:] - corners[:, :2]
    return np.column_stack([centers, sizes, logits.sigmoid().numpy()]).T


def test_the_float_file_computes_what_pytorch_computes(network, files):
    np.testing.assert_allclose(run(files[False]), run_torch(network), rtol=1e-4, atol=1e-3)


def test_the_quantized_file_is_close_and_a_quarter_of_the_size(files):
    plain, small = run(files[False]), run(files[True])
    np.testing.assert_allclose(small[4], plain[4], atol=0.02)
    assert np.median(np.abs(small[:4] - plain[:4])) < 0.5
    assert len(files[True]) < 0.3 * len(files[False])
    assert len(files[True]) < 4e6


@pytest.mark.parametrize("quantize", [False, True])
def test_groups_of_pixels_change_no_result(quantize, network, files, monkeypatch):
    monkeypatch.setattr(export, "group_pixels", lambda graph: None)
    single = run(export_network(network, FRAMES, PARAMS, {}, quantize=quantize))
    np.testing.assert_allclose(run(files[quantize]), single, atol=0 if quantize else 1e-3, rtol=1e-4)


def test_kernels_on_groups_of_pixels():
    kernel = np.arange(4 * 3 * 9).reshape(4, 3, 3, 3)
    for pixels in 2, 4:
        wide = widen(kernel, pixels)
        assert wide.shape == (4 * pixels // 2, 3 * pixels, 3, 2)
        assert wide.sum() == kernel.sum() * pixels // 2
        np.testing.assert_array_equal(narrow(wide, 3), kernel)


def test_parameters_and_facts_are_in_the_file(files, tmp_path):
    path = tmp_path / "own.onnx"
    path.write_bytes(files[True])
    model = load_network(path)
    assert {name: getattr(model, name) for name in PARAMS} == PARAMS
    assert model.metadata == {"note": "random"}
    other = load_content(set_metadata(files[True], PARAMS | {"threshold": 1.0}, {"metrics": {}}))
    assert (other.threshold, other.metadata) == (1.0, {"metrics": {}})


def test_the_file_is_the_same_again(network, files):
    assert export_network(network, FRAMES, PARAMS, {"note": "random"}) == files[True]


# --- read_weights ---


def test_weights_of_a_float_file(network, files):
    read = read_weights(files[False], "own.onnx")
    np.testing.assert_allclose(run_torch(read), run_torch(network), rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(read.scale.detach(), network.scale.detach())


def test_weights_of_a_quantized_file(network, files):
    rows, expected = run_torch(read_weights(files[True], "own.onnx")), run_torch(network)
    np.testing.assert_allclose(rows[4], expected[4], atol=0.02)
    assert np.median(np.abs(rows[:4] - expected[:4])) < 0.5


def change(content, edit):
    model = onnx.load_model_from_string(content)
    edit(model.graph)
    return model.SerializeToString()


def test_files_of_other_kinds_are_refused(files):
    content = files[False]

    def drop(graph):
        graph.node.remove(next(node for node in graph.node if node.op_type == "Conv"))

    def rename(graph):
        next(node for node in graph.node if node.op_type == "Conv").name = "/other/Conv"

    def spoil(graph):
        kernel = next(each for each in graph.initializer if each.name == "network.output.weight")
        kernel.CopyFrom(onnx.numpy_helper.from_array(np.full((5, 64, 1, 1), np.nan, np.float32), kernel.name))

    def widen(graph):
        kernel = next(each for each in graph.initializer if each.name == "network.output.weight")
        kernel.CopyFrom(onnx.numpy_helper.from_array(np.zeros((6, 64, 1, 1), np.float32), kernel.name))

    cases = {
        "is no complete ONNX file; train": content[:1000],
        r"architecture \('stem.0.0'\); train from": change(content, drop),
        "not a network of this version's architecture": change(content, rename),
        "values that are not finite": change(content, spoil),
        r"output has the shape \(6, 64, 1, 1\), expected \(5, 64, 1, 1\)": change(content, widen),
    }
    for message, data in cases.items():
        with pytest.raises(ModelFileError, match=message):
            read_weights(data, "own.onnx")
