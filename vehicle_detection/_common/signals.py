"""Signals whose exception Python would print, and go on."""

from __future__ import annotations

import _thread
import signal
import threading
import time
from types import FrameType

# Modules whose functions are called from C, by the compiler of the kernels and for weak references, and the
# method that finalizes an object.
_CALLBACKS, _FINALIZER = ("llvmlite.binding.executionengine", "weakref"), "__del__"
_REPEAT = 0.02  # seconds


def postpone(number: int, frame: FrameType | None) -> bool:
    """Repeat the signal soon if an exception would be lost in `frame`; False if it would not."""
    while frame is not None:
        if frame.f_code.co_name == _FINALIZER or frame.f_globals.get("__name__") in _CALLBACKS:
            # A thread of `threading` would take locks, which the interrupted code may hold.
            _thread.start_new_thread(_repeat, (number,))
            return True
        frame = frame.f_back
    return False


def _repeat(number: int) -> None:
    time.sleep(_REPEAT)
    if hasattr(signal, "pthread_kill"):  # it also wakes a thread that waits for a lock
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        _thread.interrupt_main(signal.Signals(number))
