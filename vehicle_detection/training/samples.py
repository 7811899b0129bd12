"""Augmented training samples: labelled frames, moved, relit and partly covered, with their boxes.

Everything works on 8-bit images with OpenCV, so that a sample takes a few milliseconds of one core.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.training.frames import TrainingFrame

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]

GRAY = 115
"""Gray level outside the frame, which the network's normalization turns into 0."""

MIN_WIDTH, MIN_VISIBLE = 9.0, 0.3
"""A vehicle of a sample is narrower (px) or cut off further: neither vehicle nor background."""

# Zoom: this factor of the scale that shows the whole frame, to this one of the scale that fills the sample.
_ZOOM_OUT, _ZOOM_IN = 0.7, 1.8
# Largest part of a vehicle that a drawn rectangle may cover.
_MAX_COVERED = 0.6
# Standard deviations of noise in gray levels, and range of its random position in pixels.
_NOISE_LEVELS, _NOISE_SHIFT = (2.0, 4.0, 8.0, 14.0), 64
# How often the frames of a source are drawn, where it is not as often as others.
_SOURCE_WEIGHTS = {"rendered": 0.4}


class Sample(NamedTuple):
    """An augmented image, its vehicles, and its boxes that are neither vehicle nor background."""

    image: Image  # (H, W, 3) RGB
    boxes: Floats  # (N, 4)
    ignored: Floats  # (M, 4)


class Sampler:
    """Draws samples of a width and height from frames.

    A source is drawn in proportion to the square root of its size, frames with vehicles more often.
    """

    def __init__(self, frames: Sequence[TrainingFrame], size: tuple[int, int]) -> None:
        self._frames, self._size = frames, size
        counts = Counter(frame.source for frame in frames)
        weights = np.array(
            [
                _SOURCE_WEIGHTS.get(frame.source, 1.0)
                * (0.5 + math.sqrt(min(len(frame.boxes), 6)))
                / math.sqrt(counts[frame.source])
                for frame in frames
            ]
        )
        self.weights = weights / weights.sum()  # probability of each frame

    def draw(self, rng: np.random.Generator) -> Sample:
        """Draw one sample; it depends on the generator alone."""
        frame = self._frames[int(rng.choice(len(self._frames), p=self.weights))]
        matrix = _random_view(frame, self._size, rng)
        image = _warp(frame.image, matrix, self._size)
        boxes, visible = move_boxes(frame.boxes, matrix, self._size)
        ignored, ignored_visible = move_boxes(frame.ignored, matrix, self._size)
        covered = _cover(image, boxes, rng)
        usable = (visible > MIN_VISIBLE) & (boxes[:, 2] - boxes[:, 0] > MIN_WIDTH) & (covered < _MAX_COVERED)
        unclear = boxes[~usable & (visible > 0)]
        image = _change_light(image, rng)
        return Sample(image, boxes[usable], np.concatenate([ignored[ignored_visible > 0], unclear]))


def _random_view(frame: TrainingFrame, size: tuple[int, int], rng: np.random.Generator) -> Floats:
    """Draw the 2x3 matrix that maps the frame to the sample: zoom, aspect, rotation, mirroring, position."""
    height, width = frame.image.shape[:2]
    ratios = size[0] / width, size[1] / height
    zoom = math.exp(rng.uniform(math.log(min(ratios) * _ZOOM_OUT), math.log(max(ratios) * _ZOOM_IN)))
    aspect = math.exp(rng.uniform(-0.1, 0.1))
    angle = rng.uniform(-0.05, 0.05) if rng.random() < 0.3 else 0.0
    mirror = -1.0 if rng.random() < 0.5 else 1.0
    view = np.array(size) / zoom  # pixels of the frame that the sample shows
    if len(frame.boxes) and rng.random() < 0.35:  # keep a vehicle in view when the zoom is large
        box = frame.boxes[rng.integers(len(frame.boxes))]
        center = (box[:2] + box[2:]) / 2 + rng.uniform(-0.45, 0.45, 2) * view
    else:
        center = rng.uniform((0.0, 0.0), (width, height))
    # Show as much of the frame as fits.
    middle = np.array([width, height]) / 2
    spare = np.abs(middle - view / 2)
    center = np.clip(center, middle - spare, middle + spare)
    cos, sin = math.cos(angle), math.sin(angle)
    linear = np.array([[cos * mirror * aspect, -sin], [sin * mirror * aspect, cos]]) * zoom
    linear[:, 1] /= aspect
    return np.column_stack([linear, np.array(size) / 2 - linear @ center])


def _warp(image: Image, matrix: Floats, size: tuple[int, int]) -> Image:
    """Resample a frame; it is halved first where the sample reduces it, against aliasing."""
    zoom = math.sqrt(abs(np.linalg.det(matrix[:, :2])))
    while zoom < 0.7 and min(image.shape[:2]) > 32:
        height, width = image.shape[:2]
        image = np.asarray(cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA))
        scale = width / (width // 2), height / (height // 2)
        matrix = np.column_stack([matrix[:, :2] * scale, matrix[:, 2]])
        zoom *= 2
    # Boxes count from the corners of pixels, OpenCV from their centers.
    shift = matrix[:, :2] @ [0.5, 0.5] - 0.5
    moved = np.column_stack([matrix[:, :2], matrix[:, 2] + shift])
    border = (GRAY, GRAY, GRAY)
    return np.asarray(cv2.warpAffine(image, moved, size, flags=cv2.INTER_LINEAR, borderValue=border))


def move_boxes(boxes: Floats, matrix: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Map boxes with a 2x3 matrix; return them clipped to the sample, and the visible fraction of each."""
    corners = boxes[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2) @ matrix[:, :2].T + matrix[:, 2]
    whole = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    clipped = np.clip(whole, 0, np.array([*size, *size], np.float64))
    areas = [(each[:, 2:] - each[:, :2]).prod(axis=1) for each in (clipped, whole)]
    return clipped, areas[0] / np.maximum(areas[1], 1e-6)


def _cover(image: Image, boxes: Floats, rng: np.random.Generator) -> Floats:
    """Cover up to three rectangles with a color, often posts before vehicles; return what boxes lose."""
    covered = np.zeros(len(boxes))
    height, width = image.shape[:2]
    for _ in range(3):
        if rng.random() > 0.35:
            continue
        if len(boxes) and rng.random() < 0.6:
            box = boxes[rng.integers(len(boxes))]
            side = np.maximum(box[2:] - box[:2], 8) * rng.uniform((0.1, 0.3), (0.6, 1.6))
            center = rng.uniform(box[:2], box[2:])
        else:
            side, center = rng.uniform(10, (110, 140)), rng.uniform((0, 0), (width, height))
        x1, y1 = np.clip(center - side / 2, 0, (width, height)).astype(int)
        x2, y2 = np.clip(center + side / 2, 0, (width, height)).astype(int)
        image[y1:y2, x1:x2] = rng.integers(0, 256, 3) if rng.random() < 0.7 else rng.integers(0, 60)
        overlap = np.minimum(boxes[:, 2:], (x2, y2)) - np.maximum(boxes[:, :2], (x1, y1))
        areas = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
        covered += np.maximum(overlap, 0).prod(axis=1) / np.maximum(areas, 1e-6)
    return covered


@functools.cache
def _noise_fields(height: int, width: int) -> list[NDArray[np.int16]]:
    """Noise of each strength, drawn once because that takes longer than all other changes of an image."""
    rng = np.random.default_rng(0)
    shape = height, width, 3
    return [np.rint(rng.normal(0, level, shape)).astype(np.int16) for level in _NOISE_LEVELS]


def _change_light(image: Image, rng: np.random.Generator) -> Image:
    """Change gamma, contrast, brightness, saturation, color cast, fog, sharpness, noise and compression."""
    gamma = math.exp(rng.uniform(-0.5, 0.5))
    if rng.random() < 0.08:  # night
        gamma = rng.uniform(1.5, 2.5)
    levels = np.arange(256) / 255
    image = np.asarray(cv2.LUT(image, np.rint(255 * levels**gamma).astype(np.uint8)))
    saturation = 0.0 if rng.random() < 0.12 else rng.uniform(0.4, 1.5)
    contrast, brightness = rng.uniform(0.6, 1.4), rng.uniform(0.7, 1.3)
    fog = rng.uniform(0.2, 0.8) if rng.random() < 0.15 else 0.0
    mean = float(cv2.mean(cv2.resize(image, (32, 32)))[1])
    mix = np.full((3, 3), (1 - saturation) / 3) + saturation * np.eye(3)
    cast = 1 + rng.uniform(-0.12, 0.12, 3)
    linear = contrast * (1 - fog) * cast[:, None] * mix
    offset = cast * mean * (brightness - contrast) * (1 - fog) + fog * 255 * rng.uniform(0.5, 0.95)
    image = np.asarray(cv2.transform(image, np.column_stack([linear, offset])))
    if rng.random() < 0.25:
        if rng.random() < 0.3:  # motion
            image = np.asarray(cv2.blur(image, (int(rng.integers(2, 6)), 1)))
        else:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.3)))
    if rng.random() < 0.35:
        fields = _noise_fields(image.shape[0] + _NOISE_SHIFT, image.shape[1] + _NOISE_SHIFT)
        x, y = rng.integers(_NOISE_SHIFT, size=2)
        noise = fields[rng.integers(len(fields))][y : y + image.shape[0], x : x + image.shape[1]]
        image = np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U))
    if rng.random() < 0.12:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 70))]
        image = np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, quality)[1], cv2.IMREAD_COLOR))
    return image
