import http.server
import io
import os
import threading
import time
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.datasets import (
    PatchSet,
    Split,
    fetch_patches,
    find_near_duplicates,
    load_frames,
    load_patches,
    load_training_patches,
    split_groups,
    split_leakage,
    split_random,
    split_sequences,
    split_sources,
)
from vehicle_detection.datasets import archives as _download
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.images import write_image


def patch_image(seed, side=64):
    return np.random.default_rng(seed).integers(0, 256, (side, side, 3), np.uint8)


def png(seed, side=64):
    return cv2.imencode(".png", patch_image(seed, side)[..., ::-1])[1].tobytes()


def write_zip(path, members, **options):
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def unpack(path, folder):
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    return folder


def make_set(names, labels=None, side=1):
    patches = np.zeros((len(names), side, side, 3), np.uint8)
    return PatchSet(patches, [1] * len(names) if labels is None else labels, names)


VEHICLES = {
    "vehicles/": b"",
    "vehicles/GTI_Far/image10.png": png(10),
    "vehicles/GTI_Far/image9.png": png(9),
    "vehicles/.DS_Store": b"litter",
    "__MACOSX/vehicles/GTI_Far/._image9.png": b"litter",
    "vehicles/KITTI_extracted/1.png": png(1),
}
OTHERS = {"non-vehicles/Extras/extra1.png": png(20), "non-vehicles/GTI/image1.png": png(21)}
IN_ORDER = (
    "vehicles/GTI_Far/image9.png",
    "vehicles/GTI_Far/image10.png",
    "vehicles/KITTI_extracted/1.png",
)


@pytest.fixture
def vehicles_zip(tmp_path):
    return write_zip(tmp_path / "vehicles.zip", VEHICLES)


@pytest.fixture
def others_zip(tmp_path):
    return write_zip(tmp_path / "non-vehicles.zip", OTHERS)


# Natural order


@given(st.lists(st.integers(0, 10**30), min_size=1))
def test_natural_order_is_the_order_of_the_numbers(numbers):
    names = [f"vehicles/GTI/image{number}.png" for number in numbers]
    ordered = sorted(names, key=_download.natural_key)
    assert ordered == [f"vehicles/GTI/image{number}.png" for number in sorted(numbers)]


@given(st.lists(st.text("a01/9-", max_size=6), unique=True))
def test_natural_order_is_total(names):
    backwards = names[::-1]
    assert sorted(names, key=_download.natural_key) == sorted(backwards, key=_download.natural_key)


# PatchSet


def test_patch_set_has_columns_of_fixed_types():
    patches = make_set(["a/x/1.png", "a/y/2.png"], [0, 1])
    assert patches.labels.dtype == np.bool_
    assert patches.names == ("a/x/1.png", "a/y/2.png")
    assert patches.sources.tolist() == ["x", "y"]
    assert len(patches) == 2
    assert patches.balance == 0.5
    assert repr(patches) == "PatchSet(2 patches of 1x1 pixels, 1 of them vehicles)"


def test_counts_are_in_natural_order():
    patches = make_set(["a/GTI10/1.png", "a/GTI9/1.png", "b/GTI9/1.png", "alone.png"])
    assert list(patches.counts().items()) == [("", 1), ("GTI9", 2), ("GTI10", 1)]


@pytest.mark.parametrize("rows", [[2, 0], np.array([True, False, True]), slice(None, None, -1), []])
def test_rows_are_taken_from_all_columns(rows):
    patches = PatchSet(np.stack([patch_image(i) for i in range(3)]), [1, 0, 1], ["0.png", "1.png", "2.png"])
    taken = patches[rows]
    expected = np.arange(3)[rows]
    assert taken.names == tuple(f"{row}.png" for row in expected)
    np.testing.assert_array_equal(taken.patches, patches.patches[expected])
    np.testing.assert_array_equal(taken.labels, patches.labels[expected])


def test_a_single_row_is_refused():
    with pytest.raises(InvalidInputError, match=r"rows must be a slice.*got 0.*patches\[index\]"):
        make_set(["a.png"])[0]


@pytest.mark.parametrize(
    ("patches", "labels", "names", "message"),
    [
        (np.zeros((2, 4, 4, 3)), [1, 1], ["a", "b"], r"patches must be an \(N, 4, 4, 3\) uint8.*float64"),
        (np.zeros((2, 4, 5, 3), np.uint8), [1, 1], ["a", "b"], r"patches must be .*\(2, 4, 5, 3\)"),
        ("a.png", [1], ["a"], "patches must be an .*load_patches"),
        (np.zeros((2, 4, 4, 3), np.uint8), [1], ["a", "b"], "labels must hold one entry .* 2 patches, got 1"),
        (np.zeros((2, 4, 4, 3), np.uint8), [1, 1], ["a"], "names must hold one entry .* 2 patches, got 1"),
        (np.zeros((2, 4, 4, 3), np.uint8), [1, -1], ["a", "b"], "labels must be .*labels > 0"),
        (np.zeros((2, 4, 4, 3), np.uint8), [1.0, 0.5], ["a", "b"], "labels must be one boolean"),
        (np.zeros((2, 4, 4, 3), np.uint8), [1, 1], ["a", Path("b")], "names must be strings"),
    ],
)
def test_bad_columns_are_refused(patches, labels, names, message):
    with pytest.raises(InvalidInputError, match=message):
        PatchSet(patches, labels, names)


def test_an_empty_set_has_no_balance():
    empty = make_set(["a.png"])[[]]
    assert len(empty) == 0
    assert np.isnan(empty.balance)
    assert empty.counts() == {}


@given(st.data())
def test_concatenating_the_parts_gives_the_whole(data):
    count = data.draw(st.integers(1, 8))
    patches = PatchSet(
        np.arange(count * 3, dtype=np.uint8).reshape(count, 1, 1, 3),
        data.draw(st.lists(st.booleans(), min_size=count, max_size=count)),
        [f"a/{index}.png" for index in range(count)],
    )
    cut = data.draw(st.integers(0, count))
    whole = PatchSet.concatenate([patches[:cut], patches[cut:]])
    assert whole.names == patches.names
    np.testing.assert_array_equal(whole.patches, patches.patches)
    np.testing.assert_array_equal(whole.labels, patches.labels)
    order = data.draw(st.permutations(range(count)))
    assert patches[order].fingerprint == patches.fingerprint


def test_sets_of_different_sides_do_not_concatenate():
    with pytest.raises(InvalidInputError, match=r"one patch size; got \[\(1, 1, 3\), \(2, 2, 3\)\]"):
        PatchSet.concatenate([make_set(["a"]), make_set(["b"], side=2)])
    with pytest.raises(InvalidInputError, match=r"sets must be one or more"):
        PatchSet.concatenate([])


def test_the_fingerprint_depends_on_names_labels_and_pixels():
    patches = make_set(["a", "b"], [0, 1])
    changed = patches.patches.copy()
    changed[0, 0, 0, 0] = 1
    others = [
        PatchSet(changed, patches.labels, patches.names),
        PatchSet(patches.patches, [1, 1], patches.names),
        PatchSet(patches.patches, patches.labels, ["a", "c"]),
    ]
    assert len({patches.fingerprint, *(other.fingerprint for other in others)}) == 4
    assert len(patches.fingerprint) == 64


# Loading


def test_a_zip_and_the_folder_it_unpacks_to_are_the_same_set(vehicles_zip, tmp_path):
    from_zip = load_patches(vehicles_zip)
    from_folder = load_patches(unpack(vehicles_zip, tmp_path / "out") / "vehicles")
    assert from_zip.names == from_folder.names == IN_ORDER
    np.testing.assert_array_equal(from_zip.patches, np.stack([patch_image(seed) for seed in (9, 10, 1)]))
    np.testing.assert_array_equal(from_zip.patches, from_folder.patches)
    assert from_zip.labels.all()
    assert from_zip.fingerprint == from_folder.fingerprint


def test_the_order_in_the_zip_does_not_matter(vehicles_zip, tmp_path):
    backwards = write_zip(tmp_path / "backwards.zip", dict(reversed(VEHICLES.items())))
    assert load_patches(backwards).names == load_patches(vehicles_zip).names


@pytest.mark.parametrize("n_jobs", [1, 2, 7])
def test_the_number_of_threads_does_not_matter(vehicles_zip, n_jobs):
    patches = load_patches(vehicles_zip, n_jobs=n_jobs)
    np.testing.assert_array_equal(patches.patches, load_patches(vehicles_zip).patches)


def test_the_folder_may_be_the_working_folder(vehicles_zip, tmp_path, monkeypatch):
    monkeypatch.chdir(unpack(vehicles_zip, tmp_path / "out") / "vehicles")
    assert load_patches(".").names == IN_ORDER


def test_a_zip_without_a_top_folder_takes_its_own_name(tmp_path):
    bare = {name.partition("/")[2]: data for name, data in VEHICLES.items() if name.endswith(".png")}
    assert load_patches(write_zip(tmp_path / "vehicles.zip", bare), label=0).names == IN_ORDER
    flat = write_zip(tmp_path / "mine.zip", {"2.png": png(1), "10.PNG": png(2)})
    assert load_patches(flat, label=1).names == ("mine/2.png", "mine/10.PNG")
    pictures = write_zip(tmp_path / "dotted.zip", {"./cars/2.png": png(1)})
    assert load_patches(pictures).names == ("cars/2.png",)


def test_jpeg_patches_are_read_and_other_files_are_not(tmp_path):
    folder = tmp_path / "cars"
    for name in ("1.jpg", "2.JPEG", "3.png"):
        (folder / name).parent.mkdir(exist_ok=True)
        write_image(folder / name, np.full((64, 64, 3), 200, np.uint8))
    (folder / "notes.txt").write_text("no patch")
    (folder / ".hidden.png").write_bytes(b"no patch")
    (folder / ".cache").mkdir()
    (folder / ".cache" / "4.png").write_bytes(b"no patch")
    patches = load_patches(folder)
    assert patches.names == ("cars/1.jpg", "cars/2.JPEG", "cars/3.png")
    assert np.abs(patches.patches.astype(int) - 200).max() <= 1


def test_labels_come_from_the_innermost_folder_that_tells_the_class(vehicles_zip, others_zip, tmp_path):
    unpack(vehicles_zip, tmp_path / "cars")
    unpack(others_zip, tmp_path / "cars")
    patches = load_patches(tmp_path / "cars")
    assert patches.labels.tolist() == [name.startswith("cars/vehicles") for name in patches.names]
    assert load_patches(others_zip).balance == 0
    assert load_patches(others_zip, label=1).balance == 1


def test_a_folder_that_tells_no_class_needs_a_label(tmp_path):
    write_image(tmp_path / "1.png", patch_image(1))
    with pytest.raises(InvalidInputError, match=r"label must be 1 or 0 .* pass label=1"):
        load_patches(tmp_path)
    with pytest.raises(InvalidInputError, match=r"label must be one of None, 0, 1; got 2"):
        load_patches(tmp_path, label=2)


def test_patches_of_another_size_are_named(tmp_path):
    source = write_zip(tmp_path / "cars.zip", {"cars/1.png": png(1), "cars/2.png": png(2, side=32)})
    with pytest.raises(
        DatasetError, match=r"cars/2.png of .*cars.zip is 32x32 pixels, expected 64x64; resize it with cv2"
    ):
        load_patches(source)
    half = write_zip(tmp_path / "half.zip", {"cars/2.png": png(2, side=32)})
    assert load_patches(half, size=32).patches.shape == (1, 32, 32, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": 0}, "size must be an integer from 1 to 4096; got 0"),
        ({"n_jobs": 0}, "n_jobs must be an integer at least 1; got 0"),
    ],
)
def test_bad_options_are_refused(vehicles_zip, options, message):
    with pytest.raises(InvalidInputError, match=message):
        load_patches(vehicles_zip, **options)


def test_a_source_must_be_a_path():
    with pytest.raises(InvalidInputError, match=r"source must be the path of a folder or zip, got 3"):
        load_patches(3)


def test_a_missing_source_is_named(tmp_path):
    with pytest.raises(DatasetError, match=r"source .*nowhere does not exist; check the path or use fetch"):
        load_patches(tmp_path / "nowhere")


def test_a_source_without_patches_is_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"source .* holds no PNG or JPEG patches; use fetch_patches"):
        load_patches(tmp_path)
    litter = write_zip(tmp_path / "litter.zip", {"vehicles/.DS_Store": b"", "__MACOSX/a.png": b""})
    with pytest.raises(DatasetError, match=r"litter.zip holds no PNG or JPEG patches"):
        load_patches(litter)
    with pytest.raises(DatasetError, match=r"holds no PNG or JPEG patches; pass a zip of it \(litter.zip\)"):
        load_patches(tmp_path)


def test_a_file_that_is_no_zip_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(png(1))
    with pytest.raises(DatasetError, match=r"a.png is not a zip; pass a folder of patches or a whole .zip"):
        load_patches(tmp_path / "a.png")
    (tmp_path / "b.zip").write_text("<html>sign in</html>")
    with pytest.raises(DatasetError, match=r"b.zip is a web page, not a zip"):
        load_patches(tmp_path / "b.zip")


def test_every_cut_of_a_zip_is_refused(tmp_path):
    data = write_zip(tmp_path / "cars.zip", {"cars/1.png": png(1, 4), "cars/2.png": png(2, 4)}).read_bytes()
    for length in range(len(data)):
        (tmp_path / "cars.zip").write_bytes(data[:length])
        with pytest.raises(DatasetError, match=r"cars.zip is (a zip that is cut short or damaged|not a zip)"):
            load_patches(tmp_path / "cars.zip", size=4)


@given(st.data())
def test_a_damaged_zip_gives_its_patches_or_a_dataset_error(tmp_path_factory, data):
    members = {"cars/1.png": png(1, 4)}
    buffer = io.BytesIO()
    write_zip(buffer, members, compression=zipfile.ZIP_DEFLATED)
    damaged = bytearray(buffer.getvalue())
    damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / "cars.zip"
    path.write_bytes(damaged)
    try:
        patches = load_patches(path, size=4, label=1)
    except DatasetError:
        return
    np.testing.assert_array_equal(patches.patches[0], patch_image(1, 4))


def test_an_unreadable_patch_is_named(tmp_path):
    source = write_zip(tmp_path / "cars.zip", {"cars/1.png": png(1), "cars/2.png": png(2)[:-100]})
    with pytest.raises(DatasetError, match=r"cars/2.png of .*cannot be decoded; replace or remove it"):
        load_patches(source)


def test_a_folder_that_cannot_be_listed_is_not_skipped(vehicles_zip, tmp_path, monkeypatch):
    folder = unpack(vehicles_zip, tmp_path / "out")
    scandir = os.scandir

    def forbid(path):
        if str(path).endswith("GTI_Far"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", forbid)
    with pytest.raises(
        DatasetError, match=r"GTI_Far cannot be read: Permission denied; check its permissions"
    ):
        load_patches(folder)


def test_progress_is_shown_on_request(vehicles_zip, capsys):
    load_patches(vehicles_zip)
    assert capsys.readouterr().err == ""
    load_patches(vehicles_zip, progress=True)
    assert "3/3" in capsys.readouterr().err


def test_training_patches_are_labelled_by_argument(vehicles_zip, others_zip):
    patches = load_training_patches(vehicles_zip, others_zip)
    assert patches.labels.tolist() == [True, True, True, False, False]
    assert patches.counts() == {"Extras": 1, "GTI": 1, "GTI_Far": 2, "KITTI_extracted": 1}
    whole = PatchSet.concatenate([load_patches(vehicles_zip), load_patches(others_zip)])
    assert patches.fingerprint == whole.fingerprint
    assert load_training_patches(others_zip, vehicles_zip).balance == 0.4


def test_training_patches_need_both_classes(vehicles_zip, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match=r"non_vehicles .*empty holds no PNG or JPEG patches"):
        load_training_patches(vehicles_zip, tmp_path / "empty")
    with pytest.raises(DatasetError, match=r"vehicles .*none.zip does not exist"):
        load_training_patches(tmp_path / "none.zip", vehicles_zip)


# Splits

FOLDERS = ("vehicles/GTI_Far", "vehicles/KITTI_extracted", "non-vehicles/GTI", "non-vehicles/Extras")
named_patches = st.lists(
    st.tuples(st.sampled_from(FOLDERS), st.integers(0, 200)), min_size=1, max_size=60, unique=True
)
shares = st.floats(0.05, 0.95)


def set_of(entries):
    names = [f"{folder}/image{number}.png" for folder, number in entries]
    return make_set(names, [name.startswith("vehicles") for name in names])


def assert_covers(split, count):
    assert sorted([*split.train.tolist(), *split.test.tolist()]) == list(range(count))
    assert (np.diff(split.train) > 0).all()
    assert (np.diff(split.test) > 0).all()


@given(st.lists(st.booleans(), min_size=20, max_size=100), shares, st.integers(0, 2**32 - 1))
def test_a_random_split_covers_all_and_keeps_the_balance(labels, share, seed):
    labels = np.array([*labels, *[True] * 20, *[False] * 20])
    split = split_random(labels, test_size=share, random_state=seed)
    assert_covers(split, len(labels))
    assert len(split.test) == np.ceil(share * len(labels))
    for label in (True, False):
        expected = len(split.test) * np.mean(labels == label)
        assert abs(np.sum(labels[split.test] == label) - expected) <= 1


def test_a_random_split_depends_on_the_seed_alone():
    patches = set_of([(folder, number) for folder in FOLDERS for number in range(10)])
    first, again = (split_random(patches, random_state=1) for _ in range(2))
    np.testing.assert_array_equal(first.test, again.test)
    np.testing.assert_array_equal(first.test, split_random(patches.labels, random_state=1).test)
    assert first.test.tolist() != split_random(patches, random_state=2).test.tolist()


@pytest.mark.parametrize(
    ("labels", "options", "message"),
    [
        ([1, 1, 1, 0], {}, "patches_or_labels cannot be split at test_size=0.2: 3 vehicles and 1 others"),
        ([], {}, "patches_or_labels cannot be split.*0 vehicles and 0 others"),
        ([1, 1, 0, 0], {"test_size": 1}, r"test_size must be a share in \(0, 1\), got 1"),
        ([1, 1, 0, 0], {"test_size": 0}, "test_size must be a number, greater than 0; got 0"),
        ([1, 1, 0, 0], {"random_state": None}, "random_state must be an integer"),
        ([-1, 1, 0, 0], {}, "patches_or_labels must be one boolean"),
    ],
)
def test_an_impossible_random_split_is_refused(labels, options, message):
    with pytest.raises(InvalidInputError, match=message):
        split_random(labels, **{"random_state": 0, **options})


@given(named_patches, shares)
def test_a_sequence_split_tests_on_the_end_of_each_folder(entries, share):
    folders = [folder for folder, _ in entries]
    counts = {folder: folders.count(folder) for folder in folders}
    if max(counts.values()) < 2:
        with pytest.raises(InvalidInputError, match=r"no folder of two or more patches; use split_random"):
            split_sequences(set_of(entries), test_size=share)
        return
    split = split_sequences(set_of(entries), test_size=share)
    assert_covers(split, len(entries))
    for folder, count in counts.items():
        train, test = ([entries[row][1] for row in rows if entries[row][0] == folder] for rows in split)
        assert train
        assert bool(test) == (count > 1)
        assert not test or max(train) < min(test)
        assert count == 1 or abs(len(test) - share * count) <= 1


@given(named_patches)
def test_a_split_by_source_keeps_sources_apart(entries):
    patches = set_of(entries)
    if len(patches.counts()) < 4:
        with pytest.raises(InvalidInputError, match=r"(train|test) must name sources of"):
            split_sources(patches)
        return
    split = split_sources(patches)
    assert_covers(split, len(entries))
    assert set(patches.sources[split.train]) == {"GTI", "GTI_Far"}
    assert set(patches.sources[split.test]) == {"KITTI_extracted", "Extras"}
    reverse = split_sources(patches, train=("KITTI", "Extras"), test="GTI")
    np.testing.assert_array_equal(reverse.train, split.test)
    np.testing.assert_array_equal(reverse.test, split.train)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"train": ("Kitty",)}, r"train must name sources of patch_set \(Extras, GTI, .*got 'Kitty'"),
        ({"train": ("",)}, "train must name sources of patch_set .*got ''"),
        ({"test": ("KITTI",)}, r"test must name sources of vehicles and of non-vehicles, got \('KITTI',\)"),
        ({"train": ()}, "train must name sources of vehicles and of non-vehicles"),
        ({"test": ("KITTI", "GTI")}, r"share no source, both take \['GTI', 'GTI_Far'\]"),
    ],
)
def test_an_impossible_split_by_source_is_refused(options, message):
    patches = set_of([(folder, 1) for folder in FOLDERS])
    with pytest.raises(InvalidInputError, match=message):
        split_sources(patches, **options)


def test_sources_of_neither_side_are_left_out():
    patches = set_of([(folder, 1) for folder in (*FOLDERS, "non-vehicles/mined")])
    split = split_sources(patches)
    assert 4 not in [*split.train, *split.test]


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        ([0, 1], [1], "train and test must share no row"),
        ([0, 0], [1], "train and test must share no row and repeat none"),
        ([], [1], "train must be a list of row numbers"),
        ([0], [-1], "test must be a list of row numbers"),
        ([0.5], [1], "train must be a list of row numbers"),
    ],
)
def test_a_split_is_checked_on_construction(train, test, message):
    with pytest.raises(InvalidInputError, match=message):
        Split(train, test)


# Splits by groups of near duplicates


def copies_of(seeds, folders=None):
    """Patches of noise: equal seeds are near duplicates, other seeds are alike by chance, up to about 0.3."""
    rng = np.random.default_rng(1)
    noise = [rng.normal(0, 3, (16, 16, 3)) for _ in seeds]
    patches = [np.clip(patch_image(seed, 16) + noise, 0, 255) for seed, noise in zip(seeds, noise)]
    folders = folders or ["vehicles/GTI"] * len(seeds)
    names = [f"{folder}/{row}.png" for row, folder in enumerate(folders)]
    return PatchSet(np.array(patches, np.uint8), [name.startswith("vehicles") for name in names], names)


@given(
    st.lists(st.tuples(st.integers(0, 15), st.sampled_from(FOLDERS)), min_size=2, max_size=60),
    shares,
    st.integers(0, 2**32 - 1),
)
def test_a_split_by_groups_keeps_near_duplicates_on_one_side(entries, share, seed):
    seeds, folders = map(np.array, zip(*entries))
    patches = copies_of(seeds.tolist(), folders.tolist())
    try:
        split = split_groups(patches, test_size=share, random_state=seed)
    except InvalidInputError as error:
        assert "no group of near duplicates that fits" in str(error)  # noqa: PT017
        return
    assert_covers(split, len(entries))
    assert not set(seeds[split.train]) & set(seeds[split.test])
    assert split_leakage(patches, split, threshold=0.9) == 0
    for folder in set(folders):
        count, tested = np.sum(folders == folder), np.sum(folders[split.test] == folder)
        assert tested <= min(max(round(count * share), 1), count - 1)
    again = split_groups(patches, test_size=share, random_state=seed)
    np.testing.assert_array_equal(split.test, again.test)


def test_a_split_by_groups_without_copies_has_the_share_of_each_folder_and_class():
    folders = [folder for folder in FOLDERS for _ in range(10)]
    patches = copies_of(list(range(40)), folders)
    splits = [split_groups(patches, test_size=0.3, random_state=seed) for seed in (0, 1)]
    assert [patches[split.test].counts() for split in splits] == [dict.fromkeys(patches.counts(), 3)] * 2
    assert splits[0].test.tolist() != splits[1].test.tolist()
    np.testing.assert_array_equal(split_groups(patches, test_size=0.3).test, splits[0].test)
    loose = PatchSet(patches.patches, patches.labels, [f"{row}.png" for row in range(40)])
    assert loose[split_groups(loose, test_size=0.3).test].balance == 0.5


def test_copies_of_copies_are_one_group():
    # Each thumbnail is alike to the next only: 0.95 from one to the next, 0.81 over two.
    steps = np.arange(8) * np.arccos(0.95)
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(np.column_stack([np.ones(256), rng.normal(size=(256, 2))]))[0][:, 1:]
    waves = 128 + 400 * np.column_stack([np.cos(steps), np.sin(steps)]) @ axes.T
    chain = np.repeat(waves.round().astype(np.uint8).reshape(8, 16, 16, 1), 3, axis=3)
    alone = np.stack([patch_image(seed, 16) for seed in range(4)])
    rows = np.random.default_rng(0).permutation(12)
    patches = PatchSet(np.concatenate([chain, alone])[rows], [1] * 12, [f"{row}.png" for row in range(12)])
    for seed in range(5):
        split = split_groups(patches, test_size=0.3, random_state=seed)
        assert sorted(rows[split.test]) == [8, 9, 10, 11]
    assert len(find_near_duplicates(patches, threshold=0.9)) == 8


def test_groups_are_found_across_chunks():
    seeds = [*range(1098), 3, 700]
    split = split_groups(copies_of(seeds), test_size=0.5)
    sides = {row: side for side, rows in enumerate(split) for row in rows.tolist()}
    assert (sides[1098], sides[1099]) == (sides[3], sides[700])
    assert len(split.test) == 550


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"test_size": 1}, r"test_size must be a share in \(0, 1\), got 1"),
        ({"threshold": 0}, "threshold must be a number, greater than 0 .*at most 1; got 0"),
        ({"random_state": None}, "random_state must be an integer"),
        ({}, r"no group of near duplicates that fits into test_size=0.2 .*raise test_size or threshold"),
    ],
)
def test_an_impossible_split_by_groups_is_refused(options, message):
    patches = copies_of([1] * 10)
    with pytest.raises(InvalidInputError, match=message):
        split_groups(patches, **options)
    with pytest.raises(InvalidInputError, match=message):
        split_groups(patches[[]], **options)


# Near duplicates


def test_brightness_contrast_and_noise_make_near_duplicates():
    patches = np.stack([patch_image(seed) for seed in range(6)])
    rng = np.random.default_rng(0)
    patches[4] = patches[0] // 2 + 60
    patches[5] = np.clip(patches[1] + rng.normal(0, 5, patches[1].shape), 0, 255).astype(np.uint8)
    before = patches.copy()
    assert find_near_duplicates(patches).tolist() == [[0, 4], [1, 5], [4, 0], [5, 1]]
    np.testing.assert_array_equal(patches, before)


def test_the_nearest_copy_is_found_across_chunks():
    patches = np.random.default_rng(0).integers(0, 256, (1100, 16, 16, 3), np.uint8)
    patches[1099] = patches[3]
    patch_set = PatchSet(patches, [1] * 1100, [f"{row}.png" for row in range(1100)])
    assert find_near_duplicates(patch_set).tolist() == [[3, 1099], [1099, 3]]


@given(st.integers(0, 2**32 - 1), st.integers(2, 12), st.floats(0.05, 1))
def test_pairs_agree_with_the_correlation_of_thumbnails(seed, count, threshold):
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (count, 2, 2, 1), np.uint8)
    patches = np.repeat(np.kron(coarse, np.ones((1, 8, 8, 1), np.uint8)), 3, axis=3)
    labels, names = [1] * count, [f"{row}.png" for row in range(count)]
    # Each pixel of a 16x16 gray patch is its own thumbnail.
    expected = np.corrcoef(patches[..., 0].reshape(count, -1)) - 2 * np.eye(count)
    pairs = find_near_duplicates(PatchSet(patches, labels, names), threshold=threshold)
    for row in range(count):
        best = expected[row].max()
        if abs(best - threshold) > 1e-4:
            assert (row in pairs[:, 0]) == (best > threshold)
    np.testing.assert_allclose(
        expected[pairs[:, 0], pairs[:, 1]], expected[pairs[:, 0]].max(axis=1), atol=1e-4
    )


def test_plain_patches_are_copies_of_nothing():
    plain = np.full((3, 64, 64, 3), 90, np.uint8)
    assert find_near_duplicates(plain).shape == (0, 2)
    assert find_near_duplicates(plain[:1]).shape == (0, 2)
    assert find_near_duplicates(plain[:0]).shape == (0, 2)


def test_leakage_is_the_share_of_test_patches_seen_in_training():
    patches = np.stack([patch_image(seed) for seed in (0, 1, 0, 1, 2, 3, 3)])
    patch_set = PatchSet(patches, [1] * 7, [f"{row}.png" for row in range(7)])
    assert split_leakage(patch_set, Split([0, 1], [2, 3, 4])) == pytest.approx(2 / 3)
    assert split_leakage(patch_set, Split([0, 1], [5, 6])) == 0  # near duplicates within the test do not leak


def test_bad_arguments_of_the_copy_search_are_refused():
    patches = make_set(["a", "b"])
    with pytest.raises(
        InvalidInputError, match=r"threshold must be a number, greater than 0 .*at most 1; got 2"
    ):
        find_near_duplicates(patches, threshold=2)
    with pytest.raises(InvalidInputError, match=r"split names row 5 of a set of 2 patches"):
        split_leakage(patches, Split([0], [5]))
    with pytest.raises(InvalidInputError, match=r"patches must be an \(N, 64, 64, 3\) uint8"):
        find_near_duplicates(np.zeros((2, 3)))


# Frames


def test_frames_are_read_when_asked_for(tmp_path):
    for number in (10, 9):
        write_image(tmp_path / f"frame{number}.png", patch_image(number))
    (tmp_path / "frame11.jpg").write_bytes(b"damaged")
    (tmp_path / "notes.txt").write_text("no frame")
    (tmp_path / "folder.png").mkdir()
    frames = load_frames(tmp_path)
    assert frames.names == ("frame9.png", "frame10.png", "frame11.jpg")
    assert len(frames) == 3
    assert "3 frames" in repr(frames)
    np.testing.assert_array_equal(frames[1], patch_image(10))
    with pytest.raises(DatasetError, match=r"frame11.jpg .*cannot be decoded; replace or remove it"):
        frames[-1]
    with pytest.raises(IndexError):
        frames[3]
    (tmp_path / "frame11.jpg").unlink()
    assert [name for name, image in load_frames(tmp_path)] == ["frame9.png", "frame10.png"]


def test_missing_and_empty_frame_folders_are_refused(tmp_path):
    with pytest.raises(
        DatasetError, match=r"folder .*nowhere does not exist or is no folder; check the path"
    ):
        load_frames(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=r"folder .* holds no PNG or JPEG frames; name the folder"):
        load_frames(tmp_path)


# Fetching, from a server of our own


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.server.requests.append(self.path)
        answer = self.server.answers.get(self.path)
        if answer is None:
            self.send_error(404)
            return
        body, length = answer
        self.send_response(200)
        self.send_header("Content-Length", str(length))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args):
        pass


class Server(http.server.ThreadingHTTPServer):
    """Answers each path of `answers` with a body and the length that it claims to have."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.answers, self.requests = {}, []
        self.url = f"http://127.0.0.1:{self.server_port}/data"

    def put(self, name, body, length=None):
        self.answers[f"/data/{name}"] = (body, len(body) if length is None else length)


def zip_bytes(members):
    buffer = io.BytesIO()
    write_zip(buffer, members)
    return buffer.getvalue()


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    counts = {
        "vehicles.zip": {"vehicles/GTI_Far": 2, "vehicles/KITTI_extracted": 1},
        "non-vehicles.zip": {"non-vehicles/Extras": 1, "non-vehicles/GTI": 1},
    }
    monkeypatch.setattr(_download, "ARCHIVES", counts)
    with Server() as running:
        running.put("vehicles.zip", zip_bytes(VEHICLES))
        running.put("non-vehicles.zip", zip_bytes(OTHERS))
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def test_both_archives_are_fetched_once(server, tmp_path, capsys):
    folder = tmp_path / "new" / "cache"
    paths = fetch_patches(folder, url=server.url, progress=False)
    assert paths == (folder / "vehicles.zip", folder / "non-vehicles.zip")
    assert load_training_patches(*paths).counts() == {
        "Extras": 1,
        "GTI": 1,
        "GTI_Far": 2,
        "KITTI_extracted": 1,
    }
    assert sorted(os.listdir(folder)) == ["non-vehicles.zip", "vehicles.zip"]
    assert server.requests == ["/data/vehicles.zip", "/data/non-vehicles.zip"]
    assert fetch_patches(folder, url=f"{server.url}/", progress=False) == paths
    assert len(server.requests) == 2
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


def test_a_damaged_archive_in_place_is_fetched_again(server, tmp_path, caplog):
    (tmp_path / "vehicles.zip").write_bytes(zip_bytes(VEHICLES).replace(b"IDAT", b"iDAT"))
    fetch_patches(tmp_path, url=server.url, progress=False)
    assert (tmp_path / "vehicles.zip").read_bytes() == zip_bytes(VEHICLES)
    assert "is damaged at 'vehicles/GTI_Far/image10.png'" in caplog.text


def test_the_cache_of_the_user_is_the_default(server, tmp_path, monkeypatch):
    monkeypatch.setattr("pooch.os_cache", lambda project: tmp_path / project)
    vehicles, _ = fetch_patches(url=server.url, progress=False)
    assert vehicles == tmp_path / "vehicle_detection" / "vehicles.zip"


def test_a_bar_shows_the_progress(server, tmp_path, capsys):
    fetch_patches(tmp_path, url=server.url)
    assert "100%" in capsys.readouterr().err


def replaced(members, old, new):
    return {new if name == old else name: data for name, data in members.items()}


BROKEN = {
    "cut": (zip_bytes(OTHERS)[:-300], len(zip_bytes(OTHERS)), "was cut off on the way; call again"),
    "short": (zip_bytes(OTHERS)[:-300], None, "is a zip that is cut short or damaged; fetch it again"),
    "page": (b"\n<!DOCTYPE html><html>sign in</html>", None, "is a web page, not a zip"),
    "text": (b"out of order", None, "is not a zip"),
    "empty": (b"", None, "is not a zip"),
    "wrong member": (
        zip_bytes({**OTHERS, "non-vehicles/GTI/setup.exe": b"MZ"}),
        None,
        "holds 'non-vehicles/GTI/setup.exe', which is no patch of the course; pass the url",
    ),
    "wrong folder": (
        zip_bytes({**OTHERS, "vehicles/GTI_Far/1.png": png(1)}),
        None,
        "holds 'vehicles/GTI_Far/1.png', which is no patch",
    ),
    "parent": (zip_bytes({**OTHERS, "../evil.png": b""}), None, "holds the unsafe member '../evil.png'"),
    "hidden parent": (
        zip_bytes({**OTHERS, "non-vehicles/../../.bashrc": b""}),
        None,
        r"holds the unsafe member 'non-vehicles/../../.bashrc'",
    ),
    "windows parent": (zip_bytes({**OTHERS, "..\\evil.png": b""}), None, "holds the unsafe member"),
    "absolute": (zip_bytes({**OTHERS, "/etc/evil.png": b""}), None, "holds the unsafe member '/etc/evil"),
    "drive": (zip_bytes({**OTHERS, "C:/evil.png": b""}), None, "holds the unsafe member 'C:/evil.png'"),
    "too few": (
        zip_bytes({"non-vehicles/GTI/image1.png": png(1)}),
        None,
        "holds 0 patches in non-vehicles/Extras, expected 1",
    ),
    "too many": (
        zip_bytes({**OTHERS, "non-vehicles/GTI/image2.png": png(1)}),
        None,
        "holds 2 patches in non-vehicles/GTI, expected 1",
    ),
    "damaged": (
        zip_bytes(OTHERS).replace(b"IDAT", b"iDAT"),
        None,
        "is damaged at 'non-vehicles/Extras/extra1.png'; fetch it again",
    ),
    "missing": (None, None, "non-vehicles.zip answers 404; pass the url of a folder that holds"),
}


@pytest.mark.parametrize("case", BROKEN)
@pytest.mark.parametrize("earlier", [False, True])
def test_a_failed_download_leaves_all_as_it_was(server, tmp_path, case, earlier, caplog):
    body, length, message = BROKEN[case]
    if earlier:
        (tmp_path / "non-vehicles.zip").write_bytes(b"an earlier file")
    if body is None:
        del server.answers["/data/non-vehicles.zip"]
    else:
        server.put("non-vehicles.zip", body, length)
    with pytest.raises(DatasetError, match=message) as caught:
        fetch_patches(tmp_path, url=server.url, progress=False)
    assert str(caught.value).startswith(f"{server.url}/non-vehicles.zip ")
    assert "\n" not in str(caught.value)
    assert sorted(os.listdir(tmp_path)) == ["non-vehicles.zip", "vehicles.zip"][not earlier :]
    if earlier:
        assert (tmp_path / "non-vehicles.zip").read_bytes() == b"an earlier file"
        assert "the file in place does not verify" in caplog.text

    server.put("non-vehicles.zip", zip_bytes(OTHERS))
    vehicles, others = fetch_patches(tmp_path, url=server.url, progress=False)
    assert len(load_training_patches(vehicles, others)) == 5
    assert server.requests.count("/data/vehicles.zip") == 1


def test_a_server_out_of_reach_is_named(server, tmp_path):
    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as closed:
        url = f"http://127.0.0.1:{closed.server_port}"
    with pytest.raises(
        DatasetError, match=r"vehicles.zip cannot be reached \(ConnectionError\); check the network"
    ):
        fetch_patches(tmp_path, url=url, progress=False)
    assert os.listdir(tmp_path) == []


def test_an_address_that_is_none_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match=r"url must start with http:// or https://; got 'data'"):
        fetch_patches(tmp_path, url="data")
    with pytest.raises(DatasetError, match=r"cannot be downloaded \(InvalidURL\); check url"):
        fetch_patches(tmp_path, url="http://", progress=False)


def test_the_folder_must_be_writable(server, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(
        InvalidInputError, match=r"to must be a folder, .*file cannot be made: .*choose another"
    ):
        fetch_patches(tmp_path / "file", url=server.url, progress=False)
    assert server.requests == []
    monkeypatch.setattr(os, "access", lambda *args: False)
    with pytest.raises(
        InvalidInputError, match=r"to needs a writable folder, .* is read-only; choose another"
    ):
        fetch_patches(tmp_path, url=server.url, progress=False)
    assert server.requests == []


def test_verified_archives_in_a_read_only_folder_are_used(server, tmp_path, monkeypatch):
    fetch_patches(tmp_path, url=server.url, progress=False)
    monkeypatch.setattr(os, "access", lambda *args: False)
    fetch_patches(tmp_path, url=server.url, progress=False)
    assert len(server.requests) == 2


def test_a_full_disk_is_named(server, tmp_path, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pooch.HTTPDownloader.__call__", full)
    with pytest.raises(
        DatasetError, match=r"cannot be stored in .*: No space left on device; free some space"
    ):
        fetch_patches(tmp_path, url=server.url, progress=False)
    assert os.listdir(tmp_path) == []


def test_parts_of_killed_downloads_are_removed_and_running_ones_kept(server, tmp_path):
    stale, running = tmp_path / ".vehicles.old.zip", tmp_path / ".vehicles.new.zip"
    for part in (stale, running):
        part.write_bytes(b"PK")
    past = time.time() - 2 * _download.STALE_SECONDS
    os.utime(stale, (past, past))
    fetch_patches(tmp_path, url=server.url, progress=False)
    assert not stale.exists()
    assert running.exists()


def test_an_interrupt_cleans_up(server, tmp_path, monkeypatch):
    def interrupt(self, address, file, pooch):
        Path(file).write_bytes(b"PK")
        raise KeyboardInterrupt

    monkeypatch.setattr("pooch.HTTPDownloader.__call__", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fetch_patches(tmp_path, url=server.url, progress=False)
    assert os.listdir(tmp_path) == []


# The real patches


@pytest.fixture(scope="module")
def real_patches(real_data):
    return load_training_patches(real_data / "vehicles.zip", real_data / "non-vehicles.zip")


@pytest.mark.realdata
def test_the_real_archives_verify_without_a_request(real_data):
    paths = fetch_patches(real_data, url="http://127.0.0.1:1")
    assert paths == (real_data / "vehicles.zip", real_data / "non-vehicles.zip")


@pytest.mark.realdata
def test_the_real_patches_are_all_there(real_patches):
    assert len(real_patches) == 17760
    counts = {
        name.rpartition("/")[2]: n for folders in _download.ARCHIVES.values() for name, n in folders.items()
    }
    assert real_patches.counts() == counts
    assert real_patches.balance == pytest.approx(8792 / 17760)
    assert real_patches.patches[::100].std() > 40  # 0-255, not 0-1


@pytest.mark.realdata
def test_the_real_splits_have_their_sizes(real_patches):
    sequences = split_sequences(real_patches)
    assert real_patches[sequences.test].counts() == {
        "Extras": 1014,
        "GTI": 780,
        "GTI_Far": 167,
        "GTI_Left": 182,
        "GTI_MiddleClose": 84,
        "GTI_Right": 133,
        "KITTI_extracted": 1193,
    }
    assert_covers(sequences, 17760)
    assert len(split_random(real_patches, random_state=0).test) == 3552
    assert len(split_sources(real_patches).train) == 6726


@pytest.mark.realdata
def test_the_real_splits_leak_as_documented(real_patches):
    sequences = split_sequences(real_patches)
    assert split_leakage(real_patches, split_random(real_patches, random_state=0)) > 0.2
    assert split_leakage(real_patches, split_sources(real_patches)) < 0.03
    # GTI is numbered through its drives, KITTI is not.
    for source, low, high in (("GTI_", 0, 0.01), ("KITTI", 0.4, 0.5)):
        test = sequences.test[np.char.startswith(real_patches.sources[sequences.test], source)]
        assert low <= split_leakage(real_patches, Split(sequences.train, test)) <= high


@pytest.mark.realdata
def test_the_real_groups_do_not_leak(real_patches):
    split = split_groups(real_patches)
    assert_covers(split, 17760)
    assert split_leakage(real_patches, split, threshold=0.9) == 0
    assert real_patches[split.test].counts() == real_patches[split_sequences(real_patches).test].counts()


@pytest.mark.realdata
def test_the_real_frames_are_listed(real_data):
    frames = load_frames(real_data / "frames" / "camvid")
    assert len(frames) == 163
    assert frames[0].shape == (360, 480, 3)
