"""Change the library in one place at a time, and count the changes that no test notices.

``python -m tools.mutation`` draws a fixed sample of the changes of each file in `TARGETS`. Each one is tried
in a process of its own, which imports the changed module instead of the file: nothing is written, and numpy,
numba and pytest are imported only once. The tests that execute the changed line run first, the fastest ones
first, then those of the test file with the module's name, then the other tests of its folder. The survivors
are printed; ``--only`` tries those of an earlier output again.

Kernels that numba compiles are not changed: their tests compare them with references. Text, type annotations
and what is raised are not changed either. It needs the extra ``dev`` and a system that can fork.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import functools
import importlib
import itertools
import json
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import coverage
import pytest

ROOT = Path(__file__).parents[1]

_PACKAGE = "vehicle_detection"
TARGETS = {
    "features.py": ("tests/test_features.py",),
    "search.py": ("tests/test_search.py",),
    "heatmap.py": ("tests/test_heatmap.py",),
    "regions.py": ("tests/test_regions.py",),
    "windows.py": ("tests/test_windows.py",),
    "boxes.py": ("tests/test_boxes.py", "tests/evaluation/test_calibration.py"),
    "tracking": ("tests/tracking",),
    "network": ("tests/network",),
}
"""Files and folders of the package that are changed, with the tests of each."""

OTHER_TESTS = ("tests/test_detector.py", "tests/video/test_engine.py")
"""Further tests, which run for a change of a line that they execute."""

PRELOADED = ("cv2", "numba", "pandas", "scipy.ndimage", "scipy.optimize", "skimage.feature",
             "sklearn.svm")  # fmt: skip
"""Modules that are imported once for all processes. Importing them starts no thread of Python."""


# --- Changes of a module's syntax tree


@dataclass(frozen=True)
class Mutant:
    """A change of a file: its line, the code before and after, and where it is in the syntax tree."""

    line: int
    before: str
    after: str
    site: int
    variant: int


_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.MatMult: ast.Mult,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip
_FUNCTIONS = {
    "min": "max", "minimum": "maximum", "any": "all", "floor": "ceil", "argmin": "argmax", "cos": "sin",
    "exp": "expm1", "log": "log1p", "zeros": "ones", "round": "floor", "mean": "median", "sum": "max",
}  # fmt: skip
_FUNCTIONS |= {after: before for before, after in _FUNCTIONS.items() if after not in _FUNCTIONS}


def mutants(source: str) -> list[Mutant]:
    """Return all changes of a module.

    Examples
    --------
    >>> [(each.before, each.after) for each in mutants("half: int = whole // 2")]
    [('whole // 2', 'whole * 2'), ('2', '3')]
    """
    return [
        Mutant(getattr(node, "lineno", 0), _text(node), _text(after), site, variant)
        for site, (node, _, _) in enumerate(_sites(ast.parse(source)))
        for variant, after in enumerate(_variants(node))
    ]


def _text(node: ast.AST) -> str:
    """Return the first line of a node's code."""
    return ast.unparse(node).partition("\n")[0]


def mutate(source: str, mutant: Mutant) -> ast.Module:
    """Return the syntax tree of a module with one change."""
    tree = ast.parse(source)
    node, place, key = next(itertools.islice(_sites(tree), mutant.site, None))
    place[key] = ast.copy_location(list(_variants(node))[mutant.variant], node)
    return ast.fix_missing_locations(tree)


def _sites(node: ast.AST) -> Iterator[tuple[ast.AST, Any, Any]]:
    """Yield the nodes that may be changed, each with the list or dictionary that holds it, and its key."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            continue
        places: Any = enumerate(value) if isinstance(value, list) else [(name, value)]
        for key, each in places:
            if isinstance(each, ast.AST) and not _is_fixed(each):
                yield each, value if isinstance(value, list) else vars(node), key
                yield from _sites(each)


def _is_fixed(node: ast.AST) -> bool:
    """Whether a part of the tree stays as it is: text, errors, aliases of types and compiled functions."""
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.Import | ast.ImportFrom):
        return True
    if isinstance(node, ast.If):
        return ast.unparse(node.test).endswith("TYPE_CHECKING")
    if isinstance(node, ast.FunctionDef):
        decorators = [ast.unparse(each) for each in node.decorator_list]
        return any("jit" in each or each == "inlined" for each in decorators)
    if isinstance(node, ast.Assign):  # __all__, and aliases such as Floats = NDArray[np.float64] | None
        targets = [ast.unparse(each) for each in node.targets]
        return targets == ["__all__"] or (targets[0][:1].isupper() and not targets[0].isupper())
    called = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
    return called.startswith(("warnings.", "_logger.", "logger.", "jit("))


def _variants(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what a node is replaced by."""
    match node:
        case ast.Compare(left, [operator], right):
            yield ast.Compare(left, [_COMPARISONS[type(operator)]()], right)
        case ast.BinOp(left, operator, right):
            yield ast.BinOp(left, _OPERATORS.get(type(operator), ast.Add)(), right)
        case ast.BoolOp(ast.And(), values):
            yield ast.BoolOp(ast.Or(), values)
        case ast.BoolOp(ast.Or(), values):
            yield ast.BoolOp(ast.And(), values)
        case ast.UnaryOp(ast.Not() | ast.USub() | ast.Invert(), operand):
            yield operand
        case ast.Constant(bool() as value):
            yield ast.Constant(not value)
        case ast.Constant(int() as value):
            yield ast.Constant(value + 1)
        case ast.Constant(float() as value):
            yield ast.Constant(2 * value if value else 1.0)
        case ast.IfExp(test, body, orelse):
            yield ast.IfExp(ast.UnaryOp(ast.Not(), test), body, orelse)
        case ast.If(test, body, orelse):
            yield ast.If(ast.UnaryOp(ast.Not(), test), body, orelse)
        case ast.Expr(ast.Call()) | ast.AugAssign():
            yield ast.Pass()
        case ast.Continue():
            yield ast.Break()
        case ast.Call(ast.Name(name), arguments, keywords) if name in _FUNCTIONS:
            yield ast.Call(ast.Name(_FUNCTIONS[name], ast.Load()), arguments, keywords)
        case ast.Call(ast.Attribute(owner, name), arguments, keywords) if name in _FUNCTIONS:
            yield ast.Call(ast.Attribute(owner, _FUNCTIONS[name], ast.Load()), arguments, keywords)


# --- Processes that run tests


class _Finder(MetaPathFinder):
    """Import one module from a changed syntax tree."""

    def __init__(self, path: Path, code: CodeType) -> None:
        self.name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        self.path, self.code = path, code

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the module with the changed code, and None for other modules."""
        if fullname != self.name:
            return None
        loader = _Loader(fullname, str(self.path))
        loader.code = self.code
        return spec_from_file_location(fullname, self.path, loader=loader)


class _Loader(SourceFileLoader):
    code: CodeType

    def get_code(self, fullname: str) -> CodeType:
        """Return the changed code."""
        return self.code


def in_child(function: Callable[[], int], seconds: float, *, quiet: bool = True) -> int | None:
    """Call a function in a forked process; return its exit code, None after a time limit."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        code = 70
        try:
            os.setsid()
            silent = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2) if quiet else ():
                os.dup2(silent, stream)
            code = function()
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(code)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        finished, status = os.waitpid(child, os.WNOHANG)
        if finished:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def run_tests(tests: Sequence[str], *, mutated: tuple[Path, ast.Module] | None = None) -> int:
    """Run tests in this process up to the first failure; return pytest's exit code."""
    if mutated is not None:
        path, tree = mutated
        sys.meta_path.insert(0, _Finder(path, compile(tree, str(path), "exec")))
    # Plain assertions, because pytest would import modules with doctests by an import hook of its own.
    options = ["-x", "-q", "--assert=plain", "-p", "no:cacheprovider", "-p", "no:xdist"]
    return int(pytest.main([*options, *tests]))


class Recorder:
    """A plugin of pytest that records the lines which each test executes, and its time.

    The lines of a fixture of a module or session count for every test that uses it.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self.files = files
        self.coverage = coverage.Coverage(
            data_file=None, config_file=False, include=[str(path) for path in files]
        )
        self.tests: dict[str, dict[str, Any]] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:
        """Record the lines of a test, and its time."""
        self.coverage.switch_context(item.nodeid)
        start = time.perf_counter()
        result = yield
        self.tests[item.nodeid] = {
            "seconds": time.perf_counter() - start,
            "fixtures": list(getattr(item, "fixturenames", ())),
        }
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Iterator[None]:
        """Record the lines of a shared fixture."""
        shared = fixturedef.scope != "function"
        if shared:
            self.coverage.switch_context(f"fixture {fixturedef.argname}")
        result = yield
        if shared:
            self.coverage.switch_context(request._pyfuncitem.nodeid)
        return result

    def lines(self) -> dict[str, dict[int, list[str]]]:
        """Return the tests that execute each line of each file."""
        data = self.coverage.get_data()
        found = {}
        for path in self.files:
            contexts = data.contexts_by_lineno(str(path))
            found[str(path)] = {line: self._tests_of(set(names)) for line, names in contexts.items()}
        return found

    def _tests_of(self, contexts: set[str]) -> list[str]:
        fixtures = {name.removeprefix("fixture ") for name in contexts if name.startswith("fixture ")}
        tests = self.tests.items()
        return [name for name, test in tests if name in contexts or fixtures & {*test["fixtures"]}]


@dataclass(frozen=True)
class Baseline:
    """The tests of the unchanged library: seconds of each, and the tests that execute each line."""

    seconds: Mapping[str, float]
    lines: Mapping[str, Mapping[str, list[str]]]

    def tests_for(self, path: Path, line: int, own: Sequence[str], budget: float) -> list[str]:
        """Return tests of about `budget` seconds: those that execute a line, then others of its file.

        A line that only runs while its module is imported, such as a constant, is executed by no test.
        """
        covering = self.lines[str(path)].get(str(line), [])
        others = [name for name in self.seconds if name.startswith(tuple(own)) and name not in covering]
        named = [name for name in others if f"/test_{path.stem}.py::" in name]
        groups = covering, named, [name for name in others if name not in named]
        names = [name for group in groups for name in sorted(group, key=self.seconds.__getitem__)]
        ends = itertools.accumulate(self.seconds[name] for name in names)
        return [name for index, (name, end) in enumerate(zip(names, ends)) if end <= budget or index == 0]


def record(files: Sequence[Path], tests: Sequence[str]) -> Baseline:
    """Run tests of the unchanged library, and record them.

    Raises
    ------
    SystemExit
        If a test fails.
    """
    with tempfile.TemporaryDirectory(prefix="mutation.") as folder:
        out = Path(folder) / "baseline.json"

        def run() -> int:
            recorder = Recorder(files)
            recorder.coverage.start()
            code = int(pytest.main(["-q", "-p", "no:cacheprovider", "-p", "no:xdist", *tests], [recorder]))
            recorder.coverage.stop()
            seconds = {name: test["seconds"] for name, test in recorder.tests.items()}
            out.write_text(json.dumps({"seconds": seconds, "lines": recorder.lines()}))
            return code

        code = in_child(run, 3600, quiet=False)
        if code != 0:
            raise SystemExit(f"the tests of the unchanged library must pass; pytest's exit code is {code}")
        return Baseline(**json.loads(out.read_text()))


# --- The command


def target_files(names: Sequence[str]) -> dict[Path, tuple[str, ...]]:
    """Return the files to change, with their tests."""
    found: dict[Path, tuple[str, ...]] = {}
    for name, tests in TARGETS.items():
        place = ROOT / _PACKAGE / name
        files = sorted(place.glob("*.py")) if place.is_dir() else [place]
        found.update((path, tests) for path in files if path.name != "__init__.py")
    if names:
        found = {path: tests for path, tests in found.items() if str(path.relative_to(ROOT)) in names}
    return found


def sample(files: Sequence[Path], count: int, seed: int) -> Iterator[tuple[Path, Mutant]]:
    """Yield up to `count` changes of each file, the same ones for the same seed, in turns."""
    found = {path: mutants(path.read_text()) for path in files}
    for path, changes in found.items():
        random.Random(f"{seed} {path.name}").shuffle(changes)
    for turn in range(count):
        yield from ((path, changes[turn]) for path, changes in found.items() if turn < len(changes))


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", help="files of the package to change; default: all of TARGETS")
    parser.add_argument("--count", type=int, default=20, help="changes of each file; default: 20")
    parser.add_argument("--seed", type=int, default=1, help="seed of the sample; default: 1")
    parser.add_argument("--budget", type=float, default=10.0, help="seconds of tests of each; default: 10")
    parser.add_argument("--minutes", type=float, default=60.0, help="time limit; default: 60")
    parser.add_argument("--only", type=Path, help="an earlier output, whose survivors are tried again")
    options = parser.parse_args()
    files = target_files(options.files)
    for name in PRELOADED:
        importlib.import_module(name)
    tests = dict.fromkeys(test for own in files.values() for test in own)
    modules = [str(path.relative_to(ROOT)) for path in files]
    baseline = record(list(files), [*tests, *OTHER_TESTS, *modules])
    before = options.only.read_text().splitlines() if options.only else None
    counts = {path: [0, 0] for path in files}
    end = time.monotonic() + 60 * options.minutes
    for path, mutant in sample(list(files), options.count, options.seed):
        source, name = path.read_text(), str(path.relative_to(ROOT))
        text = f"{name}:{mutant.line}: {mutant.before} -> {mutant.after}"
        if time.monotonic() > end or (before is not None and text not in before):
            continue
        chosen = baseline.tests_for(path, mutant.line, (*files[path], name), options.budget)
        limit = 30 + 4 * sum(baseline.seconds[each] for each in chosen)
        call = functools.partial(run_tests, chosen, mutated=(path, mutate(source, mutant)))
        is_survivor = in_child(call, limit) == 0
        counts[path][is_survivor] += 1
        if is_survivor:
            print(text, flush=True)
    for path, (killed, survived) in counts.items():
        print(f"{path.relative_to(ROOT)}: {killed} killed, {survived} survived")
    killed, survived = (sum(column) for column in zip(*counts.values()))
    print(f"{killed} of {killed + survived} killed")
    sys.exit(bool(survived))


if __name__ == "__main__":
    main()
