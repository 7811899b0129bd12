"""The network: a small anchor-free, fully convolutional detector of vehicles, in PyTorch.

A residual backbone (He et al., CVPR 2016), a feature pyramid (Lin et al., CVPR 2017) of separable
convolutions (Chollet, CVPR 2017), and one head for all levels, which predicts at every cell a logit and the
distances to the four edges of a box (Tian et al., "FCOS", ICCV 2019).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - PyTorch's convention
from torch import Tensor, nn

STRIDES = (8, 16, 32, 64)
"""Pixels between the cells of each level."""

CENTER, SCALE = 115.0, 64.0
"""Normalization of gray levels: ``(value - CENTER) / SCALE``; the center is also the padding's gray."""

_FIRST = 16  # channels at stride 2
_CHANNELS = (32, 64, 96, 128, 128)  # at strides 4 to 64
_HIDDEN = (16, 32, 48, 64, 128)  # of the residual blocks there
_BLOCKS = (1, 1, 2, 2, 1)  # number of those blocks
_PYRAMID = 64


def _conv(inputs: int, outputs: int, stride: int = 1, kernel: int = 3, *, groups: int = 1) -> nn.Sequential:
    """Convolution, batch normalization, ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


def _separable(channels: int) -> nn.Sequential:
    """Convolve each channel with 5x5 pixels, and then all channels at each pixel."""
    return nn.Sequential(
        _conv(channels, channels, kernel=5, groups=channels), _conv(channels, channels, kernel=1)
    )


class Residual(nn.Module):
    """Two 3x3 convolutions with a shortcut."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.first = _conv(channels, hidden)
        self.second = _conv(hidden, channels)[:2]

    def forward(self, x: Tensor) -> Tensor:
        """Return the sum of input and residual."""
        return F.relu(x + self.second(self.first(x)))


class Network(nn.Module):
    """The network in training: logits and boxes of all cells."""

    def __init__(self) -> None:
        super().__init__()
        stem, *stages = (
            [Residual(channels, hidden) for _ in range(count)]
            for channels, hidden, count in zip(_CHANNELS, _HIDDEN, _BLOCKS)
        )
        self.stem = nn.Sequential(_conv(3, _FIRST, 2), _conv(_FIRST, _CHANNELS[0], 2), *stem)
        self.stages = nn.ModuleList(
            nn.Sequential(_conv(inputs, outputs, 2), *blocks)
            for inputs, outputs, blocks in zip(_CHANNELS, _CHANNELS[1:], stages)
        )
        self.lateral = nn.ModuleList([nn.Conv2d(channels, _PYRAMID, 1) for channels in _CHANNELS[1:]])
        self.smooth = nn.ModuleList([_separable(_PYRAMID) for _ in range(3)])
        self.head = nn.Sequential(_separable(_PYRAMID), _separable(_PYRAMID))
        self.output = nn.Conv2d(_PYRAMID, 5, 1)
        self.scale = nn.Parameter(torch.ones(len(STRIDES)))  # of the distances of each level
        nn.init.normal_(self.output.weight, std=0.01)
        # A cell starts at a probability of 0.02, and at a box of 2.2 cells.
        nn.init.constant_(self.output.bias, 0.7)
        with torch.no_grad():
            self.output.bias[0] = -4.0

    def levels(self, x: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the logits and the distances in pixels of each level as maps."""
        x = self.stem(x)
        features = []
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        pyramid = [lateral(each) for lateral, each in zip(self.lateral, features)]
        for i in 2, 1, 0:
            above = F.interpolate(pyramid[i + 1], scale_factor=2.0, mode="nearest")
            # A level of odd size is one cell smaller than twice the next.
            above = above[:, :, : pyramid[i].shape[2], : pyramid[i].shape[3]]
            pyramid[i] = self.smooth[i](pyramid[i] + above)
        outputs = [self.output(self.head(each)) for each in pyramid]
        return [
            (each[:, :1], F.softplus(each[:, 1:] * self.scale[i]) * STRIDES[i])
            for i, each in enumerate(outputs)
        ]

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits ``(n, cells)`` and boxes ``(n, cells, 4)`` of uint8 images ``(n, H, W, 3)``."""
        logits, boxes = [], []
        for (logit, distance), stride in zip(self.levels(normalize(image)), STRIDES):
            x, y = _centers(logit, stride)
            left, top, right, bottom = distance.float().unbind(1)
            boxes.append(torch.stack([x - left, y - top, x + right, y + bottom], -1).flatten(1, 2))
            logits.append(logit.float().flatten(1))
        return torch.cat(logits, 1), torch.cat(boxes, 1)


class Deployed(nn.Module):
    """The network in a model file: ``(1, 5, cells)`` of center, size and probability, as in YOLOv8."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        """Return the boxes of normalized images ``(1, H, W, 3)``."""
        rows = []
        for (logit, distance), stride in zip(self.network.levels(image.permute(0, 3, 1, 2)), STRIDES):
            x, y = _centers(logit, stride)
            left, top, right, bottom = distance.split(1, 1)
            x, y = x + (right - left) / 2, y + (bottom - top) / 2
            rows.append(torch.cat([x, y, left + right, top + bottom, logit.sigmoid()], 1).flatten(2))
        return torch.cat(rows, 2)


def normalize(image: Tensor) -> Tensor:
    """Turn uint8 images ``(n, H, W, 3)`` into the network's input ``(n, 3, H, W)``."""
    return (image.permute(0, 3, 1, 2).float() - CENTER) / SCALE


def cell_centers(height: int, width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Centers ``(cells, 2)`` and strides ``(cells,)`` of all cells of an image, in the network's order."""
    centers, strides = [], []
    for stride in STRIDES:
        rows, columns = -(-height // stride), -(-width // stride)
        y, x = torch.meshgrid(
            torch.arange(rows, device=device), torch.arange(columns, device=device), indexing="ij"
        )
        centers.append((torch.stack([x, y], -1).reshape(-1, 2) + 0.5) * stride)
        strides.append(torch.full((rows * columns,), float(stride), device=device))
    return torch.cat(centers), torch.cat(strides)


def _centers(level: Tensor, stride: int) -> tuple[Tensor, Tensor]:
    """Coordinates of the centers of a level's cells, which broadcast over its maps."""
    x = (torch.arange(level.shape[3], device=level.device) + 0.5) * stride
    y = (torch.arange(level.shape[2], device=level.device) + 0.5) * stride
    return x, y[:, None]
