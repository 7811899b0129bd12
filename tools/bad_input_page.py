"""Write the page of the documentation that says what happens with bad input, function by function.

``python -m tools.bad_input_page`` calls every function and command with one bad value of each kind for each
argument, which takes some minutes, and writes ``docs/bad_input.md``. The tests make a part of these calls,
and fail if the page says something else or lacks a function.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

from tools.bad_input import COMMANDS_NOT_CALLED, MAX_SECONDS, NOT_CALLED, Outcome, run

PAGE = Path(__file__).parents[1] / "docs" / "bad_input.md"

KINDS = {
    "`None`": ("None", "`None`"),
    "negative number": ("negative", "`-1`, `0`, `-0.5`"),
    "huge integer": ("huge", "`10**400`, `2**63`"),
    "NaN, infinity": ("NaN", "`nan`, `inf`, `1e308`"),
    "empty": ("empty", '`""`, `[]`, `{}`, an array without rows'),
    "text": ("text", '`"x"`, `["x", "y"]`'),
    "wrong type": ("type", '`object()`, `True`, `b"x"`, `{1, 2}`, `1j`'),
    "ragged list": ("ragged", "`[1, [2, 3]]`, `[None]`"),
    "wrong number of items": ("items", "`(1,)`, `(1, 2, 3, 4, 5)`"),
    "wrong shape": ("shape", "an array of shape `(2, 3)`, a gray image"),
    "wrong dtype": ("dtype", "an array of text or objects, an image of integers or floats"),
    "invalid boxes": ("boxes", "boxes with NaN, or with the left edge right of the right one"),
    "tiny image": ("tiny", "images of 5 x 5, 0 x 5 and 1 x 1 pixels"),
    "impossible name": ("name", "file names of 5,000 characters, with lone surrogates or null bytes"),
    "missing file": ("missing", "`missing.csv`, a file in a missing folder"),
    "folder": ("folder", "a folder in place of a file"),
    "device": ("device", "a link to `/dev/zero`"),
}
"""Heading and examples of each kind of bad value."""

Outcomes = Mapping[str, Mapping[str, Outcome]]


def page(outcomes: Outcomes) -> str:
    """Return the text of the page."""
    functions = {name: row for name, row in outcomes.items() if not name.startswith("`")}
    commands = {name: row for name, row in outcomes.items() if name.startswith("`")}
    cells = [each for row in outcomes.values() for each in row.values()]
    refused, accepted = sum(each.refused for each in cells), sum(each.accepted for each in cells)
    skipped = "\n".join(f"- `{name}`: {why}" for name, why in {**NOT_CALLED, **COMMANDS_NOT_CALLED}.items())
    kinds = "\n".join(f"| {heading} | {examples} |" for heading, examples in KINDS.values())
    return f"""# Bad input, function by function

Each argument of each public function, constructor and method, and each option of the commands, was given
one bad value of each kind, while the others were valid. Of {refused + accepted:,} calls, {refused:,} ended
with an error of `vehicle_detection.errors`, or exit code 2 of a command; the value was valid in the other
{accepted:,}. No call raised another error, took longer than {MAX_SECONDS} s, or left a file after an error,
but for `tune --cache`, whose files save time the next time.
The text of an error names the argument, what was expected, what came and what to do.

`python -m tools.bad_input_page` makes these calls and writes this page. `tests/tools/test_bad_input.py` makes
a part of them, and fails if the page says something else or lacks a public function.

| kind | examples |
|---|---|
{kinds}

Not called:

{skipped}

## Functions

A cell is `x` if the kind is an error for all arguments, and `ok` if it is valid for all of them, such as
`None` for optional ones; `2 of 3` means that it is an error for two of three arguments.

{table(functions)}
## Commands

{table(commands)}"""


def table(outcomes: Outcomes) -> str:
    """Return a Markdown table, after a list of the functions for which each cell is an error."""
    strict = [name for name, row in outcomes.items() if {_cell(each) for each in row.values()} == {"x"}]
    kinds = [kind for kind in KINDS if any(kind in row for row in outcomes.values())]
    lines = [f"| | {' | '.join(KINDS[kind][0] for kind in kinds)} |", f"|---{'|---' * len(kinds)}|"]
    for name, row in outcomes.items():
        if name not in strict:
            cells = [_cell(row[kind]) if kind in row else "" for kind in kinds]
            lines.append(f"| {_code(name)} | {' | '.join(cells)} |")
    listed = f"All kinds are errors for {', '.join(map(_code, strict))}.\n\n" if strict else ""
    return listed + "\n".join(lines) + "\n"


def _code(name: str) -> str:
    return f"`{name.strip('`')}`"


def _cell(outcome: Outcome) -> str:
    total = outcome.refused + outcome.accepted
    return {0: "ok", total: "x"}.get(outcome.refused, f"{outcome.refused} of {total}")


def differences(outcomes: Outcomes, text: str) -> list[str]:
    """Name what a page does not say, or says differently, of the outcomes of some calls."""
    cells = _cells(text)
    found = [f"{_code(name)} is not on the page" for name in outcomes if _code(name) not in cells]
    names = {_code(name) for name in outcomes}
    found += [f"{name} is on the page, but was not called" for name in cells if name not in names]
    for name, row in outcomes.items():
        for kind, outcome in row.items():
            cell = cells.get(_code(name), {}).get(KINDS[kind][0], "x")
            if (cell == "x" and outcome.accepted) or (cell == "ok" and outcome.refused):
                found.append(f"{_code(name)}, {kind}: {cell} on the page, but {_cell(outcome)}")
    return found


def _cells(text: str) -> dict[str, dict[str, str]]:
    """Return the cells of a page by name and heading; functions without cells have errors only."""
    _, _, tables = text.partition("\n## Functions\n")
    found: dict[str, dict[str, str]] = {}
    headings: list[str] = []
    for line in tables.splitlines():
        if line.startswith("All kinds"):
            found.update((name, {}) for name in re.findall(r"`[^`]+`", line))
        if not line.startswith("|") or line.startswith("|---"):
            continue
        first, *rest = (part.strip() for part in line.strip("|").split("|"))
        if first:
            found[first] = dict(zip(headings, rest))
        else:
            headings = rest
    return found


def main() -> None:
    """Write the page, unless a call had another outcome than an error of the library or a valid result."""
    outcomes, problems = run("one")
    for problem in problems:
        print(problem)
    if not problems:
        PAGE.write_text(page(outcomes))
    sys.exit(bool(problems))


if __name__ == "__main__":
    main()
