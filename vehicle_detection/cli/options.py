"""Options that several commands share, and the panels of their help."""

from __future__ import annotations

import re
from typing import Annotated, Any

from typer import Option

from vehicle_detection.errors import InvalidInputError

INPUT, CAMERA, SEARCH, DRAWING, OUTPUT = "Input", "Camera", "Search", "Drawing", "Output"
"""Panels of the options in ``--help``."""

PATCHES = "--vehicles and --non-vehicles"
"""The options that name training patches, in messages about all of them."""

HORIZON_HELP = "Row of the horizon as a fraction of the frame's height, 0 at the top, such as 0.55."


def option(metavar: str, help: str, *names: str, panel: str | None = None) -> Any:  # noqa: A002 - as typer
    """Option with a value; without `names`, the parameter names it."""
    return Option(*names, metavar=metavar, help=help, rich_help_panel=panel)


def flag(*names: str, panel: str | None = None, help: str) -> Any:  # noqa: A002 - as typer
    """Option without a value; the help shows no type for it."""
    return option("", help, *names, panel=panel)


Model = Annotated[
    str,
    option(
        "NAME|FILE",
        '"default" (any road), "highway" (the course\'s), or a model file, such as yolo11n.onnx.',
        panel=SEARCH,
    ),
]
Classes = Annotated[
    str | None,
    option(
        "LIST",
        "Classes of another library's network that are vehicles, such as car,bus,truck or 2,5,7.",
        panel=SEARCH,
    ),
]
Device = Annotated[
    str, option("cpu|cuda", "Where a network runs; cuda needs the package onnxruntime-gpu.", panel=SEARCH)
]
Confidence = Annotated[
    float | None,
    option(
        "P",
        "Minimum confidence, a probability from 0 to 1, such as 0.5; default: the model's threshold.",
        panel=SEARCH,
    ),
]
Every = Annotated[
    int | None,
    option(
        "N",
        "Search every N-th frame, and interpolate between; 1: every frame; default: 12 a second.",
        panel=SEARCH,
    ),
]
Horizon = Annotated[float | None, option("F", HORIZON_HELP, panel=CAMERA)]
CameraName = Annotated[
    str | None,
    option(
        "NAME|FILE",
        "Lens: standard-58, wide-90, fisheye-120, fisheye-140 or fisheye-170; or a JSON file.",
        panel=CAMERA,
    ),
]
FieldOfView = Annotated[
    float | None,
    option(
        "DEG",
        "Field of view along the longer side in degrees, such as 90; default: 58, with a warning.",
        "--fov",
        panel=CAMERA,
    ),
]
CameraHeight = Annotated[
    float | None,
    option(
        "M",
        "Height of the lens above the road in meters, such as 1.5; default: 1.3.",
        "--camera-height",
        panel=CAMERA,
    ),
]
LineWidth = Annotated[
    int | None,
    option(
        "N",
        "Width of the boxes' lines in pixels, such as 3; default: by size of the frame.",
        "--line-width",
        panel=DRAWING,
    ),
]
Blur = Annotated[
    str | None,
    option(
        "vehicles|plates",
        "Blur the vehicles, or the region of their plates, in what is written.",
        panel=DRAWING,
    ),
]
Preset = Annotated[
    str,
    option(
        "NAME", "Speed of the encoder, from ultrafast (large files) to placebo (small ones).", panel=OUTPUT
    ),
]
NoAudio = Annotated[bool, flag("--no-audio", panel=OUTPUT, help="Write no sound.")]


def parse_time(text: str | None, name: str) -> float | None:
    """Read a time in seconds, or as players show it: ``12:30`` or ``1:02:06.5``."""
    from vehicle_detection._common import describe

    if text is None:
        return None
    clock = re.fullmatch(r"(?:(\d+):)?(\d+):(\d{1,2}(?:\.\d*)?)", text.strip())
    if clock is not None:
        hours, minutes, seconds = (float(part or 0) for part in clock.groups())
        return 3600 * hours + 60 * minutes + seconds
    try:
        return float(text)
    except ValueError:
        raise InvalidInputError(
            f"{name} must be a time in seconds or as [H:]M:S, such as 750 or 12:30; got {describe(text)}"
        ) from None


def parse_classes(text: str | None) -> list[str | int] | None:
    """Read names or numbers of classes."""
    if text is None:
        return None
    names = [name.strip() for name in text.split(",") if name.strip()]
    return [int(name) if name.isdecimal() else name for name in names]


def open_model(name: str, classes: str | None, device: Any) -> Any:
    """Load the model that the options name."""
    from vehicle_detection.loading import load_model

    return load_model(name, classes=parse_classes(classes), device=device)


def parse_blur(text: str | None) -> Any:
    """Check the region to blur before a model is loaded."""
    from vehicle_detection._common import check_choice
    from vehicle_detection.drawing import BLUR_REGIONS

    if text is not None:
        check_choice(text, "--blur", BLUR_REGIONS)
    return text
