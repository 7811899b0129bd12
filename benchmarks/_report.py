"""Measurements and their targets, as a table on the terminal and a JSON file."""

from __future__ import annotations

import contextlib
import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.table import Table

from vehicle_detection._common import JOBS_VARIABLE, available_cores, write_text

LIBRARIES = (
    "imageio-ffmpeg",
    "moviepy",
    "numba",
    "numpy",
    "opencv-python-headless",
    "scikit-image",
    "scikit-learn",
    "vehicle-detection",
)

ABOUT = 1.1
"""Factor of its value up to which an "about" target is met."""


@dataclass(frozen=True)
class Target:
    """The required value of a row: a bound, an exact value, or ``"about"`` a value or less."""

    sense: Literal["<=", ">=", "=", "about"]
    value: float

    def is_met(self, value: float) -> bool:
        """Compare a measured value with the target."""
        return {
            "<=": value <= self.value,
            ">=": value >= self.value,
            "=": value == self.value,
            "about": value <= self.value * ABOUT,
        }[self.sense]


def at_most(value: float) -> Target:
    """Target with an upper bound."""
    return Target("<=", value)


def at_least(value: float) -> Target:
    """Target with a lower bound."""
    return Target(">=", value)


@dataclass(frozen=True)
class Row:
    """One measurement; rows without a target are for information. `material` names the data."""

    what: str
    value: float
    _: KW_ONLY
    unit: str = ""
    target: Target | None = None
    material: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """``"met"``, ``"missed"``, or empty without a target."""
        if self.target is None:
            return ""
        return "met" if self.target.is_met(self.value) else "missed"

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        target = None if self.target is None else f"{self.target.sense} {self.target.value:g}"
        return {
            "what": self.what,
            "measured": round(float(self.value), 6),
            "unit": self.unit,
            "target": target,
            "verdict": self.verdict or None,
            "material": self.material,
            **({"details": dict(self.details)} if self.details else {}),
        }


Results = Mapping[str, Sequence[Row]]
"""Rows of each benchmark by its name."""


def machine_facts() -> dict[str, Any]:
    """Describe what the speed depends on, without identifying the machine."""
    return {
        "cores": available_cores(),
        "processor": _processor(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "jobs_variable": os.environ.get(JOBS_VARIABLE) or None,
        "libraries": {name: version(name) for name in LIBRARIES},
    }


def _processor() -> str:
    cpu = Path("/proc/cpuinfo")
    lines = cpu.read_text(encoding="utf-8").splitlines() if cpu.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def format_value(value: float, unit: str = "") -> str:
    """Format a number with about three digits and its unit."""
    if value == int(value) and abs(value) < 1e6:
        text = f"{int(value):,}"
    elif not unit and 0.5 <= abs(value) <= 1:
        text = f"{value:.4f}".rstrip("0")  # The last digits of fractions near 1 matter.
    else:
        text = f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"
    return f"{text} {unit}".rstrip()


def format_target(row: Row) -> str:
    """Format a row's target, with the row's unit."""
    if row.target is None:
        return ""
    sense = {"<=": "≤ ", ">=": "≥ ", "=": "", "about": "about "}[row.target.sense]
    return sense + format_value(row.target.value, row.unit)


def print_table(results: Results, console: Console | None = None) -> None:
    """Print all rows, one section per benchmark."""
    table = Table(title="vehicle_detection benchmarks", title_justify="left")
    table.add_column("what", overflow="fold")
    table.add_column("measured", justify="right", no_wrap=True)
    table.add_column("target", justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    styles = {"met": "green", "missed": "bold red"}
    for name, rows in results.items():
        table.add_section()
        materials = dict.fromkeys(row.material for row in rows if row.material)
        table.add_row(f"[bold]{name}[/bold] [dim]({'; '.join(materials)})[/dim]", "", "", "")
        for row in rows:
            verdict = f"[{styles[row.verdict]}]{row.verdict}[/]" if row.verdict else ""
            measured = format_value(row.value, row.unit)
            table.add_row(f"  {row.what}", measured, format_target(row), verdict)
    (console or Console()).print(table)


def write_json(results: Results, path: Path) -> None:
    """Write rows and machine facts; keep other benchmarks' rows if they are from the same machine."""
    facts = machine_facts()
    kept: dict[str, Any] = {}
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        earlier = json.loads(path.read_text(encoding="utf-8"))
        if earlier["machine"] == facts:
            kept = dict(earlier["benchmarks"])
    kept |= {name: [row.to_dict() for row in rows] for name, rows in results.items()}
    text = json.dumps({"machine": facts, "benchmarks": kept}, indent=2, ensure_ascii=False)
    write_text(path, text + "\n")
