"""The progress bar of long operations."""

from __future__ import annotations

from typing import Any


def progress_bar(
    show: bool,
    total: int | None = None,
    *,
    unit: str,
    desc: str | None = None,
    terminal_only: bool = False,
) -> Any:
    """Open a tqdm bar on standard error, with ``update(n=1)``; a hidden one if `show` is False.

    With `terminal_only` the bar stays hidden unless standard error is a terminal. Use it in a ``with`` block.
    """
    if not show:
        from tqdm import tqdm

        return tqdm(disable=True)
    from tqdm.auto import tqdm as notebook_or_terminal_tqdm

    disable = None if terminal_only else False
    return notebook_or_terminal_tqdm(total=total, unit=unit, desc=desc, disable=disable)
