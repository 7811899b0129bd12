"""The right word for a wrong one: commands, options and values that people try who know other tools."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from vehicle_detection.cli import common

_COMMANDS = {
    "track": "video", "process": "video", "annotate": "video", "run": "video", "stream": "video",
    "camera": "video", "predict": "detect", "image": "detect", "images": "detect", "find": "detect",
    "eval": "evaluate", "val": "evaluate", "test": "evaluate", "score": "evaluate", "download": "fetch",
    "finetune": "train-frames", "fine-tune": "train-frames", "show": "info", "model": "info",
    "version": "--version", "help": "--help",
}  # fmt: skip
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


def hint_option(word: str, params: Sequence[Any]) -> str:
    """Return what to write instead of an option that a command does not have; empty if that is unknown."""
    name = word.lstrip("-").lower().replace("-", "_")
    argument = next((str(param.metavar) for param in params if not param.opts[0].startswith("-")), "")
    if argument and name in ("source", *common.synonyms("source"), argument.lower()):
        return f"pass {argument} without an option"
    words: dict[str, tuple[Any, str]] = {}
    for param in params:
        if param.opts[0].startswith("-"):
            words |= dict.fromkeys(common.synonyms(param.name), (param, param.opts[0]))
    for param in params:
        words |= {each.lstrip("-").replace("-", "_"): (param, each) for each in param.opts if each[0] == "-"}
    close = [name] if name in words else difflib.get_close_matches(name, words, n=1, cutoff=0.75)
    return f"use {_usage(*words[close[0]])}" if close else ""


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
