import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import cv2
import numpy as np
import pytest
from threadpoolctl import ThreadpoolController

from vehicle_detection._jobs import JOBS_VARIABLE, available_cores, resolve_jobs, single_threaded_libraries
from vehicle_detection.errors import InvalidInputError


def blas_threads():
    np.dot(np.ones((2, 2)), np.ones((2, 2)))
    return {pool["num_threads"] for pool in ThreadpoolController().info() if pool["user_api"] == "blas"}


def set_blas_threads(count):
    """Set the threads of BLAS from a thread that ends, as threadpoolctl lets one live thread decide."""
    limit = partial(ThreadpoolController().limit, limits=count, user_api="blas")
    thread = threading.Thread(target=limit)
    thread.start()
    thread.join()


@pytest.fixture
def two_blas_threads():
    """Make BLAS start with two threads, on a machine with one core as well."""
    before = blas_threads()
    if not before:
        pytest.skip("no BLAS that threadpoolctl knows")
    set_blas_threads(2)
    yield
    set_blas_threads(max(before))


def test_all_cores_by_default(monkeypatch):
    monkeypatch.delenv(JOBS_VARIABLE, raising=False)
    assert resolve_jobs() == available_cores() >= 1
    monkeypatch.setenv(JOBS_VARIABLE, "")
    assert resolve_jobs(None) == available_cores()


def test_the_environment_decides(monkeypatch):
    monkeypatch.setenv(JOBS_VARIABLE, "7")
    assert resolve_jobs() == 7


def test_the_argument_beats_the_environment(monkeypatch):
    monkeypatch.setenv(JOBS_VARIABLE, "7")
    assert resolve_jobs(3) == 3
    assert resolve_jobs(np.int64(3)) == 3


@pytest.mark.parametrize("text", ["0", "-1", "two", "1.5", " 2", "²", "1e3"])
def test_a_bad_environment_is_named(monkeypatch, text):
    monkeypatch.setenv(JOBS_VARIABLE, text)
    with pytest.raises(InvalidInputError, match=f"^{JOBS_VARIABLE} must be a whole number of threads from 1"):
        resolve_jobs()


@pytest.mark.parametrize("n_jobs", [0, -1, 1025, 2.0, "2", True])
def test_a_bad_argument_is_named(n_jobs):
    with pytest.raises(InvalidInputError, match=r"^n_jobs must be an integer from 1 to 1024; got"):
        resolve_jobs(n_jobs)


@pytest.mark.usefixtures("two_blas_threads")
def test_blas_is_held_and_let_go():
    assert blas_threads() == {2}
    with single_threaded_libraries():
        assert blas_threads() == {1}
        with single_threaded_libraries():
            assert blas_threads() == {1}
        assert blas_threads() == {1}
    assert blas_threads() == {2}


def test_opencv_is_held_and_let_go():
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        with single_threaded_libraries():
            assert cv2.getNumThreads() == 1
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


@pytest.mark.usefixtures("two_blas_threads")
def test_blas_is_let_go_after_an_error():
    with pytest.raises(KeyError, match="oops"), single_threaded_libraries():
        raise KeyError("oops")
    assert blas_threads() == {2}


@pytest.mark.usefixtures("two_blas_threads")
def test_blas_is_held_until_the_last_thread_leaves():
    inside, leave = threading.Event(), threading.Event()

    def other():
        with single_threaded_libraries():
            inside.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    with single_threaded_libraries():
        thread.start()
        assert inside.wait(10)
    # The first to enter has left; the other is still at work.
    held = blas_threads()
    leave.set()
    thread.join()
    assert held == {1}
    assert blas_threads() == {2}


@pytest.mark.usefixtures("two_blas_threads")
def test_blas_is_restored_after_many_threads_come_and_go():
    def work():
        for _ in range(50):
            with single_threaded_libraries():
                pass

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert blas_threads() == {2}


@pytest.mark.usefixtures("two_blas_threads")
def test_an_interrupted_hold_does_not_last(monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    keep = single_threaded_libraries._keep
    monkeypatch.setattr(single_threaded_libraries, "_keep", lambda function: (keep(function), interrupt()))
    with pytest.raises(KeyboardInterrupt), single_threaded_libraries():
        pass
    monkeypatch.undo()
    with single_threaded_libraries():
        assert blas_threads() == {1}
    assert blas_threads() == {2}


def test_a_thread_that_outlives_the_main_one_may_still_search():
    # At the interpreter's end no new work is taken by the thread that holds the limit.
    code = (
        "import threading, time\n"
        "from vehicle_detection._jobs import single_threaded_libraries\n"
        "def work():\n"
        "    with single_threaded_libraries():\n"
        "        threading.main_thread().join()\n"
        "        time.sleep(0.2)\n"
        "    print('done')\n"
        "threading.Thread(target=work).start()\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert (run.stdout, run.stderr) == ("done\n", "")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_child_can_hold_blas_too():
    with single_threaded_libraries():
        pass
    child = os.fork()
    if child == 0:  # No test framework in the child: it ends here.
        with single_threaded_libraries():
            os._exit(0 if blas_threads() <= {1} else 1)
    for _ in range(100):
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        time.sleep(0.05)
    else:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        pytest.fail("the child hangs")
    assert status == 0
