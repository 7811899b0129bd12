"""Versions of the lesson: found by calling a module's functions, set as defaults, and equal afterwards."""

import functools
import types
import warnings
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC

import vehicle_detection.course as course
from tests.helpers import rendered_patches
from vehicle_detection import InvalidInputError, render_scene, write_image
from vehicle_detection.course import detect_versions, reference, set_lesson_defaults
from vehicle_detection.course.versions import lesson_defaults

pytestmark = [
    pytest.mark.usefixtures("restored_defaults"),
    pytest.mark.filterwarnings("ignore:the image has values 0-1, which"),
]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("patches")
    patches, labels = rendered_patches(40)
    names = [str(folder / f"{row:03}.png") for row in range(len(patches))]
    for name, patch in zip(names, patches):
        write_image(name, patch)
    image = render_scene(shape=(224, 400), focal_px=380, vehicles=4, random_state=0).image
    return SimpleNamespace(names=names, labels=labels, image=image)


def their_lesson(version):
    """Lesson functions of the reference whose defaults are those of a version."""
    own = {
        name: version[name] for name in ("transform_sqrt", "hist_range", "spatial_order") if name in version
    }
    read = {name: version[name] for name in ("imread", "channel_order") if name in version}
    band = {name: version[name] for name in ("divide_by", "cells_per_step") if name in version}
    band |= own | {"formula": version.get("find_cars_formula", "old")}

    def find_cars(img, *args):
        boxes = reference.find_car_windows(img, *args, **band)
        picture = reference.draw_boxes(img, boxes)
        return {"boxes": boxes, "both": (picture, boxes)}.get(version.get("find_cars_returns"), picture)

    functions = {
        "extract_features": functools.partial(reference.extract_features, **own, **read),
        "single_img_features": functools.partial(reference.single_img_features, **own),
        "slide_window": functools.partial(reference.slide_window, formula=version.get("formula", "old")),
        "bin_spatial": functools.partial(
            reference.bin_spatial, order=version.get("spatial_order", "interleaved")
        ),
        "color_hist": functools.partial(reference.color_hist, bins_range=version.get("hist_range", (0, 256))),
        "get_hog_features": functools.partial(
            reference.get_hog_features, transform_sqrt=version.get("transform_sqrt", False)
        ),
    }
    return SimpleNamespace(find_cars=find_cars, **functions)


def system(lesson, data, channel_order="RGB"):
    """A small system with a loop of its own around the functions of the lesson."""
    features = lesson.extract_features(data.names, "YCrCb", (16, 16), 16, 9, 8, 2, "ALL")
    scaler = StandardScaler().fit(features)
    svc = LinearSVC(C=0.01, random_state=0, max_iter=10_000).fit(scaler.transform(features), data.labels)
    unit = np.max(features[0][:768]) <= 1
    frame = data.image if channel_order == "RGB" else data.image[..., ::-1].copy()
    image = (frame / np.float32(255)) if unit else frame
    windows = lesson.slide_window(image, [60, None], [90, 200], (72, 64), (0.8, 0.7))
    hot = []
    for (x1, y1), (x2, y2) in windows:
        patch = cv2.resize(image[y1:y2, x1:x2], (64, 64))
        vector = lesson.single_img_features(patch, "YCrCb", (16, 16), 16, hog_channel="ALL")
        if svc.predict(scaler.transform([vector])) == 1:
            hot.append(((x1, y1), (x2, y2)))
    band = lesson.find_cars(frame, 90, 200, 1.2, svc, scaler, 9, 8, 2, (16, 16), 16)
    return np.array(features), windows, hot, band


VERSIONS = [
    {"transform_sqrt": True, "formula": "new"},
    {"imread": "cv2", "channel_order": "BGR", "divide_by": 1, "find_cars_returns": "boxes"},
    {"hist_range": None, "spatial_order": "channels", "find_cars_formula": "new"},
    {"imread": "cv2", "divide_by": 1, "cells_per_step": 1, "find_cars_returns": "both"},
    {"cells_per_step": 3, "find_cars_formula": "new", "hist_range": (0, 1), "transform_sqrt": True},
]


@pytest.mark.parametrize("version", VERSIONS, ids=lambda version: "-".join(version))
def test_a_system_of_a_version_is_equal_after_its_detection(data, version):
    lesson = their_lesson(version)
    found = detect_versions(lesson)
    assert found.items() >= version.items()
    assert found == {name: version.get(name, lesson_defaults[name]) for name in found}
    set_lesson_defaults(**found)
    order = version.get("channel_order", "RGB")
    (features, windows, hot, band), expected = system(course, data, order), system(lesson, data, order)
    np.testing.assert_allclose(features, expected[0], rtol=1e-6, atol=5e-6)
    assert windows == expected[1]
    assert hot == expected[2] != []
    assert type(band) is type(expected[3])
    pairs = zip(band, expected[3]) if isinstance(band, tuple) else [(band, expected[3])]
    for one, other in pairs:
        np.testing.assert_allclose(one, other, rtol=1e-6)


LESSON_OF_2017 = """
from skimage.feature import hog

def get_hog_features(img, orient, pix_per_cell, cell_per_block, vis=False, feature_vec=True):
    if vis:
        return hog(img, orientations=orient, pixels_per_cell=(pix_per_cell, pix_per_cell),
                   cells_per_block=(cell_per_block, cell_per_block), transform_sqrt=True,
                   visualise=True, feature_vector=feature_vec)
    return hog(img, orientations=orient, pixels_per_cell=(pix_per_cell, pix_per_cell),
               cells_per_block=(cell_per_block, cell_per_block), transform_sqrt=True,
               visualise=False, feature_vector=feature_vec)

def bin_spatial(img, size=(32, 32)):
    return img[::4, ::4].ravel()

def slide_window(img, x_start_stop, y_start_stop, xy_window, xy_overlap):
    return None + 1

def find_cars(img, ystart, ystop, scale, svc, X_scaler, orient, pix_per_cell, cell_per_block, size, bins):
    return [((0, 0), (64, 64))]
"""


def test_a_module_of_2017_with_changed_functions():
    lesson = types.ModuleType("lesson_functions")
    exec(LESSON_OF_2017, vars(lesson))
    hog = lesson.hog
    with pytest.warns(UserWarning, match="your .* go on using it") as caught:
        found = detect_versions(lesson)
    assert found == {"transform_sqrt": True, "find_cars_returns": "boxes"}
    assert lesson.hog is hog
    messages = [str(warning.message) for warning in caught]
    assert [message.split()[1] for message in messages] == ["slide_window", "bin_spatial", "find_cars"]
    assert "fails: TypeError" in messages[0]
    assert {warning.filename for warning in caught} == {__file__}


def test_defaults_are_checked_and_kept():
    with warnings.catch_warnings():
        assert detect_versions(SimpleNamespace()) == {}
    before = dict(lesson_defaults)
    for options, message in (
        ({"formula": "newest"}, "formula must be one of 'old', 'new'; got 'newest'"),
        ({"transform_sqrt": "yes"}, "transform_sqrt must be True or False"),
        ({"hist_range": 5}, "hist_range must be"),
        ({"imread": "imageio"}, "imread must be one of 'mpimg', 'cv2'"),
        ({"divide_by": 0}, "divide_by must be a number"),
        ({"cells": 2, "formula": "new"}, "one of 'transform_sqrt', .*; got 'cells'"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            set_lesson_defaults(**options)
    assert lesson_defaults == before


@pytest.mark.parametrize("name", ["cspace", "color_space"])
def test_find_cars_of_other_versions_by_position(data, name):
    features = course.extract_features(data.names, "YUV", orient=11, pix_per_cell=16, hog_channel="ALL",
                                       spatial_feat=False, hist_feat=False)  # fmt: skip
    svc = LinearSVC(C=0.01, random_state=0, max_iter=10_000).fit(features, data.labels)
    sizes = (11, 16, 2)
    options = {"hog_channel": "ALL", "spatial_feat": False, "hist_feat": False}
    expected = course.find_car_windows(
        data.image, 90, 200, 1.1, svc, None, *sizes, (32, 32), 32, **{name: "YUV"}, **options
    )
    set_lesson_defaults(find_cars_returns="boxes")
    inserted = course.find_cars(data.image, 90, 200, 1.1, "YUV", "ALL", svc, None, *sizes, None, None, False)
    assert inserted == expected != []
    appended = (
        data.image, 90, 200, 1.1, svc, None, *sizes, (32, 32), 32, "YUV", "ALL", False, False, True
    )  # fmt: skip
    assert course.find_cars(*appended) == expected
    switched = course.find_cars(*appended[:11], False, False, True, color_space="YUV", hog_channel="ALL")
    assert switched == expected
    with pytest.raises(TypeError, match="up to 16 positional arguments; got 17"):
        course.find_cars(*appended, 4)


def test_names_of_published_versions(data):
    image = data.image[:64, :64]
    channel = course.convert_color(image, color_space="YUV")[..., 1]
    np.testing.assert_array_equal(channel, course.convert_color(image, "RGB2YUV")[..., 1])
    sizes = {"orient": 9, "pix_per_cell": 8, "cell_per_block": 2}
    expected = course.get_hog_features(channel, **sizes)
    np.testing.assert_array_equal(course.get_hog_features(channel), expected)
    np.testing.assert_array_equal(course.get_hog_features(channel, orient_bins=9), expected)
    np.testing.assert_array_equal(
        course.extract_features_all([image], "YUV", hog_channels="ALL"),
        course.extract_features([image], "YUV", hog_channel="ALL"),
    )
    assert course.bounding_boxes(image, [((0, 0), (8, 8)), ((4, 0), (12, 8))], 1) == [((4, 0), (7, 7))]


def test_images_are_shown_in_a_grid(data):
    import matplotlib.pyplot as plt

    plt.close("all")
    course.show_images([data.image, data.image[..., 0], data.image], ["road", "red"], columns=2)
    panels = plt.gcf().axes
    assert [panel.get_title() for panel in panels] == ["road", "red", "", ""]
    assert [len(panel.images) for panel in panels] == [1, 1, 1, 0]
    plt.close("all")
