"""Run commands in the tests, in this process or as programs."""

import re
import shlex
import sys

from typer.testing import CliRunner

from tests.helpers import rendered_patches, start_interruptible
from vehicle_detection.cli.app import app
from vehicle_detection.images import write_image

COMMANDS = ("demo", "detect", "video", "batch", "evaluate", "train", "train-frames", "tune", "fetch", "info")
HEADER = "frame,track_id,x1,y1,x2,y2,score"


def run(*words):
    """Run a command in this process; errors that it does not handle are raised here."""
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert "\x1b" not in result.output, "colors without a terminal"
    return result


def succeed(*words):
    result = run(*words)
    assert result.exit_code == 0, result.output
    return result.stdout


def refuse(*words, code=2):
    """Run a command that must fail with one line on standard error; return the line."""
    result = run(*words)
    assert result.exit_code == code, result.output
    assert re.fullmatch(r"error: [^\n]+\n", result.stderr), result.stderr
    return result.stderr


def start(*words, **options):
    return start_interruptible(sys.executable, "-m", "vehicle_detection", *words, **options)


def start_changed(code, *words):
    """Start a command in a program that runs some code first, such as one that replaces a function."""
    tail = "import sys; sys.argv[0] = 'vehicle-detection'; from vehicle_detection.cli import main; main()"
    return start_interruptible(sys.executable, "-c", f"{code}\n{tail}", *words)


def finish(process):
    out, errors = process.communicate(timeout=300)
    return process.returncode, out, errors


def contents(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def write_patches(folder, count):
    """Write patches of vehicles and others, for the options that `patches_of` returns."""
    for number, (patch, label) in enumerate(zip(*rendered_patches(count))):
        home = folder / ("vehicles" if label else "non-vehicles") / "drawn"
        home.mkdir(parents=True, exist_ok=True)
        write_image(home / f"{number}.png", patch)


def patches_of(folder):
    return ["--vehicles", folder / "vehicles", "--non-vehicles", folder / "non-vehicles"]


def refuse_each(command, cases, **files):
    """Run a command with each of some wrong words; the message must name the argument and the remedy.

    The words are a line, in which ``{name}`` stands for a file.
    """
    for line, message in cases.items():
        error = refuse(command, *shlex.split(line.format(**files)))
        assert re.search(message, error), (line, error)
