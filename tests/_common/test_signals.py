"""Interrupts that arrive where Python prints an exception and goes on."""

import _thread
import contextlib
import signal
import sys
import time
import weakref

import pytest

from vehicle_detection.cli.signals import raise_on_signals
from vehicle_detection.drive import worker_pool


@pytest.fixture(autouse=True)
def interruptible():
    """Interrupts are not ignored, as they are if pytest is a background job."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def worker_signals():
    before = signal.signal(signal.SIGINT, worker_pool._interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def interrupt():
    signal.raise_signal(signal.SIGINT)


def wait():
    for _ in range(500):  # the interrupt does not end a call of sleep
        time.sleep(0.02)


class Interrupting:
    def __del__(self):
        interrupt()


def remove_object():
    Interrupting()


def call_finalizer():
    class Plain:
        pass

    weakref.finalize(Plain(), interrupt)


def call_back():
    names = {"__name__": "llvmlite.binding.executionengine", "interrupt": interrupt}
    exec("def call():\n    interrupt()", names)
    names["call"]()


@pytest.mark.parametrize("handlers", [worker_signals, raise_on_signals])
@pytest.mark.parametrize("arrive", [remove_object, call_finalizer, call_back])
def test_an_interrupt_that_would_be_lost_is_repeated(handlers, arrive):
    with handlers():
        arrive()
        with pytest.raises(KeyboardInterrupt):
            wait()


@pytest.mark.skipif(sys.platform == "win32", reason="its repeated signal wakes no thread")
def test_a_repeated_interrupt_wakes_a_thread_that_waits_for_a_lock():
    lock = _thread.allocate_lock()
    lock.acquire()
    with raise_on_signals():
        remove_object()
        began = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            lock.acquire(timeout=20)
        assert time.monotonic() - began < 10


@pytest.mark.parametrize("handlers", [worker_signals, raise_on_signals])
def test_any_other_interrupt_acts_at_once(handlers):
    with handlers(), pytest.raises(KeyboardInterrupt):
        interrupt()
