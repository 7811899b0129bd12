import errno
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import vehicle_detection
from vehicle_detection._kernels.features import find_bins
from vehicle_detection._kernels.jit import _Compilation, _save


def test_compiling_kernels_is_logged_once_and_other_functions_are_not(caplog):
    compilation = _Compilation()
    functions = logging.getLogger, find_bins, find_bins
    with caplog.at_level(logging.INFO, "vehicle_detection._kernels"):
        for function in functions:
            dispatcher = SimpleNamespace(py_func=getattr(function, "py_func", function))
            started = SimpleNamespace(data={"dispatcher": dispatcher})
            compilation.on_start(started)
            compilation.on_end(started)
    assert [record.getMessage()[:9] for record in caplog.records] == ["compiling"]


def test_a_kernel_that_cannot_be_kept_is_used(caplog):
    def save(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with caplog.at_level(logging.INFO, "vehicle_detection._kernels"):
        _save(save, None, None)
    assert "compiled kernels are not kept: [Errno 28] No space left on device" in caplog.text
    assert find_bins._cache.save_overload.func is _save


@pytest.mark.skipif(sys.platform == "win32", reason="needs the permissions of POSIX")
@pytest.mark.parametrize("mode", [0o700, 0o777])
def test_a_read_only_installation_keeps_kernels_in_a_temporary_folder(tmp_path, mode):
    """Another user could put code into a folder that all may write."""
    package, temporary = tmp_path / "vehicle_detection", tmp_path / "tmp"
    ignored = shutil.ignore_patterns("__pycache__", "*.safetensors", "*.onnx")
    shutil.copytree(Path(vehicle_detection.__file__).parent, package, ignore=ignored)
    (package / "_kernels" / "__pycache__").write_text("no folder")
    temporary.mkdir()
    (temporary / f"vehicle-detection-kernels-{os.getuid()}").mkdir()
    (temporary / f"vehicle-detection-kernels-{os.getuid()}").chmod(mode)
    code = (
        "import numpy as np; from vehicle_detection._kernels.features import find_bins;"
        "find_bins(np.zeros((4, 4, 3)), np.arange(3.0), np.zeros((4, 4, 3), np.intp));"
        "print(sum(find_bins.stats.cache_hits.values()) if find_bins._cache.cache_path else 0)"
    )
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(tmp_path), "HOME": "/dev/null/home", "TMPDIR": str(temporary)}
    environment |= {"XDG_CACHE_HOME": "/dev/null/cache", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", code]
    options = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True}
    runs = [subprocess.run(command, check=mode == 0o700, **options) for _ in range(2)]
    if mode == 0o700:
        assert [run.stdout.strip() for run in runs] == ["0", "1"]
    expected = f"kernels are kept in {temporary}" if mode == 0o700 else "compiled in every process"
    assert [expected in run.stderr for run in runs] == [True, True]
    assert len(runs[0].stderr.splitlines()) == (1 if mode == 0o700 else 2)


def test_a_change_of_another_kernel_file_is_noticed(tmp_path):
    package = Path(vehicle_detection.__file__).parent
    copy = tmp_path / "vehicle_detection"
    shutil.copytree(package, copy, ignore=shutil.ignore_patterns("__pycache__", "*.safetensors"))
    code = (
        "import numpy as np; from vehicle_detection._kernels.features import find_bins;"
        "find_bins(np.zeros((4, 4, 3)), np.arange(3.0), np.zeros((4, 4, 3), np.intp));"
        "print(sum(find_bins.stats.cache_hits.values()))"
    )

    def hits():
        environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        command = [sys.executable, "-c", code]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        return int(done.stdout)

    assert hits() == 0
    assert hits() == 1
    with (copy / "_kernels" / "linear_svm.py").open("a") as file:
        file.write("# changed\n")
    assert hits() == 0
