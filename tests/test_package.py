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

FOLDER = Path(vehicle_detection.__file__).parent
PACKAGE = "vehicle_detection"

# From the bottom up: a module imports only from rows above it. A private module that is no row of its own
# is a helper of the highest room that imports it, and may import what that room may.
ROWS = [
    "errors",
    "_checks",
    "params",
    "_files",
    "_jobs",
    "images",
    "boxes",
    "camera",
    "horizon",
    "_jit",
    "_hog_kernels",
    "_color_kernels",
    "_kernel_inputs",
    "_channels",
    "features",
    "_transformer",
    "datasets",
    "synthetic",
    "_model_file",
    "_classifier_training",
    "classifier",
    "training",
    "windows",
    "search",
    "mixture",
    "heatmap",
    "regions",
    "tracking",
    "drawing",
    "detector",
    "video",
    "evaluation",
    "tuning",
    "mixture_training",
    "mixture_report",
    "export",
    "report",
    "plotting",
    "explorer",
    "batch",
    "cli",
]
# `features` hands out the transformer, which needs scikit-learn, to those who ask for it by name.
DOORS = {("features", "_transformer"), ("__main__", "cli")}
HEAVY = {
    "matplotlib",
    "moviepy",
    "sklearn",
    "pandas",
    "pooch",
    "dask",
    "distributed",
    "pyarrow",
    "motmetrics",
    "ipywidgets",
    "IPython",
}
# All about scikit-learn: these modules are imported inside functions only.
HEAVY_MODULES = {"_halving": {"sklearn"}, "_transformer": {"sklearn"}}
UNSAFE = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}

# Public names whose docstring shows no example, and why.
WITHOUT_EXAMPLE = {
    "FrameResult": "a result: VehicleDetector shows it",
    "HeatParams": "bounding_boxes shows it",
    "HorizonEstimate": "a result: estimate_horizon shows it",
    "RegionParams": "group_windows shows it",
    "SearchBand": "SearchParams shows it",
    "Track": "a result: Tracker shows it",
    "draw_diagnostics": "a picture",
    "draw_tracks": "a picture",
    "find_vehicles": "the two functions that it calls show it",
    "fit_boxes": "its numbers are tuned",
    "hog_blocks": "get_hog_features shows it",
    "hog_image": "a picture",
    "cross_validate_mixture": "trains several models",
    "search_windows": "its scores are the shipped model's",
    "train_classifier": "needs patches and takes time",
    "train_mixture": "needs labelled frames and takes time",
    "write_image": "writes a file",
}

SOURCES = {path.stem: path.read_text() for path in FOLDER.glob("*.py")}
TREES = {name: ast.parse(text) for name, text in SOURCES.items()}
MODULES = sorted(set(TREES) - {"__init__"})


def is_typing_only(node):
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def imports_in(nodes, *, everywhere):
    """Full names of what is imported: everywhere, or only what runs when the module is imported."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif everywhere or not (
            isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) or is_typing_only(node)
        ):
            yield from imports_in(ast.iter_child_nodes(node), everywhere=everywhere)


def own_modules(name, *, everywhere=True):
    """Modules of the package that a module imports."""
    found = set()
    for imported in imports_in(TREES[name].body, everywhere=everywhere):
        parts = imported.split(".")
        if parts[0] == PACKAGE and len(parts) > 1 and parts[1] in TREES:
            found.add(parts[1])
    return found


IMPORTS = {name: own_modules(name) for name in MODULES}


def room_of(name, seen=()):
    """Find the row of a module; a private helper lives in the highest room that imports it."""
    if name in ROWS:
        return name
    if name == "__main__":
        return "cli"
    assert name.startswith("_"), f"{name} is public and no row of the table"
    importers = {other for other in MODULES if name in IMPORTS[other] and other not in (name, *seen)}
    rooms = {room_of(other, (*seen, name)) for other in importers} - {None}
    # Helpers that import each other for their types lead back to where the walk began.
    assert rooms or seen, f"nobody imports {name}"
    return min(rooms, key=ROWS.index, default=None)


@pytest.mark.parametrize("name", MODULES)
def test_a_module_imports_only_from_rows_above(name):
    room = room_of(name)
    for imported in IMPORTS[name]:
        if (name, imported) in DOORS:
            continue
        other = room_of(imported)
        if other == room:
            assert imported.startswith("_"), f"{name} is a helper of {imported} and must not import it"
        else:
            assert ROWS.index(other) < ROWS.index(room), f"{name} ({room}) imports {imported} ({other})"


def test_nobody_imports_the_command_line():
    assert [name for name in MODULES if "cli" in IMPORTS[name]] in ([], ["__main__"])
    assert "cli" not in own_modules("__init__")


def test_no_imports_go_in_circles():
    graph = {name: own_modules(name, everywhere=False) for name in MODULES}
    list(graphlib.TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("name", [*MODULES, "__init__"])
def test_heavy_libraries_are_imported_where_they_are_used(name):
    at_import = {full.split(".")[0] for full in imports_in(TREES[name].body, everywhere=False)}
    assert at_import & HEAVY <= HEAVY_MODULES.get(name, set())
    assert not own_modules(name, everywhere=False) & HEAVY_MODULES.keys()


@pytest.mark.parametrize("name", [*MODULES, "__init__"])
def test_nothing_is_pickled(name):
    imported = {full.split(".")[0] for full in imports_in(TREES[name].body, everywhere=True)}
    assert not imported & UNSAFE
    assert "allow_pickle=True" not in SOURCES[name]
    called = {
        node.func.id
        for node in ast.walk(TREES[name])
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not called & {"eval", "exec"}


@pytest.mark.parametrize("name", [*MODULES, "__init__"])
def test_nothing_is_printed_outside_the_command_line(name):
    prints = [
        node.lineno
        for node in ast.walk(TREES[name])
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]
    assert not prints or room_of(name) == "cli"


@pytest.mark.parametrize("name", MODULES)
def test_no_global_random_state(name):
    assert "random" not in {full.split(".")[0] for full in imports_in(TREES[name].body, everywhere=True)}
    used = {
        node.attr
        for node in ast.walk(TREES[name])
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("np.random", "numpy.random")
    }
    assert used <= {"default_rng", "Generator", "SeedSequence", "BitGenerator", "PCG64"}


@pytest.mark.parametrize("name", [*MODULES, "__init__"])
def test_every_module_says_what_it_is(name):
    assert (ast.get_docstring(TREES[name]) or "").split("\n")[0].rstrip().endswith((".", ":", ","))


def test_importing_the_package_is_light():
    code = (
        "import sys, json, time; began = time.perf_counter(); import vehicle_detection as v; "
        "print(json.dumps([time.perf_counter() - began, sorted(sys.modules)]))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stderr == ""
    seconds, loaded = json.loads(out.stdout)
    roots = {name.split(".")[0] for name in loaded}
    assert not roots & (HEAVY | {"numba", "cv2", "skimage", "scipy", "safetensors", "threadpoolctl"})
    assert seconds < 0.5


def test_using_the_detector_leaves_plots_and_training_alone():
    code = (
        "import sys, json, vehicle_detection as v; v.VehicleDetector(n_jobs=1); "
        "print(json.dumps(sorted({name.split('.')[0] for name in sys.modules})))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not set(json.loads(out.stdout)) & (HEAVY | {"skimage"})


def names_for_type_checkers():
    (block,) = (node for node in TREES["__init__"].body if is_typing_only(node))
    return {
        alias.name: node.module.removeprefix(f"{PACKAGE}.") for node in block.body for alias in node.names
    }


def test_the_public_names_are_listed_alike_three_times():
    assert len(set(vehicle_detection.__all__)) == len(vehicle_detection.__all__)
    rooms = vehicle_detection._ROOMS
    listed = [name for names in rooms.values() for name in names]
    assert sorted(listed) == sorted(vehicle_detection.__all__)
    assert names_for_type_checkers() == {name: room for room, names in rooms.items() for name in names}
    assert set(rooms) <= set(ROWS)


@pytest.mark.parametrize("name", vehicle_detection.__all__)
def test_a_public_name_is_there(name):
    value = getattr(vehicle_detection, name)
    assert name in dir(vehicle_detection)
    assert value.__name__ == name
    assert value.__module__.startswith(f"{PACKAGE}.")


def test_names_that_do_not_exist():
    with pytest.raises(AttributeError, match="module 'vehicle_detection' has no attribute 'nothing'"):
        vehicle_detection.nothing  # noqa: B018
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        importlib.import_module("vehicle_detection.features.extract").nothing  # noqa: B018


def test_every_exception_is_one_of_the_library():
    errors = importlib.import_module("vehicle_detection.errors")
    kinds = [value for value in vars(errors).values() if inspect.isclass(value)]
    assert len(kinds) == 5
    assert all(issubclass(kind, errors.VehicleDetectionError) for kind in kinds)
    assert {kind.__name__ for kind in kinds} <= set(vehicle_detection.__all__)


@pytest.mark.parametrize("name", vehicle_detection.__all__)
def test_a_public_name_is_documented(name):
    value = getattr(vehicle_detection, name)
    text = inspect.getdoc(value) or ""
    assert text.split("\n\n")[0].rstrip().endswith("."), "a docstring starts with a sentence"
    is_error = inspect.isclass(value) and issubclass(value, Exception)
    assert (">>> " in text) != (is_error or name in WITHOUT_EXAMPLE)


def test_the_version_is_a_version():
    assert len(vehicle_detection.__version__.split(".")) == 3
    assert (FOLDER / "py.typed").exists()
