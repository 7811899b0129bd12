"""The loss of the network: which cells answer for which vehicle, and how well they score and fit it.

Task-aligned assignment (Feng et al., "TOOD", ICCV 2021) and CIoU (Zheng et al., AAAI 2020).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 - PyTorch's convention
from torch import Tensor

_CELLS = 10  # that answer for a vehicle, at most
_BOX_WEIGHT = 2.5
# Weight of a background cell: this times its probability to this power, so that easy ones count little.
_BACKGROUND, _FOCUS = 0.75, 1.5


class Targets(NamedTuple):
    """The boxes of a batch, padded to the same number."""

    boxes: Tensor  # (n, m, 4)
    usable: Tensor  # (n, m) whether a box is one of a vehicle, and not padding
    ignored: Tensor  # (n, k, 4) neither vehicle nor background; empty boxes are padding


def detection_loss(
    logits: Tensor, predicted: Tensor, centers: Tensor, targets: Targets
) -> tuple[Tensor, Tensor]:
    """Return the losses of the scores and of the boxes of the logits and boxes that `Network` returns.

    They are the binary cross-entropy with the alignment as target; and 2.5 times ``1 - CIoU`` of the cells
    that answer for a vehicle: means over the alignments of the batch. `centers` are ``(cells, 2)``.
    """
    with torch.no_grad():
        target, vehicle = _assign(logits, predicted, centers, targets.boxes, targets.usable)
        answers = target > 0
        skipped = _inside(targets.ignored, centers).any(1) & ~answers
        background = _BACKGROUND * logits.sigmoid() ** _FOCUS
        weight = torch.where(answers, torch.ones_like(logits), background) * ~skipped
        total = target.sum().clamp(min=8.0)
        truth = torch.gather(targets.boxes, 1, vehicle[..., None].expand(-1, -1, 4))
    score_loss = F.binary_cross_entropy_with_logits(logits, target, weight, reduction="sum") / total
    box_loss = ((1 - _complete_iou(predicted, truth)) * target).sum() / total
    return score_loss, _BOX_WEIGHT * box_loss


def _assign(
    logits: Tensor, predicted: Tensor, centers: Tensor, boxes: Tensor, usable: Tensor
) -> tuple[Tensor, Tensor]:
    """Let each vehicle take the cells inside it that score and fit best.

    Returns the target score of each cell ``(n, cells)``, 0 for background, and the vehicle it answers for.
    """
    inside = _inside(boxes, centers) & usable[:, :, None]
    fit = _iou(predicted[:, None], boxes[:, :, None]) * inside
    alignment = logits.sigmoid()[:, None].clamp(min=1e-4).sqrt() * fit**4
    value, index = alignment.topk(min(_CELLS, alignment.shape[2]), 2)
    positive = torch.zeros_like(inside).scatter(2, index, value > 1e-9)
    vehicle = (fit * positive).argmax(1)  # a cell inside several vehicles answers for the one it fits best
    positive &= F.one_hot(vehicle, boxes.shape[1]).permute(0, 2, 1).bool()
    alignment, fit = alignment * positive, fit * positive
    # The best cell of a vehicle is to score its IoU, the others in proportion to their alignment.
    target = alignment * fit.amax(2, keepdim=True) / (alignment.amax(2, keepdim=True) + 1e-9)
    return target.amax(1), vehicle


def _inside(boxes: Tensor, points: Tensor) -> Tensor:
    """Which points ``(p, 2)`` lie inside which boxes ``(n, m, 4)``: ``(n, m, p)``."""
    x, y = points.unbind(-1)
    x1, y1, x2, y2 = boxes[..., None].unbind(-2)
    return (x > x1) & (x < x2) & (y > y1) & (y < y2)


def _iou(a: Tensor, b: Tensor) -> Tensor:
    """IoU of boxes in the last axis."""
    ax1, ay1, ax2, ay2 = a.unbind(-1)
    bx1, by1, bx2, by2 = b.unbind(-1)
    width = (torch.minimum(ax2, bx2) - torch.maximum(ax1, bx1)).clamp(min=0)
    height = (torch.minimum(ay2, by2) - torch.maximum(ay1, by1)).clamp(min=0)
    overlap = width * height
    return overlap / ((ax2 - ax1) * (ay2 - ay1) + (bx2 - bx1) * (by2 - by1) - overlap + 1e-6)


def _complete_iou(a: Tensor, b: Tensor) -> Tensor:
    """CIoU: IoU less the distance of the centers and the difference of the aspect ratios."""
    overlap = _iou(a, b)
    span = torch.maximum(a[..., 2:], b[..., 2:]) - torch.minimum(a[..., :2], b[..., :2])
    distance = ((a[..., :2] + a[..., 2:] - b[..., :2] - b[..., 2:]) / 2).square().sum(-1)
    wa, ha = (a[..., 2:] - a[..., :2]).clamp(min=1e-3).unbind(-1)
    wb, hb = (b[..., 2:] - b[..., :2]).clamp(min=1e-3).unbind(-1)
    aspect = 4 / math.pi**2 * (torch.atan(wa / ha) - torch.atan(wb / hb)).square()
    factor = (aspect / (1 - overlap + aspect + 1e-6)).detach()
    return overlap - distance / (span.square().sum(-1) + 1e-6) - factor * aspect
