import dataclasses
import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GridSearchCV
from sklearn.naive_bayes import GaussianNB
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC

from tests.helpers import failing, random_classifier
from vehicle_detection import FeatureParams, PatchSet, extract_features, write_image
from vehicle_detection._common import FORMAT_VERSION
from vehicle_detection._common.model_file import FORMAT, checksum
from vehicle_detection._kernels import fit_svm
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.svm import KIND, Template, VehicleClassifier, load_classifier
from vehicle_detection.training import TrainingOptions, patch_features, to_pipeline, train_classifier
from vehicle_detection.training.classifier import blur_patches, degrade_patches, mirror_patches

SMALL = FeatureParams(spatial_size=8, hist_bins=8, orient=4, pix_per_cell=16, hog_channel=0)


@pytest.fixture(scope="module")
def patches():
    """40 bright patches with an edge, and 40 dark noisy ones."""
    rng = np.random.default_rng(1)
    bright = rng.integers(120, 250, (40, 64, 64, 3), dtype=np.uint8)
    bright[:, 30:, :] //= 2
    dark = rng.integers(0, 140, (40, 64, 64, 3), dtype=np.uint8)
    return np.concatenate([bright, dark])


@pytest.fixture(scope="module")
def labels():
    return np.repeat([1, 0], 40)


@pytest.fixture(scope="module")
def trained(patches, labels):
    return train_classifier(patches, labels, params=SMALL, metadata={"accuracy": 1.0})


def test_a_trained_classifier_separates_its_patches(trained, patches, labels):
    scores = trained.decision_function(patches)
    assert scores.shape == (80,)
    assert scores.dtype == np.float64
    predicted = trained.predict(patches)
    assert predicted.dtype == np.int64
    np.testing.assert_array_equal(predicted, scores > 0)
    np.testing.assert_array_equal(predicted, labels)
    assert trained.score(patches, labels) == 1.0
    assert trained.score(patches, 1 - labels) == 0.0
    features = extract_features(patches, SMALL)
    np.testing.assert_array_equal(trained.decision_function(features), scores)
    np.testing.assert_allclose(trained.decision_function(list(patches[:3])), scores[:3], rtol=1e-6)
    assert trained.decision_function(features[:0]).shape == (0,)
    template = trained.templates[0]
    expected = ((features - template.mean) / template.scale) @ template.coef + template.intercept
    np.testing.assert_allclose(scores, expected, atol=1e-9)
    for X, y in ((patches, [1]), (patches, np.ones((80, 1))), (patches, 2 * labels - 1), (features[:0], [])):
        with pytest.raises(InvalidInputError, match=r"y must be 0 or 1, .* 80 rows|X must hold"):
            trained.score(X, y)
    training = trained.metadata["training"]
    assert (training["vehicles"], training["non_vehicles"], training["random_state"]) == (40, 40, 0)
    assert {"vehicle_detection", "numpy", "numba"} <= trained.metadata["versions"].keys()
    assert trained.metadata["accuracy"] == 1.0


def test_to_a_pipeline_and_back(trained, patches):
    pipeline = to_pipeline(trained)
    scores = trained.decision_function(patches)
    # The pipeline scales in float32, as the features are.
    np.testing.assert_allclose(pipeline.decision_function(patches), scores, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(pipeline.predict(patches), trained.predict(patches))
    again = VehicleClassifier.from_pipeline(pipeline, SMALL, metadata=trained.metadata)
    np.testing.assert_array_equal(again.decision_function(patches), scores)
    assert (again.params, again.metadata) == (trained.params, trained.metadata)


def test_gains_multiply_the_scaled_features(patches, labels):
    params = dataclasses.replace(SMALL, coarse_hog=True, cell_per_block=1, hist_sqrt=True)
    gained = dataclasses.replace(params, hist_gain=3.0, coarse_gain=0.5)
    trained = train_classifier(patches, labels, params=gained, options=TrainingOptions(mirror=False, C=0.01))
    plain = train_classifier(patches, labels, params=params, options=TrainingOptions(mirror=False, C=0.01))
    features = extract_features(patches, params)
    np.testing.assert_array_equal(extract_features(patches, gained), features)
    scaled = StandardScaler().fit_transform(features.astype(float)) * gained.gains
    svm = LinearSVC(C=0.01, random_state=0, max_iter=20_000).fit(scaled, labels)
    np.testing.assert_allclose(trained.decision_function(patches), svm.decision_function(scaled), atol=1e-3)
    np.testing.assert_allclose(trained.templates[0].scale, plain.templates[0].scale / gained.gains)
    assert np.abs(trained.decision_function(patches) - plain.decision_function(patches)).max() > 0.01


def test_gamma_changes_the_brightness_of_mirrored_patches(patches, labels):
    plain = mirror_patches(patches)
    np.testing.assert_array_equal(plain, patches[:, :, ::-1])
    varied = mirror_patches(patches, gamma=0.4)
    ratios = varied.mean(axis=(1, 2, 3)) / plain.mean(axis=(1, 2, 3))
    assert (ratios < 0.95).any()
    assert (ratios > 1.05).any()
    # The exponent of a patch does not depend on the other patches.
    np.testing.assert_array_equal(mirror_patches(patches[::-3], gamma=0.4), varied[::-3])
    # The change is monotonic, and black and white stay.
    order = np.argsort(plain[0].ravel(), kind="stable")
    assert (np.diff(varied[0].ravel()[order].astype(int)) >= 0).all()
    extremes = np.concatenate([np.zeros_like(patches[:1]), np.full_like(patches[:1], 255)])
    np.testing.assert_array_equal(mirror_patches(extremes, gamma=1.0), extremes)
    both = np.concatenate([patches, varied])
    expected = train_classifier(both, np.tile(labels, 2), params=SMALL, options=TrainingOptions(mirror=False))
    found = train_classifier(patches, labels, params=SMALL, options=TrainingOptions(gamma=0.4))
    np.testing.assert_array_equal(found.templates[0].coef, expected.templates[0].coef)
    assert found.metadata["training"]["gamma"] == 0.4


def test_degraded_copies_have_their_weight(patches, labels):
    features = patch_features(patches, SMALL, TrainingOptions(gamma=0.4, degraded=0.2))
    copies = (patches, mirror_patches(patches, gamma=0.4), blur_patches(patches), degrade_patches(patches))
    np.testing.assert_array_equal(features, np.concatenate([extract_features(c, SMALL) for c in copies]))
    assert TrainingOptions(degraded=0.2).copy_weights == (1, 1, 0.2, 0.2)
    assert TrainingOptions(mirror=False, degraded=0.2).copy_weights == (1, 0.2, 0.2)
    assert TrainingOptions(mirror=False).copy_weights == (1,)
    found = train_classifier(patches, labels, params=SMALL, options=TrainingOptions(gamma=0.4, degraded=0.2))
    fitted = fit_svm(features, np.tile(labels, 4), 1e-4 * np.repeat([1, 1, 0.2, 0.2], 80), gains=SMALL.gains)
    np.testing.assert_array_equal(found.templates[0].coef, fitted.coef)
    training = found.metadata["training"]
    assert (training["degraded"], training["vehicles"], training["non_vehicles"]) == (0.2, 40, 40)


@pytest.mark.parametrize("options", [{}, {"gamma": 0.4, "degraded": 0.2}], ids=str)
def test_any_linear_estimator(patches, labels, options):
    estimator = LogisticRegression(C=1e-3)
    training = TrainingOptions(**options)
    found = train_classifier(patches, labels, params=SMALL, estimator=estimator, options=training)
    features = patch_features(patches, SMALL, training)
    scaled = StandardScaler().fit_transform(features)
    copies = len(training.copy_weights)
    weights = np.repeat(training.copy_weights, len(patches))
    fitted = LogisticRegression(C=1e-3).fit(scaled, np.tile(labels, copies), weights)
    np.testing.assert_allclose(
        found.decision_function(features), fitted.decision_function(scaled), rtol=1e-4, atol=1e-4
    )
    assert not hasattr(estimator, "coef_")
    assert found.metadata["training"]["estimator"] == "LogisticRegression(C=0.001)"
    grid = GridSearchCV(LinearSVC(random_state=0), {"C": [1e-2]}, cv=2)
    found = train_classifier(patches, labels, params=SMALL, estimator=grid)
    expected = train_classifier(patches, labels, params=SMALL, options=TrainingOptions(C=1e-2))
    scores = (each.decision_function(patches) for each in (found, expected))
    np.testing.assert_allclose(*scores, rtol=1e-3, atol=1e-3)


def test_estimators_that_cannot_be_used(patches, labels):
    def train(estimator, **options):
        training = TrainingOptions(**options)
        train_classifier(patches, labels, params=SMALL, estimator=estimator, options=training)

    with pytest.raises(InvalidInputError, match=r"estimator must be a linear .* such as LinearSVC"):
        train(GaussianNB())
    with pytest.raises(InvalidInputError, match=r"estimator must be a scikit-learn classifier .*type"):
        train(LinearSVC)
    with pytest.raises(InvalidInputError, match="estimator must be a scikit-learn classifier without its"):
        train(make_pipeline(StandardScaler(), LinearSVC()))
    with pytest.raises(InvalidInputError, match=r"must be a scikit-learn classifier .*, got 'svm'"):
        train("svm")
    with pytest.raises(InvalidInputError, match=r"must accept sample_weight .*; LinearDis.* does not"):
        train(LinearDiscriminantAnalysis(), degraded=0.1)


def test_the_forms_of_training_patches(patches, labels, tmp_path):
    some = np.r_[0:6, 40:46]
    patches, labels = patches[some], labels[some]
    files = [tmp_path / f"{index}.png" for index in range(len(patches))]
    for file, patch in zip(files, patches):
        write_image(file, patch)
    expected = train_classifier(patches, labels, params=SMALL).templates[0].coef
    names = [f"vehicles/drawn/{index}.png" for index in range(len(patches))]
    forms = (
        (PatchSet(patches, labels, names),),
        ((patches[:6], patches[6:]),),
        ((list(patches[:6]), [str(file) for file in files[6:]]),),
        ([PatchSet(patches[:6], labels[:6], names[:6]), files[6:]],),
        (files, labels),
        (PatchSet(patches, labels, names), labels.tolist()),
    )
    for form in forms:
        np.testing.assert_array_equal(train_classifier(*form, params=SMALL).templates[0].coef, expected)
    with pytest.raises(InvalidInputError, match="labels must hold both classes"):
        train_classifier((patches, []), params=SMALL)
    with pytest.raises(InvalidInputError, match="cars must be patches or a list of paths, got 'vehicles'"):
        train_classifier(("vehicles", "non-vehicles"), params=SMALL)


def test_the_same_seed_gives_the_same_model(trained, patches, labels, tmp_path):
    before = patches.copy()
    again = train_classifier(patches, labels, params=SMALL, metadata={"accuracy": 1.0}, jobs=1)
    np.testing.assert_array_equal(patches, before)
    trained.save(tmp_path / "a.safetensors")
    again.save(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.ones(80), r"labels must hold both classes: vehicles \(1\) and non-vehicles \(0\)"),
        (np.repeat([1, np.nan], 40), "labels must be 0 or 1, or booleans, for each of the 80 patches"),
        (np.repeat([1, -1], 40), "labels must be .*; convert labels of -1 and 1 with labels > 0"),
        (np.repeat([1, 0], 39), "labels must be .* for each of the 80 patches, got an array of shape"),
        (np.repeat(["car", "road"], 40), "labels must be .* for each of the 80 patches"),
        (None, r"labels must be given, unless patches is a PatchSet or a pair \(cars, notcars\)"),
    ],
)
def test_bad_labels(patches, bad, message):
    with pytest.raises(InvalidInputError, match=message):
        train_classifier(patches, bad, params=SMALL)


def test_gamma_needs_mirrored_patches():
    with pytest.raises(InvalidInputError, match="gamma must be 0 without mirrored patches"):
        TrainingOptions(gamma=0.4, mirror=False)


@pytest.mark.parametrize(
    ("X", "message"),
    [
        (np.zeros((2, 5)), r"X must be \(N, \d+\) features or \(N, 64, 64, 3\) patches, got .*\(2, 5\)"),
        (np.full((1, SMALL.length), np.nan), "X must be finite, got NaN or infinity"),
        (np.zeros((2, 64, 64, 3)), r"X must be an \(N, 64, 64, 3\) uint8 RGB array .*float64"),
    ],
)
def test_bad_rows(trained, X, message):
    with pytest.raises(InvalidInputError, match=message):
        trained.decision_function(X)


def test_several_templates_give_the_maximum_score():
    many = random_classifier(SMALL, 5, templates=3)
    rows = np.random.default_rng(0).normal(
        many.templates[0].mean, many.templates[0].scale, (50, SMALL.length)
    )
    each = [VehicleClassifier(SMALL, (template,)).decision_function(rows) for template in many.templates]
    np.testing.assert_array_equal(many.decision_function(rows), np.max(each, axis=0))
    assert len({int(np.argmax(column)) for column in np.transpose(each)}) > 1
    with pytest.raises(InvalidInputError, match="only a model with one template converts; this has 3"):
        to_pipeline(many)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ((np.zeros(4), np.ones(3), np.ones(4), 0.0), "scale must be a vector of the features' length"),
        ((np.zeros(4), np.ones(4), np.full(4, np.nan), 0.0), "coef must be finite, got NaN or infinity"),
        ((np.zeros(4), -np.ones(4), np.ones(4), 0.0), "scale must be positive"),
        ((np.zeros(4), np.ones(4), np.ones(4), np.inf), "intercept must be a number, finite; got inf"),
        ((np.zeros(4), np.full(4, 1e-300), np.full(4, 1e300), 0.0), "coef must be of the order of scale"),
    ],
)
def test_invalid_templates(columns, message):
    with pytest.raises(InvalidInputError, match=message):
        Template(*columns)


@pytest.mark.parametrize("templates", [1, 3])
@pytest.mark.parametrize("params", [SMALL, FeatureParams.preset("lab-9432")], ids=["small", "lab"])
def test_saving_and_loading_keeps_every_bit(tmp_path, params, templates):
    path = tmp_path / "model.safetensors"
    model = VehicleClassifier(
        params, random_classifier(params, templates=templates).templates, {"a": [1, {"b": None}], "ü": 0.1}
    )
    model.save(path)
    loaded = load_classifier(str(path))
    assert loaded.params == model.params
    assert loaded.metadata == model.metadata
    for one, other in zip(model.templates, loaded.templates, strict=True):
        for name in ("mean", "scale", "coef"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
        assert one.intercept == other.intercept
    first = path.read_bytes()
    loaded.save(path)
    assert path.read_bytes() == first


def write_model(path, tensors=None, **changes):
    """Write a model file as `save` does, but with whatever tensors and header; the checksum fits."""
    model = random_classifier(SMALL)
    whole = {f"0.{name}": getattr(model.templates[0], name) for name in ("mean", "scale", "coef")}
    whole |= {"0.intercept": np.zeros(1), **(tensors or {})}
    whole = {name: np.array(tensor) for name, tensor in whole.items() if tensor is not None}
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": KIND,
        "params": json.dumps(dataclasses.asdict(SMALL)),
        "metadata": "{}",
        **changes,
    }
    header = {name: text for name, text in header.items() if text is not None}
    header.setdefault("sha256", checksum(header, whole))
    path.write_bytes(save(whole, metadata=header))
    return path


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({"0.coef": np.full(SMALL.length, np.nan)}, "coef must be finite"),
        ({"0.scale": np.zeros(SMALL.length)}, "scale must be positive"),
        ({"0.coef": np.ones(5)}, "coef must be a vector of the features' length"),
        ({"0.intercept": np.zeros(2)}, "cannot reshape"),
        ({f"0.{name}": np.ones(5) for name in ("mean", "scale", "coef")}, "must have .* weights, .*, got 5"),
        ({"0.mean": None}, "'0.mean'"),
        ({"extra": np.zeros(3)}, "'1.mean'"),
        (dict.fromkeys(("0.mean", "0.scale", "0.coef", "0.intercept")), "at least one template"),
    ],
)
def test_invalid_tensors(tmp_path, tensors, message):
    path = write_model(tmp_path / "m.safetensors", tensors)
    with pytest.raises(ModelFileError, match=rf"model file .* does not fit its own parameters: .*{message}"):
        load_classifier(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "other"}, "is a safetensors file, but not a model of this library"),
        ({"format_version": "99"}, f"has format version 99, this release reads {FORMAT_VERSION}; train"),
        ({"sha256": "0" * 64}, r"was changed after writing \(checksum differs\)"),
        ({"params": '{"orient": 0}'}, "does not fit its own parameters: orient must be an integer"),
        ({"params": '{"color": 1}'}, "does not fit its own parameters"),
        ({"params": "{"}, r"has no readable parameters \(.*\); download it again"),
        ({"params": None}, r"has no readable parameters \('params'\)"),
        ({"metadata": None}, r"has no readable parameters \('metadata'\)"),
        ({"kind": "other"}, "is a model of kind 'other', not 'patches'; train one"),
        ({"params": '{"spatial_size": 16}'}, "does not fit its own parameters: templates must have 6156"),
    ],
)
def test_invalid_headers(tmp_path, changes, message):
    path = write_model(tmp_path / "m.safetensors", **changes)
    with pytest.raises(ModelFileError, match=message):
        load_classifier(path)


def damaged_files(data):
    """Yield the contents of damaged model files: cut, continued, changed, or of another kind."""
    header = struct.unpack("<Q", data[:8])[0]
    spaces = re.search(rb" *$", data[: 8 + header]).start()  # the header is filled up with spaces
    yield from (data[:size] for size in (0, 4, 8, 100, len(data) // 2, len(data) - 1))
    yield from (data + b"x", b"PK\x03\x04 zip", b"\xff" * 100, bytes(64), save({"a": np.zeros(3)}))
    for place in (*range(0, spaces, 7), 8 + header, (8 + header + len(data)) // 2, len(data) - 1):
        changed = bytearray(data)
        changed[place] ^= 1
        yield bytes(changed)
    kind = {"dtype": "BF16", "shape": [1], "data_offsets": [0, 2]}  # which NumPy lacks
    text = json.dumps({"__metadata__": {"format": FORMAT}, "a": kind}).encode()
    yield struct.pack("<Q", len(text)) + text + bytes(2)


def test_damaged_files_are_rejected(tmp_path):
    path = write_model(tmp_path / "m.safetensors")
    assert load_classifier(path).params == SMALL
    messages = []
    for content in damaged_files(path.read_bytes()):
        path.write_bytes(content)
        with pytest.raises(ModelFileError, match=r"model file .*m\.safetensors") as error:
            load_classifier(path)
        messages.append(str(error.value))
    for message in messages[:11]:
        assert re.search("is not a complete safetensors file .* download it again or train", message), message
    assert all("was changed after writing" in message for message in messages[-4:-1])


@pytest.mark.parametrize(("name", "content"), [("svc.p", b""), ("svc", b"\x80\x04\x95"), ("a.JOBLIB", b"x")])
def test_a_pickle_is_not_opened(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ModelFileError, match=r"looks like a pickle.* to VehicleClassifier\.from_pipeline"):
        load_classifier(path)


def test_a_missing_model_file(tmp_path, monkeypatch):
    with pytest.raises(ModelFileError, match=r"model file .*nothing does not exist; check the path"):
        load_classifier(tmp_path / "nothing")
    with pytest.raises(ModelFileError, match=r"model file .* is a folder; choose a file in it"):
        load_classifier(tmp_path)
    (tmp_path / "locked").touch()
    monkeypatch.setattr(Path, "open", failing(PermissionError(13, "Permission denied")))
    with pytest.raises(ModelFileError, match=r"model file .* cannot be read: Permission denied"):
        load_classifier(tmp_path / "locked")


def test_the_shipped_model_is_valid():
    model = load_classifier()
    assert all(template.coef.any() for template in model.templates)
    gray = np.full((1, 64, 64, 3), 100, np.uint8)
    assert model.predict(gray).tolist() == [0]
    assert {"training", "versions"} <= model.metadata.keys()
