import os
import signal
import threading
import time
from collections import defaultdict

import cv2
import numpy as np
import pytest

from vehicle_detection._common import (
    JOBS_VARIABLE,
    ThreadTeam,
    available_cores,
    call_in_thread,
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


def test_the_argument_overrides_the_environment_variable_which_overrides_all_cores(monkeypatch):
    monkeypatch.delenv(JOBS_VARIABLE, raising=False)
    assert resolve_jobs() == available_cores() >= 1
    monkeypatch.setenv(JOBS_VARIABLE, "")
    assert resolve_jobs(None) == available_cores()
    monkeypatch.setenv(JOBS_VARIABLE, "7")
    assert resolve_jobs() == 7
    assert resolve_jobs(np.int64(3)) == 3


@pytest.mark.parametrize("text", ["1025", "9" * 5000, "0", "-1", "two", "1.5", " 2", "²", "1e3"])
def test_an_invalid_environment_variable(monkeypatch, text):
    monkeypatch.setenv(JOBS_VARIABLE, text)
    with pytest.raises(InvalidInputError, match=f"^{JOBS_VARIABLE} must be .* from 1 to 1024, got"):
        resolve_jobs()


@pytest.mark.parametrize("jobs", [0, -1, 1025, 2.0, "2", True])
def test_an_invalid_number_of_threads(jobs):
    with pytest.raises(InvalidInputError, match=r"^jobs must be an integer from 1 to 1024; got"):
        resolve_jobs(jobs)


@pytest.mark.usefixtures("three_threads")
def test_opencv_has_one_thread_inside_nested_contexts_and_its_own_after_an_error():
    def nest():
        with single_threaded_opencv():
            with single_threaded_opencv():
                assert cv2.getNumThreads() == 1
            assert cv2.getNumThreads() == 1
            raise KeyError("oops")

    with pytest.raises(KeyError, match="oops"):
        nest()
    assert cv2.getNumThreads() == 3


@pytest.mark.usefixtures("three_threads")
def test_opencv_has_one_thread_until_the_last_thread_leaves():
    inside, leave = threading.Event(), threading.Event()

    def other():
        with single_threaded_opencv():
            inside.set()
            leave.wait(60)

    thread = threading.Thread(target=other)
    with single_threaded_opencv():
        thread.start()
        assert inside.wait(60)
    # The first thread has left the context; the other one has not.
    inside_count = cv2.getNumThreads()
    leave.set()
    thread.join()
    assert inside_count == 1
    assert cv2.getNumThreads() == 3


# --- thread team ---


@pytest.mark.parametrize("jobs", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 2, 17])
def test_a_team_returns_results_in_the_order_of_the_items(jobs, count):
    with ThreadTeam(jobs, name="team") as team:
        assert team.map(lambda item: item * 10, range(count), cost=float) == [10 * n for n in range(count)]
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("team")]


def test_a_team_processes_expensive_items_first():
    taken = defaultdict(list)  # by thread
    items = [(7 * number) % 50 for number in range(50)]
    with ThreadTeam(2, name="team") as team:
        team.map(lambda item: taken[threading.get_ident()].append(item), items, cost=float)
    assert sum(map(len, taken.values())) == 50
    for each in taken.values():
        assert each == sorted(each, reverse=True)


def test_a_team_uses_all_threads():
    together = threading.Barrier(3)
    with ThreadTeam(3, name="team") as team:
        names = team.map(lambda _: (together.wait(60), threading.current_thread().name)[1], "abc", cost=ord)
    assert len(set(names)) == 3
    assert threading.current_thread().name in names


@pytest.mark.parametrize("failing", [0, 3, 6])
def test_a_team_raises_the_error_of_an_item(failing):
    with ThreadTeam(2, name="team") as team:
        with pytest.raises(ZeroDivisionError, match="division by zero"):
            team.map(lambda item: 1 / (item - failing), range(7), cost=float)
        assert team.map(abs, [-1, -2], cost=float) == [1, 2]


def test_the_second_of_two_callers_has_no_helpers():
    team = ThreadTeam(2, name="team")
    inside = threading.Barrier(2)
    names = {}

    def call(caller):
        def work(item):
            if item == 0:
                inside.wait(60)  # until both callers are here
            return threading.current_thread().name

        # The first item is the most expensive one, so each caller processes its own.
        names[caller] = team.map(work, range(4), cost=lambda item: -item)

    callers = [threading.Thread(target=call, args=(n,), name=f"caller-{n}") for n in range(2)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    team.close()
    assert any(set(names[n]) == {f"caller-{n}"} for n in range(2))


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 64),
        ({"proc/self/cgroup": "0::/\n"}, 64),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "max 100000\n"}, 64),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "150000 100000\n"}, 2),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "nonsense\n"}, 64),
        ({"proc/self/cgroup": "0::/pod/box\n", "sys/fs/cgroup/pod/cpu.max": "300000 100000\n",
          "sys/fs/cgroup/pod/box/cpu.max": "max 100000\n"}, 3),
        ({"proc/self/cgroup": "4:cpu:/\n", "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "50000\n",
          "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n"}, 1),
        ({"proc/self/cgroup": "4:cpu:/\n", "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1\n",
          "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n"}, 64),
    ],
)  # fmt: skip
def test_the_cpu_quota_of_a_container_limits_the_cores(tmp_path, monkeypatch, files, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(64), raising=False)
    for name, text in files.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    assert available_cores(tmp_path) == cores


def test_a_call_in_another_thread_returns_or_raises():
    assert call_in_thread(threading.get_ident) != threading.get_ident()
    with pytest.raises(ZeroDivisionError, match="division by zero"):
        call_in_thread(lambda: 1 / 0)


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="Windows has no timers")
def test_an_interrupted_call_in_another_thread_ends_first():
    def interrupt(number, frame):
        raise KeyboardInterrupt

    ended = []

    def wait():
        signal.setitimer(signal.ITIMER_REAL, 0.05)  # when the main thread waits
        time.sleep(0.2)
        ended.append(True)

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            call_in_thread(wait)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert ended
