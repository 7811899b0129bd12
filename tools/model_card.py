"""The model card of the shipped default model, written from the measurements of its training."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from pathlib import Path

from tools.recall_tables import VISIBILITY, WIDTHS, recall_tables
from vehicle_detection._common import write_text
from vehicle_detection.mixture import TemplateMixture
from vehicle_detection.training import (
    FOLD_COLUMNS,
    FoldDetections,
    FoldScore,
    FrameDataset,
    format_fold,
    markdown_table,
    markdown_text,
)

_COMMAND = "python -m tools.train_default DATA -o {name}.safetensors --card {name}.md --seed {seed}"
_METHOD = (
    "Each source was left out of training in turn, and single frames of it were searched with the default "
    "parameters, at an IoU of 0.5. F1, precision and recall are those at the threshold that is best for the "
    "other sources, where a false box counts 1.4 times as much as a missed vehicle; best F1 is that of the "
    "best threshold; AP is the average precision; false positives are "
    "counted per frame, per frame without any label, and per frame without a scored vehicle; recall is also "
    "that of vehicles that others partly occlude, that the edge of the frame cuts, and under 32 px wide. "
    '"Region F1" and "region AP" do not score a box of '
    "which at least half lies in an ignored box: where labels put one ignored box around a group of "
    "vehicles, the other columns count each vehicle detected there as false. The threshold and the "
    "calibration are chosen with such regions, and AP at an IoU of 0.7 is measured with them. ECE is the "
    "expected calibration error: the difference between the stated probability of a box and the fraction of "
    "right ones."
)
_RECALL = (
    "The fraction of the vehicles that is found at the same threshold, and their number, by the width of the "
    "labelled box, and by what hides them: another labelled vehicle, nearer by its lower edge, covers 15% of "
    "the box or more, or the frame cuts it."
)
_STATED = (
    "Boxes of all sets with a probability from 0.1 on, which is fitted to the other sources. The vehicles of "
    "foggy frames have a higher probability than stated."
)
_LICENSES = (
    "Licence: the frames of India, of Cambridge (CamVid), of Indonesia and of DAWN were published for "
    "research and other non-commercial use; the patches come from the GTI vehicle image database and the "
    "KITTI benchmark, both CC BY-NC-SA 3.0. The model inherits these terms. The course's images and clips "
    "are MIT licensed."
)
_LIMITS = (
    "The frames show daylight and dusk in three countries, fog, rain and snow, and one American highway.",
    "Vehicles that are occluded, truncated by the frame, seen from the side at close range or narrower than "
    "32 pixels are missed more often.",
    "Motor scooters, signs and shop fronts cause false positives.",
    "Use the model to explore and to annotate, not to drive.",
)


def write_card(
    path: str | os.PathLike[str],
    model: TemplateMixture,
    scores: Sequence[FoldScore],
    sources: Sequence[FrameDataset],
    *,
    seed: int,
    patches: int = 0,
    folds: Sequence[FoldDetections] = (),
) -> None:
    """Write the model card as Markdown; with the detections `folds` also by size and visibility."""
    name = Path(path).stem
    titles = [title for title, _ in FOLD_COLUMNS.values()]
    rows = [
        [score.name, str(score.frames), str(score.vehicles), *format_fold(score.to_dict(), missing="-")]
        for score in scores
    ]
    parts = [
        f"# Model card: {name}",
        markdown_text(
            f"A mixture of {len(model.templates)} linear SVM templates over FHOG channels that detects "
            "vehicles on any road. Created by"
        ),
        f"```bash\n{_COMMAND.format(name=name, seed=seed)}\n```",
        "From the same commit, with the same versions, the command creates the same file again.",
        "\n".join(markdown_text(fact, "- ") for fact in _facts(model)),
        "## Accuracy on roads that it was not trained on",
        markdown_text(_METHOD),
        markdown_table(["set", "frames", "vehicles", *titles], rows),
        *_details(folds, scores),
        "## Data",
        "\n".join(markdown_text(line, "- ") for line in _data(sources, patches)),
        markdown_text(_LICENSES),
        "## Limits",
        "\n".join(markdown_text(line, "- ") for line in _LIMITS),
    ]
    write_text(path, "\n\n".join(parts) + "\n", "path")


def _details(folds: Sequence[FoldDetections], scores: Sequence[FoldScore]) -> list[str]:
    """Tables of recall by size and visibility, and of the stated probabilities."""
    if not folds:
        return []
    by_width, by_visibility, stated = recall_tables(folds, scores)
    limits = list(itertools.pairwise(WIDTHS))
    titles = [f"{low:g} to {high:g} px" for low, high in limits[:-1]] + [f"{limits[-1][0]:g} px and more"]
    return [
        "### Recall by size and visibility",
        markdown_text(_RECALL),
        markdown_table(["set", *titles], by_width),
        markdown_table(["set", *VISIBILITY], by_visibility),
        "### Stated and true probability",
        markdown_text(_STATED),
        markdown_table(["mean stated probability", "right", "boxes"], stated),
    ]


def _facts(model: TemplateMixture) -> list[str]:
    shapes = [
        "{:g}x{:g}".format(*template.box_cells) + " at the border" * template.border
        for template in model.templates
    ]
    facts = [
        f"Templates, in cells of the vehicle's box: {', '.join(shapes)}",
        f"Threshold: log-odds of {model.threshold:.2f}",
    ]
    rescorer = model.rescorer
    if rescorer is not None:
        facts.insert(
            1,
            f"Rescoring and box correction: the mean of {len(rescorer.networks)} convolutional networks, "
            f"together {rescorer.n_weights:,} weights, on the edges and colors of cells, with a weight of "
            f"{rescorer.blend_weight:g}",
        )
    return facts


def _data(sources: Sequence[FrameDataset], patches: int) -> list[str]:
    lines = [
        f"{source.name}: {sum(len(part) for part in source.sets)} frames, "
        f"{sum(int((~part.labels.ignore).sum()) for part in source.sets)} vehicles"
        for source in sources
    ]
    return lines + ([f"{patches} vehicles on the course's patches"] if patches else [])
