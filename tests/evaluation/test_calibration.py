import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import Platt, calibrate_scores, calibration_error


def drawn_scores(a, b, count=4000, seed=0):
    rng = np.random.default_rng(seed)
    scores = rng.normal(0, 2, count)
    return scores, rng.random(count) < 1 / (1 + np.exp(a * scores + b))


@pytest.mark.parametrize(("a", "b"), [(-2.0, 0.5), (-0.1, -1.0), (1.0, 0.0)])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_sigmoid_is_recovered(a, b, scale):
    scores, truth = drawn_scores(a, b)
    platt = calibrate_scores(scores * scale, truth)
    assert platt.a * scale == pytest.approx(a, rel=0.15, abs=0.05)
    assert platt.b == pytest.approx(b, rel=0.15, abs=0.1)
    assert calibration_error(platt.probability(scores * scale), truth) < 0.025


def test_the_sigmoid_equals_that_of_scikit_learn():
    from sklearn.calibration import CalibratedClassifierCV
    from sklearn.frozen import FrozenEstimator
    from sklearn.svm import LinearSVC

    scores, truth = drawn_scores(-1.5, 0.3, count=300)
    svm = LinearSVC().fit(scores[:, None], truth)
    theirs = CalibratedClassifierCV(FrozenEstimator(svm), method="sigmoid").fit(scores[:, None], truth)
    values = svm.decision_function(scores[:, None])
    ours = calibrate_scores(values, truth).probability(values)
    np.testing.assert_allclose(ours, theirs.predict_proba(scores[:, None])[:, 1], atol=1e-3)


def test_without_the_prior_the_sigmoid_is_plain_logistic_regression():
    from sklearn.linear_model import LogisticRegression

    scores, truth = drawn_scores(-1.5, 0.3, count=300)
    plain = LogisticRegression(C=1e6, tol=1e-8).fit(scores[:, None], truth)
    platt = calibrate_scores(scores, truth, prior=False)
    assert (platt.a, platt.b) == pytest.approx((-plain.coef_[0, 0], -plain.intercept_[0]), rel=1e-4)
    assert platt.a == pytest.approx(calibrate_scores(scores, truth).a, rel=0.1)


@pytest.mark.parametrize("prior", [True, False])
def test_a_weight_counts_like_copies_of_a_sample(prior):
    scores, truth = drawn_scores(-1.5, 0.3, count=300)
    copies = np.arange(300) % 3 + 1
    weighted = calibrate_scores(scores, truth, prior=prior, weights=copies)
    repeated = calibrate_scores(np.repeat(scores, copies), np.repeat(truth, copies), prior=prior)
    assert (weighted.a, weighted.b) == pytest.approx((repeated.a, repeated.b), abs=0.05)
    same = calibrate_scores(scores, truth, prior=prior, weights=np.full(300, 0.1))
    unweighted = calibrate_scores(scores, truth, prior=prior)
    assert (same.a, same.b) == pytest.approx((unweighted.a, unweighted.b), rel=1e-4)


@given(
    scores=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=20),
    a=st.floats(-100, -1e-3),
    b=st.floats(-10, 10),
)
def test_probabilities_increase_with_the_score(scores, a, b):
    platt = Platt(a, b)
    probabilities = platt.probability(sorted(scores))
    assert ((probabilities >= 0) & (probabilities <= 1)).all()
    assert (np.diff(probabilities) >= 0).all()


def test_invalid_arguments_of_calibrate_scores():
    for scores, truth, message in (
        ([math.inf, 0], [1, 0], "scores must be finite"),
        ([0.5, 1.0], [1, -1], "convert labels of -1 and 1 with labels > 0"),
        ([0.5, 1.0], [1, 1], "labels must hold both classes"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            calibrate_scores(scores, truth)
    for weights, message in (
        (["1", "2"], "weights must be one number for each of the 2 scores"),
        ([1.0, 0.0], "weights must be positive and finite"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            calibrate_scores([0.5, 1.0], [0, 1], weights=weights)
    with pytest.raises(InvalidInputError, match="scores must be numbers without NaN"):
        Platt(-1.0, 0.0).probability([math.nan])
    for platt, probability in ((Platt(-1.0, 0.0), 1.0), (Platt(0.0, 0.0), 0.5)):
        with pytest.raises(InvalidInputError, match=r"probability must lie in \(0, 1\) and a must not be 0"):
            platt.score(probability)


def test_calibration_error_by_hand():
    # Bin 0 holds 0.1 and 0.3 (mean 0.2, half of them vehicles), bin 1 holds 0.6 and 1.0 (0.8, all vehicles).
    assert calibration_error([0.1, 0.3, 0.6, 1.0], [0, 1, 1, 1], bins=2) == pytest.approx(0.25)
    assert calibration_error([0.0, 1.0], [False, True]) == 0
    assert calibration_error(np.array([0, 1], np.uint8), [0, 1], bins=300) == 0
    assert calibration_error(np.array([0, 1], np.float16), [0, 1], bins=100_000) == 0


@given(
    pairs=st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=20),
    bins=st.integers(1, 20),
)
@example(pairs=[(1.0, False)], bins=15)
def test_calibration_error_lies_between_0_and_1(pairs, bins):
    probabilities, labels = zip(*pairs)
    error = calibration_error(probabilities, labels, bins=bins)
    assert 0 <= error <= 1
    # Finer bins cannot hide what the whole shows.
    assert error >= abs(np.mean(probabilities) - np.mean(labels)) - 1e-9
