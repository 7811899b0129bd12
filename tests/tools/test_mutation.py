"""Changes of the library that a test should notice."""

import pytest

from tests.helpers import ROOT
from tools import mutation
from tools.mutation import mutants, target_files


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


def test_the_files_and_their_tests_exist():
    for path, tests in target_files([]).items():
        assert all((ROOT / test).exists() for test in tests)
        assert mutants(path.read_text())
    assert all((ROOT / test).exists() for test in mutation.OTHER_TESTS)
