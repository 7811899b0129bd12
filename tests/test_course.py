"""The lesson functions equal their definition, and every published call form binds."""

import copy
import inspect
import warnings
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import label
from sklearn.dummy import DummyClassifier
from sklearn.linear_model import LogisticRegression, SGDClassifier
from sklearn.model_selection import GridSearchCV
from sklearn.naive_bayes import GaussianNB
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, MinMaxScaler, RobustScaler, StandardScaler
from sklearn.svm import SVC, LinearSVC
from sklearn.tree import DecisionTreeClassifier

import vehicle_detection.course as lesson
from tests import lesson_reference as reference
from vehicle_detection import Detections, FeatureParams, InvalidInputError, read_image, write_image
from vehicle_detection.course import search as search_module
from vehicle_detection.scenes import render_patches, render_scene
from vehicle_detection.svm import UNIT_CHANNELS
from vehicle_detection.training import to_pipeline, train_classifier

# Many tests use images of 0-1 with the lesson's default range of histograms.
pytestmark = pytest.mark.filterwarnings("ignore:the image has values 0-1, which")

# The kernels compute HOG in float32, scikit-image in float64: values up to 1.
HOG_TOLERANCE = 5e-6


def frame_of(dtype, seed=0, shape=(208, 330)):
    """A rendered scene as uint8, float 0-1 or, for "0-255", float 0-255."""
    image = render_scene(shape=shape, focal_px=300, vehicles=4, random_state=seed).image
    if dtype == "uint8":
        return image
    return image.astype(np.float32) / (255 if dtype == "0-1" else 1)


DTYPES = ("uint8", "0-1", "0-255")
FRAMES = {dtype: frame_of(dtype) for dtype in DTYPES}
PATCHES, LABELS = render_patches(60, random_state=5)
DETECTIONS = Detections(np.array([[3.0, 4, 40, 50], [20, 10, 60, 40]]), np.array([1.0, 2.0]))
PAIRS = [((3, 4), (40, 50)), ((20, 10), (60, 40))]


def trained(X, y=LABELS, clf=None, scaler=None):
    scaler = (scaler or StandardScaler()).fit(X)
    clf = clf or LinearSVC(C=0.01, random_state=0, max_iter=10_000)
    return clf.fit(scaler.transform(X), y), scaler


HOG_OF_YUV = {"color_space": "YUV", "orient": 11, "pix_per_cell": 16, "hog_channel": "ALL"}
HOG_OF_YUV |= {"spatial_feat": False, "hist_feat": False}


@pytest.fixture(scope="module")
def models():
    """Options of `extract_features` and a classifier for them, trained on uint8 and on float 0-1 patches."""
    found = {}
    for name, options in {
        "all": {"color_space": "YCrCb", "spatial_size": (16, 16), "hist_bins": 16, "hog_channel": "ALL"},
        "hog": HOG_OF_YUV,
        "luv": {"color_space": "LUV", "spatial_size": (16, 16), "hist_bins": 16, "orient": 8},
        "color": {"color_space": "HSV", "spatial_size": (8, 8), "hist_bins": 8, "hog_feat": False},
    }.items():
        for dtype in ("uint8", "0-1"):
            images = PATCHES if dtype == "uint8" else PATCHES.astype(np.float32) / 255
            features = np.array(reference.extract_features(images, **options))
            found[name, dtype] = SimpleNamespace(options=options, X=features, model=trained(features))
    return found


@pytest.mark.parametrize("dtype", [*DTYPES, np.float64, np.int64, np.uint16])
@pytest.mark.parametrize("cell", [4, 7, 8, 16])
@pytest.mark.parametrize("transform_sqrt", [False, True])
def test_hog_equals_scikit_image(dtype, cell, transform_sqrt):
    channel = (FRAMES[dtype] if dtype in DTYPES else FRAMES["uint8"].astype(dtype))[:75, :101, 1]
    options = {"feature_vec": False, "transform_sqrt": transform_sqrt}
    found = lesson.get_hog_features(channel, 9, cell, 2, **options)
    expected = reference.get_hog_features(channel, 9, cell, 2, **options)
    assert found.dtype == expected.dtype
    assert found.flags.c_contiguous
    np.testing.assert_allclose(found, expected, rtol=0, atol=HOG_TOLERANCE)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_hog_picture_equals_scikit_image(dtype):
    channel = FRAMES[dtype][:64, :80, 0]
    features, picture = lesson.get_hog_features(channel, 9, 8, 2, True, False)
    expected, expected_picture = reference.get_hog_features(channel, 9, 8, 2, True, False)
    np.testing.assert_allclose(features, expected, rtol=0, atol=HOG_TOLERANCE)
    np.testing.assert_allclose(picture, expected_picture, rtol=1e-6)
    for name in ("visualise", "visualize"):
        np.testing.assert_array_equal(lesson.get_hog_features(channel, 9, 8, 2, **{name: True})[1], picture)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("order", ["interleaved", "channels"])
def test_spatial_bins(dtype, order):
    for size in ((32, 32), (16, 8)):
        found = lesson.bin_spatial(FRAMES[dtype], size, order=order)
        expected = reference.bin_spatial(FRAMES[dtype], size, order=order)
        assert found.dtype == expected.dtype
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    converted = cv2.cvtColor(FRAMES[dtype], cv2.COLOR_RGB2HSV)
    np.testing.assert_array_equal(
        lesson.bin_spatial(FRAMES[dtype], color_space="HSV"), lesson.bin_spatial(converted)
    )


@given(
    st.sampled_from(DTYPES),
    st.integers(1, 70),
    st.sampled_from([(0, 256), (0, 1), (0, 255), (10, 200), (-0.5, 0.7), None]),
)
def test_histograms_equal_numpy(dtype, bins, limits):
    found = lesson.color_hist(FRAMES[dtype][:20, :30], bins, limits)
    expected = reference.color_hist(FRAMES[dtype][:20, :30], bins, limits)
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("conv", ["RGB2YCrCb", "BGR2YCrCb", "RGB2LUV", "BGR2HLS", "RGB2HSV", "RGB2YUV"])
@pytest.mark.parametrize("dtype", ["uint8", "0-1"])
def test_color_conversion_is_that_of_opencv(conv, dtype):
    found, expected = (module.convert_color(FRAMES[dtype], conv) for module in (lesson, reference))
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


def test_names_of_color_conversions():
    image = FRAMES["uint8"]
    for one, other in (("Lab", "LAB"), ("rgb2ycrcb", "RGB2YCrCb"), ("RGB2Gray", "RGB2GRAY")):
        np.testing.assert_array_equal(lesson.convert_color(image, one), lesson.convert_color(image, other))
    np.testing.assert_array_equal(lesson.convert_color(image, "LAB"), cv2.cvtColor(image, cv2.COLOR_RGB2LAB))
    copy = lesson.convert_color(image, "RGB")
    assert copy is not image
    np.testing.assert_array_equal(copy, image)
    assert lesson.convert_color(image / 255.0).dtype == np.float32
    for space in ("HSV", "HLS", "LUV", "LAB", "YUV", "YCrCb"):
        converted = lesson.convert_color(FRAMES["0-1"], f"BGR2{space}")
        np.testing.assert_allclose(lesson.convert_color(converted, f"{space}2BGR"), FRAMES["0-1"], atol=0.01)


FEATURE_OPTIONS = [
    {},
    {"color_space": "YCrCb", "hog_channel": "ALL"},
    {"color_space": "LUV", "spatial_size": (16, 16), "hist_bins": 16, "orient": 8, "transform_sqrt": True},
    {"color_space": "HLS", "spatial_size": (16, 8), "hog_channel": 2},
    {"color_space": "HSV", "hist_range": (0, 180), "hog_channel": 1, "cell_per_block": 3},
    {"color_space": "YUV", "pix_per_cell": 16, "orient": 11, "spatial_feat": False, "hist_feat": False},
    {"color_space": "LAB", "spatial_order": "channels", "hog_channel": "ALL"},
    {"hog_feat": False, "spatial_size": (20, 20)},
    {"hist_range": None, "pix_per_cell": 12},
]


@pytest.mark.parametrize("dtype", ["uint8", "0-1"])
@pytest.mark.parametrize("options", FEATURE_OPTIONS)
def test_features_equal_the_definition(dtype, options):
    if dtype == "0-1" and options.get("transform_sqrt"):
        options = {**options, "color_space": "YCrCb"}
    images = [*PATCHES[::12], FRAMES["uint8"]] if options == {} else PATCHES[::12]
    images = images if dtype == "uint8" else [image.astype(np.float32) / 255 for image in images]
    found = lesson.extract_features(images, **options)
    expected = reference.extract_features(images, **options)
    assert isinstance(found, list)
    for vector, other in zip(found, expected, strict=True):
        assert vector.dtype == np.float64 or (vector.dtype == np.float32 and dtype == "uint8")
        np.testing.assert_allclose(vector, other, rtol=1e-6, atol=HOG_TOLERANCE)
    single = lesson.single_img_features(images[0], **options)
    assert single.dtype == np.float64
    np.testing.assert_allclose(single, expected[0], rtol=1e-6, atol=HOG_TOLERANCE)


@pytest.mark.parametrize("dtype", ["uint8", "0-1"])
def test_transparency_is_dropped_from_arrays(dtype):
    patch = PATCHES[0] if dtype == "uint8" else PATCHES[0] / np.float32(255)
    transparent = np.dstack([patch, patch[..., 0]])
    for function in (
        lambda image: lesson.extract_features([image, patch], "YCrCb", hog_channel="ALL"),
        lambda image: lesson.extract_features(image[None], hist_range=None),
        lambda image: lesson.single_img_features(image, "HLS", vis=True)[0],
        lesson.bin_spatial,
        lesson.color_hist,
        lesson.convert_color,
    ):
        np.testing.assert_array_equal(function(transparent), function(patch))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("patches")
    for index, patch in enumerate(PATCHES):
        write_image(folder / f"{index:03d}.png", patch)
        write_image(folder / f"{index:03d}.jpg", patch)
    return folder


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_files_are_read_as_in_the_lesson(files, suffix):
    names = sorted(str(path) for path in files.glob(f"*.{suffix}"))[::20]
    found, expected = (module.extract_features(names, "YCrCb") for module in (lesson, reference))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=HOG_TOLERANCE)
    assert np.max(found[0][:3072]) <= (1 if suffix == "png" else 255)
    if suffix == "png":
        as_bytes = lesson.extract_features(names, "YCrCb", imread=read_image)
        np.testing.assert_array_equal(as_bytes, lesson.extract_features(PATCHES[::20], "YCrCb"))
    mixed = lesson.extract_features([names[0], reference.read_file(names[1])], "YCrCb")
    np.testing.assert_array_equal(mixed, found[:2])


def test_cspace_selects_the_features_of_the_earlier_quizzes():
    hog = lesson.extract_features(PATCHES[:2], cspace="YUV", orient=11, pix_per_cell=16, hog_channel="ALL")
    assert hog[0].shape == (3 * 3 * 3 * 4 * 11,)
    color = lesson.extract_features(
        PATCHES[:2], cspace="LUV", spatial_size=(8, 8), hist_bins=4, hist_range=(0, 256)
    )
    assert color[0].shape == (192 + 12,)
    whole = lesson.extract_features(PATCHES[:2], cspace="LUV", hist_bins=4, orient=9)
    assert whole[0].shape == (3072 + 12 + 1764,)
    told = lesson.extract_features(PATCHES[:2], cspace="LUV", orient=9, hist_feat=True)
    assert told[0].shape == (3072 + 96 + 1764,)
    with pytest.raises(InvalidInputError, match="same option"):
        lesson.extract_features(PATCHES[:2], cspace="LUV", color_space="LUV")


@pytest.mark.usefixtures("restored_defaults")
def test_the_defaults_of_the_lesson_are_set_for_all_functions(models):
    case, image, channel = models["hog", "uint8"], FRAMES["uint8"], PATCHES[0][..., 1]
    positional, keywords = band_arguments(case)
    band, keywords = (
        (image, 60, 200, 0.7, *case.model, *positional),
        {**keywords, "divide_by": 1, "cells_per_step": 1},
    )

    def results(**options):
        return [
            *lesson.extract_features(PATCHES[:2], "YCrCb", **options),
            lesson.single_img_features(PATCHES[0], "YCrCb", **options),
            lesson.get_hog_features(channel, 9, 8, 2, **options),
            lesson.get_hog_features(channel, 9, 8, 2, vis=True, **options)[1],
            lesson.search_windows(image, PAIRS, *case.model, **case.options, **options),
            lesson.find_car_windows(*band, **keywords, **options),
            lesson.find_cars(*band, **keywords, **options),
        ]

    def assert_equal(found, expected):
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other)

    plain, root = results(transform_sqrt=False), results(transform_sqrt=True)
    assert not any(np.array_equal(one, other) for one, other in zip(plain[:5], root, strict=False))
    assert_equal(results(), plain)
    lesson.set_lesson_defaults(transform_sqrt=True)
    assert_equal(results(), root)
    assert_equal(results(transform_sqrt=False), plain)
    assert lesson.slide_window(image) == lesson.slide_window(image, formula="old")
    assert lesson.set_lesson_defaults(formula="new") is None
    assert_equal(results(), root)
    assert lesson.slide_window(image) == lesson.slide_window(image, formula="new")


@given(
    st.integers(1, 90),
    st.integers(0, 50),
    st.integers(1, 200),
    st.sampled_from([0, 0.25, 0.5, 0.6, 0.75, 0.85]),
    st.sampled_from(["old", "new"]),
)
def test_windows_are_those_of_the_lesson(side, start, stop, overlap, formula):
    if int(side * (1 - overlap)) < 1 or start > stop:
        return
    image = np.zeros((120, 200, 3), np.uint8)
    arguments = ([start, stop], [None, None], (side, 40), (overlap, 0.5))
    found, expected = (
        module.slide_window(image, *arguments, formula=formula) for module in (lesson, reference)
    )
    assert found == expected
    assert arguments[:2] == ([start, stop], [None, None])
    floats = ([float(start), np.float64(stop)], [None, 120.0], (float(side), np.float32(40)), (overlap, 0.5))
    assert lesson.slide_window(image, *floats, formula=formula) == expected


@pytest.mark.parametrize("dtype", ["uint8", "0-1"])
@pytest.mark.parametrize("name", ["all", "luv", "hog", "color"])
def test_window_hits_equal_the_definition(models, dtype, name):
    case, image = models[name, dtype], FRAMES[dtype]
    windows = reference.slide_window(image, [None, None], [96, 184], (64, 64), (0.875, 0.75))
    windows += reference.slide_window(image, [40, None], [80, 200], (96, 80), (0.9, 0.5))
    assert max(x2 for _, (x2, _) in windows) > image.shape[1]
    found, expected = (
        module.search_windows(image, windows, *case.model, **case.options) for module in (lesson, reference)
    )
    assert 0 < len(expected) < len(windows)
    assert found == expected


@pytest.mark.parametrize(
    ("clf", "scaler", "labels"),
    [
        (GaussianNB(), StandardScaler(), (0, 1)),
        (DecisionTreeClassifier(random_state=0), StandardScaler(), (-1, 1)),
        (SVC(), StandardScaler(), (1, 2)),
        (SVC(kernel="linear"), StandardScaler(), (0, 1)),
        (LogisticRegression(max_iter=1000), StandardScaler(), (-1, 1)),
        (SGDClassifier(random_state=0, max_iter=5, tol=None), StandardScaler(with_mean=False), (1, 2)),
        (LinearSVC(random_state=0), MinMaxScaler(), (-1, 1)),
        (LinearSVC(random_state=0), RobustScaler(), (1, 2)),
    ],
    ids=lambda each: type(each).__name__,
)
def test_any_classifier_of_scikit_learn(models, clf, scaler, labels):
    case = models["all", "uint8"]
    model = trained(case.X, np.where(LABELS, labels[1], labels[0]), clf, scaler)
    image = FRAMES["uint8"]
    windows = reference.slide_window(image, [None, None], [70, 170], (64, 64), (0.6, 0.6))
    found, expected = (
        module.search_windows(image, windows, *model, **case.options) for module in (lesson, reference)
    )
    assert found == expected
    arguments = (80, 190, 1.5, *model, 9, 8, 2, (16, 16), 16)
    found, expected = (
        module.find_car_windows(image, *arguments, divide_by=1) for module in (lesson, reference)
    )
    assert found == expected


BAND_OPTIONS = [
    ({}, 1),
    ({}, 1.3),
    ({"formula": "new", "cells_per_step": 1}, 0.8),
    ({"resize": "before conversion", "cells_per_step": 3}, 1.3),
]


def band_arguments(case):
    """Positional and keyword options of `find_cars` for a model."""
    options = dict(case.options)
    positional = [
        options.pop("orient", 9), options.pop("pix_per_cell", 8), 2, options.pop("spatial_size", (32, 32)),
        options.pop("hist_bins", 32),
    ]  # fmt: skip
    return positional, {"hog_channel": 0, **options}


@pytest.mark.parametrize("dtype", ["uint8", "0-1"])
@pytest.mark.parametrize(("options", "scale"), BAND_OPTIONS)
@pytest.mark.parametrize("name", ["all", "hog", "luv", "color"])
def test_find_cars_equals_the_definition(models, dtype, options, scale, name):
    # Models of float patches search the uint8 frame divided by 255, as in the quiz.
    case, image = models[name, dtype], FRAMES["uint8"]
    positional, keywords = band_arguments(case)
    keywords |= options | {"divide_by": 1 if dtype == "uint8" else 255}
    arguments = (90, 90 + round(100 * scale), scale, *case.model, *positional)
    found, expected = (
        module.find_car_windows(image, *arguments, **keywords) for module in (lesson, reference)
    )
    assert found == expected
    drawn = lesson.find_cars(image, *arguments, **keywords)
    np.testing.assert_array_equal(drawn, reference.draw_boxes(image, expected))


def old_version(estimator):
    """The estimator as scikit-learn before 0.24 has pickled it."""
    estimator = copy.deepcopy(estimator)
    del estimator.n_features_in_
    return estimator


def test_the_fast_search_is_used_where_it_applies(models, monkeypatch):
    case = models["all", "uint8"]
    svc, scaler = case.model
    grid = GridSearchCV(LinearSVC(random_state=0, max_iter=10_000), {"C": [0.01]}, cv=2)
    grid.fit(scaler.transform(case.X), LABELS)
    given = [(svc, scaler), (grid, scaler), (grid.best_estimator_, scaler), [*map(old_version, case.model)]]
    monkeypatch.setattr(search_module._Estimators, "predict", None)
    arguments, hits = (9, 8, 2, (16, 16), 16), []
    for model in given:
        lesson.search_windows(FRAMES["uint8"], PAIRS, *model, **case.options)
        hits.append(lesson.find_car_windows(FRAMES["uint8"], 60, 200, 1.5, *model, *arguments, divide_by=1))
    assert hits[1] == hits[2] != []
    assert hits[3] == hits[0] != []
    with pytest.raises(InvalidInputError, match="fitted on 6108 features, but these options give 8460"):
        lesson.find_cars(FRAMES["uint8"], 60, 200, 1, *given[3], 9, 8, 2, (32, 32), 32, divide_by=1)


def test_a_changed_model_is_noticed(models):
    case = models["all", "uint8"]
    scaler, svc = case.model[1], LinearSVC(C=0.01, random_state=0, max_iter=10_000)
    svc.fit(scaler.transform(case.X), LABELS)

    def search(scale=1):
        arguments = (60, 200, scale, svc, scaler, 9, 8, 2, (16, 16), 16)
        return lesson.find_car_windows(FRAMES["uint8"], *arguments, divide_by=1)

    before = search()
    assert before == search()
    svc.intercept_ += 10
    everything = search()
    assert len(everything) > 10 * len(before) > 0
    svc.intercept_ -= 10
    svc.coef_ *= -1
    svc.intercept_ *= -1
    # All windows that were not found before.
    assert sorted(search() + before) == sorted(everything)
    svc.predict = lambda features: np.zeros(len(features))
    assert search() == []


@pytest.mark.parametrize("hog_feat", [True, False])
@pytest.mark.parametrize("hist_range", [(0, 256), None])
def test_cells_that_do_not_divide_a_window(hist_range, hog_feat):
    """Without HOG, too, they set the step between windows."""
    shared = {"hist_range": hist_range, "hog_feat": hog_feat}
    options = {"spatial_size": (16, 16), "hist_bins": 16, "pix_per_cell": 12, **shared}
    model = trained(reference.extract_features(PATCHES, "YCrCb", **options))
    arguments = (FRAMES["uint8"], 60, 200, 1, *model, 9, 12, 2, (16, 16), 16)
    keywords = {"hog_channel": 0, "formula": "new", "divide_by": 1, **shared}
    found, expected = (module.find_car_windows(*arguments, **keywords) for module in (lesson, reference))
    assert found == expected


def test_a_float_image_from_0_to_1_is_not_divided(models):
    case = models["all", "0-1"]
    arguments = (60, 200, 1, *case.model, 9, 8, 2, (16, 16), 16)
    found = [lesson.find_car_windows(FRAMES[dtype], *arguments) for dtype in DTYPES]
    assert found[0] == found[1] == found[2] != []


@pytest.mark.parametrize("space", ["HLS", "HSV", "LUV", "LAB", "YCrCb"])
def test_a_mismatch_of_the_range_of_values_warns(space):
    options = {"color_space": space, "spatial_size": (16, 16), "hist_bins": 16, "hog_channel": "ALL"}
    for images, trained_on, other in ((PATCHES, "0-255", "0-1"), (PATCHES / np.float32(255), "0-1", "uint8")):
        model = trained(np.array(lesson.extract_features(images, **options)))
        with pytest.warns(UserWarning, match=f"fitted on values {trained_on}, .*divide_by=1") as caught:
            lesson.search_windows(FRAMES[other], PAIRS, *model, **options)
        band = (FRAMES["uint8"], 60, 200, 1, *model, 9, 8, 2, (16, 16), 16)
        divide_by = 255 if trained_on == "0-255" else 1
        for find in (lesson.find_cars, lesson.find_car_windows):
            with pytest.warns(UserWarning, match=f"fitted on values {trained_on}") as also_caught:
                find(*band, color_space=space, divide_by=divide_by)
            assert {each.filename for each in (*caught, *also_caught)} == {__file__}


UNIT_SPACES = list(UNIT_CHANNELS)


@pytest.mark.filterwarnings("ignore:the scaler was fitted")
@pytest.mark.parametrize("color_space", UNIT_SPACES)
def test_histograms_of_another_range_warn(color_space):
    """With ``hist_range=(0, 256)``, a 0-1 image fills the first bins only."""
    options = {"color_space": color_space, "spatial_size": (8, 8)}
    model = trained(np.array(lesson.extract_features(PATCHES, **options)))
    image, unit = FRAMES["uint8"], FRAMES["0-1"]
    calls = {
        "extraction": lambda hist: lesson.extract_features(PATCHES[:2] / 255, **options, hist_range=hist),
        "one image": lambda hist: lesson.single_img_features(unit, **options, hist_range=hist),
        "windows": lambda hist: lesson.search_windows(unit, PAIRS, *model, **options, hist_range=hist),
        "band": lambda hist: lesson.find_cars(
            image, 60, 200, 1, *model, 9, 8, 2, (8, 8), 32, color_space=color_space, hog_channel=0,
            hist_range=hist,
        ),
    }  # fmt: skip
    if len(UNIT_CHANNELS[color_space]) == 3:
        calls["histogram"] = lambda hist: lesson.color_hist(unit, 32, hist)
    for name, call in calls.items():
        with pytest.warns(UserWarning, match='first bin .*imread="cv2".*divide_by=1') as caught:
            call((0, 256))
        assert {warning.filename for warning in caught} == {__file__}, name
        with warnings.catch_warnings(record=True) as caught:
            call((0, 1))
            call(None)
        assert not [each for each in caught if "first bin" in str(each.message)], name


@pytest.mark.parametrize(("hist_bins", "spatial_feat"), [(1, False), (2, True), (256, False)])
@pytest.mark.parametrize("color_space", [*UNIT_SPACES, "LUV", "LAB"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_images_like_those_of_the_training_do_not_warn(color_space, spatial_feat, hist_bins, dtype):
    """Warnings are errors in the tests."""
    images = {"uint8": PATCHES, "0-1": PATCHES / np.float32(255), "0-255": PATCHES.astype(np.float32)}[dtype]
    if dtype == "0-255" and color_space in ("LUV", "LAB", "HLS", "HSV"):
        return  # OpenCV defines them for 0-1
    options = {"color_space": color_space, "spatial_size": (8, 8), "spatial_feat": spatial_feat}
    options |= {"hist_bins": hist_bins, "hog_feat": hist_bins == 1}
    for hist_range in ((0, 256), (0, 1), None)[dtype == "0-1" :]:
        options["hist_range"] = hist_range
        model = trained(np.array(lesson.extract_features(images, **options)), clf=DummyClassifier())
        lesson.search_windows(FRAMES[dtype], PAIRS, *model, **options)


@given(
    st.lists(st.tuples(*[st.integers(0, 70)] * 4), max_size=12),
    st.sampled_from([np.float64, np.float32, np.int64, np.uint8]),
    st.integers(0, 4),
)
def test_heat_is_added_in_place(values, dtype, threshold):
    boxes = [((min(x1, x2), min(y1, y2)), (max(x1, x2), max(y1, y2))) for x1, y1, x2, y2 in values]
    start = np.random.default_rng(0).integers(0, 4, (40, 60)).astype(dtype)
    heat, expected = start.copy(), start.copy()
    assert lesson.add_heat(heat, boxes) is heat
    reference.add_heat(expected, boxes)
    np.testing.assert_array_equal(heat, expected)
    if dtype == np.float64:
        decayed = start * 0.9 / 7
        np.testing.assert_array_equal(
            lesson.add_heat(decayed.copy(), boxes), reference.add_heat(decayed.copy(), boxes)
        )
    assert lesson.apply_threshold(heat, threshold) is heat
    np.testing.assert_array_equal(heat, reference.apply_threshold(expected, threshold))
    drawn, expected = (
        module.draw_labeled_bboxes(np.full((40, 60, 3), 9, np.uint8), label(heat))
        for module in (lesson, reference)
    )
    np.testing.assert_array_equal(drawn, expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_boxes_are_drawn_on_a_copy(dtype):
    image = FRAMES[dtype]
    before = image.copy()
    for arguments in ((PAIRS,), (PAIRS, (255, 0, 0), 3), (PAIRS, (0, 1, 0), -1)):
        found, expected = (module.draw_boxes(image, *arguments) for module in (lesson, reference))
        assert found.dtype == image.dtype
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(image, before)
    flipped = image[:, ::-1]
    np.testing.assert_array_equal(lesson.draw_boxes(flipped, []), flipped)


def test_boxes_in_every_form():
    image, heat = FRAMES["uint8"], np.zeros((208, 330))
    lesson.add_heat(heat, PAIRS)
    expected = lesson.draw_boxes(image, PAIRS)
    for boxes in (
        np.array(PAIRS),
        np.array(PAIRS).reshape(-1, 4),
        DETECTIONS,
        tuple(PAIRS),
        DETECTIONS.boxes,
        SimpleNamespace(xyxy=DETECTIONS.boxes),  # as supervision.Detections
    ):
        np.testing.assert_array_equal(lesson.draw_boxes(image, boxes), expected)
        np.testing.assert_array_equal(lesson.add_heat(np.zeros((208, 330)), boxes), heat)
    assert not lesson.add_heat(np.zeros((4, 4)), Detections.empty()).any()


NAMES = {name: getattr(lesson, name) for name in lesson.__all__}

SIGNATURES = {
    "get_hog_features": "img, orient=9, pix_per_cell=8, cell_per_block=2, vis=False, feature_vec=True",
    "bin_spatial": "img, size=(32, 32)",
    "color_hist": "img, nbins=32, bins_range=(0, 256)",
    "extract_features": "imgs, color_space='RGB', spatial_size=(32, 32), hist_bins=32, orient=9, "
    "pix_per_cell=8, cell_per_block=2, hog_channel=0, spatial_feat=True, hist_feat=True, hog_feat=True",
    "single_img_features": "img, color_space='RGB', spatial_size=(32, 32), hist_bins=32, orient=9, "
    "pix_per_cell=8, cell_per_block=2, hog_channel=0, spatial_feat=True, hist_feat=True, hog_feat=True, "
    "vis=False",  # of the walkthrough
    "slide_window": "img, x_start_stop=(None, None), y_start_stop=(None, None), xy_window=(64, 64), "
    "xy_overlap=(0.5, 0.5)",
    "draw_boxes": "img, bboxes, color=(0, 0, 255), thick=6",
    "search_windows": "img, windows, clf, scaler, color_space='RGB', spatial_size=(32, 32), hist_bins=32, "
    "hist_range=(0, 256), orient=9, pix_per_cell=8, cell_per_block=2, hog_channel=0, spatial_feat=True, "
    "hist_feat=True, hog_feat=True",
    "find_cars": "img, ystart, ystop, scale, svc, X_scaler, orient, pix_per_cell, cell_per_block, "
    "spatial_size, hist_bins",
    "convert_color": "img, conv='RGB2YCrCb'",
    "add_heat": "heatmap, bbox_list",
    "apply_threshold": "heatmap, threshold",
    "draw_labeled_bboxes": "img, labels",
}


@pytest.mark.parametrize("name", SIGNATURES)
def test_the_signature_is_the_lessons(name):
    parameters = inspect.signature(getattr(lesson, name)).parameters.values()
    positional = [
        parameter.replace(annotation=parameter.empty)
        for parameter in parameters
        if parameter.kind is parameter.POSITIONAL_OR_KEYWORD
    ]
    assert str(inspect.Signature(positional)) == f"({SIGNATURES[name]})"


def test_a_star_import_brings_the_lesson_functions():
    names = {}
    exec("from vehicle_detection.course import *", names)
    functions = set(lesson.__all__) - {"np", "cv2", "mpimg", "hog"}
    assert set(SIGNATURES) < functions
    modules = {"np": "numpy", "cv2": "cv2", "mpimg": "matplotlib.image", "hog": "skimage.feature._hog"}
    assert functions | set(modules) == set(names) - {"__builtins__"}
    for name, module in modules.items():
        found = names[name]
        assert getattr(found, "__module__", found.__name__) == module


def test_what_the_lesson_accepts():
    image, channel = FRAMES["uint8"], FRAMES["uint8"][..., 0]
    assert (lesson.bin_spatial(channel, (16, 8)) == cv2.resize(channel, (16, 8)).ravel()).all()
    # One number is the value of the first channel, as in OpenCV.
    expected = lesson.draw_boxes(image, PAIRS, (255, 0, 0))
    assert (lesson.draw_boxes(image, PAIRS, 255) == expected).all()
    scored = [(*box, 0.7) for box in PAIRS]
    for boxes in (scored, iter(PAIRS), zip(*zip(*PAIRS)), dict.fromkeys(PAIRS)):
        assert (lesson.draw_boxes(image, boxes, (255, 0, 0)) == expected).all()
    # Options of groups that are off are not read.
    vector = lesson.single_img_features(PATCHES[0], hog_feat=False, orient=None, hog_channel=None)
    assert len(vector) == 3 * 32**2 + 3 * 32
    off = {"spatial_feat": False, "spatial_size": None, "hist_feat": False, "hist_bins": 0}
    assert len(lesson.single_img_features(PATCHES[0], **off)) == 1764


def test_labeled_boxes_are_drawn_on_a_part_of_an_image():
    heat = reference.add_heat(np.zeros((208, 290)), PAIRS)
    part = FRAMES["uint8"].copy()[:, 40:]
    expected = lesson.draw_labeled_bboxes(part.copy(), label(heat))
    assert lesson.draw_labeled_bboxes(part, label(heat)) is part
    assert (part == expected).all()
    part.flags.writeable = False  # as frames of moviepy are
    assert lesson.draw_labeled_bboxes(part, label(np.zeros_like(heat))) is part
    with pytest.raises(InvalidInputError, match="img must be writable and contiguous"):
        lesson.draw_labeled_bboxes(part, label(heat))


# As in published systems, where those of `test_course_systems` differ; with the shape of what is returned.
CALL_FORMS = [
    ("get_hog_features(d.gray, 9, 8, 2, vis=True, feature_vec=False)[0]", (7, 7, 2, 2, 9)),
    ("get_hog_features(d.gray, 9, 8, 2, visualise=True, feature_vec=True)[1]", (64, 64)),
    ("get_hog_features(d.patch[:, :, 0], 11, 16, 2, vis=False, feature_vec=True)", (396,)),
    ("bin_spatial(d.patch, size=16)", (768,)),
    ("bin_spatial(d.patch, 'HSV', (16, 16))", (768,)),
    ("bin_spatial(d.patch, color_space='HSV', size=(32, 32))", (3072,)),
    ("color_hist(d.patch / 255, 32, (0, 1))", (96,)),
    ("extract_features(d.files, cspace='YUV', orient=9, pix_per_cell=8, cell_per_block=2, "
     "hog_channel='ALL')", (3, 5292)),
    ("extract_features(d.files, cspace='RGB', spatial_size=(32, 32), hist_bins=32, "
     "hist_range=(0, 256))", (3, 3168)),
    ("slide_window(d.image, y_start_stop=(90, 200), xy_window=[48, 48])", (36, 2, 2)),
    ("search_windows(d.image, [], clf=d.svc, scaler=d.scaler, color_space='YCrCb', spatial_size=(16, 16), "
     "hist_bins=16, hog_channel='ALL')", (0,)),
    ("find_cars(img=d.image, ystart=90, ystop=200, scale=1, svc=d.svc, X_scaler=d.scaler, orient=9, "
     "pix_per_cell=8, cell_per_block=2, spatial_size=(16, 16), hist_bins=16, divide_by=1)", (208, 330, 3)),
    ("find_car_windows(d.image, 0, 60, 1, d.svc, d.scaler, 9, 8, 2, 16, 16, divide_by=1)", (0,)),
    ("find_car_windows(d.image, 0, 200, 500.0, d.svc, d.scaler, 9, 8, 2, 16, 16, divide_by=1)", (0,)),
]  # fmt: skip


@pytest.fixture(scope="module")
def call_data(models, files):
    svc, scaler = models["all", "uint8"].model
    image, heat = FRAMES["uint8"].copy(), reference.add_heat(np.zeros((208, 330)), PAIRS)
    image.setflags(write=False)
    return SimpleNamespace(
        image=image, patch=PATCHES[0], patches=PATCHES[:3], gray=PATCHES[0][..., 1],
        float_patch=PATCHES[0].astype(np.float32) / 255, files=sorted(map(str, files.glob("*.jpg")))[:3],
        svc=svc, scaler=scaler, boxes=PAIRS, heat=heat, labels=label(heat),
    )  # fmt: skip


@pytest.mark.parametrize(("form", "shape"), CALL_FORMS, ids=[form[:60] for form, _ in CALL_FORMS])
def test_every_call_form_binds(call_data, form, shape):
    assert np.shape(eval(form, {**NAMES, "np": np, "d": call_data})) == shape


@pytest.mark.parametrize(
    ("form", "message"),
    [
        ("get_hog_features(d.patch, 9, 8, 2)", "one .H, W. channel"),
        ("get_hog_features(d.gray[:9], 9, 8, 2)", "at least one block large .16x16 pixels."),
        ("get_hog_features(-d.float_patch[..., 0], 9, 8, 2, transform_sqrt=True)", "transform_sqrt must be"),
        ("bin_spatial(d.gray, 'HLS', 8)", "color_space must be RGB for one channel; got 'HLS'"),
        ("bin_spatial(d.patch, 8, 8)", "takes an image and a size; got 1 more"),
        ("color_hist(d.patch, 4, (5, 5))", "bins_range must be a number, greater than 5"),
        ("convert_color(d.patch, 'RGB2CMYK')", "conv or color_space must be"),
        ("extract_features('car.png')", "list of file names"),
        ("extract_features(d.patch)", r"list of images, .*pass \[image\], or use single_img_features"),
        ("extract_features([d.patch, d.gray])", r"imgs\[1\] must be an .H, W, 3. RGB array"),
        ("extract_features(iter([d.patch, d.patch.astype(int)]))", r"imgs\[1\] must be uint8 or float"),
        ("extract_features(d.patches, 'YCrCb', 9, 8, 2, 1)", "HOG quiz .*: cspace='YCrCb', .*hog_channel=1"),
        ("extract_features(['missing.png'])", "does not exist"),
        ("extract_features(d.files, spatial_feat=0, hist_feat=0, hog_feat=0)", "all False"),
        ("slide_window(d.image, [9, 5])", "0 <= start <= stop"),
        ("slide_window(d.image, xy_overlap=(0.5, 1))", "xy_overlap must leave a step"),
        ("search_windows(d.image, [((0, 0), (0, 9))], d.svc, d.scaler, **d.options)", "non-empty"),
        ("search_windows(d.image, [((330, 0), (340, 9))], d.svc, d.scaler, **d.options)", "330x208 image"),
        ("search_windows(d.image, d.boxes, d.svc, d.scaler)", "fitted on 6108 features, but these options"),
        ("search_windows(d.image, d.boxes, d.scaler, d.svc)", "classifier must have a method predict"),
        ("find_cars(d.image, 90, 200, 1, d.svc, StandardScaler(), 9, 8, 2, 16, 16)", "scaler must be fitted"),
        ("find_cars(d.image, 90, 90, 1, d.svc, d.scaler, 9, 8, 2, 16, 16)", "ystart and ystop"),
        ("find_cars(d.image, 90, 200, 1, d.svc, d.scaler, 9, 64, 2, 16, 16)", "must fit into a window"),
        ("find_cars(d.image, 9, 99, 1, d.svc, d.scaler, 9, 8, 2, 16, 16, resize='first')", "resize must be"),
        ("add_heat(d.heat, [((9, 9), (5, 5))])", "x1 <= x2"),
        *(
            (f"add_heat(d.heat, {boxes})", "bbox_list must be .*find_cars returns a picture, find_car_w")
            for boxes in ("d.image", "list(d.image)", "[*d.boxes, *d.image]", "iter(d.image)")
        ),
        ("draw_boxes(d.image, d.image)", "bboxes must be .*find_car_windows returns the boxes"),
        ("draw_boxes(d.image[..., [0, 1, 2, 0]], [])", r"drop the alpha channel with img\[\.\.\., :3\]"),
        ("show_images(d.image)", "each of the images must be an .H, W, 3. RGB array"),
        ("draw_labeled_bboxes(d.image[:, ::-1], d.labels)", "writable and contiguous"),
    ],
)
def test_bad_input_raises_an_error_of_the_library(call_data, models, form, message):
    data = SimpleNamespace(**vars(call_data), options=models["all", "uint8"].options)
    with pytest.raises(InvalidInputError, match=message):
        eval(form, {**NAMES, "np": np, "StandardScaler": StandardScaler, "d": data})


def test_features_of_an_image_with_a_picture_of_the_hog():
    features, picture = lesson.single_img_features(PATCHES[0], "YUV", hog_channel=1, vis=True)
    np.testing.assert_array_equal(features, lesson.single_img_features(PATCHES[0], "YUV", hog_channel=1))
    channel = lesson.convert_color(PATCHES[0], "RGB2YUV")[..., 1]
    np.testing.assert_array_equal(picture, lesson.get_hog_features(channel, 9, 8, 2, vis=True)[1])
    for options, message in (
        ({"hog_channel": "ALL"}, "pass hog_channel=0"),
        ({"hog_feat": False}, "omit vis"),
    ):
        with pytest.raises(InvalidInputError, match=f"vis needs .*; {message}"):
            lesson.single_img_features(PATCHES[0], **options, vis=True)


def test_a_classifier_without_a_scaler(models):
    """As in systems with HOG alone, whose values need no scaling."""
    case = models["hog", "uint8"]
    labels = np.arange(len(case.X)) % 2
    svc = LinearSVC(random_state=0).fit(case.X, labels)
    identity = FunctionTransformer().fit(case.X)
    options = {"color_space": "YUV", "spatial_feat": False, "hist_feat": False, "divide_by": 1}
    found, expected = (
        lesson.find_car_windows(FRAMES["uint8"], 60, 200, 1, svc, scaler, 11, 16, 2, (32, 32), 32, **options)
        for scaler in (None, identity)
    )
    assert found == expected != []
    found, expected = (
        lesson.search_windows(FRAMES["uint8"], PAIRS, svc, scaler, **case.options)
        for scaler in (None, identity)
    )
    assert found == expected
    with pytest.raises(InvalidInputError, match="the classifier was fitted on"):
        lesson.search_windows(FRAMES["uint8"], PAIRS, svc, None)


def test_labels_of_any_kind_and_number():
    class Listing:
        def predict(self, features):
            return [1] * len(features)

    class Constant:
        def predict(self, features):
            return 1

    frame = FRAMES["uint8"]
    windows = lesson.find_car_windows(frame, 0, 80, 1, Listing(), None, 9, 8, 2, (32, 32), 32, divide_by=1)
    assert len(windows) == ((frame.shape[1] // 8 - 1) - 7) // 2
    with pytest.raises(InvalidInputError, match=r"must predict a label for each .*Constant\.predict"):
        lesson.find_car_windows(frame, 0, 80, 1, Constant(), None, 9, 8, 2, (32, 32), 32, divide_by=1)


@pytest.mark.parametrize("options", [{"spatial_size": (16, 32)}, {}])
def test_a_mismatch_warns_whatever_the_scaler_and_the_bins(options):
    options = {"color_space": "RGB", "spatial_size": (16, 16)} | options
    scaler = StandardScaler(with_std="spatial_size" not in options)
    svc, scaler = trained(np.array(lesson.extract_features(PATCHES / 255, **options)), scaler=scaler)
    for model in ((svc, scaler), (make_pipeline(scaler, svc), None)):
        with pytest.warns(UserWarning, match="fitted on values 0-1"):
            lesson.search_windows(FRAMES["uint8"], PAIRS, *model, **options)


def test_a_model_of_the_library_needs_its_own_features():
    model = train_classifier(PATCHES, LABELS, params=FeatureParams(spatial_order="interleaved"))
    band, options = (FRAMES["uint8"], 60, 200, 1), (9, 8, 2, (16, 16), 32)
    _, scaler, svc = to_pipeline(model).named_steps.values()
    boxes = lesson.find_car_windows(*band, model, None, *options, divide_by=1)
    assert boxes == lesson.find_car_windows(*band, svc, scaler, *options, divide_by=1) != []
    with pytest.warns(UserWarning, match="fitted on values 0-255"):
        lesson.find_car_windows(*band, model, None, *options)
    for wrong, space in ((scaler, "YCrCb"), (None, "LUV")):
        with pytest.raises(InvalidInputError, match=r"of its own features; HeatmapDetector\(model\)"):
            lesson.find_car_windows(*band, model, wrong, *options, color_space=space, divide_by=1)
    svc.classes_ = np.array(["notcar", "car"])  # the lesson looks for the label 1, and finds nothing
    with pytest.raises(InvalidInputError, match=r"label 1 for vehicles .* got \['notcar', 'car'\]"):
        lesson.find_car_windows(*band, svc, scaler, *options)


def test_gray_images_have_a_histogram_of_their_own_range():
    gray = np.repeat(PATCHES[0][..., :1], 3, axis=2) / np.float32(255)
    assert lesson.color_hist(lesson.convert_color(gray), bins_range=None).sum() == 3 * 64**2


def test_files_of_both_ranges_warn():
    with pytest.warns(UserWarning, match='0-1 and 0-255, which do not mix.*imread="cv2"'):
        lesson.extract_features([PATCHES[0], PATCHES[1] / 255], hist_range=None)
