"""The options of the commands: how they are declared, and those that several commands share."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable
from typing import Any, TypeVar, get_type_hints

from typer import Option

import vehicle_detection as vd
from vehicle_detection.cli import common

Options = TypeVar("Options")

PATCHES = "--vehicles and --non-vehicles"
"""The options that name training patches, in messages about all of them."""

HORIZON_HELP = "Row of the horizon as a fraction of the frame's height, 0 at the top, such as 0.55."


def option(metavar: str, help: str, *names: str, default: Any = None, panel: str | None = None) -> Any:  # noqa: A002 - as typer
    """Option with a value, required if `default` is `...`; without `names`, the parameter names it."""
    return Option(default, *names, metavar=metavar, help=help, rich_help_panel=panel)


def flag(name: str, help: str, *names: str, panel: str | None = None) -> Any:  # noqa: A002 - as typer
    """Option without a value; the help shows no type for it."""
    return option("", help, name, *names, default=False, panel=panel)


def takes(options: type[Options]) -> Callable[[Callable[[Options], None]], Callable[..., None]]:
    """Declare the options of a command by a class with a field for each.

    typer reads options from the parameters of a function; the decorated function gets one for each field.
    """

    def decorate(command: Callable[[Options], None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(**values: Any) -> None:
            command(options(**values))

        hints = get_type_hints(options)
        parameters = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=getattr(options, name))
            for name in hints
        ]
        run.__annotations__ = hints
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        return run

    return decorate


# Options in a panel of the help.
source, source_flag = (functools.partial(each, panel="Input") for each in (option, flag))
camera = functools.partial(option, panel="Camera")
search = functools.partial(option, panel="Search")
drawing, drawing_flag = (functools.partial(each, panel="Drawing") for each in (option, flag))
output, output_flag = (functools.partial(each, panel="Output") for each in (option, flag))

MODEL = search(
    "NAME|FILE",
    '"default" (any road), "highway" (the course\'s), or a model file, such as yolo11n.onnx.',
    default="default",
)
CLASSES = search(
    "LIST", "Classes of another library's network that are vehicles, such as car,bus,truck or 2,5,7."
)
DEVICE = search("cpu|cuda", "Where a network runs; cuda needs the package onnxruntime-gpu.", default="cpu")
CONFIDENCE = search(
    "P", "Minimum confidence, a probability from 0 to 1, such as 0.5; default: the model's threshold."
)
EVERY = search("N", "Search every N-th frame, and interpolate between; 1: every frame; default: 12 a second.")
HORIZON = camera("F", HORIZON_HELP)
CAMERA = camera(
    "NAME|FILE",
    "Lens: standard-58, wide-90, fisheye-120, fisheye-140 or fisheye-170; or a file (JSON; OpenCV, ROS).",
)
FIELD_OF_VIEW = camera(
    "DEG", "Field of view along the longer side in degrees, such as 90; default: 58, with a warning."
)
CAMERA_HEIGHT = camera("M", "Height of the lens above the road in meters, such as 1.5; default: 1.3.")
LINE_WIDTH = drawing("N", "Width of the boxes' lines in pixels, such as 3; default: by size of the frame.")
BLUR = drawing("vehicles|plates", "Blur the vehicles, or the region of their plates, in what is written.")
PRESET = output(
    "NAME", "Speed of the encoder, from ultrafast (large files) to placebo (small ones).", default="veryfast"
)
NO_AUDIO = output_flag("--no-audio", "Write no sound.")
VEHICLES = option("PATH", "Folder or zip of patches of vehicles, such as vehicles.zip.", default=...)
NON_VEHICLES = option("PATH", "Folder or zip of other patches, such as non-vehicles.zip.", default=...)


def parse_time(text: str | None, name: str) -> float | None:
    """Read a time in seconds, or as players show it: ``12:30`` or ``1:02:06.5``."""
    if text is None:
        return None
    clock = re.fullmatch(r"(?:(\d+):)?(\d+):(\d{1,2}(?:\.\d*)?)", text.strip())
    if clock is not None:
        hours, minutes, seconds = (float(part or 0) for part in clock.groups())
        return 3600 * hours + 60 * minutes + seconds
    try:
        return float(text)
    except ValueError:
        raise common.invalid(name, "be a time in seconds or as [H:]M:S, such as 750 or 12:30", text) from None


def parse_classes(text: str | None) -> list[str | int] | None:
    """Read names or numbers of classes."""
    if text is None:
        return None
    names = [name.strip() for name in text.split(",") if name.strip()]
    return [int(name) if name.isdecimal() else name for name in names]


def open_model(name: str, classes: str | None, device: Any) -> Any:
    """Load the model that the options name."""
    return vd.load_model(name, classes=parse_classes(classes), device=device)


def check_blur(region: str | None) -> None:
    """Check the region to blur before a model is loaded."""
    from vehicle_detection.drawing import BLUR_REGIONS

    if region is not None:
        common.check.choice(region, "--blur", BLUR_REGIONS)
