"""Pictures of precision and recall and of the worst errors in the folds of a cross-validation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vehicle_detection._common import atomic_write
from vehicle_detection.evaluation import precision_recall_curve
from vehicle_detection.notebook import plot_errors, plot_precision_recall
from vehicle_detection.training import FoldDetections, FoldScore

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_KINDS: tuple[Literal["missed", "false"], ...] = ("missed", "false")


def write_pictures(folder: Path, scores: Sequence[FoldScore], folds: Sequence[FoldDetections]) -> list[str]:
    """Write ``curves.png`` and, for each set of frames, its 20 worst errors of each kind; return the names.

    Errors, in ``NAME-missed.png`` and ``NAME-false.png``, are those at the threshold of the scores.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 5), layout="constrained")
    curves = {fold.frames.name: precision_recall_curve(fold.predictions, fold.labels) for fold in folds}
    plot_precision_recall(curves, ax=figure.subplots())
    names = [_save(figure, folder, "curves.png")]
    for score, fold in zip(scores, folds):
        kept = fold.above(score.threshold)
        for kind in _KINDS:
            figure = Figure(figsize=(12, 10), layout="constrained")
            plot_errors(fold.frames, kept, kind=kind, count=20, columns=5, ax=figure.subplots())
            names.append(_save(figure, folder, f"{score.name}-{kind}.png"))
    return names


def _save(figure: Figure, folder: Path, name: str) -> str:
    with atomic_write(folder / name) as part:
        figure.savefig(part, dpi=100)
    return name
