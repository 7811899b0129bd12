"""An executor of worker processes, one call at a time each, that survives the death of a worker.

With ``ProcessPoolExecutor``, one killed process breaks the pool.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import stat
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

from vehicle_detection._common import JOBS_VARIABLE

_LOGGER = logging.getLogger(__name__)

# The program of a worker. Its argument is the folder that holds this package, which may not be installed.
# With -P, Python does not search the current folder, where a file may have the name of a module.
_PROGRAM = """\
import sys
if sys.argv[1] not in sys.path:
    sys.path.insert(0, sys.argv[1])
from vehicle_detection.drive.worker import main
main()
"""


class WorkerLost(Exception):  # noqa: N818 - named after what happened, as BrokenExecutor is
    """The process of a call has ended before its result."""


def worker_environment() -> dict[str, str]:
    """Environment of a worker: one thread, and a kernel cache on a local disk.

    A cache on shared storage is corrupted by processes of several machines.
    """
    threads = dict.fromkeys((JOBS_VARIABLE, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    cache = os.environ.get("NUMBA_CACHE_DIR") or _private_folder("vehicle-detection-kernels")
    return threads | ({"NUMBA_CACHE_DIR": cache} if cache else {})


def _private_folder(name: str) -> str | None:
    """Create a folder for temporary files that only this user can write; None if that is impossible.

    numba's cache holds pickled objects, so another user must not have created it.
    """
    if not hasattr(os, "getuid"):  # Windows, where the folder of temporary files is private
        return str(Path(tempfile.gettempdir()) / name)
    user = os.getuid()  # containers may have users without a name
    folder = Path(tempfile.gettempdir()) / f"{name}-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        _LOGGER.warning("%s cannot be created (%s); kernels are kept elsewhere", folder, error.strerror)
        return None
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != user or found.st_mode & 0o022:
        _LOGGER.warning("%s can be written by other users; remove it, kernels are kept elsewhere", folder)
        return None
    return str(folder)


class WorkerPool(Executor):
    """Executor of `workers` processes. Functions are module-level ones, arguments and results JSON values.

    `initializer` is called first in each process; the first process completes it before the others start,
    so that they find compiled kernels.
    """

    def __init__(self, workers: int, initializer: tuple[Callable[..., Any], tuple[Any, ...]]) -> None:
        self._calls: queue.SimpleQueue[tuple[Future[Any], str] | None] = queue.SimpleQueue()
        self._initializer = _message(*initializer)
        self._first_start = threading.Lock()
        self._lock = threading.Lock()
        self._stopped = False
        self._processes: set[subprocess.Popen[str]] = set()
        self._threads = [
            threading.Thread(target=self._serve, name="vehicle-worker", daemon=True) for _ in range(workers)
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call a function in a worker process; `WorkerLost` if that ends before its result."""
        assert not kwargs, "keyword arguments are not sent"
        future: Future[Any] = Future()
        self._calls.put((future, _message(fn, args)))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers; with `cancel_futures` at once, interrupting their calls."""
        if cancel_futures:
            with self._lock:
                self._stopped = True
                for process in self._processes:
                    with contextlib.suppress(OSError):
                        assert process.stdin is not None
                        process.stdin.close()
            with contextlib.suppress(queue.Empty):
                while item := self._calls.get_nowait():
                    item[0].cancel()
        for _ in self._threads:
            self._calls.put(None)
        if wait:
            for thread in self._threads:
                thread.join()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Wait for all calls, or end them at once after an error."""
        self.shutdown(cancel_futures=kind is not None)

    def _serve(self) -> None:
        """Pass calls to one process, which is started again after its death."""
        process: subprocess.Popen[str] | None = None
        try:
            while (item := self._calls.get()) is not None:
                future, message = item
                if not future.set_running_or_notify_cancel():
                    continue
                try:
                    if process is None:
                        process = self._start()
                    answer = _ask(process, message)
                except BaseException as error:
                    self._end(process)
                    process = None
                    future.set_exception(error)
                    continue
                if "error" in answer:
                    future.set_exception(RuntimeError(answer["error"]))
                else:
                    future.set_result(answer["result"])
        finally:
            self._end(process)

    def _start(self) -> subprocess.Popen[str]:
        # Ctrl-C reaches this process only, which ends the workers.
        group: dict[str, Any] = {"process_group": 0}
        if sys.platform == "win32":
            group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
        with self._first_start:
            with self._lock:
                if self._stopped:
                    raise WorkerLost("the batch has been stopped")
                process = subprocess.Popen(
                    [sys.executable, "-P", "-c", _PROGRAM, str(Path(__file__).resolve().parents[2])],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                    encoding="utf-8",
                    env={**os.environ, **worker_environment()},
                    **group,
                )
                self._processes.add(process)
            try:
                answer = _ask(process, self._initializer)
                if "error" in answer:
                    raise RuntimeError(answer["error"])
            except BaseException:
                self._end(process)
                raise
        return process

    def _end(self, process: subprocess.Popen[str] | None) -> None:
        if process is None:
            return
        with contextlib.suppress(OSError):
            assert process.stdin is not None
            process.stdin.close()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()
        with self._lock:
            self._processes.discard(process)


def _message(function: Callable[..., Any], args: tuple[Any, ...]) -> str:
    return json.dumps({"call": f"{function.__module__}:{function.__name__}", "args": args}) + "\n"


def _ask(process: subprocess.Popen[str], message: str) -> dict[str, Any]:
    """Send a call and wait for its answer; log the warnings of the worker as those of this process."""
    assert process.stdin is not None
    assert process.stdout is not None
    line = ""
    with contextlib.suppress(OSError, ValueError):
        process.stdin.write(message)
        process.stdin.flush()
        line = process.stdout.readline()
    if not line.endswith("\n"):
        code = process.wait()
        reason = f"signal {-code}" if code < 0 else f"exit code {code}"
        raise WorkerLost(f"the worker process ended ({reason})")
    answer: dict[str, Any] = json.loads(line)
    for text in answer["warnings"]:
        _LOGGER.warning("%s", text)
    return answer
