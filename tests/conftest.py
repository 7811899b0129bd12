import dataclasses
import os
from pathlib import Path

import matplotlib
import pytest
from hypothesis import settings

from tests.helpers import SMALL_MIXTURE, drawn
from vehicle_detection.mixture_training import FrameDataset, train_mixture

matplotlib.use("Agg")
settings.register_profile("steady", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("steady")


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
def drawn_source():
    return FrameDataset("drawn", (drawn(range(12)),))


@pytest.fixture(scope="session")
def small_mixture(drawn_source):
    """A mixture with a rescorer, whose training takes most of the time."""
    params = dataclasses.replace(SMALL_MIXTURE, blend_weight=0.1)
    return train_mixture([drawn_source], params, n_jobs=1)
