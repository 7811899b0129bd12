import subprocess
import sys

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from vehicle_detection.tracking.association import cheapest_pairs


@given(st.integers(0, 12), st.integers(0, 12), st.floats(0, 1), st.booleans(), st.integers(0, 2**32 - 1))
def test_the_pairs_are_those_of_scipy(rows, columns, density, with_ties, seed):
    rng = np.random.default_rng(seed)
    cost = rng.integers(0, 4, (rows, columns)).astype(float) if with_ties else rng.random((rows, columns)) * 3
    allowed = rng.random((rows, columns)) < density
    pairs = cheapest_pairs(cost, allowed)
    expected = np.transpose(linear_sum_assignment(np.where(allowed, cost, 1e6))).tolist()
    expected = [tuple(pair) for pair in expected if allowed[tuple(pair)]]
    assert all(allowed[pair] for pair in pairs)
    assert pairs == sorted(pairs)
    for axis in range(2):
        assert len({pair[axis] for pair in pairs}) == len(pairs) == len(expected)
    if with_ties:
        assert sum(cost[pair] for pair in pairs) == sum(cost[pair] for pair in expected)
    else:
        assert pairs == expected


def test_the_tracker_does_not_load_scipy_optimize():
    program = (
        "import sys, numpy as np\n"
        "from vehicle_detection.tracking.association import cheapest_pairs\n"
        "assert len(cheapest_pairs(np.eye(3), np.ones((3, 3), bool))) == 3\n"
        "assert 'scipy.optimize' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
