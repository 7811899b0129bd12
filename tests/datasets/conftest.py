import pytest

from tests.datasets.cases import OTHERS, VEHICLES, write_zip
from vehicle_detection.datasets import load_training_patches


@pytest.fixture
def vehicles_zip(tmp_path):
    return write_zip(tmp_path / "vehicles.zip", VEHICLES)


@pytest.fixture
def others_zip(tmp_path):
    return write_zip(tmp_path / "non-vehicles.zip", OTHERS)


@pytest.fixture(scope="package")
def real_patches(real_data):
    return load_training_patches(real_data / "vehicles.zip", real_data / "non-vehicles.zip")
