"""Check what the project installs: the lock of the development environment, vulnerabilities and licences.

``python -m tools.supply_chain`` checks the lock against ``pyproject.toml``, asks pip-audit for known
vulnerabilities of the locked versions, and prints the licences of what the library itself installs.
``--update`` writes the lock again with the newest versions. Both need the extra ``dev``.
``pip install --require-hashes -r requirements/dev.lock`` installs the locked versions.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from email.message import Message
from importlib import metadata
from pathlib import Path
from typing import cast

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LOCK = ROOT / "requirements" / "dev.lock"
NAME = "vehicle-detection"
EXTRAS = ("dev", "docs")
"""Extras that the lock holds; ``dev`` includes the tests."""

UNLOCKED = ("openvino", "train")
"""Extras that the lock leaves out: large packages, of which each machine needs another build."""

HEADER = "# Written by: python -m tools.supply_chain --update\n"
_PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)(?:\s*;[^\\]*)?\s*\\?$")
_HASH = re.compile(r"^\s+--hash=sha256:[0-9a-f]{64}\s*\\?$")


@dataclass
class Pin:
    """A locked package: its version, and the number of files whose hash is known."""

    version: str
    hashes: int = field(default=0)


def read_lock(text: str) -> dict[str, list[Pin]]:
    """Return the versions of each package; there are several if they depend on the Python version.

    Raises
    ------
    ValueError
        If a line is neither a version, a hash nor a comment, such as an option, an address or a path.
    """
    pins: dict[str, list[Pin]] = {}
    last: Pin | None = None
    for number, line in enumerate(text.splitlines(), 1):
        pin = _PIN.match(line)
        if pin:
            last = Pin(pin[2])
            pins.setdefault(canonicalize_name(pin[1]), []).append(last)
        elif _HASH.match(line) and last is not None:
            last.hashes += 1
        elif line.strip() and not line.lstrip().startswith("#"):
            raise ValueError(f"line {number} of the lock is no version or hash: {line!r}")
    return pins


def direct_requirements(*, extras: bool = True) -> list[Requirement]:
    """Return what ``pyproject.toml`` requires; `extras` includes the extras but for `UNLOCKED`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = list(project["dependencies"])
    for name, part in project["optional-dependencies"].items() if extras else ():
        lines += part if name not in UNLOCKED else ()
    # Extras refer to others of the project itself.
    return [each for each in map(Requirement, lines) if canonicalize_name(each.name) != NAME]


def lock_problems(text: str, requirements: Iterable[Requirement]) -> list[str]:
    """Name what the lock lacks: hashes, and versions that fulfil the requirements."""
    try:
        pins = read_lock(text)
    except ValueError as error:
        return [str(error)]
    problems = [
        f"{name} {pin.version} has no hash" for name, each in pins.items() for pin in each if not pin.hashes
    ]
    for requirement in requirements:
        found = pins.get(canonicalize_name(requirement.name), [])
        if not found:
            problems.append(f"{requirement.name} is not in the lock")
        problems += [
            f"{requirement.name} {pin.version} does not fulfil {requirement}"
            for pin in found
            if not requirement.specifier.contains(pin.version, prereleases=True)
        ]
    return problems


def update_lock() -> None:
    """Write the lock with the newest versions, for all systems and Python versions."""
    extras = [word for extra in EXTRAS for word in ("--extra", extra)]
    options = ["--universal", "--python-version", "3.11", "--generate-hashes", "--no-header", "--quiet"]
    # Neither the address of an index nor the options of this machine belong in the file.
    options += ["--no-emit-index-url", "--no-emit-find-links", "--no-annotate", "--no-emit-package", NAME]
    command = [sys.executable, "-m", "uv", "pip", "compile", "pyproject.toml", *extras, *options]
    done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    LOCK.write_text(HEADER + done.stdout)


@dataclass(frozen=True)
class Licence:
    """Licence that an installed package states."""

    name: str
    version: str
    licence: str


def installed_packages(requirements: Iterable[Requirement]) -> Iterator[metadata.Distribution]:
    """Yield the installed packages that requirements need, directly or not, sorted by name."""
    found: dict[str, metadata.Distribution] = {}
    waiting = list(requirements)
    while waiting:
        requirement = waiting.pop()
        key = canonicalize_name(requirement.name)
        wanted = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if wanted and key not in found:
            found[key] = metadata.distribution(key)
            waiting += map(Requirement, found[key].requires or ())
    yield from (found[key] for key in sorted(found))


def licence_of(distribution: metadata.Distribution) -> Licence:
    """Return the licence that the metadata state: an SPDX expression, else classifiers, else free text."""
    fields = cast(Message, distribution.metadata)
    classifiers = [
        text.rpartition(" :: ")[2]
        for text in fields.get_all("Classifier") or ()
        if text.startswith("License ::") and text != "License :: OSI Approved"
    ]
    text = (fields.get("License") or "").strip().splitlines()
    stated = fields.get("License-Expression") or " and ".join(classifiers) or (text[0] if text else "")
    return Licence(str(fields["Name"]), distribution.version, str(stated))


def audit() -> bool:
    """Ask pip-audit for known vulnerabilities of the locked versions; return whether it found none."""
    # Strict: a package that the service does not know is a failure, not a pass.
    options = ["--strict", "--require-hashes", "--disable-pip", "--progress-spinner", "off", "-r", str(LOCK)]
    return subprocess.run([sys.executable, "-m", "pip_audit", *options], check=False).returncode == 0


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--update", action="store_true", help="write the lock again")
    parser.add_argument("--no-audit", action="store_true", help="do not ask for vulnerabilities (no network)")
    options = parser.parse_args()
    if options.update:
        update_lock()
    problems = lock_problems(LOCK.read_text(), direct_requirements())
    print(f"lock: {LOCK.read_text().count('==')} versions, {len(problems)} problems")
    rows = [licence_of(package) for package in installed_packages(direct_requirements(extras=False))]
    for row in rows:
        print(f"licence: {row.name} {row.version}: {row.licence or 'not stated'}")
    problems += [f"{row.name} states no licence" for row in rows if not row.licence]
    if not options.no_audit and not audit():
        problems.append("pip-audit found vulnerabilities, or could not ask for them")
    for problem in problems:
        print(f"problem: {problem}")
    sys.exit(bool(problems))


if __name__ == "__main__":
    main()
