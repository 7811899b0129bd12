"""The pictures of the README against the truth of their scene."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tools import pictures
from vehicle_detection import DetectorError, detector_from, render_drive

DOCS = Path(__file__).parents[2] / "docs"
RECORD = json.loads((DOCS / pictures.RECORD).read_text())
HINT = "run python -m tools.pictures"


class TestShipped:
    def test_the_pictures_are_those_of_the_record(self):
        assert RECORD["scene"] == pictures.SCENE
        for name in pictures.FILES:
            assert RECORD["files"][name] == pictures.file_hash(DOCS / name), HINT

    def test_they_show_the_current_default_model(self):
        assert RECORD["model"] == pictures.file_hash(pictures.MODEL), HINT

    def test_no_box_is_false_or_missing(self):
        drive = render_drive(**RECORD["scene"])
        assert len(RECORD["boxes"]) == len(drive)
        # Every fifth frame, for speed; the command checks all.
        frames = range(0, len(drive), 5)
        truth = [drive.truth_of(frame) for frame in frames]
        assert pictures.find_errors([RECORD["boxes"][frame] for frame in frames], truth) == []
        assert all(len(rows) >= 4 for rows in truth)


SMALL = {"scenario": "traffic", "frames": 4, "random_state": 76, "shape": (180, 320)}


@pytest.fixture(scope="module")
def true_boxes():
    return [[list(row.box) for row in rows] for rows in render_drive(**SMALL).truth]


def detector_of(boxes):
    """Return a detector that finds these boxes, frame by frame."""
    left = iter(boxes)

    def find(image):
        found = next(left)
        return np.array(found, float).reshape(-1, 4), np.ones(len(found))

    return detector_from(find)


def test_pictures_of_true_boxes_are_written(tmp_path, true_boxes):
    pictures.make_pictures(tmp_path, detector_of(true_boxes), SMALL)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*pictures.FILES, pictures.RECORD])
    with Image.open(tmp_path / pictures.GIF) as animation:
        assert animation.n_frames == 2
        assert animation.info["duration"] == 120
    with Image.open(tmp_path / pictures.HERO) as hero:
        assert hero.size == (320, 180)
    record = json.loads((tmp_path / pictures.RECORD).read_text())
    assert [len(boxes) for boxes in record["boxes"]] == [len(boxes) for boxes in true_boxes]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda boxes: boxes[1:], "frame 0: 0 false and 1 missing boxes"),
        (lambda boxes: [*boxes, [5, 5, 45, 35]], "frame 0: 1 false and 0 missing boxes"),
    ],
)
def test_pictures_with_an_error_are_not_written(tmp_path, true_boxes, change, message):
    detector = detector_of([change(boxes) for boxes in true_boxes])
    with pytest.raises(DetectorError, match=rf"{message}.*choose another random_state"):
        pictures.make_pictures(tmp_path, detector, SMALL)
    assert not list(tmp_path.iterdir())
