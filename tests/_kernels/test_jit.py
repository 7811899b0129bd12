import errno
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import vehicle_detection
from vehicle_detection._kernels.features import value_counts
from vehicle_detection._kernels.jit import _Compilation, _save


def test_compiling_kernels_is_logged_once_and_other_functions_are_not(caplog):
    compilation = _Compilation()
    functions = logging.getLogger, value_counts, value_counts
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
    assert value_counts._cache.save_overload.func is _save


def test_a_change_of_another_kernel_file_is_noticed(tmp_path):
    package = Path(vehicle_detection.__file__).parent
    copy = tmp_path / "vehicle_detection"
    shutil.copytree(package, copy, ignore=shutil.ignore_patterns("__pycache__", "*.safetensors"))
    code = (
        "import numpy as np; from vehicle_detection._kernels.features import value_counts;"
        "value_counts(np.zeros((4, 4, 3), np.uint8), np.zeros((3, 256), int));"
        "print(sum(value_counts.stats.cache_hits.values()))"
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
    with (copy / "_kernels" / "vector.py").open("a") as file:
        file.write("# changed\n")
    assert hits() == 0
