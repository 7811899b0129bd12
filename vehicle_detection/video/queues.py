"""A bounded queue between two threads that either side can close."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

Item = TypeVar("Item")


class QueueClosed(Exception):  # noqa: N818 - a signal between threads, not an error
    """The other side has closed the queue."""


class ClosableQueue(Generic[Item]):
    """A bounded queue; with ``queue.Queue`` a producer would wait forever for a consumer that has failed.

    Only C code waits: an interrupt inside ``threading.Condition`` can leave its lock in the wrong state.
    """

    def __init__(self, size: int) -> None:
        self._items: SimpleQueue[Item | None] = SimpleQueue()  # None: no more
        self._spaces: SimpleQueue[None] = SimpleQueue()
        for _ in range(size):
            self._spaces.put(None)
        self._aborted = False
        self._error: BaseException | None = None

    def put(self, item: Item, *, replace: bool = False) -> None:
        """Append an item when there is space, or in place of the others; raise the error of `abort`."""
        if replace:
            self._clear()
        self._spaces.get()
        if self._aborted:
            self._spaces.put(None)  # for the next call
            self._items.put(None)  # `replace` may have dropped the one of `abort`
            raise self._error or QueueClosed
        self._items.put(item)

    def finish(self, error: BaseException | None = None) -> None:
        """Close the queue after the last item; the consumer gets the remaining items, then the error."""
        self._error = self._error or error
        self._items.put(None)

    def abort(self, error: BaseException | None = None) -> None:
        """Close the queue for both sides at once; waiting items are dropped."""
        self._error = self._error or error
        self._aborted = True
        self._spaces.put(None)
        self._items.put(None)  # first: an interrupt of what follows must not leave a thread waiting
        self._clear()
        self._items.put(None)

    def _clear(self) -> None:
        with contextlib.suppress(Empty):
            while True:
                self._items.get_nowait()
                self._spaces.put(None)

    def __iter__(self) -> Iterator[Item]:
        while True:
            item = self._items.get()
            if item is None or self._aborted:
                self._items.put(None)  # for the next call
                if self._aborted or self._error is not None:
                    raise self._error or QueueClosed
                return
            self._spaces.put(None)
            yield item
