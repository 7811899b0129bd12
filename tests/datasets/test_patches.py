import io
import os
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.datasets.cases import IN_ORDER, VEHICLES, make_set, patch_image, png, unpack, write_zip
from vehicle_detection import DatasetError, InvalidInputError, write_image
from vehicle_detection.datasets import PatchSet, archives, load_patches, load_training_patches

# PatchSet


def test_attributes_have_fixed_types():
    patches = make_set(["a/x/1.png", "a/y/2.png"], [0, 1])
    assert patches.labels.dtype == np.bool_
    assert patches.names == ("a/x/1.png", "a/y/2.png")
    assert patches.sources.tolist() == ["x", "y"]
    assert len(patches) == 2
    assert patches.balance == 0.5
    assert repr(patches) == "PatchSet(2 patches of 1x1 pixels: 1 vehicles, 1 non-vehicles)"


def test_a_notebook_shows_the_counts_as_a_table():
    html = make_set(["a/x/1.png", "a/y10/2.png", "a/y9/2.png"], [0, 1, 1])._repr_html_()
    cells = re.findall(r"<t[hd]>(.*?)</t[hd]>", html)
    header, rows = cells[:4], np.reshape(cells[4:], (4, 4)).tolist()
    assert header == ["", "vehicles", "non-vehicles", "total"]
    assert rows == [["x", *"011"], ["y9", *"101"], ["y10", *"101"], ["total", *"213"]]
    assert "total" in make_set(["a.png"])[[]]._repr_html_()


@pytest.mark.parametrize("rows", [[2, 0], np.array([True, False, True]), slice(None, None, -1), []])
def test_selecting_rows(rows):
    patches = PatchSet(np.stack([patch_image(i) for i in range(3)]), [1, 0, 1], ["0.png", "1.png", "2.png"])
    taken = patches[rows]
    expected = np.arange(3)[rows]
    assert taken.names == tuple(f"{row}.png" for row in expected)
    np.testing.assert_array_equal(taken.patches, patches.patches[expected])
    np.testing.assert_array_equal(taken.labels, patches.labels[expected])
    with pytest.raises(InvalidInputError, match=r"rows must be a slice.*got 0.*patches\[index\]"):
        patches[0]


@pytest.mark.parametrize(
    ("patches", "labels", "names", "message"),
    [
        (np.zeros((2, 4, 4, 3)), [1, 1], ["a", "b"], r"patches must be an \(N, 4, 4, 3\) uint8.*float64"),
        (np.zeros((2, 4, 5, 3), np.uint8), [1, 1], ["a", "b"], r"patches must be .*\(2, 4, 5, 3\)"),
        ("a.png", [1], ["a"], "patches must be an .*load_patches"),
        (np.zeros((2, 4, 4, 3), np.uint8), [1], ["a", "b"], "labels must hold one entry .* 2 patches, got 1"),
        (np.zeros((2, 4, 4, 3), np.uint8), [1, 1], ["a"], "names must hold one entry .* 2 patches, got 1"),
        (np.zeros((2, 4, 4, 3), np.uint8), [1, -1], ["a", "b"], "labels must be .*labels > 0"),
        (np.zeros((2, 4, 4, 3), np.uint8), [1.0, 0.5], ["a", "b"], "labels must be 0 or 1"),
        (np.zeros((2, 4, 4, 3), np.uint8), [1, 1], ["a", Path("b")], "names must be strings"),
    ],
)
def test_invalid_attributes(patches, labels, names, message):
    with pytest.raises(InvalidInputError, match=message):
        PatchSet(patches, labels, names)


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


def test_sets_of_different_patch_sizes_do_not_concatenate():
    with pytest.raises(InvalidInputError, match=r"of the same patch size; got \[\(1, 1, 3\), \(2, 2, 3\)\]"):
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
    (tmp_path / "more").mkdir()
    (folder / "3.png").rename(tmp_path / "more" / "3.png")
    (folder / "linked").symlink_to(tmp_path / "more")
    patches = load_patches(folder)
    assert patches.names == ("cars/1.jpg", "cars/2.JPEG", "cars/linked/3.png")
    assert np.abs(patches.patches.astype(int) - 200).max() <= 1


def test_the_innermost_class_folder_gives_the_label(vehicles_zip, others_zip, tmp_path):
    unpack(vehicles_zip, tmp_path / "cars")
    unpack(others_zip, tmp_path / "cars")
    patches = load_patches(tmp_path / "cars")
    assert patches.labels.tolist() == [name.startswith("cars/vehicles") for name in patches.names]
    assert load_patches(others_zip).balance == 0
    assert load_patches(others_zip, label=1).balance == 1


def test_sources_that_cannot_be_read(tmp_path, vehicles_zip):
    for folder in ("none", "zips", "plain"):
        (tmp_path / folder).mkdir()
    write_image(tmp_path / "plain" / "1.png", patch_image(1))
    (tmp_path / "a.png").write_bytes(png(1))
    (tmp_path / "b.zip").write_text("<html>sign in</html>")
    write_zip(tmp_path / "zips" / "hidden.zip", {"vehicles/.DS_Store": b"", "__MACOSX/a.png": b""})
    write_zip(tmp_path / "sizes.zip", {"cars/1.png": png(1), "cars/2.png": png(2, side=32)})
    write_zip(tmp_path / "cut.zip", {"cars/1.png": png(1), "cars/2.png": png(2)[:-100]})
    for source, message in {
        "nowhere": r"source .*nowhere does not exist; check the path, or download",
        "none": r"source .* holds no PNG or JPEG patches; download the course's",
        "zips/hidden.zip": r"hidden.zip holds no PNG or JPEG patches",
        "zips": r"holds no PNG or JPEG patches; pass one of its zip files \(hidden.zip\)",
        "a.png": r"a.png is not a zip; pass a folder of patches or a .zip file",
        "b.zip": r"b.zip is a web page, not a zip",
        "sizes.zip": r"cars/2.png of .*sizes.zip is 32x32 pixels, expected 64x64; resize it to 64x64",
        "cut.zip": r"cars/2.png of .*cannot be decoded; replace or remove it",
    }.items():
        with pytest.raises(DatasetError, match=message):
            load_patches(tmp_path / source)
    with pytest.raises(InvalidInputError, match=r"label must be 1 or 0 .* pass label=1"):
        load_patches(tmp_path / "plain")
    with pytest.raises(InvalidInputError, match=r"label must be one of None, 0, 1; got 2"):
        load_patches(tmp_path / "plain", label=2)
    with pytest.raises(DatasetError, match=r"non_vehicles .*none holds no PNG or JPEG patches"):
        load_training_patches(vehicles_zip, tmp_path / "none")
    half = write_zip(tmp_path / "half.zip", {"cars/2.png": png(2, side=32)})
    assert load_patches(half, size=32).patches.shape == (1, 32, 32, 3)


def test_a_zip_cut_anywhere_is_rejected(tmp_path):
    data = write_zip(tmp_path / "cars.zip", {"cars/1.png": png(1, 4), "cars/2.png": png(2, 4)}).read_bytes()
    for length in range(len(data)):
        (tmp_path / "cars.zip").write_bytes(data[:length])
        with pytest.raises(DatasetError, match=r"cars.zip is (a damaged or incomplete zip|not a zip)"):
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


def test_an_unreadable_folder_is_not_skipped(vehicles_zip, tmp_path, monkeypatch):
    folder = unpack(vehicles_zip, tmp_path / "out")
    scandir = os.scandir

    def forbid(path):
        if str(path).endswith("GTI_Far"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", forbid)
    with pytest.raises(DatasetError, match=r"GTI_Far cannot be .*Permission denied.*change its permissions"):
        load_patches(folder)


def test_the_argument_gives_the_label_of_training_patches(vehicles_zip, others_zip):
    patches = load_training_patches(vehicles_zip, others_zip)
    assert patches.labels.tolist() == [True, True, True, False, False]
    assert patches.counts() == {"Extras": 1, "GTI": 1, "GTI_Far": 2, "KITTI_extracted": 1}
    whole = PatchSet.concatenate([load_patches(vehicles_zip), load_patches(others_zip)])
    assert patches.fingerprint == whole.fingerprint
    with pytest.raises(
        DatasetError, match=r"vehicles .* one class .*'non-vehicles/\w+' is a folder of the other"
    ):
        load_training_patches(others_zip, vehicles_zip)


@pytest.mark.realdata
def test_the_real_patches_are_complete(real_patches):
    assert len(real_patches) == 17760
    counts = {
        name.rpartition("/")[2]: n for folders in archives.ARCHIVES.values() for name, n in folders.items()
    }
    assert real_patches.counts() == counts
    assert real_patches.balance == pytest.approx(8792 / 17760)
    assert real_patches.patches[::100].std() > 40  # 0-255, not 0-1
