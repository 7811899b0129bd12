"""The progress bar of long operations."""

from __future__ import annotations

import contextlib
import sys
from types import SimpleNamespace
from typing import Any

from vehicle_detection._common import check

_HIDDEN = SimpleNamespace(update=lambda n=1: None, set_description=lambda text: None)


def in_notebook() -> bool:
    """Whether the code runs in a cell of a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


def progress_bar(
    show: bool,
    total: int | None = None,
    *,
    unit: str,
    desc: str | None = None,
    interactive_only: bool = False,
) -> Any:
    """Context manager of a tqdm bar on standard error with ``update(n=1)`` and ``set_description(text)``.

    Nothing is shown if `show` is False or, with `interactive_only`, if standard error is neither a terminal
    nor the output of a notebook's cell.
    """
    check.flags(progress=show)
    # Not left to tqdm, whose import takes a tenth of a second.
    terminal = sys.stderr is not None and sys.stderr.isatty()  # None: closed
    if not show or (interactive_only and not terminal and not in_notebook()):
        return contextlib.nullcontext(_HIDDEN)
    from tqdm.auto import tqdm

    return tqdm(total=total, unit=unit, desc=desc, disable=False)
