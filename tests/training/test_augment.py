import cv2
import numpy as np
import pytest

from tests.helpers import rendered_patches
from vehicle_detection.training.classifier import blur_patches, degrade_patches


@pytest.fixture(scope="module")
def patches():
    return rendered_patches(24)[0]


def sharpness(images):
    gray = np.array([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images], float)
    return np.abs(np.diff(gray, axis=2)).mean(axis=(1, 2))


def color(images):
    return (images.max(axis=3).astype(float) - images.min(axis=3)).mean(axis=(1, 2))


@pytest.mark.parametrize("change", [blur_patches, degrade_patches])
@pytest.mark.parametrize("mirror", [False, True])
def test_the_result_depends_only_on_the_patch(patches, change, mirror):
    before = patches.copy()
    changed = change(patches, mirror=mirror)
    np.testing.assert_array_equal(patches, before)
    assert (changed.shape, changed.dtype) == (patches.shape, np.uint8)
    np.testing.assert_array_equal(change(patches[::-3], mirror=mirror), changed[::-3])


def test_blurred_patches_lose_sharpness_and_keep_their_color(patches):
    blurred = blur_patches(patches, mirror=False)
    assert (sharpness(blurred) <= sharpness(patches) * 1.01).all()
    assert sharpness(blurred).mean() < 0.8 * sharpness(patches).mean()
    np.testing.assert_allclose(blurred.mean(axis=(1, 2)), patches.mean(axis=(1, 2)), atol=3)


def test_degraded_patches_lose_saturation_and_keep_their_brightness(patches):
    degraded = degrade_patches(patches, mirror=False)
    assert color(degraded).mean() < 0.8 * color(patches).mean()
    np.testing.assert_allclose(degraded.mean(axis=(1, 2)).mean(), patches.mean(), atol=3)


def test_about_half_of_the_patches_are_mirrored(patches):
    left = np.zeros_like(patches)
    left[:, :, :32] = np.arange(len(patches))[:, None, None, None] + 100  # all different
    for change in (blur_patches, degrade_patches):
        bright = change(left)[:, :, :16].mean(axis=(1, 2, 3)) > 50
        assert 4 < bright.sum() < 20
        assert (change(left, mirror=False)[:, :, :16].mean(axis=(1, 2, 3)) > 50).all()
