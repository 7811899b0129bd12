"""The workers of a batch: processes of this machine, or those of a Dask cluster.

A worker process calls one function at a time. It is a pool of its own, opened again after it has died: in a
pool of several processes, one that is killed would end the calls of all others.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any

from vehicle_detection._common import JOBS_VARIABLE, available_cores, postpone, private_folder
from vehicle_detection.errors import InvalidInputError

_LOGGER = logging.getLogger(__name__)
# Seconds that the current call has to clean up after the parent process has ended.
_GRACE = 15.0
# Dask blames a lost worker on all its tasks; its default of 3 would fail innocent trips.
_ALLOWED_FAILURES = 20


class WorkerLost(Exception):  # noqa: N818 - named after what happened, as BrokenExecutor is
    """The process of a call has ended before its result."""


def worker_environment() -> dict[str, str]:
    """Environment of a worker: one thread, and a kernel cache on a local disk.

    A cache on shared storage is corrupted by processes of several machines.
    """
    threads = dict.fromkeys((JOBS_VARIABLE, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    cache = os.environ.get("NUMBA_CACHE_DIR") or private_folder("vehicle-detection-kernels")
    return threads | ({"NUMBA_CACHE_DIR": cache} if cache else {})


class WorkerPool(ThreadPoolExecutor):
    """Executor of `workers` processes, each served by a thread. Functions are module-level ones.

    `initializer` is called first in each process; the first process completes it before the others start,
    so that they find compiled kernels.
    """

    def __init__(self, workers: int, initializer: tuple[Callable[..., Any], tuple[Any, ...]]) -> None:
        super().__init__(workers, thread_name_prefix="vehicle-worker")
        self._first_call = initializer
        self._start_lock = threading.Lock()
        self._of_thread = threading.local()
        # The processes, and the connections whose end interrupts their calls.
        self._opened: dict[ProcessPoolExecutor, Connection] = {}
        self._stopped = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call a function in a worker process; `WorkerLost` if that ends before its result."""
        return super().submit(self._call, fn, args, kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers; with `cancel_futures` at once, interrupting their calls."""
        if cancel_futures:
            self._stopped = True
            for connection in list(self._opened.values()):
                connection.close()
        super().shutdown(wait, cancel_futures=cancel_futures)
        for process in list(self._opened):
            self._close(process)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Wait for all calls, or end them at once after an error."""
        self.shutdown(cancel_futures=kind is not None)

    def _call(self, *call: Any) -> Any:
        """Pass a call to the process of this thread."""
        process = getattr(self._of_thread, "process", None)
        if process not in self._opened:
            process = self._of_thread.process = self._start()
        return self._ask(process, *call)

    def _start(self) -> ProcessPoolExecutor:
        with self._start_lock:
            if self._stopped:
                raise WorkerLost("the batch has been stopped")
            end, connection = multiprocessing.Pipe(duplex=False)
            process = ProcessPoolExecutor(
                1, multiprocessing.get_context("spawn"), initializer=_prepare, initargs=(end,)
            )
            self._opened[process] = connection
            try:
                # With PYTHONSAFEPATH, Python does not search the current folder, where a file may have the
                # name of a module.
                with _environment(worker_environment() | {"PYTHONSAFEPATH": "1"}):
                    started = process.submit(os.getpid)
                started.add_done_callback(lambda _: end.close())
                self._ask(process, *self._first_call, {})
            except BaseException:
                self._close(process)
                raise
        return process

    def _ask(self, process: ProcessPoolExecutor, *call: Any) -> Any:
        """Call a function with its arguments in a process; its warnings are logged by this one."""
        try:
            result, error, warnings = process.submit(_call, *call).result()
        except (BrokenProcessPool, RuntimeError, OSError, EOFError, KeyboardInterrupt) as lost:
            self._close(process)
            raise WorkerLost("the worker process ended before its result") from lost
        for text in warnings:
            _LOGGER.warning("%s", text)
        if error is not None:
            raise RuntimeError(error)
        return result

    def _close(self, process: ProcessPoolExecutor) -> None:
        connection = self._opened.pop(process, None)
        process.shutdown()
        if connection is not None:
            connection.close()


@contextlib.contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that are started in the block."""
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name in changes:
            os.environ.pop(name, None)
        os.environ.update({name: value for name, value in before.items() if value is not None})


@contextlib.contextmanager
def open_dask(address: str, jobs: int | None = None) -> Iterator[tuple[Executor, str]]:
    """Connect to a Dask scheduler, or start one; yield the executor for `run_batch` and the dashboard's URL.

    Parameters
    ----------
    address
        Address of a scheduler, such as ``"tcp://host:8786"``, or ``"local"`` to start one on this machine.
    jobs
        Number of worker processes, of one thread each, of a local scheduler; None: one per core.

    Examples
    --------
    >>> with open_dask("local", jobs=4) as (executor, dashboard):  # doctest: +SKIP
    ...     report = run_batch("card", "results", executor)
    """
    try:
        import dask
        import distributed
    except ImportError:
        raise InvalidInputError("dask needs a package; pip install 'dask[distributed]'") from None
    scheduler = "distributed.scheduler"
    options = {f"{scheduler}.allowed-failures": _ALLOWED_FAILURES, f"{scheduler}.worker-saturation": 1.0}
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(options))
        target = address
        if address == "local":
            workers = {"n_workers": jobs or available_cores(), "threads_per_worker": 1, "processes": True}
            cluster = distributed.LocalCluster(**workers, dashboard_address=":0", env=worker_environment())
            target = stack.enter_context(cluster)
        try:
            client = stack.enter_context(distributed.Client(target))
        except (OSError, ValueError) as error:
            raise InvalidInputError(
                f"dask must be local or the address of a scheduler such as tcp://host:8786, got {address!r}; "
                f"{error}"
            ) from None
        yield _DaskExecutor(client), client.dashboard_link


class _DaskExecutor(Executor):
    """Executor of a Dask client, whose futures also end when the scheduler does.

    Those of ``client.get_executor()`` wait forever for a result that was lost on the way.
    """

    def __init__(self, client: Any) -> None:
        self._client = client

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call a function on a worker; `BrokenExecutor` if the scheduler is gone."""
        future: Future[Any] = Future()
        try:
            remote = self._client.submit(fn, *args, **kwargs, pure=False)
        except Exception as error:
            raise self._translate(error) from error
        future.set_running_or_notify_cancel()

        def finish(done: Any) -> None:
            try:
                future.set_result(done.result())
            except BaseException as error:
                future.set_exception(self._translate(error))

        remote.add_done_callback(finish)
        return future

    def _translate(self, error: BaseException) -> BaseException:
        """Tell the loss of the scheduler from errors of a call."""
        if self._client.status == "running":
            return RuntimeError(str(error)) if isinstance(error, CancelledError) else error
        return BrokenExecutor("the Dask scheduler does not answer any more")


# What follows runs in the worker process.
_idle = threading.Event()
_idle.set()


def _prepare(parent: Connection) -> None:
    """Prepare a worker: Ctrl-C reaches its parent only, whose end ends it."""
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)
    signal.signal(signal.SIGINT, _interrupt)
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _interrupt(number: int, frame: FrameType | None) -> None:
    if not postpone(number, frame):
        raise KeyboardInterrupt


def _watch(parent: Connection) -> None:
    """Wait for the end of the parent process; then interrupt the current call, and end the worker."""
    with contextlib.suppress(EOFError, OSError):
        parent.recv()
    if _idle.is_set():
        os._exit(1)
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(int(threading.main_thread().ident or 0), signal.SIGINT)
    else:
        signal.raise_signal(signal.SIGINT)
    _idle.wait(_GRACE)
    os._exit(1)


def _call(function: Callable[..., Any], args: Any, kwargs: Any) -> tuple[Any, str | None, list[str]]:
    """Call a function; return its result, its error and its warnings as plain values."""
    warnings: list[str] = []
    logger, collector = logging.getLogger("vehicle_detection"), logging.Handler(logging.WARNING)
    collector.emit = lambda record: warnings.append(record.getMessage())  # type: ignore[method-assign]
    logger.addHandler(collector)
    _idle.clear()
    try:
        return function(*args, **kwargs), None, warnings
    except Exception as error:
        return None, f"{type(error).__name__}: {error}", warnings
    finally:
        _idle.set()
        logger.removeHandler(collector)
