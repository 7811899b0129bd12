"""A small, fixed part of the random and damaged inputs; ``python -m tools.fuzz`` tries more."""

import random

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


def test_a_file_elsewhere_is_a_problem(monkeypatch):
    def cases(folder, rng):
        yield "write", lambda: (folder.parent / "other").touch()

    monkeypatch.setitem(fuzz.KINDS, "images", cases)
    assert fuzz.fuzz("images")[2] == ["images seed 0 number 0: write: wrote {'other'}"]


def test_the_same_seed_damages_alike():
    data = bytes(range(256))
    first, second, third = (fuzz.mutate(data, random.Random(seed)) for seed in (1, 1, 2))
    assert first == second != third
