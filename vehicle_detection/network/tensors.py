"""From a frame to the input of a network, and from its outputs to boxes: which kinds they are.

The sizes, the padding, layout and number format of the input; the kinds of outputs, and how to decode them.
"""

from __future__ import annotations

import ast
import functools
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import NEW_ARRAYS, Floats, Workspace
from vehicle_detection.errors import ModelFileError
from vehicle_detection.network.runtime import Array, GraphFacts

Size = tuple[int, int]
"""Height and width in pixels."""

# Largest change of the aspect ratio that avoids padding, and largest enlargement of small frames.
_MAX_SQUEEZE, _MAX_ENLARGEMENT = 0.03, 2.0

# Mean and standard deviation of ImageNet's RGB values, 0 to 1.
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

Kind = Literal["columns", "rows", "yolov5", "yolox", "final", "detr", "lists"]
"""Kinds of outputs; `ACCEPTED` describes them."""

ACCEPTED = (
    "(1, 4 + classes, N) or (1, N, 4 + classes) of YOLOv8, YOLO11 and RT-DETR; (1, N, 5 + classes) of YOLOv5 "
    "and YOLOX; (1, N, 6) after suppression; boxes (1, N, 4) and logits (1, N, classes) of DETR; or labels, "
    "boxes and scores"
)
"""Description of the accepted outputs, for messages."""

MAX_CANDIDATES = 1000
"""Maximum number of boxes before suppression."""

# Largest score with the rounding errors of 8 bits; higher ones are of a network without its last function, or
# of another kind.
_MAX_PROBABILITY = 1.02

# Boxes of a network that predicts sets, without suppression.
_MAX_SET = 1000

# Names of COCO's 80 classes, and the numbers that its own numbering, 1 to 90, leaves out.
_COCO = (
    "person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,stop sign,"
    "parking meter,bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,backpack,umbrella,handbag,"
    "tie,suitcase,frisbee,skis,snowboard,sports ball,kite,baseball bat,baseball glove,skateboard,surfboard,"
    "tennis racket,bottle,wine glass,cup,fork,knife,spoon,bowl,banana,apple,sandwich,orange,broccoli,carrot,"
    "hot dog,pizza,donut,cake,chair,couch,potted plant,bed,dining table,toilet,tv,laptop,mouse,remote,"
    "keyboard,cell phone,microwave,oven,toaster,sink,refrigerator,book,clock,vase,scissors,teddy bear,"
    "hair drier,toothbrush"
)
_COCO_GAPS = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)


def fit_input(shape: tuple[int, ...], input_size: int, multiple: int = 32) -> tuple[Size, Size]:
    """Size of a frame in a network's input, and size of the input, whose sides are multiples of a number.

    `input_size` is the longer side of the input; small frames are enlarged to twice their size at most. Both
    sizes (height, width) are equal where that changes the aspect ratio by at most 3%.

    >>> fit_input((720, 1280), 640), fit_input((480, 600), 640)
    (((352, 640), (352, 640)), ((512, 640), (512, 640)))
    >>> fit_input((1000, 1600), 640)
    ((400, 640), (416, 640))
    """
    longer, shorter = max(shape[:2]), min(shape[:2])
    long_side = _fit_side(min(float(input_size), longer * _MAX_ENLARGEMENT), multiple)
    short_side = _fit_side(shorter * long_side[0] / longer, multiple)
    sides = (short_side, long_side) if shape[0] <= shape[1] else (long_side, short_side)
    return (sides[0][0], sides[1][0]), (sides[0][1], sides[1][1])


def _fit_side(exact: float, multiple: int) -> Size:
    """Length of a side in the input, and with padding."""
    nearest = max(round(exact / multiple), 1) * multiple
    if abs(nearest - exact) <= _MAX_SQUEEZE * exact:
        return nearest, nearest
    scaled = max(round(exact), 1)
    return scaled, -(-scaled // multiple) * multiple


def _resize(
    frame: NDArray[np.uint8], size: Size, target: NDArray[np.uint8] | None, workspace: Workspace
) -> NDArray[Any]:
    """Resize a frame: by means over areas, and then linearly by less than 2.

    OpenCV takes means over whole pixels in a tenth of the time of others.
    """
    height, width = frame.shape[:2]
    factor = _reduction(frame.shape, size)
    if factor > 1:
        memory = workspace.take((height // factor, width // factor, 3), np.uint8, "reduced")
        cv2.resize(frame, (width // factor, height // factor), dst=memory, interpolation=cv2.INTER_AREA)
        frame = memory
    by_less_than_2 = frame.shape[0] < 2 * size[0] and frame.shape[1] < 2 * size[1]
    method = cv2.INTER_LINEAR if by_less_than_2 else cv2.INTER_AREA
    return cv2.resize(frame, size[::-1], dst=target, interpolation=method)


def _reduction(shape: tuple[int, ...], size: Size) -> int:
    """Whole factor by which a frame of this shape is reduced towards a size, before other factors."""
    factor = min(shape[0] // size[0], shape[1] // size[1])
    return factor if factor > 1 and shape[0] % factor == shape[1] % factor == 0 else 1


@dataclass(frozen=True)
class InputFormat:
    """What a network expects as its input.

    `size` is its fixed height and width (None: any multiples of `multiple`), `padding` the gray level of the
    padding, and with `stretch` the frame fills the whole input, whatever its aspect ratio. Floating-point
    numbers are `scaled` to 0-1 instead of 0-255, or also `standardized` by the mean and standard deviation of
    ImageNet.
    """

    size: Size | None
    dtype: str
    channels_first: bool
    multiple: int = 32
    padding: int = 114
    stretch: bool = False
    bgr: bool = False
    scaled: bool = True
    standardized: bool = False

    def fit(self, shape: tuple[int, ...], input_size: int) -> tuple[Size, Size]:
        """Size of a frame in the input, and size of the input; see `fit_input`."""
        size = (input_size, input_size) if self.size is None and self.stretch else self.size
        if size is None:
            return fit_input(shape, input_size, self.multiple)
        if self.stretch:
            return size, size
        factor = min(size[0] / shape[0], size[1] / shape[1])
        height, width = (min(max(round(side * factor), 1), limit) for side, limit in zip(shape[:2], size))
        return (height, width), size

    def reduction(self, shape: tuple[int, ...], input_size: int) -> int:
        """Whole factor by which `prepare` reduces frames of this shape; reduced ones give the same input."""
        sizes = self.fit(shape, input_size)
        factor = _reduction(shape, sizes[0])
        reduced = shape[0] // factor, shape[1] // factor
        return factor if self.fit(reduced, input_size) == sizes else 1

    def prepare(
        self, frame: NDArray[np.uint8], input_size: int, workspace: Workspace = NEW_ARRAYS
    ) -> tuple[Array, Size]:
        """Resize, pad (at the right and at the bottom) and convert a frame to a batch of one.

        Returns the input, valid until the next call with the same workspace in this thread, and height and
        width of the frame in it.
        """
        scaled, padded = self.fit(frame.shape, input_size)
        image = workspace.take((*padded, 3), np.uint8, "input")
        image[scaled[0] :] = image[: scaled[0], scaled[1] :] = self.padding
        target = image if scaled == padded else None
        resized = _resize(frame, scaled, target, workspace)
        if scaled != padded:
            image[: scaled[0], : scaled[1]] = resized
        return self._convert(image), scaled

    def _convert(self, image: NDArray[np.uint8]) -> Array:
        if self.dtype == "uint8":
            array: Array = image[..., ::-1] if self.bgr else image
            return np.ascontiguousarray((array.transpose(2, 0, 1) if self.channels_first else array)[None])
        factor = 1 / 255 if self.scaled else 1.0
        array = np.asarray(cv2.dnn.blobFromImage(image, factor, swapRB=self.bgr))
        if self.standardized:
            mean, std = np.array([_MEAN, _STD], np.float32)[..., None, None]
            array = (array - mean) / std
        if not self.channels_first:
            array = array.transpose(0, 2, 3, 1)
        return np.ascontiguousarray(array, self.dtype)


class Candidates(NamedTuple):
    """Boxes before suppression, best first."""

    boxes: Floats  # (N, 4) [x1, y1, x2, y2]
    probabilities: Floats  # (N,), in the network's output
    class_ids: NDArray[np.intp]  # (N,)


@dataclass(frozen=True)
class OutputFormat:
    """How to decode the outputs of a network.

    `normalized` boxes are fractions of the input's width and height; `order` holds the positions of the
    boxes, the scores or logits and, if there are three outputs, the labels.
    """

    kind: Kind
    n_classes: int | None = None
    normalized: bool = False
    order: tuple[int, ...] = (0,)

    def decode(
        self, outputs: list[Array], size: Size, classes: NDArray[np.intp] | None, min_probability: float
    ) -> Candidates:
        """Decode the outputs for an input of this height and width to boxes of `classes` (None: all).

        The boxes are in pixels of the input, and the class of each is its most probable one. A
        `ModelFileError` says what is not finite, no probability or no fraction, without a name.
        """
        boxes, scores, objectness, labels = self._split(outputs)
        kept = scores if classes is None or labels is not None else scores[classes[classes < len(scores)]]
        best = kept[0] if len(kept) == 1 else kept.max(axis=0, initial=0)
        highest = best.max(initial=0)
        if objectness is not None:
            best = best * objectness
        if not np.isfinite(best.sum(dtype=np.float64)):
            raise ModelFileError("scores are not finite")
        if highest > _MAX_PROBABILITY:
            raise ModelFileError(f"scores are not probabilities, but up to {highest:.3g}")
        rows = np.flatnonzero(best >= min_probability)
        if labels is None:
            class_ids = scores[:, rows].argmax(axis=0) if len(scores) > 1 else np.zeros(len(rows), np.intp)
        else:
            class_ids = labels[rows].astype(np.intp)
        if classes is not None:
            own = np.isin(class_ids, classes)
            rows, class_ids = rows[own], class_ids[own]
        order = np.argsort(-best[rows], kind="stable")[:MAX_CANDIDATES]
        rows = rows[order]
        chosen = self._corners(boxes, rows, size)
        if not np.isfinite(chosen).all():
            raise ModelFileError("boxes are not finite")
        return Candidates(chosen, best[rows].astype(np.float64), class_ids[order])

    def _split(self, outputs: list[Array]) -> tuple[Array, Array, Array | None, Array | None]:
        """``(4, N)`` boxes, ``(classes, N)`` scores, and ``(N,)`` objectness and labels where they exist."""
        if self.kind in ("detr", "lists"):
            boxes, scores, *labels = (outputs[index] for index in self.order)
            boxes = boxes.reshape(-1, 4).T
            if self.kind == "lists":
                return boxes, scores.reshape(1, -1), None, labels[0].reshape(-1)
            with np.errstate(over="ignore"):
                return boxes, 1 / (1 + np.exp(-scores[0].T.astype(np.float32))), None, None
        values = outputs[0][0] if self.kind == "columns" else outputs[0][0].T
        if self.kind in ("yolov5", "yolox"):
            return values[:4], values[5:], values[4], None
        if self.kind == "final":
            return values[:4], values[4:5], None, values[5]
        return values[:4], values[4:], None, None

    def _corners(self, boxes: Array, rows: NDArray[np.intp], size: Size) -> Floats:
        """``(N, 4)`` corners in pixels of the input, of these columns of the boxes."""
        chosen = boxes[:, rows].T.astype(np.float64)
        # Files with decoded boxes have centers up to the right border, others offsets of a few cells.
        if self.kind == "yolox" and boxes[0].max(initial=0) < size[1] / 2:
            corners, strides = _grid(size)
            chosen[:, :2] = (chosen[:, :2] + corners[rows]) * strides[rows, None]
            chosen[:, 2:] = np.exp(chosen[:, 2:].clip(max=20)) * strides[rows, None]
        if self.normalized:
            if chosen.max(initial=0) > 2:  # such as those of YOLO-NAS, in pixels
                raise ModelFileError("boxes are not fractions of the image")
            chosen *= [size[1], size[0], size[1], size[0]]
        if self.kind not in ("final", "lists"):
            half = chosen[:, 2:] / 2
            chosen = np.hstack([chosen[:, :2] - half, chosen[:, :2] + half])
        return chosen


@functools.lru_cache(maxsize=8)
def _grid(size: Size) -> tuple[Floats, Floats]:
    """Corners ``(N, 2)`` in cells, and strides ``(N,)``, of all cells of strides 8, 16 and 32 of an input."""
    corners, strides = [], []
    for stride in (8, 16, 32):
        y, x = np.mgrid[: size[0] // stride, : size[1] // stride]
        corners.append(np.stack([x, y], axis=-1).reshape(-1, 2))
        strides.append(np.full(x.size, float(stride)))
    return np.concatenate(corners).astype(np.float64), np.concatenate(strides)


def recognize(
    facts: GraphFacts, shapes: list[tuple[int, ...]], size: Size, names: int | None
) -> OutputFormat:
    """Recognize the kind of a network's outputs from their shapes for an input of this `size`.

    `names` is the number of the class names in the file's metadata, if any.
    """
    found = None
    if len(shapes) == 1 and len(shapes[0]) == 3 and shapes[0][0] == 1:
        found = _recognize_one(shapes[0][1], shapes[0][2], len(_grid(size)[1]), names)
    elif len(shapes) == 2 and all(len(shape) == 3 for shape in shapes):
        # The boxes of a network with 4 classes have the name.
        boxes = [i for i, shape in enumerate(shapes) if shape[2] == 4]
        named = [i for i in boxes if "box" in facts.outputs[i].name or "det" in facts.outputs[i].name]
        index = (named or boxes or [-1])[0]
        if index >= 0 and shapes[0][:2] == shapes[1][:2] and shapes[0][0] == 1:
            found = OutputFormat("detr", shapes[1 - index][2], True, (index, 1 - index))
    elif len(shapes) == 3:
        places = {port.name.lower(): i for i, port in enumerate(facts.outputs)}
        order = tuple(places.get(name, -1) for name in ("boxes", "scores", "labels"))
        if min(order) >= 0 and shapes[order[0]][-1] == 4:
            found = OutputFormat("lists", names, False, order)
    if found is None:
        listed = ", ".join(f"{port.name} {shape}" for port, shape in zip(facts.outputs, shapes))
        raise ModelFileError(
            f"{facts.name} has outputs that are not known: {listed}; accepted are {ACCEPTED}; export a "
            "detection network, or use detector_from"
        )
    return found


def _recognize_one(first: int, second: int, cells: int, names: int | None) -> OutputFormat | None:
    """Recognize one output of shape ``(1, first, second)``."""
    # Three anchors in each cell: YOLOv5; one: YOLOv8 and YOLOX. The names decide where they are known.
    counts = (cells, 3 * cells)
    by_columns = first <= second if (first in counts) == (second in counts) else second in counts
    if by_columns:
        return OutputFormat("columns", first - 4) if first > 4 else None
    # YOLOv5 with a stride of 64 has other counts, and with one class 6 values, too.
    if second == 6 and first not in counts and (first <= _MAX_SET or names not in (None, 1)):
        return OutputFormat("final", names)
    if second < 5:
        return None
    if first != 3 * cells and second == 4 + (80 if names is None else names):
        return OutputFormat("rows", second - 4, first != cells)
    if second > 5 and (first in counts or first > _MAX_SET):
        return OutputFormat("yolox" if first == cells and names is None else "yolov5", second - 5)
    return OutputFormat("rows", second - 4, True) if first <= _MAX_SET else None


def class_names(facts: GraphFacts) -> dict[int, str] | None:
    """Class names in the metadata of Ultralytics, the text of a dictionary or list; None without names."""
    try:
        names: Any = ast.literal_eval(facts.metadata.get("names", ""))
        pairs = names.items() if isinstance(names, dict) else enumerate(names)
        return {int(number): str(name) for number, name in pairs}
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return None


def usual_names(n_classes: int | None) -> dict[int, str] | None:
    """Names of COCO for 80 classes, and for 91 in its own numbering; None for other numbers."""
    if n_classes == 80:
        return dict(enumerate(_COCO.split(",")))
    if n_classes == 91:
        return dict(zip((number for number in range(1, 91) if number not in _COCO_GAPS), _COCO.split(",")))
    return None
