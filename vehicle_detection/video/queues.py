"""A bounded queue between two threads that either side can close."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

Item = TypeVar("Item")


class QueueClosed(Exception):  # noqa: N818 - a signal between threads, not an error
    """The other side has closed the queue."""


class ClosableQueue(Generic[Item]):
    """A bounded queue; with ``queue.Queue`` a producer would wait forever for a consumer that has failed."""

    def __init__(self, size: int) -> None:
        self._items: deque[Item] = deque()
        self._size = size
        # Used instead of the condition's own __enter__, whose interrupt could leave the lock acquired.
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._finished = self._aborted = False
        self._error: BaseException | None = None

    def put(self, item: Item, *, replace: bool = False) -> None:
        """Append an item when there is space, or in place of the others; raise the error of `abort`."""
        with self._lock:
            if replace:
                self._items.clear()
            while len(self._items) >= self._size and not self._aborted:
                self._changed.wait()
            if self._aborted:
                raise self._error or QueueClosed
            self._items.append(item)
            self._changed.notify_all()

    def finish(self, error: BaseException | None = None) -> None:
        """Close the queue after the last item; the consumer gets the remaining items, then the error."""
        with self._lock:
            self._finished = True
            self._error = self._error or error
            self._changed.notify_all()

    def abort(self, error: BaseException | None = None) -> None:
        """Close the queue for both sides at once; waiting items are dropped."""
        with self._lock:
            self._aborted = True
            self._items.clear()
            self.finish(error)

    def __iter__(self) -> Iterator[Item]:
        while True:
            with self._lock:
                while not self._items and not self._finished:
                    self._changed.wait()
                if not self._items:
                    if self._aborted or self._error is not None:
                        raise self._error or QueueClosed
                    return
                item = self._items.popleft()
                self._changed.notify_all()
            yield item
