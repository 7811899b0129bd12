"""The fast parts of the benchmarks, on small rendered images."""

import json
import sys

import numpy as np
import pytest

from benchmarks import _batch, _drives, _lenses, _report
from benchmarks._course import search_course
from benchmarks._material import Context
from benchmarks._probe import run_probe
from benchmarks._report import Row, Target, at_least, at_most
from benchmarks._scaling import stage_seconds
from benchmarks._search import check_agreement, compare_searches
from vehicle_detection import FeatureParams, SearchBand, SearchParams, VehicleClassifier, render_scene
from vehicle_detection.drive import batch_status
from vehicle_detection.svm import Template
from vehicle_detection.training import to_pipeline

SEARCH = SearchParams(
    bands=(
        SearchBand(window=(192, 192), y=(0, 256), x=(0, 0.5)),
        SearchBand(window=(128, 128), y=(0, 192), x=(0, 0.5)),
    ),
    horizon=0.5,
)


@pytest.fixture(scope="module")
def frame():
    return render_scene(shape=(360, 640), vehicles=3, random_state=2).image


@pytest.fixture(scope="module")
def classifier():
    """Random weights on scaled features: about half of the windows score above zero."""
    params = FeatureParams.preset("ycrcb-8460")
    rng = np.random.default_rng(0)
    mean = np.repeat([100.0, 128.0, 0.1], (params.spatial_length, params.hist_length, params.hog_length))
    scale = np.repeat([50.0, 100.0, 0.1], (params.spatial_length, params.hist_length, params.hog_length))
    return VehicleClassifier(params, (Template(mean, scale, rng.normal(0, 0.01, params.length), 0.0),))


@pytest.fixture(scope="module")
def course(frame, classifier):
    scaler, svc = (step for _, step in to_pipeline(classifier).steps[-2:])
    return search_course(frame, SEARCH.place(frame.shape), scaler, svc)


def test_course_and_search_agree(frame, classifier, course):
    assert 0 < (course.scores > 0).sum() < len(course.scores)
    with classifier.open_search(1) as ours:
        agreement = check_agreement(frame, ours, SEARCH, course)
    assert agreement.windows == len(course.boxes) > 200
    assert agreement.difference < 1e-4
    assert agreement.shared > 0
    assert agreement.disputed == 0


def test_search_rows(frame, classifier):
    rows = {row.what: row for row in compare_searches(frame, classifier, SEARCH, "scene", rounds=1, calls=2)}
    assert rows["windows searched"].value > 200
    assert rows["faster than course method, two cores"].value > 1
    assert rows["faster than HOG alone, two cores"].target == at_least(80)
    assert rows["maximum difference of a score"].verdict == "met"


def test_stages_are_measured_and_the_search_is_restored(frame, classifier):
    from vehicle_detection import search

    before = dict(vars(search))
    stages = stage_seconds(frame, classifier, SEARCH, calls=2)
    assert vars(search) == before
    known = {"resize", "color", "HOG cells", "blocks", "spatial bins", "histogram", "correlation", "hits"}
    assert known | {"rest"} == set(stages)
    assert all(seconds > 0 for seconds in stages.values())


@pytest.mark.parametrize(
    ("target", "met", "missed"),
    [
        (at_most(2), 2.0, 2.1),
        (at_least(2), 2.0, 1.9),
        (Target("=", 0), 0, 1),
        (Target("about", 10), 10.9, 11.1),
    ],
)
def test_verdicts(target, met, missed):
    assert Row("a", met, target=target).verdict == "met"
    assert Row("a", missed, target=target).verdict == "missed"
    assert Row("a", missed).verdict == ""


def test_report_writes_json_and_keeps_other_benchmarks(tmp_path):
    file = tmp_path / "results.json"
    row = Row("time", 1.25, unit="s", target=at_most(1), material="drawn", details={"n": 3})
    _report.write_json({"first": [row]}, file)
    _report.write_json({"second": [Row("count", 4)]}, file)
    found = json.loads(file.read_text(encoding="utf-8"))
    assert found["benchmarks"]["first"] == [
        {"what": "time", "measured": 1.25, "unit": "s", "target": "<= 1", "verdict": "missed",
         "material": "drawn", "details": {"n": 3}}
    ]  # fmt: skip
    assert found["benchmarks"]["second"][0]["verdict"] is None
    assert found["machine"]["cores"] >= 1
    assert {"numpy", "numba"} <= set(found["machine"]["libraries"])
    # Nothing else: no name of the machine, no path.
    assert set(found["machine"]) == {"cores", "processor", "system", "python", "jobs_variable", "libraries"}


def test_a_bound_batch_uses_one_cpu(tmp_path):
    if not _batch.two_cpus():
        pytest.skip("CPUs cannot be bound here, or there is one only")
    cpu = _batch.two_cpus()[1]
    program = "import os, sys; print('bound to', *os.sched_getaffinity(0), file=sys.stderr); sys.exit(1)"
    # A stand-in for ffmpeg, started by the worker.
    stand_in = tmp_path / "ffmpeg"
    stand_in.write_text(f"#!{sys.executable}\n{program}\n")
    stand_in.chmod(0o755)
    (tmp_path / "drive.mp4").write_bytes(b"\0")
    words = ("bound", str(cpu), "tracks", str(tmp_path / "out"), str(tmp_path / "drive.mp4"))
    assert run_probe(*words, FFMPEG_BINARY=str(stand_in)) == {"done": 0}
    assert f"(bound to {cpu})" in next(iter(batch_status(tmp_path / "out").messages.values()))


def test_drives_are_scored_over_seeds(tmp_path, monkeypatch):
    small = {"shape": (540, 960), "scenario": "closing"}
    monkeypatch.setattr(_drives, "FRAMES", 9)
    monkeypatch.setattr(_drives, "CASES", {"closing": small})
    monkeypatch.setattr(_drives, "EMPTY_CASES", {"empty": {"shape": (270, 480), "scenario": "empty"}})
    rows = {row.what: row for row in _drives.run(Context(tmp_path, seeds=2))}
    assert set(rows["closing: MOTA"].details) == {"seed 7", "seed 8"}
    assert rows["closing: minimum MOTA"].value <= rows["closing: MOTA"].value <= 1
    assert rows["closing: median error of the distance"].value <= rows["closing: 90th percentile of it"].value
    assert rows["drives without vehicles: boxes shown"].value == 0


def test_distances_through_lenses_are_scored(tmp_path, monkeypatch):
    monkeypatch.setattr(_drives, "FRAMES", 9)
    for name, value in {"ANGLES": (90,), "HEIGHTS": (1.4,), "SHAPE": (540, 960)}.items():
        monkeypatch.setattr(_lenses, name, value)
    rows = {row.what: row for row in _lenses.run(Context(tmp_path))}
    assert rows["90 degrees, the right camera: median error of the distance"].value < 20
    assert rows["90 degrees, no camera: median error of the distance"].value > 30
    assert rows["90 degrees, no camera: distances marked with ~"].value == 100
