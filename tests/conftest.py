import gc
import os
import zipfile
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from hypothesis import settings

from vehicle_detection.course.versions import lesson_defaults
from vehicle_detection.images import decode_image

matplotlib.use("Agg")
settings.register_profile("steady", derandomize=True, deadline=None, max_examples=25)
settings.load_profile("steady")


def pytest_collection_finish():
    """Leave what the imports have made, about a million objects, out of garbage collections."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def restored_defaults():
    """Restore the defaults of the lesson functions after the test."""
    before = dict(lesson_defaults)
    yield
    lesson_defaults.update(before)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real patches, images and clips; the test skips where it is not set."""
    folder = os.environ.get("VEHICLE_DETECTION_DATA")
    if not folder:
        pytest.skip("VEHICLE_DETECTION_DATA is not set: the real data is not at hand")
    path = Path(folder)
    assert path.is_dir(), f"VEHICLE_DETECTION_DATA names {path}, which is no folder"
    return path


@pytest.fixture(scope="session")
def some_real_patches(real_data):
    """Every tenth of the real patches, and their labels."""
    patches, labels = [], []
    for label, name in enumerate(("non-vehicles.zip", "vehicles.zip")):
        with zipfile.ZipFile(real_data / name) as archive:
            names = [each for each in archive.namelist() if each.endswith(".png") and "__MACOSX" not in each]
            patches += [decode_image(archive.read(each), each) for each in sorted(names)[::10]]
        labels += [label] * (len(patches) - len(labels))
    return np.stack(patches), np.array(labels)
