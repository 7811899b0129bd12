"""A small, fixed part of the random and damaged inputs; ``python -m tools.fuzz`` tries more."""

import pytest

from tools import fuzz


@pytest.mark.parametrize("kind", list(fuzz.KINDS))
def test_only_errors_of_the_library_come_back(kind):
    count = fuzz.SHORT[kind]
    tried, refused, problems = fuzz.fuzz(kind, count=count)
    assert problems == []
    assert tried == count
    assert refused > tried / 4, "the inputs are too harmless"


def test_an_error_of_another_class_is_a_problem(monkeypatch):
    def cases(folder, rng):
        yield "division", lambda: 1 / 0
        yield "own", lambda: fuzz.vd.read_image("missing.png")
        yield "none", lambda: 3

    monkeypatch.setitem(fuzz.KINDS, "images", cases)
    tried, refused, problems = fuzz.fuzz("images")
    assert (tried, refused) == (3, 1)
    assert problems == ["images seed 0 number 0: division: ZeroDivisionError: division by zero"]
