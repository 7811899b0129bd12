import numpy as np
import pandas as pd
import pytest

from tests.training.trial_cases import SEARCH, SMALL, SMALL_GRID, UNTIMED, count_trials, without_times
from vehicle_detection.datasets import PatchSet, Split
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.training import (
    TrialOptions,
    compare_configurations,
    expand_grid,
    parse_grid,
    read_results,
)
from vehicle_detection.training.tuning import COLUMNS


def compare(patch_set, configurations, **options):
    return compare_configurations(patch_set, configurations, **{"options": UNTIMED, **options})


# compare_configurations


def test_every_configuration_is_tried_with_every_c_split_and_seed(patch_set):
    table = compare(
        patch_set,
        {"four": SMALL, "six": {**SMALL, "orient": 6}},
        splits=("sequences", "random"),
        C=(1e-3, 1.0),
        seeds=range(3),
    )
    assert tuple(table.columns) == COLUMNS
    assert set(table["status"]) == {"ok"}
    # One row for the sequences, which do not depend on the seed, and three for the random split.
    tried = table[["configuration", "C", "split", "seed"]]
    assert list(tried.itertuples(index=False, name=None)) == [
        (name, C, split, seed)
        for name in ("four", "six")
        for C in (1e-3, 1.0)
        for split, seed in (("sequences", 0), ("random", 0), ("random", 1), ("random", 2))
    ]
    assert table["orient"].tolist() == [4] * 8 + [6] * 8
    assert table["search_ms"].isna().all()
    assert table["accuracy"].between(0.7, 1).all()
    assert table["trial"].nunique() == 16


def test_a_configuration_overrides_the_training_options(patch_set):
    configurations = [{**SMALL, "C": 0.5, "positive_weight": 3.0, "mirror": False}, SMALL]
    table = compare(patch_set, configurations, C=[0.1, 0.2])
    assert table["C"].tolist() == [0.5, 0.1, 0.2]
    assert table["positive_weight"].tolist() == [3.0, 1.0, 1.0]
    assert table["mirror"].tolist() == [False, True, True]
    assert table["train_size"].nunique() == 1


def test_impossible_combinations_are_reported_and_skipped(patch_set, caplog):
    configurations = {"fine": SMALL, "none": {**SMALL, "orient": 0}, "odd": {**SMALL, "pix_per_cell": 10}}
    table = compare_configurations(
        patch_set, configurations, splits=("sequences", "random"), options=TrialOptions(search_params=SEARCH)
    )
    assert table["configuration"].tolist() == ["fine", "fine", "none", "odd", "odd"]
    assert table["status"].tolist() == ["ok", "ok", "failed", "partial", "partial"]
    assert table["message"].isna().tolist() == [True, True, False, False, False]
    assert "orient must be an integer from 1 to 180; got 0" in table["message"][2]
    assert table["orient"][2] == 0
    assert np.isnan(table["accuracy"][2])
    # The fast search does not support cells that do not divide the window.
    assert "got pix_per_cell=10" in table["message"][3]
    assert table["accuracy"][3] > 0.7
    assert table["search_ms"].notna().tolist() == [True, True, False, False, False]
    assert "none, C=0.0001: failed: orient must be" in caplog.text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"configurations": []}, "configurations must be a mapping .* at least one entry, got"),
        ({"configurations": ["vgg"]}, "preset must be one of"),
        ({"configurations": [{"orientt": 9}]}, "configuration has the unknown option 'orientt'; use color_"),
        ({"splits": "half"}, "splits must be one of 'sequences', 'groups'"),
        ({"splits": {}}, "splits must map names to Split; got none"),
        ({"splits": {"mine": Split([0], [120])}}, r"splits\['mine'\] holds row 120, but patch_set has 120"),
        ({"seeds": (1, 1)}, "seeds must be a list of different integers"),
        ({"store": "rows.csv"}, "store must end in .jsonl, got 'rows.csv'"),
        ({"store": "missing/rows.jsonl"}, "store needs an existing folder"),
    ],
)
def test_invalid_arguments_of_compare_configurations(patch_set, options, message):
    arguments = {"configurations": [SMALL], **options}
    with pytest.raises(InvalidInputError, match=message):
        compare(patch_set, arguments.pop("configurations"), **arguments)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "grid is empty; name at least one option"),
        ("orient", "grid must look like 'orient=8,9 .* got 'orient'"),
        ("orient=8, 9", "got 'orient=8,'"),
        ("=8", "got '=8'"),
        ("orient=8 orient=9", "grid names orient twice"),
        (" ".join(f"{name}={','.join('8' * 400)}" for name in ("orient", "hist_bins")), "at most 100000"),
    ],
)
def test_the_text_of_a_grid(text, message):
    grid = parse_grid("orient=8,9 color_space=YCrCb,LAB  hog_channel=ALL,0 C=1e-4,1 mirror=true,no")
    assert grid["hog_channel"] + grid["C"] + grid["mirror"] == ["ALL", 0, 1e-4, 1, True, False]
    assert len(expand_grid(grid)) == 32
    with pytest.raises(InvalidInputError, match=message):
        expand_grid(parse_grid(text))


@pytest.mark.parametrize("grid", [{}, {"orient": 8}, {"orient": []}])
def test_invalid_grids(grid):
    with pytest.raises(InvalidInputError, match=r"grid must map option names|grid\['orient'\] must be"):
        expand_grid(grid)


# The store


def test_a_second_run_measures_only_what_is_new(patch_set, tmp_path, monkeypatch):
    store = tmp_path / "rows.jsonl"
    options = {"splits": "random", "seeds": (0, 1), "store": store}
    first = compare(patch_set, {"a": SMALL, "bad": {"orient": 0}}, **options)
    tried = count_trials(monkeypatch)
    again = compare(patch_set, {"a": SMALL, "bad": {"orient": 0}}, **options)
    assert not tried
    pd.testing.assert_frame_equal(again, first)
    pd.testing.assert_frame_equal(read_results(store), first)
    # The name of a configuration is not part of the trial.
    more = compare(patch_set, {"b": SMALL, "c": {**SMALL, "hist_bins": 4}}, **options)
    assert [candidate.params.hist_bins for candidate in tried] == [4, 4]
    assert more["configuration"].tolist() == ["b", "b", "c", "c"]
    assert len(read_results(store)) == 5


def test_rows_of_other_patches_splits_and_frames_are_not_used(patch_set, frames, tmp_path, monkeypatch):
    store = tmp_path / "rows.jsonl"
    tried = count_trials(monkeypatch)
    compare(patch_set, [SMALL], store=store)
    changed = PatchSet(patch_set.patches[:, ::-1].copy(), patch_set.labels, patch_set.names)
    on_frames = TrialOptions(frames=frames, time_search=False)
    searched = TrialOptions(frames=frames, search_params=SEARCH, time_search=False)
    own_split = {"splits": {"mine": Split([0, 119], [1, 118])}}
    others = [{"options": each} for each in (on_frames, searched, TrialOptions())]
    for number, options in enumerate([{}, own_split, *others], start=2):
        compare(changed if number == 2 else patch_set, [SMALL], store=store, **options)
        assert len(tried) == number
    compare(patch_set, [SMALL], store=store)
    assert len(tried) == 6


def test_an_interrupted_run_continues_from_its_store(patch_set, tmp_path, monkeypatch):
    store = tmp_path / "rows.jsonl"
    grid = expand_grid({**SMALL_GRID, "orient": [4, 5, 6], "C": [0.1, 1.0]})
    complete = compare(patch_set, grid)
    with monkeypatch.context() as patched:
        count_trials(patched, stop_after=4)
        with pytest.raises(KeyboardInterrupt):
            compare(patch_set, grid, store=store)
    assert len(read_results(store)) == 4
    with store.open("a") as file:
        file.write('{"status": "ok", "accur')
    tried = count_trials(monkeypatch)
    resumed = compare(patch_set, grid, store=store)
    assert len(tried) == 2
    pd.testing.assert_frame_equal(without_times(resumed), without_times(complete))
    pd.testing.assert_frame_equal(read_results(store), resumed)
