import dataclasses
import warnings

import cv2
import numpy as np
import pytest
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression, RidgeClassifier, SGDClassifier
from sklearn.model_selection import GridSearchCV
from sklearn.naive_bayes import GaussianNB
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MaxAbsScaler, MinMaxScaler, RobustScaler, StandardScaler
from sklearn.svm import SVC, LinearSVC

from vehicle_detection import InvalidInputError, VehicleClassifier, course, render_patches
from vehicle_detection.features import FeatureParams, extract_features
from vehicle_detection.search import PixelBand
from vehicle_detection.training import PatchFeatures

SMALL = FeatureParams(spatial_size=8, hist_bins=8, orient=4, pix_per_cell=16, hog_channel=0)


@pytest.fixture(scope="module")
def patches():
    return render_patches(80, random_state=1)[0]


@pytest.fixture(scope="module")
def labels():
    return render_patches(80, random_state=1)[1]


def published_features(patches, size=8):
    """Features of patches with the spatial bins in the order of ``cv2.resize(image, size).ravel()``."""
    params = dataclasses.replace(SMALL, spatial_feat=False)
    converted = [cv2.cvtColor(patch, cv2.COLOR_RGB2YCrCb) for patch in patches]
    spatial = np.array([cv2.resize(image, (size, size)).ravel() for image in converted])
    return np.hstack([spatial, extract_features(patches, params)])


def test_a_published_model_with_interleaved_spatial_bins(patches, labels):
    rows = published_features(patches)
    pipeline = make_pipeline(StandardScaler(), LinearSVC(C=1e-3, random_state=0)).fit(rows, labels)
    params = dataclasses.replace(SMALL, spatial_order="interleaved")
    classifier = VehicleClassifier.from_pipeline(pipeline, params)
    expected = pipeline.decision_function(rows)
    np.testing.assert_allclose(classifier.decision_function(patches), expected, rtol=1e-4, atol=1e-4)
    # The shared search computes the same score for a frame of one window.
    scores = classifier.open_search().score_map(patches[0], PixelBand(0, 0, 64, 64, (64, 64), (16, 16)))
    assert scores[0, 0] == pytest.approx(expected[0], abs=1e-4)
    wrong = VehicleClassifier.from_pipeline(pipeline, SMALL)
    assert np.abs(wrong.decision_function(patches) - expected).max() > 0.1


LINEAR_CLASSIFIERS = [
    LinearSVC(C=1e-3, random_state=0),
    SGDClassifier(alpha=1.0, random_state=0),
    LogisticRegression(C=1e-3),
    SVC(kernel="linear", C=1e-3),
    RidgeClassifier(alpha=1000.0),
    LinearDiscriminantAnalysis(solver="lsqr", shrinkage=0.5),
]


@pytest.mark.parametrize("scaler", [StandardScaler(), RobustScaler(), MinMaxScaler((-1, 1)), MaxAbsScaler()])
@pytest.mark.parametrize("classifier", LINEAR_CLASSIFIERS, ids=lambda each: type(each).__name__)
def test_any_scaler_and_linear_classifier(patches, labels, scaler, classifier):
    rows = extract_features(patches, SMALL)
    pipeline = make_pipeline(scaler, classifier).fit(rows, 2 * labels - 1)
    expected = pipeline.decision_function(rows)
    tolerance = 1e-4 * np.abs(expected).max()
    for model in (pipeline, (classifier, scaler), [scaler, classifier]):
        converted = VehicleClassifier.from_pipeline(model, SMALL)
        np.testing.assert_allclose(converted.decision_function(rows), expected, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(converted.predict(patches), pipeline.predict(rows) > 0)


def test_a_grid_search_over_the_features(patches, labels):
    steps = (PatchFeatures(**dataclasses.asdict(SMALL), jobs=1), StandardScaler(), LinearSVC(C=1e-3))
    grid = {"patchfeatures__orient": [5], "patchfeatures__spatial_order": ["interleaved"]}
    search = GridSearchCV(make_pipeline(*steps), grid, cv=2).fit(patches, labels)
    classifier = VehicleClassifier.from_pipeline(search)
    assert classifier.params == dataclasses.replace(SMALL, orient=5, spatial_order="interleaved")
    expected = search.decision_function(patches)
    np.testing.assert_allclose(classifier.decision_function(patches), expected, rtol=1e-4, atol=1e-4)
    gained = dataclasses.replace(classifier.params, hist_gain=2)
    assert VehicleClassifier.from_pipeline(search, gained).params == gained
    with pytest.raises(InvalidInputError, match="params must equal those of the pipeline"):
        VehicleClassifier.from_pipeline(search, SMALL)


class StandardScale(StandardScaler):
    """Scales like no scaler that the conversion knows."""


class Squared(LinearSVC):
    """Looks linear and is not."""

    def decision_function(self, X):
        return super().decision_function(X) ** 2


def test_pipelines_that_cannot_be_converted(patches, labels):
    rows = extract_features(patches, SMALL)

    def fit(*steps, rows=rows, labels=labels):
        return make_pipeline(*steps).fit(rows, labels)

    scaler = StandardScaler()
    many, names = np.arange(80) % 3, np.repeat(["car", "road"], 40)
    for pipeline, message in (
        (make_pipeline(LinearSVC()), "pipeline must be fitted; its LinearSVC is not"),
        (make_pipeline(StandardScaler(), LinearSVC()), "pipeline must be fitted; its StandardScaler is not"),
        (GridSearchCV(LinearSVC(), {"C": [1]}), "with refit=True; its GridSearchCV is not"),
        ([], "must end in a linear classifier; got no step"),
        (3, "must end in a linear classifier; got 3"),
        (fit(scaler, GaussianNB()), "such as LinearSVC; got GaussianNB"),
        (fit(StandardScale(), LinearSVC(C=1e-3)), "before the classifier; got StandardScale,"),
        (fit(PCA(4), LinearSVC()), "before the classifier; got PCA"),
        (fit(MinMaxScaler(clip=True), LinearSVC()), r"train with MinMaxScaler\(clip=False\)"),
        (fit(scaler, Squared()), "weighted sum of the features; StandardScaler and Squared"),
        (fit(scaler, LinearSVC(C=1e-5), labels=many), "0 or -1 for others and 1 for vehicles, got .*2"),
        (fit(scaler, LinearSVC(), labels=names), "must be fitted on the labels 0 or -1"),
        (fit(StandardScaler(), LinearSVC(), rows=rows[:, :5]), "features .*; its StandardScaler .* 5"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            VehicleClassifier.from_pipeline(pipeline, SMALL)
    with pytest.raises(InvalidInputError, match=r"must be the FeatureParams of .*, got None"):
        VehicleClassifier.from_pipeline(fit(StandardScaler(), LinearSVC()))


@pytest.mark.parametrize("scaler", [StandardScaler, RobustScaler, MinMaxScaler, MaxAbsScaler])
@pytest.mark.parametrize("color_space", ["RGB", "YUV", "YCrCb", "HSV", "HLS", "LUV", "LAB"])
def test_a_model_of_images_with_values_0_to_1_is_rejected(patches, labels, color_space, scaler):
    """The course reads PNG files as such images; the scores of uint8 images would be useless."""
    params = dataclasses.replace(SMALL, color_space=color_space, hist_feat=False, spatial_order="interleaved")
    options = {"color_space": color_space, "hist_feat": False, "spatial_size": (params.spatial_size,) * 2}
    options |= {"orient": 4, "pix_per_cell": 16, "hog_channel": 0}
    for images, is_float in ((patches, False), (patches.astype(np.float32) / 255, True)):
        features = np.stack(course.extract_features(images, **options))
        fitted = scaler().fit(features)
        model = LinearSVC(C=1e-3).fit(fitted.transform(features), labels), fitted
        if is_float and scaler is MaxAbsScaler and color_space in ("LUV", "LAB"):
            continue  # it subtracts nothing, so that its scales do not show the range
        if is_float:
            with pytest.raises(InvalidInputError, match=r"fitted on values 0-1.*read_image"):
                VehicleClassifier.from_pipeline(model, params)
        else:
            assert VehicleClassifier.from_pipeline(model, params).score(patches, labels) > 0.9


@pytest.mark.parametrize("scaler", [StandardScaler(), RobustScaler(), MinMaxScaler(), MaxAbsScaler()])
def test_estimators_of_old_versions_lack_the_number_of_features(patches, labels, scaler):
    """``n_features_in_`` was added in scikit-learn 0.24."""
    rows = extract_features(patches, SMALL)
    scaler = scaler.fit(rows)
    svc = LinearSVC(C=0.01, random_state=0).fit(scaler.transform(rows), labels)
    expected = VehicleClassifier.from_pipeline((svc, scaler), SMALL).decision_function(patches)
    for estimator in (scaler, svc):
        del estimator.n_features_in_
    found = VehicleClassifier.from_pipeline((svc, scaler), SMALL).decision_function(patches)
    np.testing.assert_array_equal(found, expected)
    with pytest.raises(InvalidInputError, match=f"its {type(scaler).__name__} was fitted on"):
        VehicleClassifier.from_pipeline((svc, scaler), dataclasses.replace(SMALL, orient=5))


@pytest.mark.parametrize("color_space", ["RGB", "YCrCb", "HSV", "HLS"])
def test_a_model_whose_histograms_have_one_bin_is_rejected(patches, labels, color_space):
    params = FeatureParams(color_space=color_space, spatial_feat=False)
    options = {"color_space": color_space, "hog_channel": "ALL", "spatial_feat": False}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the colors that are lost
        features = np.stack(course.extract_features(patches.astype(np.float32) / 255, **options))
    scaler = StandardScaler().fit(features)
    model = LinearSVC(C=1e-3).fit(scaler.transform(features), labels), scaler
    with pytest.raises(InvalidInputError, match="fitted on values 0-1"):
        VehicleClassifier.from_pipeline(model, params)
