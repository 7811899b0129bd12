"""Pictures of how a mixture does on sources that it was not trained on: curves, and its worst mistakes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from vehicle_detection._common import atomic_write
from vehicle_detection.evaluation import precision_recall_curve
from vehicle_detection.mixture_training.cross_validation import FoldDetections, FoldScore
from vehicle_detection.plotting import plot_errors, plot_precision_recall

_KINDS: tuple[Literal["missed", "false"], ...] = ("missed", "false")
# Mistakes that are shown of each set, and how many in a row.
_COUNT, _COLUMNS = 20, 5


def write_pictures(folder: Path, scores: Sequence[FoldScore], held: Sequence[FoldDetections]) -> list[str]:
    """Write ``curves.png``, and for each set of frames ``NAME-missed.png`` and ``NAME-false.png``.

    Parameters
    ----------
    folder
        An existing folder.
    scores, held
        As `cross_validate_mixture` returns them. Mistakes are those at the threshold of the scores.

    Returns
    -------
    list of str
        Names of the files.
    """
    from matplotlib.figure import Figure

    def save(figure: Figure, name: str) -> str:
        with atomic_write(folder / name) as part:
            figure.savefig(part, dpi=100)
        return name

    figure = Figure(figsize=(7, 5), layout="constrained")
    curves = {part.frames.name: precision_recall_curve(part.found, part.truth) for part in held}
    plot_precision_recall(curves, ax=figure.subplots())
    names = [save(figure, "curves.png")]
    for score, part in zip(scores, held):
        kept = part.above(score.threshold)
        for kind in _KINDS:
            figure = Figure(figsize=(12, 10), layout="constrained")
            plot_errors(part.frames, kept, kind=kind, count=_COUNT, columns=_COLUMNS, ax=figure.subplots())
            names.append(save(figure, f"{score.name}-{kind}.png"))
    return names
