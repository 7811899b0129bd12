"""The right word for a wrong one: commands, options and values that people try who know other tools."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_COMMANDS = {
    "track": "video", "process": "video", "annotate": "video", "run": "video", "stream": "video",
    "camera": "video", "predict": "detect", "image": "detect", "images": "detect", "find": "detect",
    "eval": "evaluate", "val": "evaluate", "test": "evaluate", "score": "evaluate", "download": "fetch",
    "finetune": "train-frames", "fine-tune": "train-frames", "show": "info", "model": "info",
    "version": "--version", "help": "--help",
}  # fmt: skip
_OPTIONS = {
    "-o": "save save-path save-dir out output-dir output-file target dest project name o",
    "--model": "weights net network checkpoint m",
    "--conf": "confidence conf-thres conf-threshold threshold score-threshold min-conf min-score thresh",
    "--jobs": "workers threads n-jobs num-workers processes nproc cpus j",
    "--fov": "field-of-view hfov angle",
    "--every": "stride vid-stride skip step frame-skip interval frame-interval",
    "--device": "gpu cuda accelerator",
    "--camera-height": "height mount-height cam-height",
    "--camera": "lens calibration calib intrinsics",
    "--tracks": "csv save-txt json results mot export save-csv",
    "--boxes": "csv save-txt json results export save-csv",
    "--show": "view display view-img imshow gui window preview",
    "--units": "mph imperial miles metric unit",
    "--no-audio": "no-sound mute an",
    "--own-speed": "speed ego-speed",
    "--gpx": "gps nmea",
    "--labels": "label text hide-labels hide-conf no-labels",
    "--line-width": "thickness line-thickness linewidth",
    "--start": "begin from ss since",
    "--end": "to until stop duration t",
    "--quiet": "silent no-progress",
    "--blur": "anonymize privacy hide-plates",
    "--classes": "class filter-classes class-ids",
}
_INPUT = "source src input images image video file path i"
"""Options of other tools for what is an argument here."""
_VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".m4v", ".webm", ".ts")
_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".heic")


def hint_command(word: str, commands: Iterable[str]) -> str:
    """Return what to write instead of a command that does not exist; empty if that is unknown."""
    suffix = Path(word).suffix.lower()
    if suffix in _VIDEO_SUFFIXES or word.isdecimal() or "://" in word:
        return f"use vehicle-detection video {word}"
    if suffix in _IMAGE_SUFFIXES or Path(word).is_dir():
        return f"use vehicle-detection detect {word}"
    close = difflib.get_close_matches(word, commands, n=1)
    found = _COMMANDS.get(word.lower()) or (close[0] if close else "")
    return f"use {found}" if found else f"the commands are {', '.join(commands)}"


def hint_option(word: str, params: Iterable[Any]) -> str:
    """Return what to write instead of an option that a command does not have; empty if that is unknown."""
    options = {name: param for param in params for name in param.opts if name.startswith("-")}
    name = word.lstrip("-").lower().replace("_", "-")
    metavar = next((str(param.metavar) for param in params if not param.opts[0].startswith("-")), "")
    if metavar and name in (*_INPUT.split(), metavar.lower()):
        return f"pass {metavar} without an option"
    words = {
        each: option for option, listed in _OPTIONS.items() if option in options for each in listed.split()
    }
    words |= {option.lstrip("-"): option for option in options}
    close = [name] if name in words else difflib.get_close_matches(name, words, n=1, cutoff=0.75)
    return f"use {_usage(options[words[close[0]]], words[close[0]])}" if close else ""


def hint_value(param: Any) -> str:
    """Return an option or argument with its value and its help, which has an example."""
    option = param.opts[-1]
    help_text = " ".join(str(getattr(param, "help", None) or "").split()).rstrip(".")
    return f"{_usage(param, option)}: {help_text}" if help_text else ""


def _usage(param: Any, option: str) -> str:
    """Name of an option with what its value is called."""
    metavar = "" if getattr(param, "is_flag", False) else str(param.metavar or "")
    if not option.startswith("-"):
        return metavar
    return re.sub(r"\s+", " ", f"{option} {metavar}").strip()
