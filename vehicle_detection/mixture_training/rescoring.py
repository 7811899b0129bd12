"""Train the rescorer, a small convolutional network, on the boxes that the templates propose.

Plain gradient descent with numpy: the network is small, and nothing more needs to be installed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, relight
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.mixture import (
    EDGE_OFFSET,
    KERNEL,
    MIRROR_ORDER,
    N_CHANNELS,
    N_INPUTS,
    STRIDES,
    EdgePyramid,
    Layer,
    MixtureSearch,
    Network,
    Rescorer,
    inputs_after,
    rescoring_inputs,
)
from vehicle_detection.mixture_training.negatives import is_negative
from vehicle_detection.mixture_training.positives import jitter_boxes
from vehicle_detection.mixture_training.sources import TrainingFrame
from vehicle_detection.params import MixtureParams, PyramidParams

Singles = NDArray[np.float32]

_NETWORKS = 2  # that are trained, and averaged
_OUTPUTS = (32, 48, 64, 64, 5)  # of the layers
_EPOCHS, _BATCH, _DROPOUT = 16, 256, 0.3
_MIN_STEPS = 40  # of an epoch; with few samples batches are smaller
# Largest step of the optimizer, the share of the steps in which it rises, and the decay of the weights.
_RATE, _WARMUP, _DECAY = 2e-3, 0.2, 1e-3
# Weight of the shifts in the loss, and the error from which on they count linearly.
_BOX_WEIGHT, _SMOOTH = 1.0, 0.05
# IoU from which on a proposed box is positive, and range of IoU in which a jittered box is negative.
_MIN_POSITIVE_IOU, _NEGATIVE_IOU = 0.5, (0.1, 0.4)
# Positive copies of a labelled box and their jitter, negatives beside each box, and the narrowest label.
_COPIES, _JITTER_SCALE, _BESIDE, _MIN_WIDTH = 2, 0.12, 2, 20.0
# Minimum margin and greatest number of the proposals in a frame to train on; more do not help.
_MIN_MARGIN, _MAX_PROPOSALS = -1.3, 60
_MAX_SHIFT = 0.6  # of an edge of a positive box, as a fraction of the box's side
# Random contrast of edges and saturation of colors (standard deviations of their logarithms), and tint.
_CONTRAST, _SATURATION, _TINT = 0.25, 0.4, 0.1

_MIRROR = np.concatenate([MIRROR_ORDER, np.arange(len(MIRROR_ORDER), N_INPUTS)])


@dataclass(frozen=True, eq=False)
class Samples:
    """Crops to train on, as columns."""

    inputs: Singles  # (23, N, 12, 12)
    is_vehicle: NDArray[np.bool_]  # (N,)
    shifts: Singles  # (N, 4), of the edges of the positive boxes, as fractions of their sides

    @classmethod
    def join(cls, parts: Sequence[Samples]) -> Samples:
        """Concatenate samples."""
        return cls(
            np.concatenate([part.inputs for part in parts], axis=1),
            np.concatenate([part.is_vehicle for part in parts]),
            np.concatenate([part.shifts for part in parts]),
        )


def train_rescorer(
    frames: Sequence[TrainingFrame],
    search: MixtureSearch,
    params: MixtureParams,
    rng: np.random.Generator,
    pool: ThreadPoolExecutor,
) -> Rescorer | None:
    """Train a rescorer on the boxes that a search proposes; None if one of the classes has no sample."""
    seeds = rng.integers(2**32, size=len(frames)).tolist()

    def sample(frame: TrainingFrame, seed: int) -> list[Samples]:
        generator = np.random.default_rng(seed)
        relit = [relight(frame.image, generator)] if len(frame.boxes) else []
        return [_sample(image, frame, search, params, generator) for image in (frame.image, *relit)]

    samples = Samples.join([part for parts in pool.map(sample, frames, seeds) for part in parts])
    if samples.is_vehicle.all() or not samples.is_vehicle.any():
        return None
    networks = pool.map(partial(fit_network, samples), rng.spawn(_NETWORKS))
    return Rescorer(tuple(networks), params.blend_weight)


def _sample(
    image: NDArray[np.uint8],
    frame: TrainingFrame,
    search: MixtureSearch,
    params: MixtureParams,
    rng: np.random.Generator,
) -> Samples:
    """Crops of a frame, or of its relit copy `image`."""
    positives, negatives = sample_boxes(image, frame, search, params, rng)
    boxes = np.concatenate([positives, negatives])
    shifts = np.zeros((len(boxes), 4), np.float32)
    if len(positives):
        labels = frame.boxes[iou_matrix(positives, frame.boxes).argmax(axis=1)]
        shifts[: len(positives)] = (labels - positives) / np.tile(positives[:, 2:] - positives[:, :2], 2)
    inputs = np.ascontiguousarray(rescoring_inputs(EdgePyramid(image), boxes).transpose(1, 3, 0, 2))
    is_vehicle = np.arange(len(boxes)) < len(positives)
    return Samples(inputs, is_vehicle, shifts.clip(-_MAX_SHIFT, _MAX_SHIFT))


def sample_boxes(
    image: NDArray[np.uint8],
    frame: TrainingFrame,
    search: MixtureSearch,
    params: MixtureParams,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Positive boxes (proposals on vehicles, shifted labels) and negatives (other proposals, parts)."""
    _, windows = search.score_windows(image, PyramidParams(min_width=params.search.min_width))
    proposals, _ = search.model.propose_boxes(
        EdgePyramid(image), windows, min_margin=_MIN_MARGIN, max_boxes=_MAX_PROPOSALS
    )
    right = iou_matrix(proposals, frame.boxes).max(axis=1, initial=0) >= _MIN_POSITIVE_IOU
    wrong = is_negative(proposals, frame) & ~right
    wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= _MIN_WIDTH]
    copies = np.tile(wide, (_COPIES, 1))
    copies += rng.uniform(-1, 1, copies.shape) * _JITTER_SCALE * np.tile(copies[:, 2:] - copies[:, :2], 2)
    beside = jitter_boxes(np.tile(wide, (2 * _BESIDE, 1)), rng)
    overlap = iou_matrix(beside, frame.boxes).max(axis=1, initial=0)
    beside = beside[(overlap > _NEGATIVE_IOU[0]) & (overlap < _NEGATIVE_IOU[1])][: _BESIDE * len(wide)]
    return np.concatenate([copies, proposals[right]]), np.concatenate([proposals[wrong], beside])


def fit_network(samples: Samples, rng: np.random.Generator) -> Network:
    """Minimize the logistic loss and the error of the shifts: AdamW (Loshchilov and Hutter, ICLR 2019).

    Half of the crops of a batch are mirrored, their contrast and colors vary, and some values of the dense
    layers are dropped out (Srivastava et al., "Dropout", JMLR 2014).
    """
    values = _initial_values(rng)
    means, squares = ([np.zeros_like(value) for value in values] for _ in range(2))
    count = len(samples.is_vehicle)
    batch = min(_BATCH, max(count // _MIN_STEPS, 1))
    steps = _EPOCHS * (count // batch)
    for step, rows in enumerate(_batches(count, batch, rng), 1):
        gradients = _gradients(values, _vary(_draw(samples, rows, rng), rng), rng)
        # The rate rises linearly, then falls like a cosine.
        progress = step / steps
        rising = progress / _WARMUP
        falling = 0.5 * (1 + np.cos(np.pi * (progress - _WARMUP) / (1 - _WARMUP)))
        rate = _RATE * (rising if progress < _WARMUP else falling)
        for value, gradient, mean, square in zip(values, gradients, means, squares):
            mean += 0.1 * (gradient - mean)
            square += 0.001 * (gradient * gradient - square)
            corrected = mean / (1 - 0.9**step)
            value *= np.float32(1 - rate * _DECAY * (value.ndim == 2))
            value -= np.float32(rate) * corrected / (np.sqrt(square / (1 - 0.999**step)) + np.float32(1e-8))
    return Network(tuple(Layer(weights, bias) for weights, bias in zip(values[::2], values[1::2])))


def _initial_values(rng: np.random.Generator) -> list[Singles]:
    """Small random weights and biases of each layer (LeCun et al., "Efficient backprop", 1998)."""
    values: list[Singles] = []
    inputs = KERNEL**2 * N_INPUTS
    for number, outputs in enumerate(_OUTPUTS):
        limit = 1 / np.sqrt(inputs)
        shapes = (outputs, inputs), (outputs,)
        values += [rng.uniform(-limit, limit, shape).astype(np.float32) for shape in shapes]
        inputs = inputs_after(number, outputs)
    return values


def _batches(count: int, batch: int, rng: np.random.Generator) -> Iterator[NDArray[np.intp]]:
    for _ in range(_EPOCHS):
        order = rng.permutation(count)
        for start in range(0, count - batch + 1, batch):
            yield order[start : start + batch]


def _draw(samples: Samples, rows: NDArray[np.intp], rng: np.random.Generator) -> Samples:
    """Take some samples, half of them mirrored."""
    inputs, shifts = samples.inputs[:, rows], samples.shifts[rows].copy()
    mirrored = np.flatnonzero(rng.random(len(rows)) < 0.5)
    inputs[:, mirrored] = inputs[_MIRROR][:, mirrored, :, ::-1]
    shifts[mirrored] = shifts[mirrored][:, [2, 1, 0, 3]] * np.array([-1, 1, -1, 1], np.float32)
    return Samples(inputs, samples.is_vehicle[rows], shifts)


def _vary(batch: Samples, rng: np.random.Generator) -> Samples:
    """Vary the contrast of the crops' edges, and the saturation and tint of their colors."""

    def draw(std: float, *shape: int) -> Singles:
        return rng.normal(0, std, (*shape, len(batch.is_vehicle), 1, 1)).astype(np.float32)

    edges, lightness, colors = np.split(batch.inputs, [N_CHANNELS, N_CHANNELS + 1])
    edges = (edges - np.float32(EDGE_OFFSET)) * np.exp(draw(_CONTRAST, 1)) + np.float32(EDGE_OFFSET)
    colors = colors * np.exp(draw(_SATURATION, 2)) + draw(_TINT, 2)
    return replace(batch, inputs=np.concatenate([edges, lightness, colors]))


def _gradients(values: list[Singles], batch: Samples, rng: np.random.Generator | None) -> list[Singles]:
    """Gradients of the loss by backpropagation; without a generator nothing is dropped out."""
    weights, biases = values[::2], values[1::2]
    columns: list[Singles] = []
    kept: list[Singles] = []
    shapes: list[tuple[int, ...]] = []
    current = batch.inputs
    for number, (weight, bias) in enumerate(zip(weights, biases)):
        shapes.append(current.shape)
        if number < len(STRIDES):
            unfolded, shape = _unfold(current, STRIDES[number])
        else:
            unfolded = current
        columns.append(unfolded)
        current = weight @ unfolded + bias[:, None]
        if number + 1 < len(weights):
            # What passes: positive outputs, of which some are dropped in the dense part.
            mask = (current > 0).astype(np.float32)
            if rng is not None and number >= len(STRIDES) - 1:
                mask *= (rng.random(mask.shape, np.float32) >= _DROPOUT) / np.float32(1 - _DROPOUT)
            kept.append(mask)
            current = current * mask
        if number < len(STRIDES):
            current = current.reshape(-1, *shape)
        if number + 1 == len(STRIDES):
            last_shape = current.shape
            channels, count, rows, wide = current.shape
            current = current.transpose(0, 2, 3, 1).reshape(channels * rows * wide, count)
    gradient = _loss_gradient(current, batch)
    gradients: list[Singles] = []
    for number in range(len(weights) - 1, -1, -1):
        if number + 1 < len(weights):
            if number + 1 == len(STRIDES):
                channels, count, rows, wide = last_shape
                gradient = gradient.reshape(channels, rows, wide, count).transpose(0, 3, 1, 2)
            gradient = gradient.reshape(len(weights[number]), -1) * kept[number]
        gradients += [gradient.sum(axis=1), gradient @ columns[number].T]
        if number:
            gradient = weights[number].T @ gradient
            if number < len(STRIDES):
                gradient = _fold(gradient, shapes[number], STRIDES[number])
    return gradients[::-1]


def _loss_gradient(outputs: Singles, batch: Samples) -> Singles:
    """Gradient of the mean loss by the outputs ``(5, N)``."""
    count, positive = len(batch.is_vehicle), batch.is_vehicle
    gradient = np.empty_like(outputs)
    gradient[0] = (1 / (1 + np.exp(-outputs[0].clip(-80, 80))) - positive) / count
    error = (outputs[1:] - batch.shifts.T) / _SMOOTH
    gradient[1:] = _BOX_WEIGHT * error.clip(-1, 1) * positive / max(int(positive.sum()), 1)
    return gradient


def _unfold(values: Singles, stride: int) -> tuple[Singles, tuple[int, int, int]]:
    """List the 3x3 cells around each output of a convolution, ``(9 * channels, outputs)``.

    `values` is ``(channels, N, rows, columns)``; also returns the outputs' shape, ``(N, rows, columns)``.
    """
    channels, count, rows, columns = values.shape
    high, wide = ((side - KERNEL) // stride + 1 for side in (rows, columns))
    unfolded = np.empty((KERNEL, KERNEL, channels, count, high, wide), np.float32)
    for i in range(KERNEL):
        for j in range(KERNEL):
            stop_y, stop_x = i + stride * (high - 1) + 1, j + stride * (wide - 1) + 1
            unfolded[i, j] = values[:, :, i:stop_y:stride, j:stop_x:stride]
    return unfolded.reshape(KERNEL**2 * channels, -1), (count, high, wide)


def _fold(columns: Singles, shape: tuple[int, ...], stride: int) -> Singles:
    """Add unfolded cells up: the transpose of `_unfold`."""
    channels, count, rows, wide = shape
    high, across = ((side - KERNEL) // stride + 1 for side in (rows, wide))
    parts = columns.reshape(KERNEL, KERNEL, channels, count, high, across)
    folded = np.zeros(shape, np.float32)
    for i in range(KERNEL):
        for j in range(KERNEL):
            stop_y, stop_x = i + stride * (high - 1) + 1, j + stride * (across - 1) + 1
            folded[:, :, i:stop_y:stride, j:stop_x:stride] += parts[i, j]
    return folded
