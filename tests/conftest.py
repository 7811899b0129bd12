import gc
import os
from pathlib import Path

import matplotlib
import pytest
from hypothesis import settings

matplotlib.use("Agg")
settings.register_profile("steady", derandomize=True, deadline=None, max_examples=25)
settings.load_profile("steady")


def pytest_collection_finish():
    """Leave what the imports have made, about a million objects, out of garbage collections."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real patches, images and clips; the test skips where it is not set."""
    folder = os.environ.get("VEHICLE_DETECTION_DATA")
    if not folder:
        pytest.skip("VEHICLE_DETECTION_DATA is not set: the real data is not at hand")
    path = Path(folder)
    assert path.is_dir(), f"VEHICLE_DETECTION_DATA names {path}, which is no folder"
    return path
