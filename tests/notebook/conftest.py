import matplotlib
import matplotlib.pyplot as plt
import pytest

from vehicle_detection.datasets import PatchSet
from vehicle_detection.scenes import render_patches


@pytest.fixture(autouse=True)
def unchanged_settings():
    """Check that no test changes matplotlib's settings, and close pyplot's figures."""
    before = dict(matplotlib.rcParams)
    yield
    assert dict(matplotlib.rcParams) == before
    plt.close("all")


@pytest.fixture(scope="package")
def patch_set():
    patches, labels = render_patches(40, random_state=3)
    folders = {True: "vehicles/Far", False: "non-vehicles/Road"}
    names = [f"{folders[bool(label)]}/{number}.png" for number, label in enumerate(labels)]
    return PatchSet(patches, labels, names)
