"""Frames of the explorer: by their names, kept in memory as far as it is worth it, and painted on."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_image, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.datasets import FrameSet
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.images import read_image

Image = NDArray[np.uint8]
Frames = Sequence[Image | str | os.PathLike[str]] | Mapping[str, Image | str | os.PathLike[str]] | FrameSet

Key = TypeVar("Key")
Value = TypeVar("Value")

# Score at which a window has the brightest colour.
_BRIGHTEST = 2.0


def named_sources(frames: object) -> dict[str, Callable[[], Image]]:
    """Name each frame and say how to get it; images are checked at once, files when they are read."""
    if isinstance(frames, FrameSet):
        return {name: _reader(frames.folder / name) for name in frames.names}
    if isinstance(frames, Mapping):
        pairs = [(str(name), frame) for name, frame in frames.items()]
    elif isinstance(frames, (list, tuple)):
        paths = [isinstance(frame, (str, os.PathLike)) for frame in frames]
        pairs = [
            (Path(frame).name if path else f"frame {number}", frame)
            for number, (frame, path) in enumerate(zip(frames, paths))
        ]
        if len({name for name, _ in pairs}) < len(pairs):
            pairs = [(str(frame) if path else name, frame) for (name, frame), path in zip(pairs, paths)]
    else:
        raise InvalidInputError(
            f"frames must be a list of images or paths, or a mapping from names to them; "
            f"got {describe(frames)}; wrap a single one in a list"
        )
    if not pairs:
        raise InvalidInputError("frames must hold at least one image; got none")
    return {
        name: _reader(frame) if isinstance(frame, (str, os.PathLike)) else _holder(frame, name)
        for name, frame in pairs
    }


def _reader(path: str | os.PathLike[str]) -> Callable[[], Image]:
    return lambda: read_image(path)


def _holder(image: object, name: str) -> Callable[[], Image]:
    checked = check_image(image, f"frames[{name!r}]")
    return lambda: checked


def remember(memory: OrderedDict[Key, Value], key: Key, make: Callable[[], Value], most: int) -> Value:
    """Return the value of a key, made if it is not known; the one unused for longest is forgotten."""
    if key not in memory:
        memory[key] = make()
        while len(memory) > most:
            memory.popitem(last=False)
    memory.move_to_end(key)
    return memory[key]


def _palette() -> Image:
    """Plasma from dark to bright, ``(256, 3)`` RGB."""
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.asarray(cv2.applyColorMap(ramp, cv2.COLORMAP_PLASMA)[:, 0, ::-1], np.uint8)


def put_windows(picture: Image, windows: Detections, shrink: float) -> None:
    """Draw windows by their scores into a picture, the best last."""
    order = np.argsort(windows.scores, kind="stable")
    levels = (windows.scores[order] * (255 / _BRIGHTEST)).clip(100, 255).astype(int)
    colors = _palette()[levels].tolist()
    for (x1, y1, x2, y2), color in zip((windows.boxes[order] * shrink).round().astype(int).tolist(), colors):
        cv2.rectangle(picture, (x1, y1), (x2 - 1, y2 - 1), color, 1)


def lay_heat(picture: Image, heat: NDArray[np.float32]) -> Image:
    """Blend heat over a copy of a picture, the stronger the hotter."""
    small = np.asarray(cv2.resize(heat, picture.shape[1::-1]), np.float32)
    peak = float(small.max())
    level = (small * (255 / peak if peak > 0 else 0)).clip(0, 255).astype(np.uint8)
    hot = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    return np.asarray(cv2.addWeighted(picture, 0.45, hot, 0.75, 0), np.uint8)
