import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.datasets.cases import (
    FOLDERS,
    assert_covers,
    copies_of,
    fractions,
    make_set,
    named_patches,
    patch_image,
    set_of,
)
from vehicle_detection import InvalidInputError, PatchSet
from vehicle_detection.datasets import (
    Split,
    find_near_duplicates,
    split_groups,
    split_leakage,
    split_random,
    split_sequences,
    split_sources,
)


@given(st.lists(st.booleans(), min_size=20, max_size=100), fractions, st.integers(0, 2**32 - 1))
def test_a_random_split_covers_all_patches_and_keeps_the_balance(labels, fraction, seed):
    labels = np.array([*labels, *[True] * 20, *[False] * 20])
    split = split_random(labels, test_size=fraction, random_state=seed)
    assert_covers(split, len(labels))
    assert len(split.test) == np.ceil(fraction * len(labels))
    for label in (True, False):
        expected = len(split.test) * np.mean(labels == label)
        assert abs(np.sum(labels[split.test] == label) - expected) <= 1


@given(named_patches, fractions)
def test_a_sequence_split_tests_on_the_end_of_each_folder(entries, fraction):
    folders = [folder for folder, _ in entries]
    counts = {folder: folders.count(folder) for folder in folders}
    if max(counts.values()) < 2:
        with pytest.raises(InvalidInputError, match=r"a folder of two or more patches; add patches, or"):
            split_sequences(set_of(entries), test_size=fraction)
        return
    split = split_sequences(set_of(entries), test_size=fraction)
    assert_covers(split, len(entries))
    for folder, count in counts.items():
        train, test = ([entries[row][1] for row in rows if entries[row][0] == folder] for rows in split)
        assert train
        assert bool(test) == (count > 1)
        assert not test or max(train) < min(test)
        assert count == 1 or abs(len(test) - fraction * count) <= 1


@given(named_patches)
def test_a_split_by_source_separates_the_sources(entries):
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
    ("train", "test", "message"),
    [
        ([0, 1], [1], "train and test must not share or repeat rows"),
        ([0, 0], [1], "train and test must not share or repeat rows"),
        ([], [1], "train must be a list of row numbers"),
        ([0], [-1], "test must be a list of row numbers"),
        ([0.5], [1], "train must be a list of row numbers"),
    ],
)
def test_an_invalid_split(train, test, message):
    with pytest.raises(InvalidInputError, match=message):
        Split(train, test)


# Groups of near duplicates


@given(
    st.lists(st.tuples(st.integers(0, 15), st.sampled_from(FOLDERS)), min_size=2, max_size=60),
    fractions,
    st.integers(0, 2**32 - 1),
)
def test_a_split_by_groups_keeps_near_duplicates_together(entries, fraction, seed):
    seeds, folders = map(np.array, zip(*entries))
    patches = copies_of(seeds.tolist(), folders.tolist())
    try:
        split = split_groups(patches, test_size=fraction, random_state=seed)
    except InvalidInputError as error:
        assert "must hold a group of near duplicates" in str(error)  # noqa: PT017
        return
    assert_covers(split, len(entries))
    assert not set(seeds[split.train]) & set(seeds[split.test])
    assert split_leakage(patches, split, threshold=0.9) == 0
    for folder in set(folders):
        count, tested = np.sum(folders == folder), np.sum(folders[split.test] == folder)
        assert tested <= min(max(round(count * fraction), 1), count - 1)
    again = split_groups(patches, test_size=fraction, random_state=seed)
    np.testing.assert_array_equal(split.test, again.test)


def test_a_split_by_groups_without_duplicates_is_stratified():
    folders = [folder for folder in FOLDERS for _ in range(10)]
    patches = copies_of(list(range(40)), folders)
    splits = [split_groups(patches, test_size=0.3, random_state=seed) for seed in (0, 1)]
    assert [patches[split.test].counts() for split in splits] == [dict.fromkeys(patches.counts(), 3)] * 2
    assert splits[0].test.tolist() != splits[1].test.tolist()
    np.testing.assert_array_equal(split_groups(patches, test_size=0.3).test, splits[0].test)
    loose = PatchSet(patches.patches, patches.labels, [f"{row}.png" for row in range(40)])
    assert loose[split_groups(loose, test_size=0.3).test].balance == 0.5


def test_duplicates_of_duplicates_are_one_group():
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


def test_equal_patches_are_duplicates_at_the_largest_threshold():
    patches = np.random.default_rng(0).integers(0, 256, (50, 16, 16, 3), np.uint8)
    both = PatchSet(np.concatenate([patches, patches]), [1] * 100, [f"{row}.png" for row in range(100)])
    assert len(find_near_duplicates(both, threshold=1)) == 100
    assert split_leakage(both, Split(range(50), range(50, 100)), threshold=1) == 1


SEED, EACH, SAME = {"random_state": 0}, set_of([(folder, 1) for folder in FOLDERS]), copies_of([1] * 10)


@pytest.mark.parametrize(
    ("split", "patches", "options", "message"),
    [
        (split_random, [1, 1, 1, 0], SEED, "3 vehicles and 1 non-vehicles are too few .* test part of 20%"),
        (split_random, [], SEED, "0 vehicles and 0 non-vehicles are too few"),
        (split_random, [1, 1, 0, 0], SEED | {"test_size": 1}, r"test_size must be .* \(0, 1\), got 1"),
        (split_random, [-1, 1, 0, 0], SEED, "patches_or_labels must be 0 or 1"),
        (split_sources, EACH, {"train": ("Kitty",)}, r"train must .* \(Extras, GTI, .*got 'Kitty'"),
        (split_sources, EACH, {"train": ("",)}, "train must name sources of patch_set .*got ''"),
        (split_sources, EACH, {"test": ("KITTI",)}, r"test must .* of non-vehicles, got \('KITTI',\)"),
        (split_sources, EACH, {"train": ()}, "train must name sources of vehicles and of non-vehicles"),
        (split_sources, EACH, {"test": ("KITTI", "GTI")}, r"both match \['GTI', 'GTI_Far'\]; use longer"),
        (split_groups, SAME, {"test_size": 1}, r"test_size must be a fraction in \(0, 1\), got 1"),
        (split_groups, SAME, {}, "a group of .* that fits .*, 20% .*raise test_size or threshold"),
        (split_groups, SAME[[]], {}, "a group of near duplicates that fits into the test part"),
        (split_sequences, SAME.patches, {}, "patch_set must be a PatchSet, .*read one with load_train"),
    ],
)
def test_impossible_splits(split, patches, options, message):
    with pytest.raises(InvalidInputError, match=message):
        split(patches, **options)


def test_leakage_is_a_fraction_of_the_test_patches():
    patches = np.stack([patch_image(seed) for seed in (0, 1, 0, 1, 2, 3, 3)])
    patch_set = PatchSet(patches, [1] * 7, [f"{row}.png" for row in range(7)])
    assert split_leakage(patch_set, Split([0, 1], [2, 3, 4])) == pytest.approx(2 / 3)
    assert split_leakage(patch_set, Split([0, 1], [5, 6])) == 0  # near duplicates within the test do not leak


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
    some = real_patches[::3]
    split = split_groups(some)
    assert_covers(split, 5920)
    assert split_leakage(some, split, threshold=0.9) == 0
    assert some[split.test].counts() == some[split_sequences(some).test].counts()


# Near duplicates


def test_brightness_contrast_and_noise_are_ignored():
    patches = np.stack([patch_image(seed) for seed in range(6)])
    rng = np.random.default_rng(0)
    patches[4] = patches[0] // 2 + 60
    patches[5] = np.clip(patches[1] + rng.normal(0, 5, patches[1].shape), 0, 255).astype(np.uint8)
    before = patches.copy()
    assert find_near_duplicates(patches).tolist() == [[0, 4], [1, 5], [4, 0], [5, 1]]
    np.testing.assert_array_equal(patches, before)


def test_the_nearest_duplicate_is_found_across_chunks():
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
    np.testing.assert_allclose(expected[pairs[:, 0], pairs[:, 1]], expected[pairs[:, 0]].max(1), atol=1e-4)


def test_uniform_patches_have_no_duplicates():
    plain = np.full((3, 64, 64, 3), 90, np.uint8)
    assert find_near_duplicates(plain).shape == (0, 2)
    assert find_near_duplicates(plain[:1]).shape == (0, 2)
    assert find_near_duplicates(plain[:0]).shape == (0, 2)


def test_invalid_arguments():
    patches = make_set(["a", "b"])
    with pytest.raises(InvalidInputError, match=r"split holds row 5, but patch_set has 2 patches"):
        split_leakage(patches, Split([0], [5]))
