from types import SimpleNamespace

import numpy as np
import pytest
from sklearn.naive_bayes import GaussianNB
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.tree import DecisionTreeClassifier

from tests.training.trial_cases import SMALL
from vehicle_detection.datasets import Split, make_split
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import FeatureParams, extract_features
from vehicle_detection.training import FeatureCache, compare_classifiers

PARAMS = FeatureParams(**SMALL)


def test_the_scores_are_those_of_a_scaler_and_the_classifier(patch_set):
    models = {"bayes": GaussianNB(), "tree": DecisionTreeClassifier(random_state=0)}
    table = compare_classifiers(patch_set, models, params=PARAMS, splits="random", seeds=(0, 1))
    assert [*zip(table["classifier"], table["seed"])] == [
        ("bayes", 0),
        ("bayes", 1),
        ("tree", 0),
        ("tree", 1),
    ]
    for row in table.itertuples():
        split = make_split(patch_set, "random", random_state=row.seed)
        X, X_test = (extract_features(patch_set.patches[rows], PARAMS) for rows in split)
        y, y_test = (patch_set.labels[rows].astype(int) for rows in split)
        reference = make_pipeline(StandardScaler(), models[row.classifier]).fit(X, y)
        wrong = reference.predict(X_test) != y_test
        assert row.accuracy == pytest.approx(1 - wrong.mean())
        assert row.false_negative_rate == pytest.approx(wrong[y_test == 1].mean())
        assert row.false_positive_rate == pytest.approx(wrong[y_test == 0].mean())
        assert (row.split, row.train_size, row.test_size) == ("random", len(y), len(y_test))
        assert min(row.fit_seconds, row.predict_seconds) >= 0


def test_naive_bayes_and_a_linear_svm_are_compared_by_default(patch_set, tmp_path):
    first = compare_classifiers(patch_set, params=PARAMS, cache=tmp_path)
    assert first["classifier"].tolist() == ["naive Bayes", "linear SVM"]
    assert first["split"].tolist() == ["sequences"] * 2
    assert len(list(tmp_path.iterdir())) == 1
    again = compare_classifiers(
        patch_set, params=PARAMS, cache=FeatureCache(patch_set.patches, folder=tmp_path)
    )
    assert again["accuracy"].tolist() == first["accuracy"].tolist()


def test_a_test_part_of_one_class_has_one_error_rate(patch_set):
    vehicles, rest = (np.flatnonzero(patch_set.labels == label) for label in (1, 0))
    split = Split(np.concatenate([vehicles[10:], rest]), vehicles[:10])
    table = compare_classifiers(patch_set, {"bayes": GaussianNB()}, params=PARAMS, splits={"own": split})
    assert table["split"].tolist() == ["own"]
    assert table["accuracy"][0] == pytest.approx(1 - table["false_negative_rate"][0])
    assert table["false_positive_rate"].isna().all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"classifiers": {}}, r"classifiers must map names to estimators .* at least one"),
        ({"classifiers": [GaussianNB()]}, r"classifiers must map names to estimators"),
        ({"classifiers": {"bayes": GaussianNB}}, r"classifiers\['bayes'\] must be an estimator .*instance"),
        ({"classifiers": {"own": SimpleNamespace(fit=print, predict=print)}}, r"fit, predict and get_params"),
        ({"params": "luv-2384"}, r"params must be a FeatureParams"),
        ({"splits": "half"}, r"splits must be one of"),
        ({"seeds": 5}, r"seeds must be a list of different integers"),
    ],
)
def test_invalid_arguments(patch_set, arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        compare_classifiers(patch_set, **arguments)
