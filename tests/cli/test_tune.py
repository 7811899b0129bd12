import re
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.cli import commands
from vehicle_detection.datasets import write_labels
from vehicle_detection.images import read_image, write_image
from vehicle_detection.scenes import render_scene, truth_table
from vehicle_detection.training import read_results, tuning

SMALL = "spatial_size=8 hist_bins=8 pix_per_cell=16 hog_channel=0 mirror=no"


def run(*words):
    return commands.run("tune", *words)


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """Return a folder with patches of both classes, and a frame with its labels."""
    folder = tmp_path_factory.mktemp("material")
    commands.write_patches(folder, 80)
    (folder / "road").mkdir()
    scene = render_scene(shape=(360, 640), vehicles=2, random_state=1)
    write_image(folder / "road" / "1.png", scene.image)
    write_labels(truth_table({"1.png": scene.truth}), folder / "road.csv")
    return folder


@pytest.fixture
def patches(material):
    return commands.patches_of(material)


def test_a_grid_becomes_a_table_and_a_figure(patches, tmp_path, monkeypatch):
    out, plot = tmp_path / "table.csv", tmp_path / "plot.png"
    words = (*patches, "--grid", f"orient=3,0,4 {SMALL}", "-o", out, "--plot", plot)
    result = run(*words)
    assert result.exit_code == 0, result.output
    table = read_results(out)
    assert list(table["orient"]) == [3, 0, 4]
    assert list(table["status"]) == ["ok", "failed", "ok"]
    assert list(table["split"].fillna("")) == ["sequences", "", "sequences"]
    assert re.search(r"2 measured; \*: no other is as accurate and faster,", result.stdout)
    assert re.search(r"(?m)^ *\* +\S.*orient=\d", result.stdout)
    assert re.search(r"orient=0.* failed: orient must be an integer from 1 to 180", result.stdout)
    assert result.stdout.endswith(f"wrote {out}, {plot}\n")
    assert np.ptp(read_image(plot)) == 255
    # The same command finds no configuration left to measure.
    text = out.read_text()
    monkeypatch.setattr("vehicle_detection.training.tuning.Trials.measure", None)
    assert run(*words).exit_code == 0
    assert out.read_text() == text


def test_a_search_is_varied_on_labelled_frames(material, tmp_path):
    out, plot = tmp_path / "searches.csv", tmp_path / "plot.png"
    grid = "scales=1,0.8+1.5 overlap=0.75 threshold=1,4,500"
    words = ["--frames", material / "road", "--labels", material / "road.csv", "--plot", plot]
    result = run("--grid", grid, "-o", out, *words)
    assert result.exit_code == 0, result.output
    table = read_results(out)
    assert len(table) == 6
    assert set(table["scales"].astype(str)) == {"1", "0.8+1.5"}
    assert table["f1"].is_monotonic_decreasing
    assert (table["recall"][table["threshold"] == 500] == 0).all()
    assert re.search(r"6 searches, best first\s+scales +overlap +threshold +f1", result.stdout)
    assert plot.exists()


@pytest.mark.parametrize("split", ["sequences", "random"])
def test_halving_measures_its_finalists(patches, tmp_path, split):
    out = tmp_path / "table.jsonl"
    grid = f"orient=0,3,4 C=1e-9,1e-2 {SMALL}"
    result = run(*patches, "--grid", grid, "-o", out, "--halving", "--finalists", 2, "--split", split)
    assert result.exit_code == 0, result.output
    table = read_results(out)
    assert list(table["split"]) == [split] * 2
    assert set(table["C"]) == {1e-2}


def test_frames_are_scored(patches, material, tmp_path):
    out = tmp_path / "table.parquet"
    words = ["--frames", material / "road", "--labels", material / "road.csv"]
    words += ["--cache", tmp_path / "features"]
    result = run(*patches, "--grid", f"orient=3 {SMALL}", "-o", out, *words)
    assert result.exit_code == 0, result.output
    assert re.search(r"frames F1 +best F1", result.stdout)
    assert out.exists()
    (row,) = read_results(tmp_path / "table.jsonl").to_dict("records")
    assert row["frame_f1_by_set"].startswith("road ")
    (file,) = (tmp_path / "features").glob("*.npy")
    file.write_bytes(file.read_bytes()[:200])  # damaged: computed again
    assert run(*patches, "--grid", f"orient=3 C=1 {SMALL}", "-o", out, *words).exit_code == 0


def test_an_interrupt_keeps_the_measured_rows(patches, tmp_path, monkeypatch):
    measure = tuning.Trials.measure
    done = []

    def interrupted(self, *arguments, **options):
        if done:
            raise KeyboardInterrupt
        done.append(1)
        return measure(self, *arguments, **options)

    monkeypatch.setattr(tuning.Trials, "measure", interrupted)
    result = run(*patches, "--grid", f"orient=3,4 {SMALL}", "-o", tmp_path / "table.csv")
    assert result.exit_code == 130
    assert list(read_results(tmp_path / "table.jsonl")["orient"]) == [3]


def test_tune_refuses_bad_input(patches, material, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.csv", "a.jsonl"):
        Path(name).write_text("a,b\n1,2\n")
    cases = {
        "{patches} -o t.csv --grid color=LAB": "--grid has the unknown option 'color'",
        "{patches} {grid} -o t.csv --model highway": "--model needs a --grid of a search",
        "{grid} -o t.csv": "--grid of features needs patches to train on; give --vehicles and",
        "--grid 'scale=1 overlap=0.5' -o t.csv {frames}": "--grid of a search must be one of 'scales', 'ov",
        "--grid scales=1 -o t.csv": "--grid of a search needs labelled frames",
        "--grid scales=a+b -o t.csv {frames}": "--grid must join scales by +",
        "{patches} {grid} -o t.xls": "--output must end in .csv or .jsonl or .parquet",
        "{patches} {grid} -o none/t.csv": "--output needs an existing folder",
        "{patches} {grid} -o t.csv --plot p.jpg": "--plot must end in .png or .svg",
        "{patches} {grid} -o t.csv --plot none/p.png": "--plot needs an existing folder",
        "{patches} {grid} -o t.csv --frames {material}/road": "--frames and --labels .*; give both",
        "{patches} {grid} -o t.csv --horizon 0.5": "--horizon needs --frames",
        "--vehicles missing.zip {others} {grid} -o t.csv": "missing.zip does not exist",
        "{patches} {grid} -o a.jsonl": "is not a table of trials",
        "{patches} {grid} -o a.csv": "--output a.csv exists and is no table of tune",
        "--grid scales=1 {frames} -o a.jsonl": "--output a.jsonl exists and is no table of tune",
        "--vehicles a.csv {others} {grid} -o a.csv": "is also --vehicles",
    }
    vehicles, others = (f"{name} {path}" for name, path in (patches[:2], patches[2:]))
    frames = f"--frames {material}/road --labels {material}/road.csv"
    files = {"patches": f"{vehicles} {others}", "others": others, "material": material, "frames": frames}
    commands.refuse_each("tune", cases, grid=f"--grid 'orient=3 {SMALL}'", **files)
    assert commands.contents(tmp_path) == ["a.csv", "a.jsonl"]
    assert Path("a.csv").read_text() == Path("a.jsonl").read_text() == "a,b\n1,2\n"


def test_a_missing_package_is_named_before_anything_is_trained(patches, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    words = ("tune", *patches, "--grid", f"orient=3 {SMALL}", "-o", tmp_path / "table.parquet")
    assert ".parquet files need pyarrow; pip install pyarrow" in commands.refuse(*words)
    assert commands.contents(tmp_path) == []
    (tmp_path / "table.parquet").write_bytes(b"PAR1")
    assert ".parquet files need pyarrow; pip install pyarrow" in commands.refuse(*words)


def test_a_grid_that_cannot_be_trained_is_an_error(patches, tmp_path):
    for _ in range(2):
        result = run(*patches, "--grid", f"{SMALL} C=-1", "-o", tmp_path / "t.csv")
        assert result.exit_code == 2
        assert "failed: C must be" in result.stdout
        message = "error: --grid has no configuration that can be trained, for the reasons above"
        assert result.stderr.splitlines()[-1] == message
        assert not (tmp_path / "t.csv").exists()
