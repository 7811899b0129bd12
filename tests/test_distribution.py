"""The wheel and the source distribution: their files, and that two builds give the same bytes."""

import os
import re
import shutil
import subprocess
import tarfile
import tomllib
import zipfile

import pytest
import yaml

from tests.helpers import ROOT
from vehicle_detection import __version__

NAME = f"vehicle_detection-{__version__}"
SOURCES = {"vehicle_detection", "benchmarks", "docs", "notebooks", "requirements", "tests", "tools"}
SOURCES |= {"test_images"}
TEXTS = {"README.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "SECURITY.md", "LICENSE"}
TEXTS |= {"CODE_OF_CONDUCT.md"}


@pytest.fixture(scope="module")
def tracked():
    """Files of the repository that git tracks."""
    git = shutil.which("git")
    if git is None or not (ROOT / ".git").exists():
        pytest.skip("this is not a git repository")
    listed = subprocess.run([git, "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    return {name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()}


@pytest.fixture(scope="module")
def source(tracked, tmp_path_factory):
    """A copy of the tracked files, with another date and other permissions than in the repository."""
    folder = tmp_path_factory.mktemp("source")
    for name in tracked:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / name)
        os.chmod(folder / name, 0o600)
        os.utime(folder / name, (1e9, 1e9))
    return folder


def build(kind, source, folder):
    """Build a wheel or a source distribution in this process, without a network."""
    module = pytest.importorskip(f"hatchling.builders.{kind}")
    builder = {"wheel": "WheelBuilder", "sdist": "SdistBuilder"}[kind]
    (path,) = getattr(module, builder)(str(source)).build(directory=str(folder), versions=["standard"])
    return path


def test_the_wheel_holds_the_package_and_nothing_else(source, tracked, tmp_path):
    with zipfile.ZipFile(build("wheel", source, tmp_path)) as wheel:
        names = set(wheel.namelist())
    metadata = {f"{NAME}.dist-info/{name}" for name in ("METADATA", "WHEEL", "RECORD", "entry_points.txt")}
    package = {name for name in tracked if name.startswith("vehicle_detection/")}
    assert names == package | metadata | {f"{NAME}.dist-info/licenses/LICENSE"}
    assert {"vehicle_detection/py.typed", "vehicle_detection/models/default.onnx"} <= names


def test_the_source_distribution_holds_the_sources_and_nothing_else(source, tracked, tmp_path):
    with tarfile.open(build("sdist", source, tmp_path)) as archive:
        members = archive.getmembers()
    assert all(member.isfile() and not member.name.startswith(("/", "..")) for member in members)
    names = {member.name.removeprefix(f"{NAME}/") for member in members}
    expected = {name for name in tracked if name.split("/")[0] in SOURCES} | TEXTS
    assert names == expected | {"pyproject.toml", ".gitignore", "PKG-INFO"}


@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_two_builds_give_the_same_bytes(kind, source, tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    # Copies without the large files, and with other dates and permissions.
    some = {"ignore": shutil.ignore_patterns("docs", "notebooks", "tests", "models", "test_images")}
    first = shutil.copytree(source, tmp_path / "first", **some)
    second = shutil.copytree(source, tmp_path / "second", copy_function=shutil.copyfile, **some)
    paths = [build(kind, folder, folder / "dist") for folder in (first, second)]
    with open(paths[0], "rb") as one, open(paths[1], "rb") as other:
        assert one.read() == other.read()


CONDA_NAMES = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base", "PyYAML": "pyyaml"}


def test_the_conda_recipe_requires_what_the_package_requires():
    recipe = yaml.safe_load((ROOT / "conda/recipe.yaml").read_text())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pairs = [re.match(r"([\w-]+)(.*)", each).groups() for each in project["dependencies"]]
    expected = {f"{CONDA_NAMES.get(name, name)} {version}" for name, version in pairs}
    assert set(recipe["requirements"]["run"]) == expected | {"python >=${{ python_min }}"}
    assert recipe["context"]["version"] == __version__


def test_the_workflows_test_the_stated_pythons_and_files_that_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    stated = {each.split()[-1] for each in project["classifiers"] if ":: 3." in each}
    jobs = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text())["jobs"]
    assert stated == set(jobs["all"]["strategy"]["matrix"]["python"])
    paths = [
        word for step in jobs["core"]["steps"] for word in step.get("run", "").split() if "tests/" in word
    ]
    assert paths
    assert all((ROOT / path).exists() for path in paths)


@pytest.mark.parametrize(
    "name", [".github/workflows/release.yml", ".readthedocs.yaml", ".pre-commit-config.yaml"]
)
def test_settings_of_services_can_be_read(name):
    assert isinstance(yaml.safe_load((ROOT / name).read_text()), dict)
