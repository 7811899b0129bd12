"""Run the core tests with the oldest supported versions of all dependencies, or with the newest.

``python -m tools.compatibility oldest`` installs the lower bounds of ``pyproject.toml`` into a new virtual
environment and runs the tests; ``newest`` installs the newest versions. ``--python 3.13`` chooses the Python.
It needs the extra ``dev``, whose uv resolves the versions.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
RESOLUTIONS = {"oldest": "lowest-direct", "newest": "highest"}
TESTS = (
    "tests/test_features.py", "tests/test_search.py", "tests/test_boxes.py", "tests/test_heatmap.py",
    "tests/test_images.py", "tests/test_svm.py", "tests/test_detector.py", "tests/network",
    "tests/tracking", "tests/datasets", "tests/test_sklearn_models.py", "tests/video/test_writing.py",
    "tests/cli/test_app.py",
)  # fmt: skip
"""Tests of the parts that depend most on other libraries."""


def install(kind: str, venv: Path, python: str) -> Path:
    """Create a virtual environment with the project and its tests; return its Python."""
    uv = [sys.executable, "-m", "uv"]
    subprocess.run([*uv, "venv", "--quiet", "--clear", "--python", python, str(venv)], check=True)
    executable = venv / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    install = [*uv, "pip", "install", "--quiet", "--python", str(executable)]
    subprocess.run([*install, "--resolution", RESOLUTIONS[kind], f"{ROOT}[test]"], check=True)
    return executable


def run_tests(executable: Path, venv: Path, tests: list[str]) -> bool:
    """Run tests of the source tree in an environment; return whether they pass."""
    # Old libraries warn about new ones, so warnings are no errors here.
    options = ["-q", "-n", "2", "--dist", "worksteal", "-W", "default", "-p", "no:cacheprovider"]
    # Without real data, and without a test that trains for minutes.
    options += ["-m", "not realdata", "-k", "not train_frames"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(venv / "numba")}
    command = [str(executable), "-m", "pytest", *options, *tests]
    return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode == 0


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=RESOLUTIONS)
    parser.add_argument("--python", default="3.11", help="version of Python; default: 3.11")
    parser.add_argument("--venv", type=Path, help="folder of the environment; default: a temporary one")
    parser.add_argument("--tests", nargs="+", default=list(TESTS), help="tests to run; default: the core")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="compatibility.") as folder:
        venv = options.venv or Path(folder) / "venv"
        passed = run_tests(install(options.kind, venv, options.python), venv, options.tests)
    sys.exit(not passed)


if __name__ == "__main__":
    main()
