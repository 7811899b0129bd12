"""The package's structure: layers, interfaces, imports, and the public names."""

import ast
import graphlib
import importlib
import inspect
import json
import subprocess
import sys
from pathlib import Path

import pytest

import vehicle_detection
from tools.bad_input import package_names
from vehicle_detection import errors

FOLDER = Path(vehicle_detection.__file__).parent
FILES = {".".join(path.relative_to(FOLDER).with_suffix("").parts): path for path in FOLDER.rglob("*.py")}
TREES = {name: ast.parse(path.read_text()) for name, path in FILES.items()}

# Everything else is the core, which imports from none of these.
OUTER = {"course", "drive", "notebook", "scenes", "cli"}
# The rings between which imports are allowed, beside those to the core.
ALLOWED = {("cli", ring) for ring in ("course", "drive", "notebook", "scenes")}

HEAVY = {"matplotlib", "moviepy", "sklearn", "pandas", "pooch", "jinja2", "dask", "pyarrow", "motmetrics"}
HEAVY |= {"ipywidgets", "IPython"}
# Modules about scikit-learn, themselves imported on first use.
SKLEARN_MODULES = {"training.pipeline", "course.reference"}
UNSAFE = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}


def imports(name, *, at_import=False):
    """Modules that a module imports from: everywhere, or only when it is imported itself."""

    def walk(node):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                yield from (alias.name for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                # Inside notebook, `from vehicle_detection.notebook import style` imports another file.
                own_package = child.module == f"vehicle_detection.{package_of(name)}"
                for alias in child.names:
                    is_file = own_package and f"{package_of(name)}.{alias.name}" in FILES
                    yield f"{child.module}.{alias.name}" if is_file else child.module
            elif not at_import or not (
                isinstance(child, ast.FunctionDef)
                or (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test))
            ):
                yield from walk(child)

    return list(walk(TREES[name]))


def own_modules(name, *, at_import=False):
    """Modules of this package that a module imports from."""
    for full in imports(name, at_import=at_import):
        if full.startswith("vehicle_detection."):
            other = full.removeprefix("vehicle_detection.")
            yield other if other in FILES else f"{other}.__init__"


def package_of(name):
    return name.split(".")[0]


MODULES = sorted(set(FILES) - {"__init__", "__main__"})


def ring_of(name):
    ring = package_of(name)
    return ring if ring in OUTER or ring == "training" else "core"


@pytest.mark.parametrize("name", MODULES)
def test_a_module_imports_its_own_ring_and_the_core_through_interfaces(name):
    for other in own_modules(name):
        if package_of(other) == package_of(name) or other == "__init__":
            continue
        ring, other_ring = ring_of(name), ring_of(other)
        if ring != other_ring and other_ring not in ("core", "training"):
            assert (ring, other_ring) in ALLOWED
        if ring_of(name) != ring_of(other) or ring == "core":
            assert "." not in other.removesuffix(".__init__"), f"{name} imports {other}, not its package"


def test_imports_are_acyclic():
    """Counting the imports inside functions and those for types."""
    graph = {name: {*own_modules(name)} - {name} for name in MODULES}
    list(graphlib.TopologicalSorter(graph).static_order())  # else CycleError, with the circle


def test_the_root_is_small():
    assert len(list(FOLDER.glob("*.py"))) <= 18


@pytest.mark.parametrize("name", sorted(FILES))
def test_conventions_of_a_module(name):
    tree, everywhere = TREES[name], {full.split(".")[0] for full in imports(name)}
    at_import = {full.split(".")[0] for full in imports(name, at_import=True)}
    assert (ast.get_docstring(tree) or "").split("\n")[0].rstrip().endswith((".", ":", ","))
    assert not at_import & HEAVY or name in SKLEARN_MODULES, "import heavy libraries inside functions"
    assert not everywhere & UNSAFE, "nothing is pickled"
    assert "random" not in everywhere, "pass random_state instead of global random numbers"
    calls = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    assert not calls & {"eval", "exec"}
    assert "print" not in calls or package_of(name) == "cli", "log instead"
    assert all(node.level == 0 for node in ast.walk(tree) if isinstance(node, ast.ImportFrom))
    random = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "np.random"
    }
    assert random <= {"default_rng", "Generator", "SeedSequence", "PCG64"}, "no global random state"


def modules_after(code):
    script = f"import sys, json, time; {code}; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return {name.split(".")[0] for name in json.loads(done.stdout)}


def test_importing_the_package_is_light():
    loaded = modules_after("import vehicle_detection")
    assert not loaded & (HEAVY | {"numpy", "numba", "cv2", "skimage", "scipy", "safetensors"})


def test_the_detector_imports_no_plotting_and_no_training():
    loaded = modules_after("import vehicle_detection as v; v.VehicleDetector(jobs=1)")
    assert not loaded & (HEAVY | {"skimage"})


def test_all_names_are_listed():
    assert {*vehicle_detection.__all__} <= {*dir(vehicle_detection)}


@pytest.mark.parametrize(("name", "value"), package_names().items())
def test_a_public_name_is_documented(name, value):
    text = inspect.getdoc(value) or ""
    assert text.split("\n\n")[0].rstrip().endswith("."), "a docstring starts with a sentence"
    if inspect.ismodule(value) or (inspect.isclass(value) and issubclass(value, Exception)):
        return
    assert value.__name__ == name
    assert ">>> " in text, "a public name has an example"


def test_unknown_names():
    with pytest.raises(AttributeError, match="No vehicle_detection attribute nothing"):
        vehicle_detection.nothing  # noqa: B018
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        importlib.import_module("vehicle_detection.features").nothing  # noqa: B018


def test_every_exception_is_one_of_the_library():
    kinds = [value for value in vars(errors).values() if inspect.isclass(value)]
    assert len(kinds) == 8
    assert all(issubclass(kind, errors.VehicleDetectionError) for kind in kinds)
    assert {kind.__name__ for kind in kinds} <= set(vehicle_detection.__all__)


def test_version_and_type_marker():
    assert len(vehicle_detection.__version__.split(".")) == 3
    assert "__version__" in dir(vehicle_detection)
    assert (FOLDER / "py.typed").exists()
