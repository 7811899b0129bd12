import importlib.util
import subprocess
import sys

import numpy as np
import onnx
import pytest
from onnx import helper

from tests.network.graphs import own_network, serialize
from vehicle_detection.errors import DetectorError, InvalidInputError, ModelFileError
from vehicle_detection.network import load_network, open_session
from vehicle_detection.network.runtime import _multiplies_matrices

NO_OPENVINO = importlib.util.find_spec("openvino") is None
RUNTIMES = [
    "onnxruntime",
    pytest.param("openvino", marks=pytest.mark.skipif(NO_OPENVINO, reason="openvino is not installed")),
]


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_a_session_runs_inputs_of_any_size(runtime):
    session = open_session(own_network(), "the network", jobs=1, runtime=runtime)
    for height in (32, 64, 96, 128, 160, 192, 64):
        (boxes,) = session.run({"image": np.zeros((1, height, 64, 3), np.uint8)})
        assert boxes.shape == (1, 5, height // 16)
    with pytest.raises(DetectorError, match="the network failed on an input of shape"):
        session.run({"image": np.zeros((1, 8, 8, 3), np.uint8)})
    session.close()


def test_matrix_units_are_recognized(tmp_path):
    file = tmp_path / "cpuinfo"
    assert not _multiplies_matrices(file)
    file.write_text("flags : fpu avx2 avx512_vnni")
    assert not _multiplies_matrices(tmp_path / "." / "cpuinfo")
    amx = tmp_path / "amx"
    amx.write_text("flags : fpu amx_bf16 amx_tile amx_int8")
    assert _multiplies_matrices(amx)


def test_the_libraries_are_imported_on_first_use():
    code = (
        "import sys, vehicle_detection.network as n; assert not {'onnxruntime', 'openvino'} & {*sys.modules};"
        "n.open_session(open(sys.argv[1], 'rb').read(), 'it'); assert 'onnxruntime' in sys.modules"
    )
    file = "/dev/null"
    done = subprocess.run([sys.executable, "-c", code, file], capture_output=True, text=True)
    assert "ModelFileError: it" in done.stderr


def test_devices_and_runtimes(tmp_path, monkeypatch):
    file = tmp_path / "network.onnx"
    file.write_bytes(own_network())
    with pytest.raises(InvalidInputError, match="device must be one of 'cpu', 'cuda'"):
        load_network(file, device="gpu")
    with pytest.raises(InvalidInputError, match="runtime must be one of"):
        load_network(file, runtime="tensorrt")
    with pytest.raises(InvalidInputError, match="onnxruntime-gpu"):
        load_network(file, device="cuda")
    with pytest.raises(InvalidInputError, match=r"got 'openvino'; omit it|needs the package openvino"):
        load_network(file, device="cuda", runtime="openvino")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InvalidInputError, match="pip install"):
        load_network(file, runtime="openvino")


def external(folder):
    model = onnx.load_from_string(own_network())
    options = {"save_as_external_data": True, "location": "weights.bin", "size_threshold": 0}
    onnx.save(model, folder / "network.onnx", **options)
    return (folder / "network.onnx").read_bytes()


def custom(_):
    node = helper.make_node("Magic", ["images"], ["output0"], domain="com.example")
    return serialize([node], [("images", "float32", [1, 3, 64, 64])], [("output0", "float32", [1, 84, 84])])


BROKEN = {
    "text": (lambda _: b"not a network\n", "not a complete ONNX file; download"),
    "empty": (lambda _: b"", "not a complete ONNX file|export it again"),
    "cut": (lambda _: own_network()[:3000], "not a complete ONNX file; download"),
    "cut at the end": (lambda _: own_network()[:-40], "not a complete ONNX file; download"),
    "zip": (lambda _: b"PK\x03\x04rest", "PyTorch.*format=onnx"),
    "pickle": (lambda _: b"\x80\x02rest", "pickle"),
    "external data": (external, "weights in another file; store them in the file"),
    "custom operator": (custom, "operators that are not part of ONNX"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_files(tmp_path, capfd, kind):
    make, remedy = BROKEN[kind]
    file = tmp_path / "network.onnx"
    file.write_bytes(make(tmp_path))
    with pytest.raises(ModelFileError, match=remedy) as raised:
        load_network(file)
    assert "network.onnx" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert capfd.readouterr() == ("", "")
