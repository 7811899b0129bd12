import numpy as np
import pytest

from tests.helpers import random_classifier, rendered_patches
from tests.training.trial_cases import SMALL
from vehicle_detection import FeatureParams, LabelledFrames, PatchSet, TrackTable, render_scene


@pytest.fixture(scope="package")
def patch_set():
    patches, labels = rendered_patches(120)
    sources = ("vehicles/GTI_Far", "vehicles/KITTI_extracted"), ("non-vehicles/GTI", "non-vehicles/Extras")
    names = [f"{sources[not label][row % 2]}/{row}.png" for row, label in enumerate(labels)]
    return PatchSet(patches, labels, names)


@pytest.fixture(scope="package")
def scenes():
    return [render_scene(shape=(360, 640), vehicles=2, random_state=seed) for seed in (1, 2)]


@pytest.fixture(scope="package")
def labels(scenes):
    rows = [
        (number, truth.box, bool(truth.ignore))
        for number, scene in enumerate(scenes)
        for truth in scene.truth
    ]
    frames, boxes, ignore = zip(*rows)
    return TrackTable(frames, None, np.array(boxes), ignore=np.array(ignore), frame_keys=range(len(scenes)))


@pytest.fixture(scope="package")
def frames(scenes, labels):
    return LabelledFrames("drawn", [scene.image for scene in scenes], labels)


@pytest.fixture(scope="package")
def random_svm():
    """A classifier that takes about half of all windows for vehicles."""
    return random_classifier(FeatureParams(**SMALL))
