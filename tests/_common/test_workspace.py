from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from vehicle_detection._common import NEW_ARRAYS, SPARE, Workspace, with_spare
from vehicle_detection._kernels.vector import float_block


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


def test_memory_goes_on_beyond_the_end():
    workspace = Workspace()
    arrays = [workspace.take((3, 5), np.int32, "a"), NEW_ARRAYS.take((3, 5), np.int32, "a")]
    arrays += [arrays[0][:2], with_spare(np.ones((3, 5), np.int32))]
    for array in arrays:
        assert with_spare(array) is array


@pytest.mark.parametrize("missing", [0, 1, SPARE])
def test_an_array_at_the_end_of_its_memory_is_copied(missing):
    memory = np.arange(15 + SPARE, dtype=np.float32)
    array = memory[SPARE - missing : SPARE - missing + 15].reshape(3, 5)
    copied = with_spare(array)
    assert (copied is array) == (missing == SPARE)
    np.testing.assert_array_equal(copied, array)


def test_memory_with_an_unknown_end_is_copied():
    values = np.arange(100, dtype=np.float32)
    # The memory of another object, and views that overlap.
    for array in (np.frombuffer(values.tobytes(), np.float32), sliding_window_view(values, 90)[10:11]):
        copied = with_spare(array)
        assert not np.shares_memory(copied, array)
        np.testing.assert_array_equal(copied, array)


def test_the_spare_memory_is_enough_for_every_processor():
    assert float_block().columns <= SPARE


def test_threads_do_not_share_arrays():
    workspace = Workspace()
    own = workspace.take((3, 5), np.int32, "a")
    with ThreadPoolExecutor(1) as pool:
        assert not np.shares_memory(own, pool.submit(workspace.take, (3, 5), np.int32, "a").result())
    assert workspace.take((3, 5), np.int32, "a") is own
