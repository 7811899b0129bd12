import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC

from vehicle_detection._kernels import fit_svm


def overlapping_clouds(count=120, length=30, seed=0):
    """Two overlapping classes; columns have very different means and scales, and the last one is constant."""
    rng = np.random.default_rng(seed)
    labels = np.arange(count) % 2
    features = rng.normal(0, 1, (count, length)) + 0.4 * labels[:, None]
    features = features * rng.uniform(0.01, 50, length) + rng.uniform(-100, 100, length)
    features[:, -1] = 7.1
    return features.astype(np.float32), labels


def scores_of(fitted, features):
    return (features - fitted.mean) / fitted.scale @ fitted.coef + fitted.intercept


@settings(max_examples=15)
@given(st.integers(0, 1000), st.sampled_from([1e-3, 0.01, 0.1]))
def test_the_optimum_equals_that_of_scikit_learn(seed, C):
    features, labels = overlapping_clouds(seed=seed)
    weights = np.where(np.arange(len(labels)) % 3, 1.0, 0.2)
    gains = np.linspace(0.5, 2, features.shape[1])
    scaler = StandardScaler().fit(features.astype(np.float64))
    scaled = scaler.transform(features.astype(np.float64)) * gains
    svm = LinearSVC(C=C, tol=1e-8, max_iter=100_000).fit(scaled, labels, sample_weight=weights)
    fitted = fit_svm(features, labels, C * weights, gains=gains)
    np.testing.assert_allclose(fitted.mean, scaler.mean_, rtol=1e-6)
    np.testing.assert_allclose(fitted.scale, scaler.scale_ / gains, rtol=1e-4)
    # This is the tolerance of the solver; float32 is more accurate.
    np.testing.assert_allclose(scores_of(fitted, features), svm.decision_function(scaled), atol=5e-3)


def test_a_solution_that_has_not_converged_is_reported(caplog):
    features, labels = overlapping_clouds()
    fit_svm(features, labels, np.full(len(labels), 0.1))
    assert caplog.text == ""
    fit_svm(features, labels, np.full(len(labels), 1e4))
    assert "has not converged after 300 sweeps; use a smaller C" in caplog.text


def test_other_rows_have_no_effect():
    features, labels = overlapping_clouds()
    rows = np.flatnonzero(np.arange(len(labels)) % 5)
    costs = np.full(len(labels), 0.01)
    before = features.copy()
    some = fit_svm(features, labels, costs, rows=rows, random_state=3)
    alone = fit_svm(features[rows], labels[rows], costs[rows], random_state=3)
    for found, expected in zip(some, alone):
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(features, before)


def test_the_seed_changes_only_the_last_digits():
    features, labels = overlapping_clouds()
    costs = np.full(len(labels), 0.01)
    first, again, other = (fit_svm(features, labels, costs, random_state=seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.coef, again.coef)
    np.testing.assert_allclose(scores_of(first, features), scores_of(other, features), atol=5e-3)
    assert first.scale[-1] == 1.0
    assert first.coef[-1] == pytest.approx(0, abs=1e-6)


def test_compiled_and_cached_kernels_give_the_same_result(tmp_path):
    code = (
        "import sys; import numpy as np; results = set()\n"
        "for _ in range(2):\n"
        "    from vehicle_detection._kernels.linear_svm import fit_svm\n"
        "    features = np.random.default_rng(0).normal(size=(90, 300)).astype(np.float32)\n"
        "    results.add(fit_svm(features, np.arange(90) % 2, np.full(90, 0.01)).coef.tobytes())\n"
        "    del sys.modules['vehicle_detection._kernels.linear_svm']\n"
        "print(len(results))"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    assert subprocess.check_output([sys.executable, "-c", code], env=environment).strip() == b"1"
