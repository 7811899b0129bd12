"""The command that trains the default network on labelled frames."""

from __future__ import annotations

from pathlib import Path

from typer import Argument

import vehicle_detection as vd
from vehicle_detection.cli import common
from vehicle_detection.cli.info import print_held_out
from vehicle_detection.cli.options import option
from vehicle_detection.cli.output import check_targets, name_kept_files, option_names, print_line


@option_names(random_state="--seed", sources="DATA", initial="--model")
def train_frames(
    data: Path = Argument(
        ..., metavar="DATA", help="Folder with labels/NAME.csv and frames/NAME/ or videos/NAME.mp4."
    ),
    output: Path = option("FILE", "Model file to write, such as own.onnx.", "-o", "--output", default=...),
    model: str = option(
        "MODEL", '"default" or a file of this command to continue from, such as own.onnx.', default="default"
    ),
    steps: int | None = option(
        "N", "Steps of 8 samples, 0.6 s each on two cores; default: 5 per frame, 200 to 1200."
    ),
    device: str | None = option("cpu|cuda", "Default: cuda where PyTorch offers it."),
    curves: Path | None = option("FILE.csv", "Precision and recall on each set of held-out frames."),
    jobs: int | None = option("N", "Threads, such as 2; default: all cores."),
    seed: int = option("N", "Random seed.", default=0),
) -> None:
    """Continue the training of the default model on labelled frames, and evaluate it on a fifth of them.

    An interrupted training is continued by the same command.
    """
    targets = check_targets({"--output": output, "--curves": curves}, {"DATA": data})
    common.check_suffix(output, "--output", (".onnx",))
    sources = vd.training.find_sources(data)
    for source in sources:
        for part in source.sets:
            empty = sum(not len(part.labels.rows(key)) for key in part.keys)
            boxes = common.pluralize(len(part.labels), "box", "es")
            print_line(
                f"{source.name}: {common.pluralize(len(part), 'frame')}, {boxes}, {empty} frames without any"
            )
    checkpoint = output.with_name(f"{output.name}.checkpoint")
    if checkpoint.exists():
        print_line(f"continuing the training of {checkpoint}")
    try:
        tuned = vd.training.fine_tune_network(
            sources,
            initial=model,
            steps=steps,
            random_state=seed,
            jobs=jobs,
            device=device,
            checkpoint=checkpoint,
            on_step=lambda _, line: print_line(line),
        )
    except KeyboardInterrupt as error:
        if checkpoint.exists():
            error.args = (f"; the same command continues from {checkpoint}",)
        raise
    with name_kept_files(targets):
        tuned.model.save(output)
        if curves is not None:
            vd.training.write_curves(curves, tuned.folds)
    metrics = tuned.model.metadata["metrics"]
    print_held_out(metrics["held_out"], metrics["held_out_before"])
    print_line(f"wrote {', '.join(map(str, targets))}")
