"""Augmented training samples: labelled frames, moved, mixed, partly covered and relit, with their boxes.

What happens to a sample is drawn with NumPy, for a whole batch at once. Its pixels are computed on the device
of the training, so that a graphics card does not wait for the processor.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - PyTorch's convention
from numpy.typing import NDArray
from torch import Tensor

from vehicle_detection.training.architecture import CENTER
from vehicle_detection.training.frames import TrainingFrame
from vehicle_detection.training.loss import Targets

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Rng = np.random.Generator

NO_BOX, IGNORED, VEHICLE = range(3)
"""Kinds of boxes: padding, neither vehicle nor background, and vehicle."""

MIN_WIDTH, MIN_VISIBLE = 8.0, 0.3
"""A vehicle of a sample is narrower (px) or cut off further: neither vehicle nor background."""

# Zoom: this factor of the scale that shows the whole frame, to this one of the scale that fills the sample.
_ZOOM_OUT, _ZOOM_IN = 0.65, 1.8
# A vehicle is enlarged to this part of the sample, at most by this factor.
_LARGE, _MAX_ZOOM = (0.35, 1.1), 3.0
# Largest part of a vehicle that rectangles may cover.
_MAX_COVERED = 0.6
# Rectangles of one color in a sample, at most.
_COVERS = 3
# How often the frames of a source are drawn, where it is not as often as others.
_SOURCE_WEIGHTS = {"rendered": 0.4}
# Length of the kernels of blurs (px).
_KERNEL = 7


class Sampler:
    """Draws batches of samples of a width and height from frames.

    A source is drawn in proportion to the square root of its size, frames with vehicles more often.
    """

    def __init__(self, frames: Sequence[TrainingFrame], size: tuple[int, int], device: torch.device) -> None:
        self._size, self._device = size, device
        images = [np.require(frame.image, requirements=("C", "W")) for frame in frames]
        memory = torch.cuda.mem_get_info(device.index)[0] if device.type == "cuda" else 0
        # Frames that leave too little memory for the training are copied to the device when they are drawn.
        place = device if sum(image.nbytes for image in images) < 0.3 * memory else torch.device("cpu")
        self._images = [torch.from_numpy(image).to(place) for image in images]
        self._sizes = np.array([frame.image.shape[1::-1] for frame in frames], np.float64)
        self._counts = np.array([len(frame.boxes) for frame in frames])
        # All boxes of a frame, vehicles first, padded to the same number.
        most = max(1, *(len(frame.boxes) + len(frame.ignored) for frame in frames))
        self._boxes, self._kinds = np.zeros((len(frames), most, 4)), np.full((len(frames), most), NO_BOX)
        for row, frame in enumerate(frames):
            boxes = np.concatenate([frame.boxes, frame.ignored])
            self._boxes[row, : len(boxes)] = boxes
            self._kinds[row, : len(boxes)] = IGNORED
            self._kinds[row, : len(frame.boxes)] = VEHICLE
        numbers = Counter(frame.source for frame in frames)
        rates = [_SOURCE_WEIGHTS.get(each.source, 1.0) / math.sqrt(numbers[each.source]) for each in frames]
        weights = rates * (0.5 + np.sqrt(np.minimum(self._counts, 6)))
        self.weights = weights / weights.sum()  # probability of each frame

    def draw(self, rng: Rng, count: int) -> tuple[Tensor, Targets]:
        """Draw uint8 RGB images ``(count, height, width, 3)`` and their boxes; they depend on `rng` alone."""
        rows = rng.choice(len(self._images), count, p=self.weights)
        views = self._random_views(rows, rng)
        boxes, visible = move_boxes(self._boxes[rows], views, self._size)
        covers = _random_covers(boxes, (visible > 0) & (self._kinds[rows] == VEHICLE), self._size, rng)
        covered = sum(_overlaps(boxes, covers[:, [i]]) for i in range(_COVERS))
        kinds = _judge(self._kinds[rows], boxes, visible, covered)
        # Each sample may show a part of the one before it, if that is another one.
        before, kinds_before = np.roll(boxes, 1, 0), np.roll(kinds, 1, 0)
        parts = _random_parts(before, kinds_before == VEHICLE, self._size, rng)
        added, inside = clip_boxes(before, parts)
        kept = _judge(kinds, boxes, visible, covered + _overlaps(boxes, parts[:, None]))
        kinds = np.concatenate([kept, _judge(kinds_before, added, inside * np.roll(visible, 1, 0))], axis=1)
        boxes = np.concatenate([boxes, added], axis=1)
        image = self._warp(rows, views)
        for i in range(_COVERS):
            # A third of the colors are dark.
            colors = rng.uniform(0, 255, (count, 3)) * np.where(rng.random((count, 1)) < 0.3, 0.25, 1.0)
            image = self._paint(image, covers[:, i], self._tensor(colors)[:, :, None, None])
        image = self._paint(image, parts, image.roll(1, 0))
        image = self._change_light(image, rng).round_().clamp_(0, 255).byte().permute(0, 2, 3, 1)
        (vehicles, exists), (ignored, _) = (_compact(boxes, kinds == kind) for kind in (VEHICLE, IGNORED))
        return image, Targets(self._tensor(vehicles), self._tensor(exists), self._tensor(ignored))

    def _tensor(self, values: NDArray[np.generic]) -> Tensor:
        """Copy an array to the device, floats as float32."""
        kind = values.dtype if values.dtype == np.bool_ else np.float32
        tensor = torch.from_numpy(np.ascontiguousarray(values, kind))
        if self._device.type == "cuda":
            tensor = tensor.pin_memory()
        return tensor.to(self._device, non_blocking=True)

    def _random_views(self, rows: NDArray[np.intp], rng: Rng) -> Floats:
        """Draw the 2x3 matrices that map frames to samples: zoom, aspect, rotation, mirroring, position."""
        n, size, sizes = len(rows), np.array(self._size, np.float64), self._sizes[rows]
        ratios = size / sizes
        zoom = np.exp(rng.uniform(np.log(ratios.min(1) * _ZOOM_OUT), np.log(ratios.max(1) * _ZOOM_IN)))
        box = self._boxes[rows, (rng.random(n) * self._counts[rows]).astype(int)]
        choice = np.where(self._counts[rows] > 0, rng.random(n), 1.0)
        # Enlarge a vehicle; or keep one in view when the zoom is large.
        large = rng.uniform(*_LARGE, n) * (size / np.maximum(box[:, 2:] - box[:, :2], 1.0)).min(1)
        zoom = np.where(choice < 0.12, np.clip(large, zoom, ratios.max(1) * _MAX_ZOOM), zoom)
        view = size / zoom[:, None]  # pixels of the frame that the sample shows
        center = (box[:, :2] + box[:, 2:]) / 2 + rng.uniform(-0.45, 0.45, (n, 2)) * view
        center = np.where(choice[:, None] < 0.4, center, rng.uniform(0, sizes))
        # Show as much of the frame as fits.
        spare = np.abs(sizes - view) / 2
        center = np.clip(center, sizes / 2 - spare, sizes / 2 + spare)
        angle = np.where(rng.random(n) < 0.3, rng.uniform(-0.05, 0.05, n), 0.0)
        cos, sin, mirror = np.cos(angle), np.sin(angle), np.where(rng.random(n) < 0.5, -1.0, 1.0)
        aspect = np.exp(rng.uniform(-0.1, 0.1, n))
        first = np.stack([cos * mirror * aspect, sin * mirror * aspect], 1)
        second = np.stack([-sin, cos], 1) / aspect[:, None]
        linear = np.stack([first, second], 2) * zoom[:, None, None]
        return np.concatenate([linear, size[:, None] / 2 - linear @ center[..., None]], axis=2)

    def _warp(self, rows: NDArray[np.intp], views: Floats) -> Tensor:
        """Resample frames; one is halved first where the sample reduces it, against aliasing."""
        width, height = self._size
        # From the sample to the frame, both from -1 to 1.
        inverse = np.linalg.inv(views[:, :, :2])
        offset = -inverse @ views[:, :, 2:]
        sizes, size = self._sizes[rows][:, :, None], np.array(self._size, np.float64)
        linear = inverse * size / sizes
        moved = 2 * (inverse @ (size[:, None] / 2) + offset) / sizes - 1
        theta = self._tensor(np.concatenate([linear, moved], axis=2))
        grids = F.affine_grid(theta, [len(rows), 3, height, width], align_corners=False)
        zooms = np.sqrt(np.abs(np.linalg.det(views[:, :, :2])))
        samples = []
        for row, zoom, grid in zip(rows, zooms, grids):
            image = self._images[row].to(self._device).permute(2, 0, 1)[None].float() - CENTER
            while zoom < 0.7 and min(image.shape[2:]) > 32:
                half = image.shape[2] // 2, image.shape[3] // 2
                # Means of 2x2 pixels, for even sides; the mode "area" takes thrice as long for the same.
                image, zoom = F.interpolate(image, half, mode="bilinear"), zoom * 2
            samples.append(F.grid_sample(image, grid[None], align_corners=False))
        return torch.cat(samples).add_(CENTER)

    def _paint(self, image: Tensor, rectangles: Floats, source: Tensor) -> Tensor:
        """Copy a rectangle of each sample from other images or colors; empty ones copy nothing."""
        chosen = np.flatnonzero((rectangles[:, 2:] > rectangles[:, :2]).all(axis=1))
        x1, y1, x2, y2 = self._tensor(rectangles[chosen]).round()[:, :, None, None, None].unbind(1)
        x = torch.arange(self._size[0], device=self._device)
        y = torch.arange(self._size[1], device=self._device)[:, None]
        inside = (x >= x1) & (x < x2) & (y >= y1) & (y < y2)
        rows = torch.from_numpy(chosen).to(self._device)
        image[rows] = torch.where(inside, source[rows], image[rows])
        return image

    def _change_light(self, image: Tensor, rng: Rng) -> Tensor:
        """Change gamma, contrast, brightness, saturation, color cast, fog, sharpness, noise, compression."""
        n = len(image)
        # 8% of the samples become night.
        gamma = np.where(rng.random(n) < 0.08, rng.uniform(1.5, 2.5, n), np.exp(rng.uniform(-0.5, 0.5, n)))
        saturation = np.where(rng.random(n) < 0.12, 0.0, rng.uniform(0.4, 1.5, n))
        contrast, brightness = rng.uniform(0.6, 1.4, n), rng.uniform(0.7, 1.3, n)
        fog = np.where(rng.random(n) < 0.15, rng.uniform(0.2, 0.8, n), 0.0)
        cast = 1 + rng.uniform(-0.12, 0.12, (n, 3))
        mix = (1 - saturation[:, None, None]) / 3 + saturation[:, None, None] * np.eye(3)
        linear = (contrast * (1 - fog))[:, None, None] * cast[:, :, None] * mix
        slope = (brightness - contrast)[:, None] * (1 - fog)[:, None] * cast  # times the mean gray level
        haze = fog * 255 * rng.uniform(0.5, 0.95, n)
        image = (image.clamp_(0, 255) / 255).pow_(self._tensor(gamma)[:, None, None, None])  # from 0 to 1
        mean = 255 * image[:, 1].mean((1, 2))[:, None]
        offset = self._tensor(slope) * mean + self._tensor(haze)[:, None]
        image = torch.einsum("nij,njhw->nihw", self._tensor(255 * linear), image)
        image = image.add_(offset[:, :, None, None]).clamp_(0, 255)
        for chosen, change in (
            (rng.random(n) < 0.25, self._blur),
            (rng.random(n) < 0.12, self._reduce),
            (rng.random(n) < 0.35, self._add_noise),
            (rng.random(n) < 0.2, self._compress),
        ):
            rows = torch.from_numpy(np.flatnonzero(chosen)).to(self._device)
            if len(rows):
                image[rows] = change(image[rows], rng)
        return image

    def _blur(self, image: Tensor, rng: Rng) -> Tensor:
        """Defocus images, or move them sideways while they are exposed."""
        n, at = len(image), np.arange(_KERNEL) - _KERNEL // 2
        round_kernel = np.exp(-0.5 * (at / rng.uniform(0.4, 1.4, (n, 1))) ** 2)
        is_motion = rng.random((n, 1)) < 0.3
        across = np.where(is_motion, np.abs(at) <= rng.integers(1, _KERNEL // 2 + 1, (n, 1)), round_kernel)
        down = np.where(is_motion, at == 0, round_kernel)
        for kernel, shape in (across, (1, _KERNEL)), (down, (_KERNEL, 1)):
            weights = self._tensor(kernel / kernel.sum(1, keepdims=True)).repeat_interleave(3, 0)
            weights = weights.reshape(3 * n, 1, *shape)
            y, x = shape[0] // 2, shape[1] // 2
            padded = F.pad(image, (x, x, y, y), mode="replicate").flatten(0, 1)[None]
            image = F.conv2d(padded, weights, groups=3 * n).reshape(image.shape)
        return image

    def _reduce(self, image: Tensor, rng: Rng) -> Tensor:
        """Enlarge images from fewer pixels, as a camera of a lower resolution has."""
        scale = rng.uniform(0.45, 0.85)
        # A rounded size with the scale as it is would move pixels against their boxes.
        small = F.interpolate(
            image, scale_factor=scale, mode="bilinear", antialias=True, recompute_scale_factor=True
        )
        return F.interpolate(small, image.shape[2:], mode="bilinear")

    def _add_noise(self, image: Tensor, rng: Rng) -> Tensor:
        generator = torch.Generator(self._device).manual_seed(int(rng.integers(1 << 62)))
        level = self._tensor(rng.choice([2.0, 4.0, 8.0, 14.0], len(image)))
        noise = torch.randn(image.shape, generator=generator, device=self._device)
        return (image + noise * level[:, None, None, None]).clamp(0, 255)

    def _compress(self, image: Tensor, rng: Rng) -> Tensor:
        """Round the frequencies of blocks of 8x8 pixels, high ones more coarsely, as JPEG does."""
        at = np.arange(8)
        cosines = np.cos(np.pi * (2 * at + 1) * at[:, None] / 16) / 2
        cosines[0] /= math.sqrt(2)
        transform = self._tensor(cosines)
        steps = self._tensor((10 + 6 * (at + at[:, None])) * rng.uniform(0.6, 2.2, (len(image), 1, 1)))
        height, width = image.shape[2:]
        blocks = image.reshape(-1, 3, height // 8, 8, width // 8, 8).transpose(3, 4)
        waves = transform @ (blocks - 128) @ transform.T
        steps = steps[:, None, None, None]
        blocks = transform.T @ ((waves / steps).round() * steps) @ transform + 128
        return blocks.transpose(3, 4).reshape(image.shape).clamp(0, 255)


def _judge(
    kinds: NDArray[np.int_], boxes: Floats, visible: Floats, covered: Floats | float = 0.0
) -> NDArray[np.int_]:
    """Kinds of boxes of which a fraction is in view and another one is covered."""
    is_clear = (visible > MIN_VISIBLE) & (covered < _MAX_COVERED)
    is_clear &= boxes[..., 2] - boxes[..., 0] > MIN_WIDTH
    kinds = np.where((kinds == VEHICLE) & ~is_clear, IGNORED, kinds)
    return np.where(visible > 0, kinds, NO_BOX)


def _compact(boxes: Floats, exists: Bools) -> tuple[Floats, Bools]:
    """Move existing boxes to the front, and drop columns that no sample needs; the others are empty."""
    order = np.argsort(~exists, axis=1, kind="stable")[:, : max(1, exists.sum(axis=1).max())]
    kept: Bools = np.asarray(np.take_along_axis(exists, order, 1), np.bool_)
    return np.take_along_axis(boxes, order[..., None], 1) * kept[..., None], kept


def move_boxes(boxes: Floats, views: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Map boxes ``(n, m, 4)`` with matrices ``(n, 2, 3)``; clip them, and return their visible fractions."""
    corners = boxes[..., [0, 1, 2, 1, 2, 3, 0, 3]].reshape(*boxes.shape[:2], 4, 2)
    corners = corners @ views[:, None, :, :2].swapaxes(2, 3) + views[:, None, None, :, 2]
    moved = np.concatenate([corners.min(axis=2), corners.max(axis=2)], axis=2)
    moved *= (boxes[..., 2:] > boxes[..., :2]).all(2, keepdims=True)  # padding stays empty
    return clip_boxes(moved, np.tile((0.0, 0.0, *size), (len(boxes), 1)))


def clip_boxes(boxes: Floats, windows: Floats) -> tuple[Floats, Floats]:
    """Clip boxes ``(n, m, 4)`` to a window of each sample; return also the fraction of each inside it."""
    low, high = windows[:, None, [0, 1, 0, 1]], windows[:, None, [2, 3, 2, 3]]
    clipped = np.clip(boxes, low, high)
    return clipped, _areas(clipped) / np.maximum(_areas(boxes), 1e-6)


def _areas(boxes: Floats) -> Floats:
    return np.asarray((boxes[..., 2:] - boxes[..., :2]).prod(axis=-1))


def _overlaps(boxes: Floats, others: Floats) -> Floats:
    """Fraction of each box ``(n, m, 4)`` that one other box of its sample ``(n, 1, 4)`` covers."""
    size = np.minimum(boxes[..., 2:], others[..., 2:]) - np.maximum(boxes[..., :2], others[..., :2])
    return np.asarray(np.maximum(size, 0).prod(axis=-1) / np.maximum(_areas(boxes), 1e-6))


def _choose(boxes: Floats, exists: Bools, rng: Rng) -> tuple[Floats, Bools]:
    """Choose one of the existing boxes of each sample, and say whether there is one."""
    chosen = np.where(exists, rng.random(exists.shape), -1.0).argmax(axis=1)
    return boxes[np.arange(len(boxes)), chosen], np.asarray(exists.any(axis=1))


def _random_covers(boxes: Floats, shown: Bools, size: tuple[int, int], rng: Rng) -> Floats:
    """Draw up to three rectangles of each sample, often posts before vehicles; empty ones cover nothing."""
    covers = np.zeros((len(boxes), _COVERS, 4))
    for i in range(_COVERS):
        box, exists = _choose(boxes, shown, rng)
        n, is_post = len(box), (exists & (rng.random(len(box)) < 0.6))[:, None]
        side = np.maximum(box[:, 2:] - box[:, :2], 8) * rng.uniform((0.1, 0.3), (0.6, 1.6), (n, 2))
        side = np.where(is_post, side, rng.uniform(10, (110, 140), (n, 2)))
        center = np.where(is_post, rng.uniform(box[:, :2], box[:, 2:]), rng.uniform((0, 0), size, (n, 2)))
        cover = np.concatenate([center - side / 2, center + side / 2], axis=1)
        covers[:, i] = np.clip(cover, 0, (*size, *size)) * (rng.random((n, 1)) < 0.35)
    return covers


def _random_parts(boxes: Floats, exists: Bools, size: tuple[int, int], rng: Rng) -> Floats:
    """Draw the part of another sample that each second one shows: a vehicle of it, or any part."""
    n, whole = len(boxes), np.array(size, np.float64)
    box, found = _choose(boxes, exists, rng)
    margin = rng.uniform(0, 0.15, (n, 4)) * np.tile(box[:, 2:] - box[:, :2], 2) * (-1, -1, 1, 1)
    side, center = rng.uniform(0.3, (0.7, 1.0), (n, 2)) * whole, rng.uniform(0, 1, (n, 2)) * whole
    free = np.concatenate([center - side / 2, center + side / 2], axis=1)
    part = np.where((found & (rng.random(n) < 0.5))[:, None], box + margin, free)
    return np.asarray(np.clip(part, 0, (*size, *size)) * ((rng.random((n, 1)) < 0.5) & (n > 1)))
