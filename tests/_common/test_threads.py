import threading

import cv2
import numpy as np
import pytest

from vehicle_detection._common import (
    JOBS_VARIABLE,
    ThreadTeam,
    available_cores,
    resolve_jobs,
    single_threaded_opencv,
)
from vehicle_detection.errors import InvalidInputError


@pytest.fixture
def three_threads():
    """Make OpenCV start with three threads, on a machine with one core as well."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    yield
    cv2.setNumThreads(before)


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


@pytest.mark.usefixtures("three_threads")
def test_opencv_is_held_and_let_go():
    with single_threaded_opencv():
        assert cv2.getNumThreads() == 1
        with single_threaded_opencv():
            assert cv2.getNumThreads() == 1
        assert cv2.getNumThreads() == 1
    assert cv2.getNumThreads() == 3


@pytest.mark.usefixtures("three_threads")
def test_opencv_is_let_go_after_an_error():
    with pytest.raises(KeyError, match="oops"), single_threaded_opencv():
        raise KeyError("oops")
    assert cv2.getNumThreads() == 3


@pytest.mark.usefixtures("three_threads")
def test_opencv_is_held_until_the_last_thread_leaves():
    inside, leave = threading.Event(), threading.Event()

    def other():
        with single_threaded_opencv():
            inside.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    with single_threaded_opencv():
        thread.start()
        assert inside.wait(10)
    # The first to enter has left; the other is still at work.
    held = cv2.getNumThreads()
    leave.set()
    thread.join()
    assert held == 1
    assert cv2.getNumThreads() == 3


@pytest.mark.usefixtures("three_threads")
def test_opencv_is_restored_after_many_threads_come_and_go():
    def work():
        for _ in range(50):
            with single_threaded_opencv():
                pass

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert cv2.getNumThreads() == 3


# --- sharing work ---


@pytest.mark.parametrize("jobs", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 2, 17])
def test_a_crew_returns_results_in_the_items_order(jobs, count):
    crew = ThreadTeam(jobs, name="crew")
    try:
        assert crew.map(lambda item: item * 10, range(count), cost=float) == [10 * n for n in range(count)]
    finally:
        crew.close()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("crew")]


def test_a_crew_takes_the_costly_items_first():
    taken = []
    ThreadTeam(1, name="crew").map(taken.append, [3, 9, 1, 5], cost=float)
    assert taken == [9, 5, 3, 1]


def test_a_crew_works_on_all_threads():
    together = threading.Barrier(3)
    crew = ThreadTeam(3, name="crew")
    names = crew.map(lambda _: (together.wait(10), threading.current_thread().name)[1], range(3), cost=float)
    crew.close()
    assert len(set(names)) == 3
    assert threading.current_thread().name in names


@pytest.mark.parametrize("failing", [0, 3, 6])
def test_an_error_of_one_item_is_the_crews(failing):
    crew = ThreadTeam(2, name="crew")

    def work(item):
        if item == failing:
            raise ZeroDivisionError(item)
        return item

    with pytest.raises(ZeroDivisionError, match=str(failing)):
        crew.map(work, range(7), cost=float)
    assert crew.map(abs, [-1, -2], cost=float) == [1, 2]
    crew.close()


def test_callers_beside_each_other_work_alone():
    crew = ThreadTeam(2, name="crew")
    inside = threading.Barrier(2)
    names = {}

    def call(caller):
        def work(item):
            if item == 0:
                inside.wait(10)  # both callers are at work
            return threading.current_thread().name

        # The first item is the costly one: whoever came second has no helper.
        names[caller] = crew.map(work, range(4), cost=lambda item: -item)

    callers = [threading.Thread(target=call, args=(n,), name=f"caller-{n}") for n in range(2)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    crew.close()
    assert any(set(names[n]) == {f"caller-{n}"} for n in range(2))
