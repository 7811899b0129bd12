"""COCO JSON: images, annotations and results."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any

from vehicle_detection.export.rows import TRACK_COLUMNS, Row, without_noise

CocoImages = Mapping[int | str, Mapping[str, Any]]
"""Entry of each frame in the list of images of a COCO file."""


def coco_images(frames: Iterable[int | str], shape: tuple[int, ...] | None) -> CocoImages:
    """Describe frames as COCO images. Their ids depend on nothing else, so that files agree about them."""
    keys = sorted(set(frames), key=lambda key: (isinstance(key, str), key))
    size = {} if shape is None else {"height": int(shape[0]), "width": int(shape[1])}
    return {key: {"id": _image_id(key), **_image_name(key), **size} for key in keys}


def _image_id(key: int | str) -> int:
    """Frame number plus 1; for a file name 52 bits of its hash, which every JSON reader holds exactly."""
    if isinstance(key, str):
        return int(hashlib.sha256(key.encode()).hexdigest()[:13], 16)
    return key + 1


def _image_name(key: int | str) -> dict[str, Any]:
    """Name of an image; a video frame has no file, so that its number serves as the file name."""
    return {"file_name": key} if isinstance(key, str) else {"file_name": f"{key:06d}", "frame": key}


def coco_result(row: Row, image_id: int, category_id: int) -> dict[str, Any]:
    """COCO result: box, score and, if known, track, distance, speed and confidence of one detection."""
    optional = {"track_id": row.track_id} | {name: getattr(row, name) for name in TRACK_COLUMNS[7:]}
    return {
        "image_id": image_id,
        "category_id": category_id,
        "bbox": [row.x1, row.y1, without_noise(row.x2 - row.x1), without_noise(row.y2 - row.y1)],
        **({} if row.score is None else {"score": row.score}),
        **{name: value for name, value in optional.items() if value is not None},
    }


COCO_CATEGORIES = [{"id": 1, "name": "vehicle", "supercategory": "vehicle"}]
"""The categories of a data set that is written here."""


def coco_annotation(number: int, row: Row, image: Mapping[str, Any]) -> dict[str, Any]:
    """COCO annotation of a row, with its score if it has one; `number` is its id.

    Ignored rows are crowds, because pycocotools overwrites ``ignore`` with ``iscrowd``.
    """
    result = coco_result(row, image["id"], 1)
    width, height = result["bbox"][2:]
    flags = {"area": round(width * height, 2), "iscrowd": int(row.ignore)}
    flags |= {"ignore": 1} if row.ignore else {}
    # An explicit null: readers number labels that name no track.
    return {"id": number, "track_id": None} | result | flags


def coco_document(rows: Iterable[Row], images: CocoImages) -> dict[str, Any]:
    """COCO data set: every frame is an image, every row an annotation."""
    annotations = [
        coco_annotation(number, row, images[row.frame]) for number, row in enumerate(rows, start=1)
    ]
    return {"images": list(images.values()), "annotations": annotations, "categories": COCO_CATEGORIES}
