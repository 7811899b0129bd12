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


TINY = "from vehicle_detection._kernels.jit import jit\ntwice = jit(lambda x: 2 * x)\n"
USE_TINY = (
    "from vehicle_detection._kernels.tiny import twice; assert twice(2) == 4; "
    "print(sum(twice.stats.cache_hits.values()) if twice._cache.cache_path else 0)"
)


@pytest.mark.skipif(sys.platform == "win32", reason="needs the permissions of POSIX")
@pytest.mark.parametrize("mode", [0o700, 0o777])
def test_a_read_only_installation_keeps_kernels_in_a_temporary_folder(tmp_path, mode):
    """A folder that all may write could hold foreign code. A change of any kernel file is noticed."""
    package, temporary = tmp_path / "vehicle_detection", tmp_path / "tmp"
    ignored = shutil.ignore_patterns("__pycache__", "*.safetensors", "*.onnx")
    shutil.copytree(Path(vehicle_detection.__file__).parent, package, ignore=ignored)
    (package / "_kernels" / "__pycache__").write_text("no folder")
    (package / "_kernels" / "tiny.py").write_text(TINY)
    folder = temporary / f"vehicle-detection-kernels-{os.getuid()}"
    folder.mkdir(parents=True)
    folder.chmod(mode)
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(tmp_path), "HOME": "/dev/null/home", "TMPDIR": str(temporary)}
    environment |= {"XDG_CACHE_HOME": "/dev/null/cache", "PYTHONDONTWRITEBYTECODE": "1"}

    def run():
        options = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True}
        return subprocess.run([sys.executable, "-c", USE_TINY], check=True, **options)

    runs = [run()]
    if mode == 0o700:
        runs += [run()]
        with (package / "_kernels" / "linear_svm.py").open("a") as file:
            file.write("# changed\n")
        runs += [run()]
    assert [each.stdout.strip() for each in runs] == ["0", "1", "0"][: len(runs)]
    expected = f"kernels are kept in {temporary}" if mode == 0o700 else "compiled in every process"
    assert all(expected in each.stderr for each in runs)
    assert len(runs[0].stderr.splitlines()) == (1 if mode == 0o700 else 2)
