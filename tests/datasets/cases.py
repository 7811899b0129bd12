"""Patches, archives and sets for the tests of datasets."""

import zipfile

import cv2
import numpy as np
from hypothesis import strategies as st

from vehicle_detection.datasets import PatchSet


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
    "vehicles/.DS_Store": b"hidden",
    "__MACOSX/vehicles/GTI_Far/._image9.png": b"hidden",
    "vehicles/KITTI_extracted/1.png": png(1),
}
OTHERS = {"non-vehicles/Extras/extra1.png": png(20), "non-vehicles/GTI/image1.png": png(21)}
IN_ORDER = ("vehicles/GTI_Far/image9.png", "vehicles/GTI_Far/image10.png", "vehicles/KITTI_extracted/1.png")

FOLDERS = ("vehicles/GTI_Far", "vehicles/KITTI_extracted", "non-vehicles/GTI", "non-vehicles/Extras")
named_patches = st.lists(
    st.tuples(st.sampled_from(FOLDERS), st.integers(0, 200)), min_size=1, max_size=60, unique=True
)
fractions = st.floats(0.05, 0.95)


def set_of(entries):
    names = [f"{folder}/image{number}.png" for folder, number in entries]
    return make_set(names, [name.startswith("vehicles") for name in names])


def assert_covers(split, count):
    assert sorted([*split.train.tolist(), *split.test.tolist()]) == list(range(count))
    assert (np.diff(split.train) > 0).all()
    assert (np.diff(split.test) > 0).all()


def copies_of(seeds, folders=None):
    """Patches of noise: equal seeds are near duplicates, other seeds are alike by chance, up to about 0.3."""
    rng = np.random.default_rng(1)
    noise = [rng.normal(0, 3, (16, 16, 3)) for _ in seeds]
    patches = [np.clip(patch_image(seed, 16) + noise, 0, 255) for seed, noise in zip(seeds, noise)]
    folders = folders or ["vehicles/GTI"] * len(seeds)
    names = [f"{folder}/{row}.png" for row, folder in enumerate(folders)]
    return PatchSet(np.array(patches, np.uint8), [name.startswith("vehicles") for name in names], names)
