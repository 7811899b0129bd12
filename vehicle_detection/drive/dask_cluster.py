"""A Dask cluster as the executor of a batch."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from typing import Any

from vehicle_detection._common import available_cores
from vehicle_detection.drive.worker_pool import worker_environment
from vehicle_detection.errors import InvalidInputError

# Dask blames a lost worker on all its tasks; its default of 3 would fail innocent trips.
_ALLOWED_FAILURES = 20


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
        raise InvalidInputError(
            "dask needs dask[distributed]; pip install 'dask[distributed]', or omit it"
        ) from None
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
