"""Write label and result files as the annotation and tracking tools of today do, from a known truth.

`tool_cases` feeds them to `read_labels`, whole and damaged: a whole file must give the truth, a damaged one
the truth or an error of the library. Formats that are not read must be named in the error.
"""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import vehicle_detection as vd
from vehicle_detection.errors import VehicleDetectionError

CLASSES = ("person", "car", "truck", "bus")
SHAPE = (540, 960)
CORNERS = ("x1", "y1", "x2", "y2")


@dataclass(frozen=True)
class Box:
    """A true box: an image's number and name, a track, a class and corners in whole pixels."""

    image: int
    name: str
    track: int
    label: str
    corners: tuple[int, int, int, int]
    occluded: int
    score: float

    @property
    def size(self) -> tuple[int, int, int, int]:
        """Left, top, width and height."""
        x1, y1, x2, y2 = self.corners
        return x1, y1, x2 - x1, y2 - y1


@dataclass(frozen=True)
class Written:
    """A file or folder of a tool, and what reading it must give."""

    path: Path
    lines: tuple[Path, ...] = ()  # files in which each line is a box
    header: int = 0  # lines before the boxes
    key: Callable[[Box], Any] = lambda box: box.image  # frame of a box
    all_classes: bool = False  # the format has no class names, so all boxes are read
    tracks: bool = True
    scores: bool = False
    occlusion: bool = False
    options: Mapping[str, Any] | None = None


def random_truth(rng: random.Random) -> list[Box]:
    """Boxes of some images, each with at least one vehicle; names differ as tools and systems write them."""
    pattern = rng.choice(("frame_{:06d}", "{:06d}", "img{}", "drive 1_{}", "straße-{}"))
    boxes = []
    for image in range(rng.randrange(2, 5)):
        for track in range(1, rng.randrange(2, 5)):
            x1, y1 = rng.randrange(0, 800), rng.randrange(0, 440)
            corners = (x1, y1, x1 + rng.randrange(41, 150), y1 + rng.randrange(8, 100))
            label = rng.choice(CLASSES) if track > 1 else "car"
            score = rng.randrange(5, 95) / 100
            name = pattern.format(image)
            boxes.append(Box(image, name, track, label, corners, rng.randrange(2), score))
    return boxes


def _write(path: Path, text: str, rng: random.Random) -> Path:
    """Write a text with the line ends and the mark of some editor or system."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = rng.choice(("", "", "\ufeff")) + text + rng.choice(("", "\n")) * (not text.endswith("\n"))
    path.write_text(text, encoding="utf-8", newline=rng.choice(("\n", "\r\n")))
    return path


def _by_image(truth: Sequence[Box]) -> dict[str, list[Box]]:
    names = dict.fromkeys(box.name for box in truth)
    return {name: [box for box in truth if box.name == name] for name in names}


def _yolo_line(box: Box, *values: object) -> str:
    x, y, width, height = box.size
    sides = (x + width / 2) / SHAPE[1], (y + height / 2) / SHAPE[0], width / SHAPE[1], height / SHAPE[0]
    return " ".join(
        [str(CLASSES.index(box.label)), *map("{:.6f}".format, sides), *map("{:g}".format, values)]
    )  # fmt: skip


def _yolo(
    folder: Path, truth: Sequence[Box], rng: random.Random, values: Callable[[Box], Sequence[float]]
) -> tuple[Path, ...]:
    return tuple(
        _write(folder / f"{name}.txt", "\n".join(_yolo_line(box, *values(box)) for box in boxes), rng)
        for name, boxes in _by_image(truth).items()
    )


def _yolo_key(truth: Sequence[Box]) -> Callable[[Box], Any]:
    """Frame of a box in a YOLO folder: the number, where all names are numbers of six digits."""
    numbers = all(box.name.isdecimal() and len(box.name) == 6 for box in truth)
    return lambda box: box.image if numbers else box.name


def cvat_yolo(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """YOLO 1.1 of CVAT: obj.data, obj.names, train.txt and a folder of a subset."""
    _write(folder / "obj.names", "\n".join(CLASSES), rng)
    _write(folder / "obj.data", "classes = 4\ntrain = data/train.txt\nnames = data/obj.names\n", rng)
    _write(folder / "train.txt", "\n".join(f"data/obj_train_data/{box.name}.png" for box in truth), rng)
    inner = folder / "obj_train_data"
    files = _yolo(inner, truth, rng, lambda box: ())
    return Written(
        rng.choice((folder, inner)), files, key=_yolo_key(truth), tracks=False, options={"shape": SHAPE}
    )


def roboflow_yolo(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """YOLO of Roboflow, of Ultralytics' data sets and of FiftyOne: a YAML file, and labels beside images."""
    listed = json.dumps(CLASSES if rng.random() < 0.5 else dict(enumerate(CLASSES)))
    described = folder / rng.choice(("data.yaml", "dataset.yaml"))
    _write(described, f"train: ../train/images\nnc: 4\nnames: {listed}\n".replace('"', "'"), rng)
    inner = folder / "train" / "labels"
    files = _yolo(inner, truth, rng, lambda box: ())
    return Written(
        rng.choice((inner, inner.parent)), files, key=_yolo_key(truth), tracks=False, options={"shape": SHAPE}
    )


def ultralytics(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """Predictions or tracks of Ultralytics with save_txt and save_conf."""
    tracked = rng.random() < 0.5
    files = _yolo(
        folder / "labels", truth, rng, lambda box: (box.score, box.track) if tracked else (box.score,)
    )
    return Written(
        folder,
        files,
        key=_yolo_key(truth),
        all_classes=True,
        tracks=tracked,
        scores=True,
        options={"shape": SHAPE},
    )


def _coco(truth: Sequence[Box], rng: random.Random, entry: Callable[[Box], Mapping[str, Any]]) -> Any:
    first = rng.randrange(2)  # the first id of Roboflow is 0
    names = rng.choice(("{}.jpg", "cam/{}.jpg", "cam\\{}.jpg"))
    numbers = {name: index + first for index, name in enumerate(_by_image(truth))}
    return {
        "info": {"description": ""},
        "images": [
            {"id": number, "file_name": names.format(name), "height": SHAPE[0], "width": SHAPE[1]}
            for name, number in numbers.items()
        ],
        "categories": [
            {"id": index + first, "name": name, "supercategory": "none"} for index, name in enumerate(CLASSES)
        ],
        "annotations": [
            {
                "id": index + first,
                "image_id": numbers[box.name],
                "category_id": CLASSES.index(box.label) + first,
                "bbox": list(map(float, box.size)),
                "area": box.size[2] * box.size[3],
                "segmentation": [],
                "iscrowd": 0,
                **entry(box),
            }
            for index, box in enumerate(truth)
        ],
    }, names


def cvat_coco(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """COCO 1.0 of CVAT, with tracks and occlusion among the attributes."""
    data, names = _coco(
        truth,
        rng,
        lambda box: {
            "attributes": {
                "track_id": box.track,
                "occluded": bool(box.occluded),
                "keyframe": True,
                "rotation": 0.0,
            }
        },
    )
    path = _write(folder / "annotations" / "instances_default.json", json.dumps(data), rng)
    return Written(path, key=lambda box: names.format(box.name), occlusion=True)


def roboflow_coco(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """COCO of Roboflow, Label Studio and others: no tracks."""
    data, names = _coco(truth, rng, lambda box: {})
    path = _write(folder / "_annotations.coco.json", json.dumps(data, indent=rng.choice((None, 2))), rng)
    return Written(path, key=lambda box: names.format(box.name), tracks=False)


def mmtracking(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """CocoVID of MMTracking and of TAO: tracks as instance_id or track_id."""
    name = rng.choice(("instance_id", "track_id"))
    data, names = _coco(truth, rng, lambda box: {name: box.track, "occluded": bool(box.occluded)})
    path = _write(folder / "train.json", json.dumps(data), rng)
    return Written(path, key=lambda box: names.format(box.name), occlusion=True)


def _mot(
    folder: Path, truth: Sequence[Box], rng: random.Random, values: Callable[[Box], Sequence[object]]
) -> Path:
    separator = rng.choice((",", ", ", " "))
    rows = []
    for box in truth:
        x, y, width, height = box.size
        sides = [f"{side:.{rng.choice((0, 2))}f}" for side in (x + 1, y + 1, width, height)]
        rows.append(separator.join(map(str, (box.image + 1, box.track, *sides, *values(box)))))
    return _write(folder / "gt.txt", "\n".join(rows), rng)


def mot_labels(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """Ground truth of MOTChallenge, also of CVAT's MOT 1.1: flag, class and visibility."""
    path = _mot(folder, truth, rng, lambda box: (1, 1, rng.choice(("1.0", "0.5", "1"))))
    return Written(path, (path,), all_classes=True)


def mot_results(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """Results with 7 to 10 columns, as of BoxMOT, TrackEval and MOTChallenge."""
    ends: tuple[tuple[object, ...], ...] = ((), (2,), (2, -1), (-1, -1), (-1, -1, -1))
    end = rng.choice(ends)
    path = _mot(folder, truth, rng, lambda box: (box.score, *end))
    return Written(path, (path,), all_classes=True, scores=True)


def kitti_tracking(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """Labels of KITTI's tracking benchmark: one file for a drive."""
    names = {"person": "Pedestrian", "car": "Car", "truck": "Truck", "bus": "Van"}
    lines = [
        f"{box.image} {box.track} {names[box.label]} 0 {box.occluded} -1.57 "
        f"{' '.join(map('{:.6f}'.format, box.corners))} 1.5 1.6 4.0 1.0 2.0 30.0 -1.5"
        for box in truth
    ]
    path = _write(folder / "0001.txt", "\n".join(lines), rng)
    return Written(path, (path,), occlusion=True)


def kitti(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """Labels of KITTI's object benchmark: one file for an image."""
    names = {"person": "Pedestrian", "car": "Car", "truck": "Truck", "bus": "Van"}
    files = []
    for name, boxes in _by_image(truth).items():
        lines = [
            f"{names[box.label]} 0.00 {box.occluded} -1.57 {' '.join(map('{:.2f}'.format, box.corners))} "
            "1.65 1.67 3.64 -0.65 1.71 46.70 -1.59"
            for box in boxes
        ]
        files.append(_write(folder / "label_2" / f"{name}.txt", "\n".join(lines), rng))
    return Written(files[0].parent, tuple(files), key=lambda box: box.name, tracks=False, occlusion=True)


def table(folder: Path, truth: Sequence[Box], rng: random.Random) -> Written:
    """Table of spreadsheets and pandas: commas, semicolons or tabs, columns in any order."""
    scored = rng.random() < 0.5
    columns: dict[str, Callable[[Box], object]] = {
        "frame": lambda box: box.image,
        rng.choice(("track", "track_id")): lambda box: box.track,
        **{name: partial(lambda box, at: box.corners[at], at=at) for at, name in enumerate(CORNERS)},
        **({"score": lambda box: box.score} if scored else {"occluded": lambda box: box.occluded}),
        rng.choice(("class", "label", "category")): lambda box: box.label,
        "note": lambda box: "",
    }  # fmt: skip
    order = rng.sample(list(columns), len(columns))
    separator = rng.choice(",;\t")
    rows = [separator.join(str(columns[name](box)) for name in order) for box in truth]
    path = _write(folder / "labels.csv", "\n".join([separator.join(order), *rows]), rng)
    return Written(path, (path,), header=1, scores=scored, occlusion=not scored)


TOOLS: dict[str, Callable[[Path, Sequence[Box], random.Random], Written]] = {
    "CVAT YOLO 1.1": cvat_yolo,
    "Roboflow YOLO": roboflow_yolo,
    "Ultralytics": ultralytics,
    "CVAT COCO 1.0": cvat_coco,
    "Roboflow COCO": roboflow_coco,
    "MMTracking": mmtracking,
    "MOT labels": mot_labels,
    "MOT results": mot_results,
    "KITTI tracking": kitti_tracking,
    "KITTI": kitti,
    "table": table,
}
"""Writers of the formats that are read."""


def _refused(folder: Path, truth: Sequence[Box], rng: random.Random) -> tuple[str, Path]:
    """Write a file of a tool whose format is not read; return a word that the error must hold."""
    box = truth[0]
    x, y, width, height = box.size
    shape = {"label": box.label, "points": [[x, y], [x + width, y + height]], "shape_type": "rectangle"}
    percent = {"x": 100 * x / SHAPE[1], "y": 100 * y / SHAPE[0], "rectanglelabels": [box.label]}
    files = {
        "CVAT": ("annotations.xml", f'<?xml version="1.0" encoding="utf-8"?>\n<annotations>\n'
                 f'<track id="0" label="{box.label}"><box frame="0" xtl="{x}"/></track></annotations>'),
        "Pascal VOC": ("Annotations/a.xml", f"<annotation><object><name>{box.label}</name></object>"),
        "Labelme or X-AnyLabeling": ("a.json", {"version": "2.4.0", "flags": {}, "shapes": [shape],
                                                "imagePath": "a.jpg", "imageData": None}),
        "Label Studio": ("export.json", [rng.choice((
            {"id": 1, "annotations": [{"result": [{"value": percent}]}], "data": {"image": "/data/a.jpg"}},
            {"image": "/data/a.jpg", "id": 1, "label": [percent], "annotator": 1}))]),
        "BDD100K": ("det_train.json", [{"name": "a.jpg", "videoName": "b", "labels": [
            {"id": "1", "category": "car", "box2d": {"x1": x, "y1": y, "x2": 900, "y2": 500}}]}]),
        "VGG Image Annotator": ("via.json", {"a.jpg123": {"filename": "a.jpg", "size": 123, "regions": []}}),
        "Datumaro": ("default.json", {"info": {}, "categories": {"label": {}}, "items": [{"id": "a"}]}),
        "Supervisely": ("a.jpg.json", {"tags": [], "size": {"height": 1, "width": 1}, "objects": []}),
    }  # fmt: skip
    word = rng.choice(list(files))
    name, content = files[word]
    text = content if isinstance(content, str) else json.dumps(content)
    path = _write(folder / name, text, rng)
    return word, path.parent if "/" in name and rng.random() < 0.5 else path


def damage_line(text: str, rng: random.Random, first: int) -> str:
    """Damage one line of a text as interrupted copies, editors and spreadsheets do."""
    lines = text.splitlines()
    at = rng.randrange(first, len(lines))
    separator = next((each for each in (";", "\t", ",") if each in lines[at]), " ")
    cells = lines[at].split(separator)
    frame = (
        lines[0].lstrip("\ufeff").split(separator).index("frame") if first else None
    )  # which may be a name
    number = [place for place, cell in enumerate(cells) if _is_number(cell) and place != frame]
    match rng.randrange(5):
        case 0:
            lines[at] = separator.join(cells[: rng.randrange(1, len(cells))])
        case 1:
            cells[rng.choice(number)] = rng.choice(
                ("inf", "-", "x", "1e999", "1_0", *("nan",) * (frame is None))
            )
            lines[at] = separator.join(cells)
        case 2:
            lines[at] += 4 * (separator + "5")  # one more may be a track or a score
        case 3 if at > first:  # the only line of a file may have lost any optional value
            cut = lines[at][: rng.randrange(1, lines[at].rindex(separator))]
            lines = [*lines[:at], cut]
        case _:  # the copies of some tools end with zeros
            lines = [*lines[: at + 1], "\0" * 20, *lines[at + 1 :]]
    return "\n".join(lines)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def damage_json(text: str, rng: random.Random) -> str:
    """Damage a COCO file: cut it off, or remove or change an entry that others need."""
    if rng.random() < 0.2:
        return text[: rng.randrange(1, len(text.rstrip()) - 1)]
    data = json.loads(text.lstrip("\ufeff"))
    entry = rng.choice(data["annotations"])
    match rng.randrange(7):
        case 0:
            del entry[rng.choice(("bbox", "image_id", "category_id"))]
        case 1:
            entry["bbox"] = rng.choice((entry["bbox"][:3], "10 10 20 20", None, [*entry["bbox"], 1]))
        case 2:
            entry["bbox"][rng.randrange(4)] = rng.choice((None, "x", float("nan"), [1], True))
        case 3:
            entry["bbox"][rng.randrange(2, 4)] = rng.choice((0, -20))
        case 4:
            data["images"] = [each for each in data["images"] if each["id"] != entry["image_id"]]
        case 5:
            data["images"][0]["id"] = data["images"][-1]["id"]
        case _:
            del data[rng.choice(("images", "annotations", "categories"))]
    return json.dumps(data)


def _difference(written: Written, truth: Sequence[Box]) -> str:
    """Read a file, and say how its table differs from the truth; empty if it does not."""
    table = vd.read_labels(written.path, **(written.options or {}))
    boxes = [box for box in truth if written.all_classes or box.label != "person"]
    rows = {
        (written.key(box), tuple(map(float, box.corners))): (
            box.track if written.tracks else -1,
            box.occluded if written.occlusion else 0,
            box.score if written.scores else None,
        )
        for box in boxes
    }
    if ("score" in table.columns) != written.scores:
        return "labels are read as results" if not written.scores else "results are read as labels"
    scores = table["score"]
    if written.scores and table.columns and isinstance(written.options, dict):  # YOLO: log-odds
        scores = 1 / (1 + np.exp(-scores))
    found = {
        (key, tuple(np.round(corners).tolist())): (track, occluded, score if written.scores else None)
        for key, corners, track, occluded, score in zip(
            table["frame"].tolist(),
            table.boxes,
            table["track_id"].tolist(),
            table["occluded"].tolist(),
            np.round(scores, 6).tolist(),
        )
    }
    if table["ignore"].any():
        return "some boxes are ignored"
    wrong = [key for key in rows.keys() | found.keys() if rows.get(key) != found.get(key)]
    return "" if not wrong else f"{wrong[0]}: {rows.get(wrong[0])} is read as {found.get(wrong[0])}"


def _check_whole(written: Written, truth: Sequence[Box]) -> None:
    try:
        difference = _difference(written, truth)
    except VehicleDetectionError as error:
        difference = f"refused: {error}"
    if difference:
        raise AssertionError(difference)


def _check_damaged(written: Written, truth: Sequence[Box]) -> None:
    difference = _difference(written, truth)
    if difference:
        raise AssertionError(f"damage without a word: {difference}")


def _check_refused(word: str, path: Path) -> None:
    try:
        table = vd.read_labels(path)
    except VehicleDetectionError as error:
        if word in str(error):
            raise
        raise AssertionError(f"the error does not name {word}: {error}") from None
    raise AssertionError(f"{word} is read as {table}")


def tool_cases(folder: Path, rng: random.Random) -> Iterator[tuple[str, Callable[[], object]]]:
    """Files of every tool, whole, damaged, and of formats that are not read."""
    while True:
        shutil.rmtree(folder)
        folder.mkdir()
        truth = random_truth(rng)
        if rng.random() < 0.1:
            word, path = _refused(folder, truth, rng)
            yield f"refused: {word}", partial(_check_refused, word, path)
            continue
        name = rng.choice(list(TOOLS))
        written = TOOLS[name](folder / "data", truth, rng)
        if rng.random() < 0.4:
            yield name, partial(_check_whole, written, truth)
            continue
        file = rng.choice(written.lines) if written.lines else written.path
        text = file.read_text(encoding="utf-8")
        damaged = damage_line(text, rng, written.header) if written.lines else damage_json(text, rng)
        file.write_text(damaged, encoding="utf-8")
        yield f"{name}, damaged", partial(_check_damaged, written, truth)
