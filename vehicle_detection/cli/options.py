"""Options that several commands have."""

from __future__ import annotations

from typing import Annotated

from typer import Option

Model = Annotated[
    str, Option(metavar="NAME|FILE", help='"default" (any road), "highway" (fastest), or a model file.')
]
LineWidth = Annotated[
    int | None,
    Option("--line-width", metavar="N", help="Width of the boxes in pixels; default: by size of the frame."),
]
Confidence = Annotated[
    float | None,
    Option(
        metavar="P", help="Minimum confidence, a probability from 0 to 1; default: the model's threshold."
    ),
]
CameraFile = Annotated[
    str | None,
    Option(
        metavar="NAME|FILE",
        help="standard-58, wide-90, fisheye-120, fisheye-140, fisheye-170 (typical lenses), or a JSON file.",
    ),
]
FieldOfView = Annotated[
    float | None,
    Option("--fov", metavar="DEG", help="Horizontal field of view in degrees, such as 90; default: 58."),
]
CameraHeight = Annotated[
    float | None,
    Option("--camera-height", metavar="M", help="Height of the lens above the road in meters; default: 1.3."),
]
Blur = Annotated[
    str | None,
    Option(metavar="R", help='Blur "vehicles" or the region of their "plates" in what is written.'),
]
HORIZON_HELP = "Height of the horizon as a fraction of the frame's height, 0 at the top."
Every = Annotated[
    int | None,
    Option(metavar="N", help="Search every N-th frame, interpolate between; default: 12 a second."),
]
Preset = Annotated[str, Option(metavar="P", help="Encoder speed, ultrafast to placebo.")]
NoAudio = Annotated[bool, Option("--no-audio", help="Write no sound.")]
