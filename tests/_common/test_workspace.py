from concurrent.futures import ThreadPoolExecutor

import numpy as np

from vehicle_detection._common import NEW_ARRAYS, Workspace


def test_arrays_of_one_name_share_the_memory_of_the_largest():
    workspace = Workspace()
    small = workspace.take((2, 3), np.float32, "a")
    assert workspace.take((2, 3), np.float32, "a") is small
    large = workspace.take((4, 3), np.float32, "a")
    assert (large.shape, large.dtype, large.flags.c_contiguous) == ((4, 3), np.float32, True)
    assert np.shares_memory(workspace.take((2, 3), np.float32, "a"), large)
    for dtype, name in ((np.float32, "b"), (np.int32, "a")):
        assert not np.shares_memory(workspace.take((2, 3), dtype, name), large)
    assert not np.shares_memory(*(NEW_ARRAYS.take((2, 3), np.float32, "a") for _ in range(2)))
    for number in range(5000):
        workspace.take((number % 12, 1), np.float32, str(number))
    assert np.shares_memory(workspace.take((2, 3), np.float32, "a"), large)


def test_threads_do_not_share_arrays():
    workspace = Workspace()
    own = workspace.take((3, 5), np.int32, "a")
    with ThreadPoolExecutor(1) as pool:
        assert not np.shares_memory(own, pool.submit(workspace.take, (3, 5), np.int32, "a").result())
    assert workspace.take((3, 5), np.int32, "a") is own
