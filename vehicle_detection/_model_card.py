"""The model card: what a user of a model should know of it, as Markdown."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from vehicle_detection._training_report import SPLITS, TrainingReport
from vehicle_detection.classifier import VehicleClassifier


def model_card(
    classifier: VehicleClassifier,
    report: TrainingReport,
    *,
    others: Sequence[TrainingReport] = (),
    command: str | None = None,
) -> str:
    """Write what a user of the model should know, as Markdown.

    Parameters
    ----------
    classifier, report
        What `train_and_judge` returned.
    others
        Reports of other features on the same patches, for a table beside them.
    command
        The command that trains the model.

    Returns
    -------
    str
        Data, licence, accuracy on each split, what flatters it, limits.
    """
    parts = [
        *_about(classifier, report, command),
        *_data(report),
        *_accuracy(report, others),
        "## Limits",
        "\n".join(_wrap(line, "- ") for line in _limits(report)),
    ]
    return "\n\n".join(parts) + "\n"


def _about(classifier: VehicleClassifier, report: TrainingReport, command: str | None) -> list[str]:
    params = report.params
    parts = f"{params.spatial_length} spatial bins, {params.hist_length} histogram, {params.hog_length} HOG"
    versions = ", ".join(f"{name} {text}" for name, text in classifier.metadata["versions"].items())
    mirrored = "with mirrored patches" if report.mirror else "without mirrored patches"
    mirrored += f" of other brightness (gamma {report.gamma:g})" if report.gamma else ""
    mirrored += f", and degraded ones of weight {report.degraded:g}" if report.degraded else ""
    facts = [
        f"Features: {report.features}, in {params.color_space}, {params.length} values ({parts})",
        f"Training: C = {report.C:g}, {mirrored}, seed {report.random_state}",
        f"Versions: {versions}",
    ]
    text = [
        "# Model card",
        "A linear SVM that tells 64x64 RGB patches with a vehicle from those without, to search images with.",
        "\n".join(_wrap(fact, "- ") for fact in facts),
    ]
    if command:
        text += [
            "Made by",
            f"```bash\n{command}\n```",
            "Again, with the same versions, it makes the same file.",
        ]
    return text


def _data(report: TrainingReport) -> list[str]:
    total = report.vehicles + report.non_vehicles
    counts = (
        f"{report.vehicles:,} patches of vehicles and {report.non_vehicles:,} of anything else "
        f"({report.balance:.1%} vehicles). The model is trained on all {total:,}."
    )
    if any(source.startswith(("GTI", "KITTI")) for source in report.sources):
        licence = (
            "Licence: the patches come from the GTI vehicle image database and the KITTI benchmark, both "
            "CC BY-NC-SA 3.0. The model is made of them and inherits the note: non-commercial use, with "
            "attribution."
        )
    else:
        licence = "Licence: the model inherits the terms of the patches it is made of."
    return [
        "## Data",
        _wrap(counts),
        _table(("source", "patches"), [(name, f"{count:,}") for name, count in report.sources.items()]),
        f"Fingerprint of the patches (SHA-256): `{report.fingerprint}`",
        _wrap(licence),
    ]


def _accuracy(report: TrainingReport, others: Sequence[TrainingReport]) -> list[str]:
    how = (
        "Scaler and SVM are fitted on the training part of a split alone and judged on the other. A "
        "near-copy is a tested patch much like one of the training patches: the correlation of their 16x16 "
        "gray thumbnails is 0.95 or more."
    )
    if "random" in report.splits:
        seeds = len(report.splits["random"].accuracies)
        how += f" The random split is the mean of {seeds} seed{'s' * (seeds > 1)}."
    columns = (
        "tested on",
        "trained",
        "tested",
        "accuracy",
        "missed vehicles",
        "false vehicles",
        "near-copies",
    )
    rows = [
        (
            SPLITS[name],
            f"{score.train:,}",
            f"{score.test:,}",
            f"{score.accuracy:.4f}",
            f"{score.missed:.2%}",
            f"{score.false:.2%}",
            f"{score.leakage:.1%}",
        )
        for name, score in report.splits.items()
    ]
    text = ["## Accuracy", _wrap(how), _table(columns, rows)]
    if report.calibration_error is not None:
        text.append(
            _wrap(
                f"Probabilities: the expected calibration error is {report.calibration_error:.4f} on the "
                "last fifth of each folder, with Platt's sigmoid fitted on the last fifth of the rest."
            )
        )
    if others:
        names = [name for name in SPLITS if name in report.splits]
        accuracies = [
            (each.features, str(each.params.length), *(f"{each.splits[name].accuracy:.4f}" for name in names))
            for each in (report, *others)
        ]
        heads = ("features", "length", *(SPLITS[name] for name in names))
        text += ["Other features, trained and judged in the same way:", _table(heads, accuracies)]
    return text


def _limits(report: TrainingReport) -> list[str]:
    lines = [
        "The accuracy is that of patches, not of vehicles found in frames, where most windows show none."
    ]
    if "random" in report.splits:
        lines.append(
            "Neighbouring patches show the same vehicle from one frame to the next: a random split tests on "
            "near-copies of what it trained on, which flatters."
        )
    if "KITTI_extracted" in report.sources:
        lines.append(
            "The numbers of `KITTI_extracted` are shuffled: the split by sequences leaks there as the random "
            "one does. Only the cross-source rows test on another camera and other roads."
        )
    if "Extras" in report.sources:
        lines.append(
            "`Extras` holds crops of the road of the course's project video: scores on clips of that road "
            "are flattered."
        )
    lines.append(
        "The patches show mostly cars from behind, by day. Trucks, buses, motorcycles, vehicles straight "
        "from the side, night and heavy rain are rare among them or missing."
    )
    return lines


def _wrap(text: str, mark: str = "") -> str:
    return textwrap.fill(
        text, 110, initial_indent=mark, subsequent_indent=" " * len(mark), break_on_hyphens=False
    )


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
