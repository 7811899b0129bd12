"""Trials, each measured once: results of an earlier run are reused."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from vehicle_detection.datasets import Split
from vehicle_detection.tuning.cache import digest_of
from vehicle_detection.tuning.grid import Candidate
from vehicle_detection.tuning.results import ResultTable, RowStore
from vehicle_detection.tuning.trials import COLUMNS, Bench, Recipe

_LOGGER = logging.getLogger(__name__)


class Ledger:
    """Runs trials on a bench and writes down every result at once.

    Parameters
    ----------
    bench
        Where the trials run.
    store
        Results of this and earlier runs.
    bar
        A progress bar with an ``update``, or None.
    """

    def __init__(self, bench: Bench, store: RowStore, bar: Any = None) -> None:
        self.bench = bench
        self.rows: list[Mapping[str, Any]] = []
        self._store = store
        self._bar = bar

    def table(self) -> ResultTable:
        """Return the rows so far, in the order they were asked for."""
        return ResultTable(self.rows)

    def run(
        self,
        recipe: Recipe,
        split: Split,
        seed: int,
        *,
        name: str,
        split_name: str,
        stage: str,
        on_frames: bool = True,
    ) -> Mapping[str, Any]:
        """Return the row of a trial, measured now or earlier."""
        trial = self.bench.trial(recipe, split, seed, on_frames=on_frames)
        words = {"stage": stage, "configuration": name, "split": split_name, "seed": seed}
        if trial in self._store:
            row = _row({**self._store[trial], **words})
        else:
            measured = self.bench.measure(recipe, split, seed, on_frames=on_frames)
            row = _row({**measured, **recipe.to_cells(), **words, "trial": trial})
            self._store.add(row)
            _LOGGER.info("%s, C=%g, %s: %s", name, recipe.C, split_name, row["accuracy"] or row["message"])
        self._keep(row)
        return row

    def refuse(self, candidate: Candidate, *, stage: str) -> None:
        """Write down a combination that is impossible."""
        trial = digest_of(dict(candidate.options), candidate.fault)
        words = {"status": "refused", "message": candidate.fault, "configuration": candidate.name}
        row = _row({**candidate.options, **words, "stage": stage, "trial": trial})
        if trial not in self._store:
            self._store.add(row)
            _LOGGER.warning("%s is refused: %s", candidate.name, candidate.fault)
        self._keep(row)

    def _keep(self, row: Mapping[str, Any]) -> None:
        self.rows.append(row)
        if self._bar is not None:
            self._bar.update()


def _row(cells: Mapping[str, Any]) -> dict[str, Any]:
    return {name: cells.get(name) for name in COLUMNS}
