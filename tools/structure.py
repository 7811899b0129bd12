"""Print the table of the structure: lines, files, imports, walks, and what is long.

``python -m tools.structure`` prints a row for each measure. A walk counts the files that one call passes
through, and the calls from one file to another: a frame of a video, and a lesson's call of ``find_cars``,
each after a first call that imports and compiles.
"""

import ast
import io
import sys
import threading
import tokenize
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "vehicle_detection"
OUTER = ("course", "drive", "notebook", "scenes", "cli")
LIMIT = 60  # lines of code in a function


def module_name(path: Path) -> str:
    """Return the name by which a file is imported."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def find_imports(path: Path, modules: set[str]) -> Iterator[str]:
    """Yield the modules of the package that a file imports anywhere, in functions and for types too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vehicle_detection"):
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in modules else str(node.module)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)


def find_circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules that import each other: strongly connected components."""
    reachable: dict[str, set[str]] = {}
    for start in graph:
        seen, waiting = set[str](), [start]
        while waiting:
            new = graph.get(waiting.pop(), set()) - seen
            seen |= new
            waiting += new
        reachable[start] = seen
    circles = {
        tuple(sorted(other for other in reachable[name] if name in reachable.get(other, ())))
        for name in graph
        if name in reachable[name]
    }
    return [list(circle) for circle in sorted(circles)]


def ring(name: str) -> str:
    """Return the outer ring of a module, or ``core``."""
    part = [*name.split("."), ""][1]
    return part if part in OUTER else "core"


def is_upward(name: str, other: str) -> bool:
    """Whether an import goes from the core to an outer ring, or between outer rings."""
    source, target = ring(name), ring(other)
    return target not in ("core", source) and source != "cli" and "__main__" not in name


def code_lines(source: str, node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines of code of a function: without docstring, comments and blank lines."""
    text = "".join(source.splitlines(keepends=True)[node.lineno - 1 : node.end_lineno])
    skip = {
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENDMARKER,
    }
    lines = set[int]()
    indent = len(text) - len(text.lstrip())
    unindented = "".join(line[indent:] or "\n" for line in text.splitlines(keepends=True))
    for token in tokenize.generate_tokens(io.StringIO(unindented).readline):
        if token.type not in skip:
            lines |= set(range(token.start[0], token.end[0] + 1))
    if ast.get_docstring(node) is not None:
        first = node.body[0]
        offset = node.lineno - 1
        lines -= set(range(first.lineno - offset, (first.end_lineno or first.lineno) - offset + 1))
    return len(lines)


def count_walk(call: Callable[[], object]) -> tuple[int, int]:
    """Count the files of the package that a call passes through, and the calls between files."""
    files, crossings = set[str](), 0
    folder = str(PACKAGE)

    def profile(frame: object, event: str, argument: object) -> None:
        nonlocal crossings
        if event != "call":
            return
        name = frame.f_code.co_filename  # type: ignore[attr-defined]
        if not name.startswith(folder):
            return
        files.add(name)
        caller = frame.f_back  # type: ignore[attr-defined]
        while caller is not None and not caller.f_code.co_filename.startswith(folder):
            caller = caller.f_back
        crossings += caller is None or caller.f_code.co_filename != name

    threading.setprofile(profile)
    sys.setprofile(profile)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return len(files), crossings


def read_test_image() -> np.ndarray:
    """Read a frame with two vehicles."""
    from vehicle_detection import read_image

    return read_image(ROOT / "test_images" / "road1.jpg")


def walk_frame() -> tuple[int, int]:
    """Count a frame of a video with the default model: search and tracking."""
    from vehicle_detection import VehicleDetector

    image, detector = read_test_image(), VehicleDetector()
    for step in range(5):
        detector.process(image, step / 25)
    return count_walk(lambda: detector.process(image, 5 / 25))


def walk_find_cars() -> tuple[int, int]:
    """Count a lesson's call, with a scaler and a linear SVM of scikit-learn."""
    from sklearn.preprocessing import StandardScaler
    from sklearn.svm import LinearSVC

    from vehicle_detection import course

    random = np.random.default_rng(0)
    features = random.normal(100, 10, size=(40, 8460))
    scaler = StandardScaler().fit(features)
    classifier = LinearSVC().fit(scaler.transform(features), np.arange(40) % 2)
    image = read_test_image()

    def call() -> object:
        # Values of 0-255, as the scaler was fitted on: of others it warns.
        return course.find_cars(image, 400, 656, 1.5, classifier, scaler, 9, 8, 2, (32, 32), 32, divide_by=1)

    call()
    return count_walk(call)


def measure() -> list[tuple[str, object, object]]:
    """Return the rows of the table: what, the measured value, the target."""
    import vehicle_detection

    sources = {path: path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}
    names = {module_name(path) for path in sources}
    graph = {module_name(path): {*find_imports(path, names)} - {module_name(path)} for path in sources}
    upward = [(name, other) for name, others in graph.items() for other in others if is_upward(name, other)]
    nodes = [
        (path, source, node)
        for path, source in sources.items()
        for node in ast.walk(ast.parse(source))
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    ]
    long = [
        (code_lines(source, node), f"{module_name(path)}.{node.name}")
        for path, source, node in nodes
        if path.parent.name != "cli"
    ]
    arguments = [
        (len(node.args.args) + len(node.args.kwonlyargs) - 1, module_name(path))
        for path, _, node in nodes
        if node.name == "__init__"
    ]
    lines = {path: source.count("\n") for path, source in sources.items()}
    longest = max(lines, key=lines.__getitem__)
    tests = sum(path.read_text().count("\n") for path in (ROOT / "tests").rglob("*.py"))
    frame, lesson = walk_frame(), walk_find_cars()
    return [
        ("lines of the library", sum(lines.values()), 33_000),
        ("subpackages", len({path.parent for path in sources}) - 1, 13),
        ("modules in the root", len(list(PACKAGE.glob("*.py"))), 18),
        ("public names", len(vehicle_detection.__all__), 110),
        ("circles of imports", len(find_circles(graph)), 0),
        ("upward imports", len(upward), 0),
        ("a frame of a video: files", frame[0], 15),
        ("a frame of a video: calls between files", frame[1], 200),
        ("a lesson's find_cars: files", lesson[0], 6),
        ("a lesson's find_cars: calls between files", lesson[1], 40),
        (f"longest module ({longest.relative_to(PACKAGE)})", lines[longest], 600),
        (f"functions over {LIMIT} lines of code, without commands", sum(n > LIMIT for n, _ in long), 0),
        (f"arguments of a constructor ({max(arguments)[1]})", max(arguments)[0], 8),
        ("lines of tests", tests, 27_000),
        ("words of the README", len((ROOT / "README.md").read_text().split()), 900),
        *((f"  circle: {' - '.join(circle)}", "", "") for circle in find_circles(graph)),
        *((f"  upward: {name} -> {other}", "", "") for name, other in upward),
        *((f"  long: {name}", count, LIMIT) for count, name in sorted(long, reverse=True) if count > LIMIT),
        *((f"  long: {path.relative_to(PACKAGE)}", n, 600) for path, n in lines.items() if n > 600),
    ]


if __name__ == "__main__":
    for what, value, target in measure():
        print(f"{what:80}{value!s:>8}{target!s:>8}")
