import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection._kernels.features import add_correlation


def reference(weights, channels, dilation=1):
    """Sum the products window by window, in double precision."""
    rows, columns, _ = weights.shape
    height = channels.shape[1] - (rows - 1) * dilation
    width = channels.shape[2] - (columns - 1) * dilation
    scores = np.zeros((height, width))
    for i, j in np.ndindex(rows, columns):
        top, left = i * dilation, j * dilation
        part = channels[:, top : top + height, left : left + width]
        scores += np.tensordot(weights[i, j].astype(np.float64), part, axes=1)
    return scores


def random_inputs(rows, columns, depth, height, width, seed=0):
    rng = np.random.default_rng(seed)
    shapes = (rows, columns, depth), (depth, height, width)
    return [rng.normal(size=shape).astype(np.float32) for shape in shapes]


@settings(max_examples=60)
@given(
    rows=st.integers(1, 10),
    columns=st.integers(1, 10),
    depth=st.integers(1, 30),
    dilation=st.integers(1, 2),
    more=st.tuples(st.integers(0, 5), st.integers(0, 120)),
    seed=st.integers(0, 99),
)
def test_scores_equal_the_sums_of_products(rows, columns, depth, dilation, more, seed):
    height, width = (rows - 1) * dilation + 1 + more[0], (columns - 1) * dilation + 1 + more[1]
    weights, channels = random_inputs(rows, columns, depth, height, width, seed)
    expected = reference(weights, channels, dilation)
    scores = np.zeros(expected.shape, np.float32)
    add_correlation(channels, weights, dilation, scores)
    np.testing.assert_allclose(scores, expected, rtol=1e-4, atol=1e-4)


def test_products_are_added_to_the_scores_of_the_first_windows():
    weights, channels = random_inputs(3, 3, 5, 9, 50)
    scores = np.full((4, 20), 7, np.float32)
    add_correlation(channels, weights, 1, scores)
    np.testing.assert_allclose(scores, reference(weights, channels)[:4, :20] + 7, rtol=1e-4, atol=1e-4)
