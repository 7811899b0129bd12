"""The lock of the development environment, and licences."""

import re

import pytest
from packaging.requirements import Requirement

from tools import supply_chain

HASH = f"    --hash=sha256:{'0' * 64}"
LOCK = (
    f"# A comment\nnumpy==2.1.0 \\\n{HASH} \\\n{HASH}\ncolorama==1.0 ; sys_platform == 'win32' \\\n{HASH}\n"
)


def test_the_lock_fulfils_the_project():
    text = supply_chain.LOCK.read_text()
    assert supply_chain.lock_problems(text, supply_chain.direct_requirements()) == []
    assert not re.search(r"https?:|file:|/opt|simple/|index|@", text), "the lock names no server and no path"


def test_a_lock_has_versions_and_hashes():
    pins = supply_chain.read_lock(LOCK)
    assert {name: [(pin.version, pin.hashes) for pin in found] for name, found in pins.items()} == {
        "numpy": [("2.1.0", 2)],
        "colorama": [("1.0", 1)],
    }


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("numpy==2.1.0\n", "numpy 2.1.0 has no hash"),
        (LOCK.replace("2.1.0", "1.9"), "numpy 1.9 does not fulfil numpy>=2.0"),
        (LOCK.replace("numpy", "scipy"), "numpy is not in the lock"),
        ("--index-url https://example.org/simple\n" + LOCK, "line 1 of the lock is no version or hash"),
        (LOCK + "tool @ file:///tool\n", "line 7 of the lock is no version or hash"),
    ],
)
def test_problems_of_a_lock(text, problem):
    assert problem in "\n".join(supply_chain.lock_problems(text, [Requirement("numpy>=2.0")]))


def test_what_the_library_installs_states_its_licence():
    packages = supply_chain.installed_packages(supply_chain.direct_requirements(extras=False))
    licences = {row.name: row for row in map(supply_chain.licence_of, packages)}
    assert {"numpy", "numba", "typer", "MarkupSafe"} <= set(licences)  # the last one is Jinja2's
    assert all(row.licence for row in licences.values())
