import numpy as np

from vehicle_detection.scenes import render_patches


def test_shapes_labels_and_seed():
    patches, labels = render_patches(7, random_state=3)
    assert patches.shape == (7, 64, 64, 3)
    assert patches.dtype == np.uint8
    assert labels.dtype == bool
    assert labels.tolist() == [True] * 4 + [False] * 3
    assert patches.tobytes() == render_patches(7, random_state=3)[0].tobytes()
    assert patches.tobytes() != render_patches(7, random_state=4)[0].tobytes()


def test_size():
    assert render_patches(1, size=32)[0].shape == (1, 32, 32, 3)


def test_patches_differ_and_have_contrast():
    patches, labels = render_patches(60, random_state=1)
    assert len({patch.tobytes() for patch in patches}) == 60
    contrast = patches.reshape(60, -1).std(1)
    assert contrast[labels].min() > 8
    assert contrast[labels].mean() > contrast[~labels].mean()
