"""Pages of the documentation site that are generated when it is built.

``docs/conf.py`` calls `write_pages`, which copies notebooks, model cards and the changelog into ``docs``,
takes sections of the README, and generates the pages of the command line and of the public names. Git
ignores all of them. Relative links are changed so that they hold on the site.
"""

from __future__ import annotations

import ast
import inspect
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]

# Copied files, and their places on the site; `docs` itself is the site's root.
COPIES = {
    "CHANGELOG.md": "docs/changelog.md",
    "CONTRIBUTING.md": "docs/contributing.md",
    "CODE_OF_CONDUCT.md": "docs/code_of_conduct.md",
    "SECURITY.md": "docs/security.md",
    "notebooks/README.md": "docs/notebooks/index.md",
    "vehicle_detection/models/default.md": "docs/models/default.md",
    "vehicle_detection/models/highway.md": "docs/models/highway.md",
}
COPIES |= {
    f"notebooks/{path.name}": f"docs/notebooks/{path.name}" for path in (ROOT / "notebooks").glob("*.ipynb")
}
PLACES = COPIES | {"README.md": "docs/index.md"}

# Sections of the README that pages of the site include.
README_SECTIONS = ("Start", "Your own video", "In a notebook")

# Pages of the API reference: name, title, and modules of the package whose public names they describe.
API_PAGES = (
    ("detect", "Detect and track", "detector results tracking boxes camera function_model"),
    ("video", "Video and drawing", "video annotator drawing images"),
    ("drive", "Events, reports and batches", "drive"),
    ("datasets", "Tables, files and data sets", "tables datasets"),
    ("models", "Models and training", "network svm training"),
    ("explain", "Explain and explore", "notebook"),
    ("course_steps", "Features, windows and heat maps", "features windows search heatmap regions course"),
    ("evaluation", "Evaluation", "evaluation"),
    ("scenes", "Rendered scenes", "scenes"),
    ("errors", "Errors", "errors"),
)
SUBPACKAGE_NAMES = {
    "boxes": "Platt",
    "datasets": (
        "find_near_duplicates Split split_groups split_leakage split_random split_sequences split_sources"
    ),
    "drive": (
        "batch_status batch_summary BatchReport BatchStatus cut_clips Event find_trips open_dask "
        "OwnSpeed Trip VehicleCounts"
    ),
    "evaluation": (
        "calibrate_scores calibration_error DetectionScores DistanceScores evaluate_distances Explanation "
        "precision_recall_curve TrackScores"
    ),
    "search": "SearchResult",
    "tracking": "HorizonEstimate SceneCuts",
    "training": (
        "compare_configurations compare_searches FrameDataset mine_negatives pareto_front "
        "PatchFeatures read_results TrainingReport TrialOptions"
    ),
    "video": "FrameSource TrackRun VideoReport",
}
"""Public names that are attributes of a subpackage or module, and not of the package."""
API_MODULES = ("notebook", "course")  # modules that have a page of their own

_LINK = re.compile(r"""(?P<start>\]\(|src=\\?")(?P<path>[^)"\\#\s:]+)(?P<end>#[^)"\\\s]*)?(?=[)"\\])""")


def move_links(text: str, source: str, target: str) -> str:
    """Change relative links so that they hold on the site.

    Parameters
    ----------
    text : str
        Markdown, or a notebook as JSON.
    source, target : str
        Place of the text in the repository, and where the site has it, relative to the repository's root.

    Examples
    --------
    >>> move_links("[log](../CHANGELOG.md#a), [b](b.md)", "docs/x.md", "docs/x.md")
    '[log](changelog.md#a), [b](b.md)'
    """

    def move(match: re.Match[str]) -> str:
        path = os.path.normpath(PurePosixPath(source).parent / match["path"])
        if not (ROOT / path).exists():
            return match[0]
        moved = os.path.relpath(PLACES.get(path, path), PurePosixPath(target).parent)
        return f"{match['start']}{PurePosixPath(moved)}{match['end'] or ''}"

    return _LINK.sub(move, text)


def read_section(text: str, title: str) -> str:
    r"""Return a section of a Markdown page, without its heading.

    Raises
    ------
    ValueError
        If there is no such section.

    Examples
    --------
    >>> read_section("# A\n## B\ntext\n## C\n", "B")
    'text'
    """
    found = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    if found is None:
        raise ValueError(f"no section {title!r}: change README_SECTIONS in {__name__}")
    return found[1].strip()


def public_names() -> dict[str, list[str]]:
    """Return the public names by the module that defines them: ``__init__.pyi`` and `SUBPACKAGE_NAMES`."""
    tree = ast.parse((ROOT / "vehicle_detection/__init__.pyi").read_text())
    names: dict[str, list[str]] = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            names.setdefault(node.module or "", []).extend(alias.name for alias in node.names)
    for module, others in SUBPACKAGE_NAMES.items():
        names[module] = [*names[module], *(f"{module}.{name}" for name in others.split())]
    return names


def api_pages() -> dict[str, str]:
    """Return the pages of the API reference, as reStructuredText by their file names.

    Raises
    ------
    ValueError
        If a public name is on no page, or `API_PAGES` names a module that has none.
    """
    names = public_names()
    unknown = {module for _, _, modules in API_PAGES for module in modules.split()} - names.keys()
    if unknown:
        raise ValueError(
            f"no public names from {', '.join(sorted(unknown))}; correct API_PAGES in {__name__}"
        )
    described = {name: names.get(name, []) for name in API_MODULES}
    pages = {}
    for page, title, modules in API_PAGES:
        found = sorted((name for module in modules.split() for name in names.pop(module)), key=_place_in_page)
        table = [".. autosummary::", "", *(f"   {name}" for name in found), ""]
        pages[f"{page}.rst"] = "\n".join(
            [*_heading(title), ".. currentmodule:: vehicle_detection", "", *table, *map(_directive, found)]
        )
    for name in API_MODULES:
        directive = [f".. automodule:: vehicle_detection.{name}", "   :members:"]
        directive += [f"   :exclude-members: {', '.join(described[name])}"] * bool(described[name])
        pages[f"{name}.rst"] = "\n".join([*_heading(f"vehicle_detection.{name}"), *directive, ""])
    missing = [name for module, rest in names.items() if module for name in rest]
    if missing:
        raise ValueError(f"public names without a page: {', '.join(missing)}; add their modules to API_PAGES")
    toctree = [".. toctree::", "   :maxdepth: 2", "", *(f"   {Path(page).stem}" for page in pages), ""]
    pages["index.rst"] = "\n".join([*_heading("API reference"), _API_INTRODUCTION, *toctree])
    return pages


_API_INTRODUCTION = """\
Names are attributes of the package or of a subpackage: ``import vehicle_detection as vd``, then
``vd.VehicleDetector`` and ``vd.training.mine_negatives``.
Images are ``(H, W, 3)`` uint8 RGB, boxes ``[x1, y1, x2, y2]`` in half-open pixels.
"""

_NOTEBOOKS_TOCTREE = """
```{toctree}
:hidden:
:glob:

[0-9]*
```
"""


def _place_in_page(name: str) -> tuple[bool, str]:
    """Order of names: the detector that most users need comes first."""
    return name != "VehicleDetector", name.lower()


def _heading(title: str) -> list[str]:
    return [title, "=" * len(title), ""]


def _place(name: str) -> str:
    """Return a name as Sphinx takes it in the module `vehicle_detection`: complete if it has a dot."""
    return f"vehicle_detection.{name}" if "." in name else name


def _directive(name: str) -> str:
    value = pkgutil.resolve_name(f"vehicle_detection.{name}")
    if not inspect.isclass(value):
        return f".. autofunction:: {_place(name)}\n"
    kind = "autoexception" if issubclass(value, BaseException) else "autoclass"
    return f".. {kind}:: {_place(name)}\n   :members:\n"


def command_page() -> str:
    """Return the page of the command line, as Markdown, generated by typer."""
    command = ["-m", "typer", "vehicle_detection.cli.app", "utils", "docs", "--name", "vehicle-detection"]
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, check=True, cwd=ROOT)
    return tidy_commands(done.stdout.replace("# `vehicle-detection`", "# Command line", 1))


def tidy_commands(page: str) -> str:
    """Complete the shortened descriptions of commands, and write arguments as the terminal does."""
    described = dict(
        re.findall(r"^## `vehicle-detection (\S+)`\n\n(.+?)\n\n", page, re.MULTILINE | re.DOTALL)
    )
    for name, text in described.items():
        full = " ".join(text.split()).replace("\\", r"\\")
        page = re.sub(rf"^(\* `{name}`): .*$", rf"\1: {full}", page, flags=re.MULTILINE)
    page = re.sub(r"^(\* `[A-Z][\w.]*) <[^>`]+>`", r"\1`", page, flags=re.MULTILINE)
    usage = re.compile(r"^\$ vehicle-detection .*$", re.MULTILINE)
    return usage.sub(
        lambda line: re.sub(r"\{([A-Z][\w.]*)\}(\.\.\.)?", r"\1", line[0]).replace("...]...", "...]"), page
    )


def write_pages(docs: Path) -> None:
    """Write all generated pages into the folder of the site; unchanged files keep their times."""
    pages = {docs / "cli.md": command_page()}
    for source, target in COPIES.items():
        pages[docs / Path(target).relative_to("docs")] = move_links(
            (ROOT / source).read_text(), source, target
        )
    pages[docs / "notebooks/index.md"] += _NOTEBOOKS_TOCTREE
    readme = (ROOT / "README.md").read_text()
    for title in README_SECTIONS:
        name = f"{title.lower().replace(' ', '_')}.md"
        section = move_links(read_section(readme, title), "README.md", "docs/index.md")
        pages[docs / "_readme" / name] = section + "\n"
    pages |= {docs / "api" / name: text for name, text in api_pages().items()}
    for path, text in pages.items():
        if not path.exists() or path.read_text() != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
