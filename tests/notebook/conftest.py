import matplotlib
import matplotlib.pyplot as plt
import pytest

from tests.helpers import rendered_patches
from vehicle_detection.datasets import PatchSet


@pytest.fixture(autouse=True)
def unchanged_settings():
    """Check that no test changes matplotlib's settings, and close pyplot's figures."""
    before = dict(matplotlib.rcParams)
    yield
    assert dict(matplotlib.rcParams) == before
    plt.close("all")


@pytest.fixture(scope="package")
def patch_set():
    patches, labels = rendered_patches(40)
    folders = {True: "vehicles/Far", False: "non-vehicles/Road"}
    names = [f"{folders[bool(label)]}/{number}.png" for number, label in enumerate(labels)]
    return PatchSet(patches, labels, names)
