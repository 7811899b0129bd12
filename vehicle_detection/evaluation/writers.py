"""Write labelled or predicted boxes in each format that `read_labels` reads."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from vehicle_detection._common import atomic_write, check_type, write_parquet
from vehicle_detection.boxes import clip_boxes
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation.frame_boxes import NO_TRACK, FrameBoxes, FrameKey, without_suffix
from vehicle_detection.evaluation.readers import FRAME_NUMBER, read_coco_file, vehicle_categories
from vehicle_detection.export import (
    FOLDER_FORMATS,
    FORMATS,
    TRACK_COLUMNS,
    CocoImages,
    Row,
    check_format,
    coco_document,
    coco_images,
    coco_result,
    mot_line,
    new_folder,
    open_row_file,
)

_ROUNDING = 1.0  # px by which a box may extend beyond its image


def write_labels(
    labels: FrameBoxes,
    path: str | os.PathLike[str],
    *,
    format: str | None = None,  # noqa: A002
    shape: tuple[int, ...] | None = None,
    truth: str | os.PathLike[str] | None = None,
) -> int:
    """Write labelled or predicted boxes to a file, which `read_labels` reads back.

    Parameters
    ----------
    labels
        The boxes: predictions if they have scores, else labels.
    path, format
        File to write, and its format:

        - ``"csv"``, ``"jsonl"``, ``"parquet"`` (needs pyarrow): the columns of `FrameBoxes.to_pandas`.
        - ``"mot"``: MOTChallenge text, ground truth for labels and results for predictions.
        - ``"coco"``: a COCO data set with all frames as images, also those without boxes.
        - ``"coco_results"``: the list of predictions that ``COCO.loadRes`` of pycocotools takes.
        - ``"mot_zip"``: the archive that CVAT imports as tracks.
        - ``"kitti"``: a new folder with one ``label_2`` file for each frame.
        - ``"yolo"``: a new folder with ``data.yaml`` and one file in ``labels`` for each frame.

        None chooses by the suffix: .csv, .jsonl, .ndjson, .parquet, .txt or .zip (MOT), or .json (data set).
    shape
        ``(height, width, ...)`` of the images, which YOLO and some viewers of COCO data sets need. All images
        have this shape: write those of each size separately.
    truth
        A COCO data set whose image ids are used; required for results. Frames are found by file name, or by
        number in data sets written here. A data set has its images, too.

    Returns
    -------
    int
        Number of boxes written.

    Raises
    ------
    InvalidInputError
        If the format is unknown or cannot hold these boxes, or the folder is missing or read-only.
    DatasetError
        If `truth` is missing or not a COCO data set.

    Notes
    -----
    No format but KITTI, YOLO (tracks of labels) and the archive for CVAT (scores) loses a box's score, track
    or ``ignore`` without an error. What else each cannot hold:

    - CSV, JSON Lines, Parquet: frames without boxes. CSV also reads names that are all whole numbers as
      numbers, and rejects them.
    - MOT: frames without boxes, named frames (an error), predictions marked ``ignore`` (an error), occlusion
      and truncation (the file has an estimate of the visible fraction), distance and speed.
    - COCO: occlusion and truncation. Ignored boxes are crowds, which pycocotools ignores as
      `evaluate_detections` does with ``ignored_as_regions=True``.
    - COCO results: the same, and predictions marked ``ignore`` (an error).
    - YOLO: ignored boxes (an error), boxes that extend beyond `shape` by over 1 px (an error), suffixes of
      file names, distance and speed. Scores become confidences.
    - KITTI: numbered frames (an error), suffixes of images' names, tracks, distance and speed. Ignored
      boxes become regions, and `read_labels` ignores labels that are narrow, hidden or truncated.

    Without `truth`, the id of a COCO image is its frame number plus 1 or a hash of its file name: it does not
    depend on the other frames, so that labels and predictions written separately agree.

    Examples
    --------
    >>> import tempfile
    >>> from vehicle_detection import read_labels
    >>> file = Path(tempfile.mkdtemp()) / "labels.txt"
    >>> write_labels(FrameBoxes([0, 2], [1, 1], [[0, 0, 50, 40], [4, 0, 54, 40]]), file)
    2
    >>> print(file.read_text().rstrip())
    1,1,1.0,1.0,50.0,40.0,1,3,1.0
    3,1,5.0,1.0,50.0,40.0,1,3,1.0
    >>> read_labels(file).frames
    (0, 2)
    """
    check_type(labels, "labels", FrameBoxes, "collect the boxes of each frame in one")
    kind = check_format(path, format, (*FORMATS.values(), "coco_results", *FOLDER_FORMATS))
    if kind == "kitti":
        _write_kitti(labels, Path(path))
        return len(labels)
    if truth is not None and not kind.startswith("coco"):
        raise InvalidInputError(f"truth must be None for the format {kind!r}; only COCO files have image ids")
    _check_holds(labels, kind, shape)
    if kind == "parquet":
        _write_parquet(labels, path)
        return len(labels)
    if kind in ("mot_zip", "yolo"):
        with open_row_file(path, kind, TRACK_COLUMNS, shape) as rows:
            for key in labels.frame_keys:
                rows.add_frame(key)
            for row in _rows(labels):
                rows.write(row)
        return len(labels)
    if kind.startswith("coco"):
        content = _coco_content(labels, kind, shape, truth)
    with atomic_write(path, "path") as part, part.open("w", encoding="utf-8", newline="") as file:
        if kind == "csv":
            table = labels.to_pandas().astype({"ignore": int})
            table.to_csv(file, index=False, lineterminator="\n")
        elif kind == "jsonl":
            file.writelines(json.dumps(record, ensure_ascii=False) + "\n" for record in _records(labels))
        elif kind == "mot":
            file.writelines(mot_line(row) + "\n" for row in _rows(labels))
        else:
            json.dump(content, file, ensure_ascii=False)
    return len(labels)


def _check_holds(labels: FrameBoxes, kind: str, shape: tuple[int, ...] | None) -> None:
    """Raise if a format would change or lose what decides about the scores."""
    names = [key for key in labels.frames if isinstance(key, str)]
    if kind == "csv" and names:
        if all(FRAME_NUMBER.fullmatch(name.strip()) for name in names):
            raise InvalidInputError(
                f"labels have frame names that CSV does not tell from numbers, such as {names[0]!r}; "
                "convert them with labels.renamed(int), or write .jsonl"
            )
        padded = next((name for name in names if name != name.strip() or not name), None)
        if padded is not None:
            raise InvalidInputError(
                f"labels name a frame {padded!r}; CSV drops the spaces around a name, so write .jsonl"
            )
    if kind in ("mot", "mot_zip") and names:
        raise InvalidInputError(
            f"labels must have numbered frames for MOT, got {names[0]!r}; number them with labels.renamed"
        )
    if kind == "yolo" and shape is not None and len(labels):
        beyond = np.abs(labels.boxes - clip_boxes(labels.boxes, shape)).max(axis=1)
        row = int(beyond.argmax())
        if beyond[row] > _ROUNDING:
            raise InvalidInputError(
                f"labels hold the box {labels.boxes[row].tolist()} in frame {labels.frames[row]!r}, beyond "
                f"the {shape[1]}x{shape[0]} pixels of shape; write images of each size into a folder of "
                "their own, and clip boxes that leave their image with clip_boxes"
            )
    if kind == "yolo" and labels.ignore.any():
        raise InvalidInputError(
            "labels hold boxes marked ignore, which YOLO cannot mark; drop them with labels[~labels.ignore]"
        )
    if kind in ("mot", "coco_results") and labels.scores is not None and labels.ignore.any():
        raise InvalidInputError(
            f"labels hold predictions marked ignore, which the format {kind!r} cannot mark; drop them with "
            "labels[~labels.ignore]"
        )
    if kind == "coco_results" and labels.scores is None and len(labels):
        raise InvalidInputError("labels need scores for COCO results; write labels as a data set ('coco')")


def _records(labels: FrameBoxes) -> Iterator[dict[str, Any]]:
    """Rows of the table as JSON values, None where a value is unknown."""
    for record in labels.to_pandas().to_dict("records"):
        yield {
            name: None if isinstance(value, float) and math.isnan(value) else value
            for name, value in record.items()
        }


def _write_parquet(labels: FrameBoxes, path: str | os.PathLike[str]) -> None:
    named = any(isinstance(key, str) for key in labels.frame_keys)
    types = {"track_id": "int64", "occluded": "int64", "ignore": "bool"}
    types |= {"frame": "string" if named else "int64"}
    table = labels.to_pandas()
    columns = {name: table[name].tolist() for name in table}
    write_parquet(path, columns, types={name: types.get(name, "double") for name in columns})


def _rows(labels: FrameBoxes) -> Iterator[Row]:
    """Rows for the formats that `write_tracks` shares."""
    for record in _records(labels):
        values: dict[str, Any] = {name: record.get(name) for name in Row._fields[:-1]}
        values["track_id"] = None if record["track_id"] == NO_TRACK else record["track_id"]
        hidden = min(record["occluded"], 2) / 2
        yield Row(**values, visible=round((1 - record["truncated"]) * (1 - hidden), 2))


def _coco_content(
    labels: FrameBoxes, kind: str, shape: tuple[int, ...] | None, truth: str | os.PathLike[str] | None
) -> Any:
    """Return the data set or the list of results, with the image ids of `truth`."""
    if kind == "coco":
        images = coco_images(labels.frame_keys, shape)
        if truth is not None:
            file = read_coco_file(Path(truth))
            images = dict(zip(file.images.values(), file.entries))
            _check_images(labels.frame_keys, images, truth)
        return coco_document(_rows(labels), images)
    if truth is None:
        raise InvalidInputError(
            "truth must name the COCO ground truth, whose image ids the results refer to, got None; "
            "write it with write_labels, too"
        )
    file = read_coco_file(Path(truth))
    categories = vehicle_categories(file, Path(truth), None)
    if len(categories) != 1:
        listed = ", ".join(repr(file.categories[number]) for number in categories) or "none"
        raise InvalidInputError(
            f"truth must have one category of vehicles, as the boxes have none, got {listed}; join them with "
            "write_labels(read_labels(truth), 'vehicles.json', truth=truth) and pass that file"
        )
    images = dict(zip(file.images.values(), file.entries))
    _check_images(labels.frames, images, truth)
    return [coco_result(row, images[row.frame]["id"], *categories) for row in _rows(labels)]


def _check_images(frames: Iterable[FrameKey], images: CocoImages, truth: str | os.PathLike[str]) -> None:
    unknown = next((key for key in frames if key not in images), None)
    if unknown is not None:
        such = f", which has images such as {next(iter(images))!r}" if images else ""
        raise InvalidInputError(
            f"labels hold frame {unknown!r}, which is not an image of {Path(truth).name}{such}; "
            "use the same names (labels.renamed), or drop these boxes"
        )


def _write_kitti(labels: FrameBoxes, folder: Path) -> None:
    """Write one file for each frame into a new folder, which appears when it is complete."""
    for key in labels.frame_keys:
        if not isinstance(key, str) or Path(key).name != key:
            raise InvalidInputError(
                f"labels must have frames that are file names for KITTI, got {key!r}; "
                "name them with labels.renamed(lambda frame: f'{frame:06d}')"
            )
    names: dict[str, FrameKey] = {}
    for key in labels.frame_keys:
        other = names.setdefault(without_suffix(str(key)), key)
        if other != key:
            raise InvalidInputError(
                f"path cannot hold the frames {other!r} and {key!r}, which are one file in KITTI; rename them"
            )
    with new_folder(folder, "KITTI") as part:
        for name, key in names.items():
            with (part / f"{name}.txt").open("w", encoding="utf-8", newline="") as file:
                _write_kitti_file(labels.frame(key), file)


def _write_kitti_file(labels: FrameBoxes, file: IO[str]) -> None:
    """Write the objects of one frame; angle, size and place in 3D are unknown."""
    for row, box in enumerate(labels.boxes.tolist()):
        name = "DontCare" if labels.ignore[row] else "Car"
        corners = " ".join(map(str, box))
        place = "-1 -1 -1 -1000 -1000 -1000 -10"
        score = "" if labels.scores is None else f" {float(labels.scores[row])}"
        file.write(f"{name} {labels.truncated[row]} {labels.occluded[row]} -10 {corners} {place}{score}\n")
