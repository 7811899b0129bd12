"""The gallery's pictures of explorer and report."""

import json
from pathlib import Path

import cv2

from tools import pictures, screenshots

GALLERY = Path(__file__).parents[2] / "docs" / "gallery"
HINT = "run python -m tools.screenshots"


def test_the_shipped_pictures_show_the_current_default_model():
    record = json.loads((GALLERY / screenshots.RECORD).read_text())
    assert record["model"] == pictures.file_hash(pictures.MODEL), HINT
    for name in screenshots.FILES:
        assert record["files"][name] == pictures.file_hash(GALLERY / name), HINT
        assert (GALLERY / name).stat().st_size < 150_000
        assert cv2.imread(str(GALLERY / name)).shape[1] == 800
