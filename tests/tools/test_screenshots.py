"""The gallery's pictures of explorer and report."""

import json
from pathlib import Path

import cv2
import pytest

from tools import pictures, screenshots
from vehicle_detection import DetectorError, detector_from

GALLERY = Path(__file__).parents[2] / "docs" / "gallery"
HINT = "run python -m tools.screenshots"


def test_the_shipped_pictures_show_the_current_default_model():
    record = json.loads((GALLERY / screenshots.RECORD).read_text())
    assert record["model"] == pictures.file_hash(pictures.MODEL), HINT
    for name in screenshots.FILES:
        assert record["files"][name] == pictures.file_hash(GALLERY / name), HINT
        assert (GALLERY / name).stat().st_size < 150_000
        assert cv2.imread(str(GALLERY / name)).shape[1] == 800


def test_a_picture_with_an_error_is_not_written(tmp_path, monkeypatch):
    scene = {"frames": 3, "shape": (180, 320), "random_state": 76, "scenario": "traffic"}
    monkeypatch.setattr(screenshots, "SCENE", scene)
    monkeypatch.setattr(screenshots, "REPORT_FRAME", 2)
    blind = detector_from(lambda image: ([], []))
    with pytest.raises(DetectorError, match=r"frame 0: 0 false and \d missing boxes; choose another random_"):
        screenshots._write_report(tmp_path, blind)


def test_without_a_browser_nothing_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SystemExit):
        screenshots.main(["-o", str(tmp_path)])
    assert "no chromium and chromedriver here" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
