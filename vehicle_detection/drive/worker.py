"""The program of a worker process: calls functions that arrive as JSON lines, until its input ends."""

from __future__ import annotations

import _thread
import contextlib
import gc
import importlib
import json
import logging
import os
import queue
import signal
import sys
import threading
from types import FrameType
from typing import Any

from vehicle_detection._common import postpone

# Seconds that the current call has to clean up after the parent process has ended.
_GRACE = 15.0


def main() -> None:
    """Answer each line ``{"call": "module:function", "args": [...]}`` with a line of JSON.

    An answer holds ``"warnings"``, the texts that the call has logged, and ``"result"`` or ``"error"``.
    """
    signal.signal(signal.SIGINT, _interrupt)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever a library prints must not be taken for an answer
    calls: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    idle = threading.Event()
    idle.set()
    with contextlib.suppress(KeyboardInterrupt, BrokenPipeError):  # the parent process is gone
        threading.Thread(target=_receive, args=(calls, idle), daemon=True).start()
        while (line := calls.get()) is not None:
            answer = json.dumps(_call(json.loads(line)))
            idle.set()  # before the answer, after which the next call may arrive at any time
            answers.write(answer + "\n")
            answers.flush()
        # An interrupt that is meant for the last call may come after it.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        return
    # The call's open generators, such as that of a temporary folder, are closed with the error's traceback.
    gc.collect()
    os._exit(1)


def _interrupt(number: int, frame: FrameType | None) -> None:
    if not postpone(number, frame):
        raise KeyboardInterrupt


def _receive(calls: queue.SimpleQueue[str | None], idle: threading.Event) -> None:
    """Queue the calls; interrupt the current one if the parent process is gone."""
    for line in sys.stdin:
        idle.clear()
        calls.put(line)
    calls.put(None)
    if not idle.is_set():
        if hasattr(signal, "pthread_kill"):
            signal.pthread_kill(int(threading.main_thread().ident or 0), signal.SIGINT)
        else:
            _thread.interrupt_main()
        timer = threading.Timer(_GRACE, os._exit, (1,))
        timer.daemon = True
        timer.start()


class _Collector(logging.Handler):
    """Keeps the texts of warnings, which the parent process logs."""

    def __init__(self, texts: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._texts = texts

    def emit(self, record: logging.LogRecord) -> None:
        self._texts.append(record.getMessage())


def _call(message: dict[str, Any]) -> dict[str, Any]:
    module, name = message["call"].split(":")
    warnings: list[str] = []
    logger, collector = logging.getLogger("vehicle_detection"), _Collector(warnings)
    logger.addHandler(collector)
    try:
        function = getattr(importlib.import_module(module), name)
        return {"result": function(*message["args"]), "warnings": warnings}
    except Exception as error:
        return {"error": f"{type(error).__name__}: {error}", "warnings": warnings}
    finally:
        logger.removeHandler(collector)
