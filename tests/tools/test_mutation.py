"""Changes of the library that a test should notice."""

import ast
import os
import subprocess
import sys

import pytest

from tests.helpers import ROOT
from tools import mutation
from tools.mutation import Baseline, mutants, mutate, target_files


def changes(source):
    return [(each.before, each.after) for each in mutants(source)]


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("y = x < 1", [("x < 1", "x <= 1"), ("1", "2")]),
        ("y = a @ b", [("a @ b", "a * b")]),
        ("y = a and b", [("a and b", "a or b")]),
        ("y = not x", [("not x", "x")]),
        ("y = -x", [("-x", "x")]),
        ("y = f(True, 0.0, 0.5)", [("True", "False"), ("0.0", "1.0"), ("0.5", "1.0")]),
        ("if x:\n    y = z", [("if x:", "if not x:")]),
        ("y = a if x else b", [("a if x else b", "a if not x else b")]),
        ("x += y", [("x += y", "pass")]),
        ("f(x)", [("f(x)", "pass")]),
        ("for x in y:\n    continue", [("continue", "break")]),
        ("warnings.warn('a', stacklevel=2)", [("warnings.warn('a', stacklevel=2)", "pass")]),
        ("y = np.minimum(x, z)", [("np.minimum(x, z)", "np.maximum(x, z)")]),
        ("y = min(z)", [("min(z)", "max(z)")]),
    ],
)  # fmt: skip
def test_changes(source, expected):
    assert changes(source) == expected


@pytest.mark.parametrize(
    "source",
    [
        'y = "text"',
        "Floats = NDArray[np.float64] | None",
        "__all__ = [1]",
        "def f(x: Literal[1]) -> Literal[2]:\n    raise ValueError(1 + 2)",
        "@jit\ndef f(x):\n    return x + 1",
        "if TYPE_CHECKING:\n    x = 1",
    ],
)
def test_what_is_not_changed(source):
    assert changes(source) == []


def test_a_change_is_made_in_one_place():
    source = "def f(x):\n    if x < 1 and x != 3:\n        g(x)\n    return [2 * x, max(x, 0)]"
    found = [ast.unparse(mutate(source, each)) for each in mutants(source)]
    assert len(found) == len(set(found)) == 11
    for text in found:
        pairs = zip(text.splitlines(), source.splitlines(), strict=True)
        assert sum(line != before for line, before in pairs) == 1


def test_tests_that_execute_the_line_come_first_then_those_of_the_module():
    path = ROOT / "a.py"
    names = ["tests/a.py::fast", "tests/a.py::slow", "tests/a.py::other"]
    seconds = dict(zip([*names, "tests/b.py::b"], (1.0, 5.0, 0.5, 0.1)))
    baseline = Baseline(seconds, {str(path): {"3": names[1::-1]}})
    assert baseline.tests_for(path, 3, ["tests/a.py"], 10) == names
    assert baseline.tests_for(path, 3, ["tests/a.py"], 2) == names[:1]
    assert baseline.tests_for(path, 4, ["tests/a.py"], 0.1) == names[2:]
    # No test executes the line.
    seconds = {"tests/test_b.py::b": 0.1, "tests/test_a.py::slow": 2.0, "tests/test_a.py::fast": 1.0}
    baseline = Baseline(seconds, {str(path): {}})
    names = ["tests/test_a.py::fast", "tests/test_a.py::slow", "tests/test_b.py::b"]
    assert baseline.tests_for(path, 1, ["tests"], 10) == names


def test_the_files_and_their_tests_exist():
    for path, tests in target_files([]).items():
        assert all((ROOT / test).exists() for test in tests)
        assert mutants(path.read_text())
    assert all((ROOT / test).exists() for test in mutation.OTHER_TESTS)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_survivors_are_printed_and_can_be_tried_again(tmp_path):
    (tmp_path / "package").mkdir()
    (tmp_path / "package/__init__.py").touch()
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = --doctest-modules\n")
    (tmp_path / "package/clip.py").write_text(
        'def clip(x, high=10):\n    """\n    >>> clip(3)\n    3\n    """\n    return min(x, high)\n'
    )
    (tmp_path / "test_clip.py").write_text(
        "from package.clip import clip\n\ndef test_clip():\n    assert clip(3) == 3\n"
    )
    code = (
        "from pathlib import Path\n"
        "from tools import mutation\n"
        "mutation.ROOT, mutation._PACKAGE = Path.cwd(), 'package'\n"
        "mutation.TARGETS, mutation.OTHER_TESTS = {'clip.py': ('test_clip.py',)}, ()\n"
        "mutation.PRELOADED = ()\n"
        "mutation.main()\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"

    def run(*options):
        command = [sys.executable, "-c", code, *options]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.stderr == ""
        return done.returncode, done.stdout.splitlines()

    returncode, lines = run()
    assert (returncode, lines[-3:]) == (
        1,
        ["package/clip.py:1: 10 -> 11", "package/clip.py: 1 killed, 1 survived", "1 of 2 killed"],
    )
    (tmp_path / "survivors.txt").write_text("\n".join(lines))
    with (tmp_path / "test_clip.py").open("a") as file:
        file.write("    assert clip(99) == 10\n")
    assert run("--only", "survivors.txt")[1][-1] == "1 of 1 killed"
    with (tmp_path / "test_clip.py").open("a") as file:
        file.write("    assert clip(99) == 11\n")
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert "the tests of the unchanged library must pass; pytest's exit code is 1" in done.stderr
