import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection._kernels import matmul


@given(
    rows=st.integers(0, 7), depth=st.integers(1, 11), columns=st.integers(1, 1100), seed=st.integers(0, 999)
)
def test_products_equal_those_of_numpy(rows, depth, columns, seed):
    rng = np.random.default_rng(seed)
    left = rng.normal(0, 1, (rows, depth)).astype(np.float32)
    right = rng.normal(0, 1, (depth, columns)).astype(np.float32)
    found = matmul(left, right)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, left.astype(np.float64) @ right, atol=1e-4)


def test_few_and_many_rows_give_the_same_products():
    rng = np.random.default_rng(0)
    left = rng.normal(0, 1, (300, 20)).astype(np.float32)
    right = rng.normal(0, 1, (20, 600)).astype(np.float32)
    few = np.concatenate([matmul(part, right) for part in np.array_split(left, 5)])
    np.testing.assert_allclose(matmul(left, right), few, atol=1e-4)
