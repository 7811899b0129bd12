"""The round trip through CVAT, by the code of its page."""

import json
import re
import zipfile
from pathlib import Path

import numpy as np

from tests.video.clips import write_clip
from vehicle_detection import Detections, TrackTable, read_labels, write_tracks

PAGE = Path(__file__).resolve().parents[2] / "docs" / "cvat.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)


def correct(archive, target):
    """Export as CVAT does: labels by their own numbers, a track deleted, a box moved and one ignored."""
    with zipfile.ZipFile(archive) as uploaded:
        rows = [line.split(",") for line in uploaded.read("gt/gt.txt").decode().splitlines()]
    assert {row[7] for row in rows} == {"1"}, "the task's first label"
    kept = [row for row in rows if row[1] != "2"]
    kept[0][2] = str(float(kept[0][2]) + 5)
    kept[1][6] = "0"
    lines = [",".join([*row[:7], "1", "1.0"]) for row in kept]
    with zipfile.ZipFile(target, "w") as exported:
        exported.writestr("gt/gt.txt", "\n".join(lines))
        exported.writestr("gt/labels.txt", "vehicle\n")


def test_videos(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_clip(tmp_path / "drive.mp4", [np.zeros((96, 128, 3), np.uint8)] * 4)
    places = {1: (10.25, 20, 50, 60), 2: (70, 20, 110, 50)}
    boxes = [*places.values()] * 3
    write_tracks(TrackTable([0, 0, 1, 1, 2, 2], [*places] * 3, boxes, score=[1.5] * 6), "tracks.csv")
    names = {}
    exec(BLOCKS[0], names)
    correct(tmp_path / "annotations.zip", tmp_path / "corrected.zip")
    exec(BLOCKS[1], names)
    labels = read_labels("labels.csv")
    assert labels["track_id"].tolist() == [1, 1, 1]
    np.testing.assert_allclose(labels.boxes[:, 0], [15.25, 10.25, 10.25])
    assert labels["ignore"].tolist() == [False, True, False]
    assert "2 found, 0 missed, 3 false, 1 ignored" in capsys.readouterr().out


def test_images(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    boxes = Detections([[10, 20, 50, 60], [70, 20, 90, 40]], [1.5, 0.5])
    write_tracks(TrackTable.from_detections({"a.jpg": boxes, "b.jpg": Detections.empty()}), "boxes.json")
    document = json.loads(Path("boxes.json").read_text())
    # CVAT numbers images and annotations by itself; the second box was deleted there.
    ids = {image["id"]: number for number, image in enumerate(document["images"], start=1)}
    images = [{"id": ids[each["id"]], "file_name": each["file_name"]} for each in document["images"]]
    kept = document["annotations"][0]
    flags = {"iscrowd": 0, "segmentation": [], "attributes": {"occluded": False}}
    annotation = {"id": 1, "image_id": ids[kept["image_id"]], "category_id": 1, "bbox": kept["bbox"]} | flags
    categories = [{"id": 1, "name": "vehicle"}]
    corrected = {"images": images, "annotations": [annotation], "categories": categories}
    Path("annotations").mkdir()
    Path("annotations/instances_default.json").write_text(json.dumps(corrected))
    names = {}
    exec("import vehicle_detection as vd\n" + BLOCKS[2], names)
    assert names["labels"].frame_keys == ("a.jpg", "b.jpg")
    assert re.search(r"precision +0\.500\n +recall +1\.000\n", capsys.readouterr().out)


def test_every_block_is_run():
    assert len(BLOCKS) == 3
