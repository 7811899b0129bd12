"""The base of objects that a ``with`` block closes."""

from __future__ import annotations

from typing import Self


class Closing:
    """A context manager whose :meth:`close` is called at the end of the block."""

    def close(self) -> None:
        """Release everything."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
