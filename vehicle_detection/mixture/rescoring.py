"""Rescoring: a second stage that scores and corrects the boxes that the templates propose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Floats, Workspace, check_number, finite_array
from vehicle_detection._kernels import Convolution, ConvolutionalNetwork
from vehicle_detection.boxes import clip_boxes
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture.crops import CROP_CELLS, N_INPUTS, rescoring_inputs
from vehicle_detection.mixture.features import EdgePyramid

Singles = NDArray[np.float32]

RESCORE_MIN, RESCORE_AGAIN_MIN = -1.05, -1.1
"""Minimum margin of a proposed box that is rescored, and of a rescored one that is rescored again."""

KERNEL, STRIDES = 3, (1, 2, 1)
"""Side of the convolutions in cells, and the step of each."""

MAX_CORRECTION = 0.4
"""Largest shift of an edge, as a fraction of the box's side."""

LAYERS = ("convolution 1", "convolution 2", "convolution 3", "hidden", "output")
"""Layers of the network."""

# Log-odds of a network are limited.
_MAX_LOG_ODDS = 6
# Minimum margin after the first network of a box that the other networks see.
_NEXT_NETWORK_MIN = -1.0
# Fewest boxes that a thread computes.
_MIN_BOXES = 8


@dataclass(frozen=True, eq=False)
class Layer:
    """Weights ``(outputs, inputs)`` and biases ``(outputs,)`` of a layer.

    The inputs of a convolution are the channels of its 3x3 cells, cell by cell.
    """

    weights: Singles
    bias: Singles


@dataclass(frozen=True, eq=False)
class Network:
    """A small convolutional network on the edges and colors of a box's cells.

    Three convolutions of 3x3 cells and a hidden layer, with rectified outputs, give the log-odds of a vehicle
    and the shifts of the box's four edges: LeCun et al., "Gradient-based learning applied to document
    recognition" (Proc. IEEE 1998); Girshick, "Fast R-CNN" (ICCV 2015), for the two outputs.

    Attributes
    ----------
    layers
        The five `LAYERS`.
    """

    layers: tuple[Layer, ...]
    _kernel: ConvolutionalNetwork = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if len(self.layers) != len(LAYERS):
            raise InvalidInputError(f"layers must be {len(LAYERS)}, got {len(self.layers)}; train again")
        layers = []
        inputs = KERNEL**2 * N_INPUTS
        for number, (name, layer) in enumerate(zip(LAYERS, self.layers)):
            outputs = len(np.atleast_1d(layer.bias))
            weights = finite_array(layer.weights, f"rescorer.{name}", (outputs, inputs))
            bias = finite_array(layer.bias, f"rescorer.{name} bias", (outputs,))
            layers.append(Layer(weights, bias))
            inputs = inputs_after(number, outputs)
        if len(layers[-1].bias) != 5:
            raise InvalidInputError(
                f"rescorer.{LAYERS[-1]} must have 5 outputs, got {len(layers[-1].bias)}; train again"
            )
        object.__setattr__(self, "layers", tuple(layers))
        object.__setattr__(self, "_kernel", ConvolutionalNetwork(_convolutions(layers)))

    def outputs(self, inputs: Singles, workspace: Workspace = NEW_ARRAYS) -> Floats:
        """Log-odds and shifts of the edges, ``(N, 5)``, of `rescoring_inputs`."""
        return self._kernel(inputs, workspace).T.astype(np.float64)


@dataclass(frozen=True, eq=False)
class Rescorer:
    """Networks that score and correct boxes together.

    The mean of networks that differ in their random initial weights is better than each: Hansen and Salamon,
    "Neural network ensembles" (PAMI 1990).

    Attributes
    ----------
    networks
        One or more `Network`.
    blend_weight
        Factor of the log-odds in the final margin: margin of the templates plus weighted log-odds.
    """

    networks: tuple[Network, ...]
    blend_weight: float

    def __post_init__(self) -> None:
        if not self.networks:
            raise InvalidInputError("networks must hold at least one network, got none; train again")
        check_number(self.blend_weight, "rescorer.blend_weight", above=0, high=1)

    @property
    def n_weights(self) -> int:
        """Number of trained numbers."""
        layers = [layer for network in self.networks for layer in network.layers]
        return sum(layer.weights.size + layer.bias.size for layer in layers)

    def predict(
        self, inputs: Singles, margins: Floats, workspace: Workspace = NEW_ARRAYS
    ) -> tuple[Floats, Floats]:
        """Log-odds ``(N,)`` and shifts of the edges ``(N, 4)``, as fractions of a box's sides, of crops.

        `inputs` are `rescoring_inputs`, and `margins` ``(N,)`` those of the templates. Boxes that the first
        network leaves below a margin of -1 are not passed to the others: a cascade (Viola and Jones,
        "Robust real-time face detection", IJCV 2004).
        """
        outputs = self.networks[0].outputs(inputs, workspace)
        rows = np.flatnonzero(self._blend(margins, outputs[:, 0]) >= _NEXT_NETWORK_MIN)
        if len(rows):
            chosen = workspace.take((*inputs.shape[:-1], len(rows)), np.float32, "chosen inputs")
            np.take(inputs, rows, axis=-1, out=chosen, mode="clip")  # without a check of each row
            others = [network.outputs(chosen, workspace) for network in self.networks[1:]]
            outputs[rows] = np.mean([outputs[rows], *others], axis=0)
        return outputs[:, 0], np.clip(outputs[:, 1:], -MAX_CORRECTION, MAX_CORRECTION)

    def apply(self, pyramid: EdgePyramid, boxes: Floats, margins: Floats) -> tuple[Floats, Floats]:
        """Corrected boxes, clipped to the frame, and their margins. The pyramid's threads share the boxes."""
        if not len(boxes):
            return boxes, margins

        def predict(rows: slice) -> tuple[Floats, Floats]:
            return self.predict(rescoring_inputs(pyramid, boxes[rows]), margins[rows], pyramid.workspace)

        count = max(min(pyramid.team.n_threads, len(boxes) // _MIN_BOXES), 1)
        bounds = [len(boxes) * part // count for part in range(count + 1)]
        parts = [slice(*pair) for pair in pairwise(bounds)]
        found = pyramid.team.map(predict, parts, cost=lambda rows: rows.stop - rows.start)
        log_odds, shifts = (np.concatenate(each) for each in zip(*found))
        corrected = boxes + shifts * np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        return clip_boxes(corrected, pyramid.shape), self._blend(margins, log_odds)

    def _blend(self, margins: Floats, log_odds: Floats) -> Floats:
        limited = np.clip(log_odds, -_MAX_LOG_ODDS, _MAX_LOG_ODDS)
        return np.asarray(margins + self.blend_weight * limited)

    def tensors(self) -> dict[str, NDArray[Any]]:
        """Arrays for the model file by name."""
        arrays = {}
        for number, network in enumerate(self.networks, 1):
            for name, layer in zip(LAYERS, network.layers):
                arrays[f"rescorer.{number}.{name}.weights"] = layer.weights
                arrays[f"rescorer.{number}.{name}.bias"] = layer.bias
        return arrays

    def numbers(self) -> dict[str, float]:
        """Numbers for the model file."""
        return {"blend_weight": self.blend_weight, "networks": len(self.networks)}

    @classmethod
    def build(cls, tensors: Mapping[str, NDArray[Any]], numbers: Mapping[str, float]) -> Rescorer:
        """Rebuild a rescorer from its `tensors` and `numbers`."""
        networks = []
        for number in range(1, int(numbers["networks"]) + 1):
            names = [f"rescorer.{number}.{name}" for name in LAYERS]
            layers = [Layer(tensors[f"{name}.weights"], tensors[f"{name}.bias"]) for name in names]
            networks.append(Network(tuple(layers)))
        return cls(tuple(networks), float(numbers["blend_weight"]))


def _convolutions(layers: Sequence[Layer]) -> list[Convolution]:
    """All layers as convolutions; the hidden one covers all cells that the last convolution leaves."""
    convolutions = []
    for layer, stride in zip(layers[: len(STRIDES)], STRIDES):
        weights = layer.weights.reshape(len(layer.bias), KERNEL, KERNEL, -1)
        convolutions.append(Convolution(weights, layer.bias, stride))
    hidden, output = layers[len(STRIDES) :]
    side = _last_side()
    weights = hidden.weights.reshape(len(hidden.bias), -1, side, side).transpose(0, 2, 3, 1)
    convolutions.append(Convolution(weights, hidden.bias, 1))
    convolutions.append(Convolution(output.weights[:, None, None], output.bias, 1))
    return convolutions


def inputs_after(number: int, outputs: int) -> int:
    """Return the number of inputs of the layer after layer `number`, which has so many outputs."""
    if number < 2:
        return outputs * KERNEL**2
    return outputs * (_last_side() ** 2 if number == 2 else 1)


def _last_side() -> int:
    """Side of a crop in cells after the last convolution."""
    side = CROP_CELLS
    for stride in STRIDES:
        side = (side - KERNEL) // stride + 1
    return side
