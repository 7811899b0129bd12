import logging
import math
import shutil
import signal
import subprocess
import sys
import time

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import random_classifier
from vehicle_detection.classifier import train_classifier
from vehicle_detection.datasets import (
    PatchSet,
    Split,
    load_frames,
    split_random,
    split_sequences,
    split_sources,
)
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.evaluation import (
    FrameBoxes,
    LabelledFrames,
    evaluate_detections,
    read_labels,
)
from vehicle_detection.features import extract_features
from vehicle_detection.params import FeatureParams, SearchBand, SearchParams
from vehicle_detection.plotting import plot_tradeoff
from vehicle_detection.search import find_cars
from vehicle_detection.synthetic import render_patches, render_scene
from vehicle_detection.tuning import (
    FeatureCache,
    ResultTable,
    RowStore,
    compare_configurations,
    expand_grid,
    mine_negatives,
    parse_grid,
    read_results,
    search_parameters,
)
from vehicle_detection.tuning import cache as _feature_cache
from vehicle_detection.tuning import trials as _trials
from vehicle_detection.tuning.search import make_folds
from vehicle_detection.tuning.trials import COLUMNS, Bench

SMALL = {"spatial_size": 8, "hist_bins": 8, "orient": 4, "pix_per_cell": 16, "hog_channel": 0}
PLAIN = {"time_search": False, "mirror": False}
SEARCH = SearchParams(
    bands=(SearchBand(window=(128, 128), y=(-64, 192)), SearchBand(window=(256, 256), y=(-128, 300)))
)


@pytest.fixture(scope="module")
def patch_set():
    patches, labels = render_patches(120)
    sources = ("vehicles/GTI_Far", "vehicles/KITTI_extracted"), ("non-vehicles/GTI", "non-vehicles/Extras")
    names = [f"{sources[not label][row % 2]}/{row}.png" for row, label in enumerate(labels)]
    return PatchSet(patches, labels, names)


@pytest.fixture(scope="module")
def scenes():
    return [render_scene(shape=(360, 640), vehicles=2, random_state=seed) for seed in (1, 2)]


@pytest.fixture(scope="module")
def labels(scenes):
    rows = [
        (number, truth.box, bool(truth.ignore))
        for number, scene in enumerate(scenes)
        for truth in scene.truth
    ]
    frames, boxes, ignore = zip(*rows)
    return FrameBoxes(frames, None, np.array(boxes), ignore=np.array(ignore), frame_keys=range(len(scenes)))


@pytest.fixture(scope="module")
def frames(scenes, labels):
    return LabelledFrames("drawn", [scene.image for scene in scenes], labels)


def count_measurements(monkeypatch, stop_after=None):
    """Count the trials that are measured, and end the run like Ctrl-C after some."""
    done = []
    measure = Bench.measure

    def counted(self, recipe, *arguments, **options):
        if stop_after is not None and len(done) == stop_after:
            raise KeyboardInterrupt
        done.append(recipe)
        return measure(self, recipe, *arguments, **options)

    monkeypatch.setattr(Bench, "measure", counted)
    return done


def without_times(table):
    return [
        {name: value for name, value in row.items() if name not in ("fit_seconds", "search_ms")}
        for row in table
    ]


# compare_configurations


def test_every_configuration_meets_every_c_split_and_seed(patch_set):
    table = compare_configurations(
        patch_set,
        {"four": SMALL, "six": {**SMALL, "orient": 6}},
        splits=("sequences", "random"),
        C=(1e-3, 1.0),
        seeds=range(3),
        **PLAIN,
    )
    assert table.columns == COLUMNS
    assert set(table.column("status")) == {"ok"}
    # One row for the sequences, which no seed changes, and three for the random split.
    assert [(row["configuration"], row["C"], row["split"], row["seed"]) for row in table] == [
        (name, C, split, seed)
        for name in ("four", "six")
        for C in (1e-3, 1.0)
        for split, seed in (("sequences", 0), ("random", 0), ("random", 1), ("random", 2))
    ]
    assert table.column("orient") == [4] * 8 + [6] * 8
    assert table.column("search_ms") == [None] * 16
    assert all(0.7 < accuracy <= 1 for accuracy in table.column("accuracy"))
    assert len(set(table.column("trial"))) == 16
    summary = table.summarize()
    assert summary.column("runs") == [1, 3] * 4
    assert summary[0]["accuracy_std"] is None


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("split", ["sequences", "sources", "sources-reversed", "random"])
def test_a_trial_is_what_training_on_that_part_gives(patch_set, mirror, split):
    parts = {
        "sequences": split_sequences(patch_set),
        "sources": split_sources(patch_set),
        "sources-reversed": split_sources(patch_set, train=("KITTI", "Extras"), test=("GTI",)),
        "random": split_random(patch_set, random_state=3),
    }[split]
    (row,) = compare_configurations(
        patch_set, [SMALL], splits=split, C=0.01, mirror=mirror, seeds=[3], time_search=False
    )
    train, test = patch_set[parts.train], patch_set[parts.test]
    params = FeatureParams(**SMALL)
    classifier = train_classifier(
        train.patches, train.labels, params=params, C=0.01, mirror=mirror, random_state=3
    )
    recipe = _trials.Recipe(params=params, C=0.01, mirror=mirror)
    tried = Bench(patch_set, FeatureCache(patch_set.patches)).train(recipe, parts.train, 3)
    for name in ("mean", "scale", "coef", "intercept"):
        expected, found = (getattr(each.templates[0], name) for each in (classifier, tried))
        np.testing.assert_array_equal(found, expected)
    assert row["accuracy"] == classifier.score(test.patches, test.labels)
    assert row["train_accuracy"] == classifier.score(train.patches, train.labels)
    assert (row["train_size"], row["test_size"]) == (len(train), len(test))
    assert row["mirror"] is mirror


def test_splits_of_ones_own_and_presets_by_name(patch_set):
    split = Split(np.arange(0, 120, 2), np.arange(1, 120, 2))
    table = compare_configurations(patch_set, ["luv-2384"], splits={"mine": split}, **PLAIN)
    assert (table[0]["split"], table[0]["features"], table[0]["configuration"]) == ("mine", 2384, "luv-2384")


def test_what_a_configuration_says_itself_goes_before_the_defaults(patch_set):
    given = [{**SMALL, "C": 0.5, "vehicle_weight": 3.0, "mirror": True}, SMALL]
    table = compare_configurations(patch_set, given, C=[0.1, 0.2], **PLAIN)
    assert table.column("C") == [0.5, 0.1, 0.2]
    assert table.column("vehicle_weight") == [3.0, 1.0, 1.0]
    assert table.column("mirror") == [True, False, False]
    assert table[0]["train_size"] == table[1]["train_size"]


def test_a_weight_on_vehicles_finds_more_of_them(patch_set):
    noise = np.random.default_rng(0).integers(0, 2, len(patch_set)).astype(bool)
    unclear = PatchSet(patch_set.patches, patch_set.labels ^ noise, patch_set.names)
    bench = Bench(unclear, FeatureCache(unclear.patches))
    found = []
    for weight in (0.05, 1.0, 20.0):
        recipe = _trials.Recipe(params=FeatureParams(**SMALL), C=1e-4, mirror=False, vehicle_weight=weight)
        found.append(bench.train(recipe, np.arange(len(unclear)), 0).predict(unclear.patches).sum())
    assert found[0] < found[1] < found[2]


def test_impossible_combinations_are_reported_and_skipped(patch_set, caplog):
    given = {"fine": SMALL, "none": {**SMALL, "orient": 0}, "odd": {**SMALL, "pix_per_cell": 10}}
    table = compare_configurations(patch_set, given, splits=("sequences", "random"), search=SEARCH)
    assert table.column("configuration") == ["fine", "fine", "none", "odd", "odd"]
    assert table.column("status") == ["ok", "ok", "refused", "partial", "partial"]
    assert table[0]["message"] is None
    assert "orient must be an integer from 1 to 180; got 0" in table[2]["message"]
    assert (table[2]["orient"], table[2]["accuracy"]) == (0, None)
    # Other windows than those of the fast search can be judged, but not searched quickly.
    assert "pix_per_cell=10 leaves a rest" in table[3]["message"]
    assert table[3]["accuracy"] > 0.7
    assert table[3]["search_ms"] is None
    assert "none is refused: orient must be" in caplog.text


def test_features_beyond_the_memory_are_refused(patch_set, monkeypatch):
    monkeypatch.setattr(_trials.os, "sysconf", lambda name: 100)
    (row,) = compare_configurations(patch_set, [SMALL], **PLAIN)
    assert row["status"] == "refused"
    assert "features of 96 patches need about 1 GB to train on, this machine has 0" in row["message"]


def test_one_class_to_train_on_is_refused_by_row(patch_set):
    rows = np.flatnonzero(patch_set.labels)
    (row,) = compare_configurations(
        patch_set, [SMALL], splits={"lopsided": Split(rows, np.flatnonzero(~patch_set.labels))}, **PLAIN
    )
    assert row["status"] == "refused"
    assert "labels must hold both classes" in row["message"]


def test_frames_are_scored_as_the_detector_does(patch_set, frames, labels):
    other = LabelledFrames("again", {1: frames.frames[1]}, labels, horizon=0.5)
    (row,) = compare_configurations(patch_set, [SMALL], frames=[frames, other], search=SEARCH, C=0.1)
    train = patch_set[split_sequences(patch_set).train]
    classifier = train_classifier(train.patches, train.labels, params=FeatureParams(**SMALL), C=0.1)
    scores = []
    for each in (frames, other):
        with VehicleDetector(classifier, search_params=SEARCH, horizon=each.horizon) as detector:
            found = FrameBoxes.from_detections({key: detector.detect(image) for key, image in each})
        scores.append(evaluate_detections(found, each.labels, frames=each.keys))
    assert row["frame_f1"] == pytest.approx(np.nanmean([score.f1 for score in scores]))
    assert row["frame_average_precision"] == pytest.approx(np.mean([s.average_precision for s in scores]))
    assert row["frame_f1"] <= row["frame_best_f1"] + 1e-12
    assert row["frame_f1_each"].split()[::2] == ["drawn", "again"]
    assert row["search_ms"] > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"configurations": []}, "configurations must be a mapping .* at least one; got"),
        ({"configurations": [3]}, "a configuration must be FeatureParams, a mapping .*; got 3"),
        ({"configurations": ["vgg"]}, "preset must be one of"),
        (
            {"configurations": [{"orientt": 9}]},
            "a configuration knows no 'orientt'; the options are color_space",
        ),
        ({"splits": "half"}, "splits must be one of 'sequences', 'groups'"),
        ({"splits": ()}, "splits must name at least one of sequences"),
        ({"splits": {}}, "splits must map names to Split; got"),
        ({"splits": {"mine": Split([0], [120])}}, r"splits\['mine'\] names row 120 of a set of 120 patches"),
        ({"C": ()}, "C must be a number or several; got none"),
        ({"seeds": ()}, "seeds must be different integers, at least one"),
        ({"seeds": (1, 1)}, "seeds must be different integers"),
        ({"seeds": "12"}, "seeds must be a list of integers"),
        ({"seeds": (0.5,)}, "seeds must be an integer at least 0|seeds must be an integer from 0"),
        (
            {"cache": FeatureCache(np.zeros((1, 64, 64, 3), np.uint8))},
            "cache must be a FeatureCache of the patches",
        ),
        ({"frames": [3]}, "frames must be LabelledFrames, one or more; got 3"),
        ({"store": "rows.txt"}, "store must end in .csv or .jsonl; got 'rows.txt'"),
        ({"store": "missing/rows.csv"}, "store needs an existing folder"),
    ],
)
def test_arguments_that_make_no_sense(patch_set, options, message):
    arguments = {"configurations": [SMALL], **PLAIN, **options}
    with pytest.raises(InvalidInputError, match=message):
        compare_configurations(patch_set, arguments.pop("configurations"), **arguments)


def test_a_bad_c_is_a_refused_row(patch_set):
    table = compare_configurations(patch_set, [SMALL], C=[-1.0, 1.0], **PLAIN)
    assert table.column("status") == ["refused", "ok"]
    assert "C must be a number, greater than 0" in table[0]["message"]


def test_patches_must_be_a_set_and_frames_have_names(patch_set, frames):
    with pytest.raises(InvalidInputError, match="patch_set must be a PatchSet with patches, got an array"):
        compare_configurations(patch_set.patches, [SMALL])
    with pytest.raises(InvalidInputError, match="frames must have different names"):
        compare_configurations(patch_set, [SMALL], frames=[frames, frames])
    with pytest.raises(InvalidInputError, match="'GTI'"):
        compare_configurations(
            PatchSet(patch_set.patches, patch_set.labels, [f"a/{n}.png" for n in range(120)]),
            [SMALL],
            splits="sources",
        )


def test_a_bar_counts_the_rows(patch_set, capsys):
    compare_configurations(patch_set, [SMALL, {"orient": 0}], progress=True, **PLAIN)
    assert "2/2" in capsys.readouterr().err


# The store


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_a_second_run_measures_only_what_is_new(patch_set, tmp_path, monkeypatch, suffix):
    store = tmp_path / f"rows{suffix}"
    options = {"splits": "random", "seeds": (0, 1), "store": store, **PLAIN}
    first = compare_configurations(patch_set, {"a": SMALL, "bad": {"orient": 0}}, **options)
    done = count_measurements(monkeypatch)
    again = compare_configurations(patch_set, {"a": SMALL, "bad": {"orient": 0}}, **options)
    assert not done
    assert again.rows == first.rows
    assert read_results(store).rows == first.rows
    # Another name for the same trial does not make it another one.
    more = compare_configurations(patch_set, {"b": SMALL, "c": {**SMALL, "hist_bins": 4}}, **options)
    assert [recipe.params.hist_bins for recipe in done] == [4, 4]
    assert more.column("configuration") == ["b", "b", "c", "c"]
    assert len(read_results(store)) == 5


def test_rows_of_other_patches_splits_and_frames_do_not_count(patch_set, frames, tmp_path, monkeypatch):
    store = tmp_path / "rows.csv"
    done = count_measurements(monkeypatch)
    compare_configurations(patch_set, [SMALL], store=store, **PLAIN)
    changed = PatchSet(patch_set.patches[:, ::-1].copy(), patch_set.labels, patch_set.names)
    for number, (patches, options) in enumerate(
        [
            (changed, {}),
            (patch_set, {"splits": {"mine": Split([0, 119], [1, 118])}}),
            (patch_set, {"frames": frames}),
            (patch_set, {"frames": frames, "search": SEARCH}),
            (patch_set, {"time_search": True}),
            (patch_set, {"mirror": True}),
        ],
        start=2,
    ):
        compare_configurations(patches, [SMALL], store=store, **{**PLAIN, **options})
        assert len(done) == number
    compare_configurations(patch_set, [SMALL], store=store, **PLAIN)
    assert len(done) == 7


def test_an_interrupted_run_goes_on_where_it_was(patch_set, tmp_path, monkeypatch):
    store = tmp_path / "rows.jsonl"
    grid = expand_grid(
        {**{name: [value] for name, value in SMALL.items()}, "orient": [4, 5, 6], "C": [0.1, 1.0]}
    )
    whole = compare_configurations(patch_set, grid, **PLAIN)
    with monkeypatch.context() as patched:
        count_measurements(patched, stop_after=4)
        with pytest.raises(KeyboardInterrupt):
            compare_configurations(patch_set, grid, store=store, **PLAIN)
    assert len(read_results(store)) == 4
    with store.open("a") as file:
        file.write('{"status": "ok", "accur')
    done = count_measurements(monkeypatch)
    resumed = compare_configurations(patch_set, grid, store=store, **PLAIN)
    assert len(done) == 2
    assert without_times(resumed) == without_times(whole)
    assert read_results(store).rows == resumed.rows


def test_a_killed_process_loses_nothing(tmp_path):
    store = tmp_path / "rows.csv"
    code = f"""
import numpy as np
from vehicle_detection.datasets import PatchSet
from vehicle_detection.tuning import compare_configurations
patches = np.random.default_rng(0).integers(0, 256, (40, 64, 64, 3), np.uint8)
names = [f"{{row % 2}}/{{row}}.png" for row in range(40)]
patch_set = PatchSet(patches, np.arange(40) % 2 == 0, names)
grid = [{{**{SMALL!r}, "hist_bins": bins}} for bins in range(1, 250)]
compare_configurations(patch_set, grid, splits="random", store={str(store)!r}, time_search=False)
"""
    process = subprocess.Popen([sys.executable, "-c", code])
    try:
        deadline = time.monotonic() + 60
        while not (store.exists() and store.read_bytes().count(b"\n") > 3):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == -signal.SIGKILL
    rows = read_results(store)
    assert len(rows) >= 3
    assert rows.column("hist_bins") == list(range(1, len(rows) + 1))
    assert set(rows.column("status")) == {"ok"}


def example_row(number):
    row = dict.fromkeys(COLUMNS)
    return {
        **row,
        "status": "ok",
        "message": 'a "quoted", text; ä',
        "configuration": "007",
        "hog_channel": ["ALL", 0][number % 2],
        "mirror": True,
        "C": 1e-4 / (number + 1),
        "accuracy": 1 / (number + 3),
        "seed": number,
        "trial": f"{number:04d}e{number}",
    }


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
@settings(max_examples=40)
@given(cut=st.integers(0, 10**6), count=st.integers(0, 5))
def test_a_file_cut_anywhere_keeps_its_whole_lines(tmp_path_factory, suffix, cut, count):
    path = tmp_path_factory.mktemp("cut") / f"rows{suffix}"
    store = RowStore(path, COLUMNS)
    for number in range(count):
        store.add(example_row(number))
    data = path.read_bytes() if count else b""
    path.write_bytes(data[: cut % (len(data) + 1)])
    whole = path.read_bytes().count(b"\n") - (suffix == ".csv")
    again = RowStore(path, COLUMNS)
    kept = [number for number in range(count) if f"{number:04d}e{number}" in again]
    assert kept == list(range(max(whole, 0)))
    for number in range(len(kept), count + 1):
        again.add(example_row(number))
    assert [dict(row) for row in read_results(path)] == [example_row(number) for number in range(count + 1)]


def test_a_numpy_value_and_a_nan_are_written_plainly(tmp_path):
    row = {**example_row(0), "accuracy": np.float64(0.5), "frame_f1": math.nan, "message": "two\nlines"}
    for suffix in (".csv", ".jsonl"):
        RowStore(tmp_path / f"rows{suffix}", COLUMNS).add(row)
        (read,) = read_results(tmp_path / f"rows{suffix}")
        assert (read["accuracy"], read["frame_f1"], read["message"]) == (0.5, None, "two lines")


def test_stores_that_are_something_else(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("frame,track\n1,2\n")
    with pytest.raises(DatasetError, match="has other columns than this release writes; choose another"):
        RowStore(path, COLUMNS)
    RowStore(tmp_path / "other.csv", COLUMNS).add(example_row(0))
    text = (tmp_path / "other.csv").read_text()
    path.write_text(text + "ok,1\n")
    with pytest.raises(DatasetError, match=r"rows.csv are damaged in line 3; delete that line"):
        RowStore(path, COLUMNS)
    lines = tmp_path / "rows.jsonl"
    lines.write_text("[1]\n")
    with pytest.raises(DatasetError, match=r"rows.jsonl are damaged in line 1"):
        RowStore(lines, COLUMNS)
    lines.write_bytes(b"\xff\xfe\n")
    with pytest.raises(DatasetError, match="are no UTF-8 text"):
        read_results(lines)
    with pytest.raises(DatasetError, match=r"results .*missing.csv do not exist"):
        read_results(tmp_path / "missing.csv")
    with pytest.raises(InvalidInputError, match=r"path must end in .csv or .jsonl; got 'rows.txt'"):
        read_results(tmp_path / "rows.txt")


# Features kept


def test_kept_features_are_the_features(patch_set, monkeypatch):
    cache = FeatureCache(patch_set.patches)
    params = FeatureParams(**SMALL)
    rows = np.array([5, 3, 117])
    expected = extract_features(patch_set.patches, params)
    np.testing.assert_array_equal(cache.rows(params, rows), expected[rows])
    np.testing.assert_array_equal(cache.all(params), expected)
    flipped = extract_features(np.ascontiguousarray(patch_set.patches[:, :, ::-1]), params)
    np.testing.assert_array_equal(cache.all(params, mirrored=True), flipped)
    monkeypatch.setattr(_feature_cache, "extract_features", None)
    cache.rows(params, rows)[:] = -1  # The caller's own copy.
    np.testing.assert_array_equal(cache.all(params), expected)
    with pytest.raises(ValueError, match="read-only"):
        cache.all(params)[0] = 0


def test_the_longest_unused_features_go_first(patch_set):
    one, two = FeatureParams(**SMALL), FeatureParams(**{**SMALL, "orient": 5})
    size = 120 * one.length * 4 / 1e6
    cache = FeatureCache(patch_set.patches, memory_mb=size * 2.5)
    for params, mirrored in ((one, False), (two, False), (one, False), (one, True)):
        cache.all(params, mirrored=mirrored)
    assert list(cache._kept) == [(one, False), (one, True)]
    assert len(FeatureCache(patch_set.patches, memory_mb=0).all(one)) == 120


def test_features_stay_on_disk(patch_set, tmp_path, monkeypatch, caplog):
    folder = tmp_path / "new" / "features"
    params = FeatureParams(**SMALL)
    expected = FeatureCache(patch_set.patches, folder=folder).all(params)
    (file,) = folder.iterdir()
    computed = []

    def counted(patches, *arguments, **options):
        computed.append(len(patches))
        return extract_features(patches, *arguments, **options)

    monkeypatch.setattr(_feature_cache, "extract_features", counted)
    np.testing.assert_array_equal(FeatureCache(patch_set.patches, folder=folder).all(params), expected)
    assert max(computed) < 10  # A probe only.
    FeatureCache(patch_set.patches[:50], folder=folder).all(params)
    assert max(computed) == 50
    whole = file.read_bytes()
    for faulty, message in (
        (whole[: len(whole) // 2], "are damaged"),
        (b"", "are damaged"),
        (whole[:200] + bytes(len(whole) - 200), "are not those of this release"),
    ):
        caplog.clear()
        file.write_bytes(faulty)
        with caplog.at_level(logging.WARNING):
            found = FeatureCache(patch_set.patches, folder=folder).all(params)
        np.testing.assert_array_equal(found, expected)
        assert message in caplog.text
        assert file.read_bytes() == whole


def test_a_cache_that_cannot_be_made(patch_set, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match=r"cache must be a folder that can be made, got .*file"):
        compare_configurations(patch_set, [SMALL], cache=tmp_path / "file")


# search_parameters


def test_halving_keeps_the_better_and_measures_the_best_in_full(patch_set, frames):
    grid = {**{name: [value] for name, value in SMALL.items()}, "orient": [0, 4, 6], "C": [1e-9, 1e-3, 1.0]}
    table = search_parameters(patch_set, grid, frames=frames, search=SEARCH, finalists=2, folds=2)
    assert list(dict.fromkeys(table.column("stage"))) == ["grid", "halving", "final"]
    refused = table.where(stage="grid")
    assert refused.column("status") == ["refused"] * 3
    rounds = table.where(stage="halving")
    # 120 patches are too few for more than one round: 6 recipes on 2 folds.
    assert len(rounds) == 12
    assert set(rounds.column("split")) == {"sequences, fold 1 of 2", "sequences, fold 2 of 2"}
    assert rounds.column("search_ms") == [None] * 12
    means = rounds.summarize(by=("orient", "C")).sort("accuracy")
    final = table.where(stage="final")
    assert len(final) == 2
    assert (final[0]["orient"], final[0]["C"]) == (means[0]["orient"], means[0]["C"])
    assert final.column("split") == ["sequences"] * 2
    assert all(row["search_ms"] > 0 and row["frame_f1"] is not None for row in final)
    assert len(final.front()) >= 1


def larger(patch_set, times):
    """The patches several times over, each copy a little brighter."""
    copies = [
        PatchSet(
            (patch_set.patches // 2 + 10 * number).astype(np.uint8),
            patch_set.labels,
            [name.replace("/", f"/{number}_", 1) for name in patch_set.names],
        )
        for number in range(times)
    ]
    return PatchSet.concatenate(copies)


def test_later_rounds_see_fewer_recipes_and_more_patches(patch_set):
    many = larger(patch_set, 8)
    grid = {**{name: [value] for name, value in SMALL.items()}, "C": [1e-9, 1e-5, 1e-3, 1.0]}
    table = search_parameters(
        many, grid, split="random", folds=2, factor=2, finalists=0, time_search=False, random_state=1
    )
    sizes = table.numbers("train_size") + table.numbers("test_size")
    recipes = {
        size: len(set(table._take(np.flatnonzero(sizes == size)).column("C"))) for size in sorted(set(sizes))
    }
    assert list(recipes.values()) == [4, 2]
    assert max(recipes) == pytest.approx(2 * min(recipes), rel=0.01)
    assert 1e-9 not in table._take(np.flatnonzero(sizes == max(sizes))).column("C")


def test_candidates_are_drawn_at_random(patch_set):
    grid = {**{name: [value] for name, value in SMALL.items()}, "C": [10.0**power for power in range(-8, 2)]}
    options = {"split": "random", "candidates": 3, "finalists": 1, "time_search": False, "folds": 2}
    drawn = [
        set(
            search_parameters(patch_set, grid, random_state=seed, **options)
            .where(stage="halving")
            .column("C")
        )
        for seed in (0, 0, 1)
    ]
    assert len(drawn[0]) == 3
    assert drawn[0] == drawn[1] != drawn[2]


def test_a_killed_search_goes_on_where_it_was(patch_set, tmp_path, monkeypatch):
    many = larger(patch_set, 8)
    grid = {**{name: [value] for name, value in SMALL.items()}, "C": [1e-5, 1e-4, 1e-3], "orient": [3, 4, 5]}
    options = {
        "split": "groups",
        "folds": 2,
        "finalists": 2,
        "time_search": False,
        "store": tmp_path / "rows.csv",
    }
    with monkeypatch.context() as patched:
        done = count_measurements(patched, stop_after=13)
        with pytest.raises(KeyboardInterrupt):
            search_parameters(many, grid, **options)
    assert len(read_results(options["store"])) == 13
    done = count_measurements(monkeypatch)
    resumed = search_parameters(many, grid, **options)
    once = len(done)
    fresh = search_parameters(many, grid, **{**options, "store": None})
    assert len(done) - once == once + 13
    assert without_times(fresh) == without_times(resumed)


def test_a_recipe_that_cannot_be_trained_loses(patch_set, monkeypatch):
    train = Bench.train

    def without_six(self, recipe, *arguments):
        if recipe.params.orient == 6:
            raise InvalidInputError("too large")
        return train(self, recipe, *arguments)

    monkeypatch.setattr(Bench, "train", without_six)
    grid = {**{name: [value] for name, value in SMALL.items()}, "orient": [6, 4]}
    table = search_parameters(patch_set, grid, split="random", folds=2, time_search=False)
    assert table.where(stage="halving").where(orient=6).column("status") == ["refused"] * 2
    assert table.where(stage="final").column("orient") == [4]


@pytest.mark.parametrize("split", ["sequences", "groups", "random"])
def test_folds_cover_all_and_leak_nothing(patch_set, split):
    copies = PatchSet(
        np.concatenate([patch_set.patches, patch_set.patches // 2 + 20]),
        np.tile(patch_set.labels, 2),
        (*patch_set.names, *(name.replace(".png", "0.png") for name in patch_set.names)),
    )
    fold_of = make_folds(copies, split, 3, seed=0)
    assert set(fold_of) == {0, 1, 2}
    assert np.bincount(fold_of).min() > 240 / 3 * 0.6
    if split == "groups":
        np.testing.assert_array_equal(fold_of[:120], fold_of[120:])
    if split == "sequences":
        for source in set(copies.sources):
            rows = np.flatnonzero(copies.sources == source)
            numbers = [int(copies.names[row].rpartition("/")[2].removesuffix(".png")) for row in rows]
            assert (np.diff(fold_of[rows][np.argsort(numbers)]) <= 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"grid": {}}, "grid must map names of color_space, .* to lists of values; got"),
        ({"grid": {"size": [1]}}, "grid knows no 'size'; the options are"),
        ({"grid": {"orient": 8}}, r"grid\['orient'\] must be a list of values; got 8"),
        ({"grid": {"color_space": "LAB"}}, r"grid\['color_space'\] must be a list of values"),
        ({"grid": {"orient": []}}, r"grid\['orient'\] must hold at least one value"),
        ({"grid": {"orient": [0, 500]}}, "grid holds no possible combination: orient must be"),
        ({"grid": {"orient": range(1, 181), "hist_bins": range(1, 257), "C": range(1, 9)}}, "at most 100000"),
        ({"split": "sources"}, "split must be one of 'sequences', 'groups', 'random'"),
        ({"folds": 1}, "folds must be an integer from 2 to 100"),
        ({"folds": 90, "split": "random"}, "patch_set is too small for folds=90"),
        ({"factor": 1}, "factor must be an integer from 2"),
        ({"finalists": -1}, "finalists must be an integer at least 0"),
        ({"candidates": 0}, "candidates must be an integer at least 1"),
        ({"random_state": -1}, "random_state must be an integer from 0"),
    ],
)
def test_searches_that_make_no_sense(patch_set, options, message):
    with pytest.raises(InvalidInputError, match=message):
        search_parameters(patch_set, **{"grid": {"orient": [4]}, "time_search": False, **options})


def test_a_fold_with_one_class_is_refused(patch_set):
    lopsided = PatchSet(patch_set.patches, patch_set.labels, [f"all/{row}.png" for row in range(120)])
    with pytest.raises(InvalidInputError, match="lacks vehicles or others in or beside fold 1 of folds=2"):
        search_parameters(lopsided, {"orient": [4]}, folds=2)


def test_a_typed_grid():
    text = "orient=8,9 color_space=YCrCb,LAB  hog_channel=ALL,0 C=1e-4,1 mirror=true,no"
    grid = parse_grid(text)
    assert grid == {
        "orient": [8, 9],
        "color_space": ["YCrCb", "LAB"],
        "hog_channel": ["ALL", 0],
        "C": [1e-4, 1],
        "mirror": [True, False],
    }
    assert len(expand_grid(grid)) == 32
    assert list(expand_grid({"orient": np.arange(8, 10), "C": (1,)})) == [
        {"orient": 8, "C": 1},
        {"orient": 9, "C": 1},
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "grid is empty; name at least one option"),
        ("orient", "grid must be like 'orient=8,9 .* got 'orient'"),
        ("orient=8, 9", "got 'orient=8,'"),
        ("=8", "got '=8'"),
        ("orient=8 orient=9", "grid names orient twice"),
        ("color=LAB", "grid knows no 'color'"),
    ],
)
def test_a_grid_typed_wrong(text, message):
    with pytest.raises(InvalidInputError, match=message):
        parse_grid(text)


# The table


points = st.lists(st.tuples(st.none() | st.integers(0, 5), st.none() | st.integers(0, 5)), max_size=12).map(
    lambda pairs: ResultTable([{"accuracy": gain, "search_ms": cost} for gain, cost in pairs])
)


@given(table=points)
def test_the_front_is_what_nothing_beats(table):
    full = [(row["accuracy"], row["search_ms"]) for row in table if None not in row.values()]
    front = [(row["accuracy"], row["search_ms"]) for row in table.front()] if len(table) else []
    assert sorted(front) == front
    for gain, cost in full:
        beaten = any((g >= gain and c < cost) or (g > gain and c <= cost) for g, c in full)
        assert ((gain, cost) in front) == (not beaten)
    assert len(set(front)) == len(front)


def test_mean_and_spread():
    rows = [
        {"configuration": "a", "C": 1, "split": "random", "accuracy": value} for value in (0.9, 0.8, None)
    ]
    (row,) = ResultTable([*rows, {**rows[0], "configuration": "b", "accuracy": None}]).summarize()
    assert row["runs"] == 2
    assert row["accuracy"] == pytest.approx(0.85)
    assert row["accuracy_std"] == pytest.approx(np.std([0.9, 0.8], ddof=1))


def test_rows_can_be_picked_and_ordered():
    table = ResultTable(
        [{"name": "a", "ms": 3.0}, {"name": "b", "ms": None}, {"name": "c", "ms": 1.0, "x": 1}]
    )
    assert table.columns == ("name", "ms", "x")
    assert table.column("x") == [None, None, 1]
    assert table.sort("ms", descending=False).column("name") == ["c", "a", "b"]
    assert table.sort("ms").column("name") == ["a", "c", "b"]
    assert table.where(name="c")[0]["ms"] == 1.0
    assert repr(table) == "ResultTable(3 rows of 3 columns)"
    with pytest.raises(TypeError, match="item assignment"):
        table[0]["ms"] = 4
    with pytest.raises(InvalidInputError, match="column 'sec' is none of the table's: name, ms, x"):
        table.column("sec")
    with pytest.raises(InvalidInputError, match="column 'name' holds more than numbers"):
        table.numbers("name")
    with pytest.raises(InvalidInputError, match="rows must be a list of mappings"):
        ResultTable("rows")
    with pytest.raises(InvalidInputError, match="rows must be mappings, got 3"):
        ResultTable([3])


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_a_table_reads_as_it_was_written(tmp_path, suffix):
    table = ResultTable([example_row(number) for number in range(4)])
    table.write(tmp_path / f"table{suffix}")
    assert read_results(tmp_path / f"table{suffix}").rows == table.rows
    assert (tmp_path / f"table{suffix}").read_text(encoding="utf-8").count("\n") == 4 + (suffix == ".csv")


def test_a_table_as_parquet_and_in_pandas(tmp_path):
    pytest.importorskip("pandas")
    parquet = pytest.importorskip("pyarrow.parquet")
    table = ResultTable([example_row(number) for number in range(4)])
    table.write(tmp_path / "table.parquet")
    read = parquet.read_table(tmp_path / "table.parquet").to_pylist()
    assert [row["accuracy"] for row in read] == table.column("accuracy")
    assert [row["hog_channel"] for row in read] == ["ALL", "0", "ALL", "0"]
    assert [row["trial"] for row in read] == table.column("trial")
    frame = table.to_pandas()
    assert list(frame.columns) == list(COLUMNS)
    assert frame["C"].tolist() == table.column("C")


def test_an_empty_table(tmp_path):
    table = ResultTable([])
    assert (len(table), table.columns, table.column("anything"), len(table.summarize())) == (0, (), [], 0)
    table.write(tmp_path / "empty.jsonl")
    assert len(read_results(tmp_path / "empty.jsonl")) == 0
    with pytest.raises(InvalidInputError, match=r"path must end in .csv or .jsonl or .parquet; got 'a.xls'"):
        table.write(tmp_path / "a.xls")


# The plot


def test_the_plot_marks_the_front():
    table = ResultTable(
        [
            {"configuration": name, "accuracy": accuracy, "search_ms": cost}
            for name, accuracy, cost in (("a", 0.97, 4), ("b", 0.96, 5), ("c", 0.99, 9), ("d", None, 1))
        ]
    )
    figure, given = plt.subplots()
    try:
        assert plot_tradeoff(table, ax=given) is given
        assert given.lines[0].get_xydata().tolist() == [[4, 0.97], [9, 0.99]]
        assert given.collections[0].get_offsets().tolist() == [[4, 0.97], [5, 0.96], [9, 0.99]]
        assert [text.get_text() for text in given.texts] == ["a", "c"]
        assert (given.get_xlabel(), given.get_ylabel()) == ("search ms", "accuracy")
        other = plot_tradeoff(table, label=None)
        assert other.figure is not figure
        assert not other.texts
    finally:
        plt.close("all")
    with pytest.raises(InvalidInputError, match="column 'frame_f1' is none of"):
        plot_tradeoff(table, quality="frame_f1")
    with pytest.raises(InvalidInputError, match="table has no row with both accuracy and search_ms"):
        plot_tradeoff(ResultTable([]))


# Mined negatives


@pytest.fixture(scope="module")
def careless():
    """A classifier that takes about half of all windows for vehicles."""
    return random_classifier(FeatureParams(**SMALL))


def boxes_of(mined):
    """Frame and box of each mined patch, as its name tells them."""
    parts = [name.removesuffix(".png").rsplit("/", 1)[1].rsplit("_", 3) for name in mined.names]
    corners = np.array([[int(left), int(top), int(side)] for _, left, top, side in parts]).reshape(-1, 3)
    boxes = np.concatenate([corners[:, :2], corners[:, :2] + corners[:, 2:]], axis=1)
    return [frame for frame, *_ in parts], boxes


def test_mined_windows_are_false_and_touch_no_label(scenes, labels, careless):
    images = {number: scene.image for number, scene in enumerate(scenes)}
    mined = mine_negatives(images, labels, careless, search=SEARCH, max_overlap=1.0)
    assert len(mined) > 10
    assert not mined.labels.any()
    assert set(mined.sources) == {"mined"}
    numbers, boxes = boxes_of(mined)
    for number, (left, top, right, bottom) in zip(numbers, boxes):
        for x1, y1, x2, y2 in labels.boxes[labels.rows(int(number))]:
            assert left >= x2 - 1 or right <= x1 + 1 or top >= y2 - 1 or bottom <= y1 + 1
    # Without labels, the windows on vehicles are mistakes as well.
    nothing = FrameBoxes([], None, [], frame_keys=(0, 1))
    assert len(mine_negatives(images, nothing, careless, search=SEARCH, max_overlap=1.0)) > len(mined)
    found = sum(len(find_cars(image, careless, SEARCH)) for image in images.values())
    assert len(mine_negatives(images, nothing, careless, search=SEARCH, max_overlap=1.0)) == found


def test_a_mined_patch_is_the_window_that_was_searched(careless):
    # At this width a window of 64 is not resized, so that the patch is the frame's own pixels.
    image = np.random.default_rng(3).integers(0, 256, (200, 1280, 3), np.uint8)
    search = SearchParams(bands=(SearchBand(window=(64, 64), y=(0, 100)),), horizon=0.25)
    mined = mine_negatives([image], FrameBoxes([], None, [], frame_keys=[0]), careless, search=search)
    assert len(mined) > 5
    _, boxes = boxes_of(mined)
    for patch, (left, top, right, bottom) in zip(mined.patches, boxes):
        np.testing.assert_array_equal(patch, image[top:bottom, left:right])
    windows = find_cars(image, careless, search)
    scores = {tuple(box): score for box, score in zip(windows.boxes.astype(int).tolist(), windows.scores)}
    mined_scores = [scores[tuple(box)] for box in boxes.tolist()]
    assert mined_scores == sorted(mined_scores, reverse=True)


def test_a_window_beyond_the_frame_repeats_its_edge(careless):
    image = np.random.default_rng(4).integers(0, 256, (200, 1280, 3), np.uint8)
    search = SearchParams(
        bands=(SearchBand(window=(64, 64), y=(0, 100)),), horizon=0.25, horizontal_padding=0.5
    )
    mined = mine_negatives(
        [image],
        FrameBoxes([], None, [], frame_keys=[0]),
        careless,
        search=search,
        min_score=-1e6,
        max_overlap=1,
    )
    _, boxes = boxes_of(mined)
    row = int(boxes[:, 0].argmin())
    left, top = boxes[row, :2]
    assert left == -32
    np.testing.assert_array_equal(mined.patches[row][:, :32], image[top : top + 64, :1].repeat(32, axis=1))
    np.testing.assert_array_equal(mined.patches[row][:, 32:], image[top : top + 64, :32])


def test_fewer_and_surer_windows(frames, labels, careless):
    def mine(**options):
        return len(mine_negatives(frames.frames, labels, careless, search=SEARCH, **options))

    assert mine(max_overlap=0.0) < mine() < mine(max_overlap=1.0)
    assert mine(min_score=1.0) < mine() < mine(min_score=-1.0)
    assert mine(per_frame=2) == 4
    assert mine(min_score=1e5) == 0
    everything = FrameBoxes([0, 1], None, [[0, 0, 640, 360]] * 2, ignore=np.array([True, True]))
    assert len(mine_negatives(frames.frames, everything, careless, search=SEARCH)) == 0


def test_mined_patches_make_a_better_classifier(patch_set, frames, labels):
    params = FeatureParams(**SMALL)
    few = patch_set[::3]
    before = train_classifier(few.patches, few.labels, params=params, C=0.1)
    mined = mine_negatives(frames.frames, labels, before, search=SEARCH, min_score=-0.5)
    more = PatchSet.concatenate([few, mined])
    after = train_classifier(more.patches, more.labels, params=params, C=0.1)
    mistakes = [(each.decision_function(mined.patches) > -0.5).sum() for each in (before, after)]
    assert mistakes[1] < mistakes[0] / 2
    assert after.score(few.patches, few.labels) > 0.9


def test_frames_from_a_folder_are_mined_by_name(tmp_path, scenes, careless):
    from vehicle_detection.images import write_image

    write_image(tmp_path / "road one.png", scenes[0].image)
    boxes = FrameBoxes(["road one.png"], None, [[0, 0, 5, 5]])
    mined = mine_negatives(load_frames(tmp_path), boxes, careless, search=SEARCH, source="road")
    assert mined.names[0].startswith("non-vehicles/road/road one.png_")
    assert set(mined.sources) == {"road"}


def test_mining_what_makes_no_sense(frames, labels, careless):
    images = [image for _, image in frames]
    for arguments, message in (
        ((images, labels.renamed(str), careless), "labels know none of the frames, such as 0, such as '0'"),
        (
            (images, FrameBoxes([], None, []), careless),
            "labels know none of the frames, such as 0, but it is empty",
        ),
        ((images, [[0, 0, 5, 5]], careless), "labels must be Labels, got"),
        ((7, labels, careless), "frames must be a list of images, a mapping .*; got 7"),
        (([images[0].astype(float)], labels, careless), r"frame 0 must be an \(H, W, 3\) uint8 RGB array"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            mine_negatives(*arguments)
    for options, message in (
        ({"max_overlap": 1.5}, "max_overlap must be a number, at least 0 and at most 1"),
        ({"per_frame": 0}, "per_frame must be an integer at least 1"),
        ({"min_score": math.nan}, "min_score must be a number"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            mine_negatives(images, labels, careless, **options)


@pytest.mark.realdata
def test_real_frames_are_mined_beside_their_labels(real_data, careless):
    labels = read_labels(real_data / "labels" / "test_images.csv")
    frames = load_frames(real_data / "test_images")
    mined = mine_negatives(frames, labels, careless, per_frame=30, min_score=0.5)
    assert 0 < len(mined) <= 180
    for frame, box in zip(*boxes_of(mined)):
        boxes = labels.boxes[labels.rows(frame)]
        inside = np.minimum(boxes[:, 2:], box[2:]) - np.maximum(boxes[:, :2], box[:2])
        assert not (inside > 1).all(axis=1).any()


# The course's tables


def test_the_course_tables_are_written(patch_set, tmp_path, monkeypatch):
    from benchmarks import _course_runs, course_tables
    from vehicle_detection.images import write_image

    for image, name in zip(patch_set.patches, patch_set.names):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / name, image)
    for archive in ("vehicles", "non-vehicles"):
        shutil.make_archive(str(tmp_path / archive), "zip", tmp_path, archive)
    monkeypatch.setattr(_course_runs, "SEEDS", range(2))
    for name in ("FIRST", "SECOND"):
        monkeypatch.setattr(_course_runs, name, FeatureParams(**SMALL))
    for plan in _course_runs.PLANS.values():
        small = {
            name: FeatureParams(**{**SMALL, "orient": 2 + number})
            for number, name in enumerate(plan.configurations)
        }
        monkeypatch.setitem(vars(plan), "configurations", small)
    out = tmp_path / "docs"
    command = ["--data", str(tmp_path), "--out", str(out)]
    course_tables.main(command)
    page = (out / "results.md").read_text(encoding="utf-8")
    rows = (out / "results" / "rows.csv").read_bytes()
    assert page.count("\n## ") == 9
    assert "| random | 96 | 24 |" in page
    assert "## The shipped model" in page
    assert "| (9, 8, 2, All) | " in page
    assert str(tmp_path) not in page
    figures = sorted(path.stem for path in (out / "results").glob("*.png"))
    assert figures == sorted([*_course_runs.PLANS, "bayes_or_svm", "leakage", "prediction_time"])
    for name in figures:
        assert f"![](results/{name}.png)" in page
        assert len(read_results(out / "results" / f"{name}.csv")) > 1
    # Nothing is measured twice.
    count_measurements(monkeypatch, stop_after=0)
    course_tables.main(command)
    assert (out / "results" / "rows.csv").read_bytes() == rows
