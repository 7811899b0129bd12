"""Commands as people try them who know other tools: each gives one line with the right one."""

import re
import shlex

import pytest

import vehicle_detection as vd
from tests.cli.commands import refuse

WRONG = {
    "track drive.mp4": "use video", "detcet road.jpg": "use detect",
    "val found.csv labels.csv": "use evaluate", "download": "use fetch", "help": "use --help",
    "banana": "the commands are .*detect, video", "drive.mp4": "use vehicle-detection video drive.mp4",
    "road.jpg": "use vehicle-detection detect road.jpg", "0": "use vehicle-detection video 0",
    "rtsp://camera/1": "use vehicle-detection video rtsp://camera/1",
    "video drive.mp4 --save out.mp4": "use -o TARGET",
    "video --source drive.mp4": "pass SOURCE without an option",
    "video drive.mp4 --weights own.onnx": "use --model NAME|FILE",
    "video drive.mp4 --confidence 0.5": "use --conf P", "video drive.mp4 --workers 2": "use --jobs N",
    "video drive.mp4 --field-of-view 90": "use --fov DEG", "video drive.mp4 --vid-stride 3": "use --every N",
    "video drive.mp4 --gpu": "use --device cpu|cuda", "video drive.mp4 --height 1.2": "use --camera-height M",
    "video drive.mp4 --csv tracks.csv": "use --tracks FILE", "video drive.mp4 --display": "use --show;",
    "video drive.mp4 --mph": "use --units metric|imperial",
    "video drive.mp4 --speed 100": "use --own-speed SPEED", "video drive.mp4 --mute": "use --no-audio;",
    "video drive.mp4 --colour-by id": "use --color-by id|distance",
    "video drive.mp4 --strat 5": "use --start TIME",
    "video drive.mp4 --fov wide": "--fov DEG: .*degrees, such as 90",
    "video drive.mp4 --jobs many": "--jobs N: .*such as 2", "video": "SOURCE: Video file, such as drive.mp4",
    "video missing.mp4": "SOURCE missing.mp4 does not exist; check the path",
    "detect": "IMAGE...: Image files, such as frames/", "detect road.jpg --treshold 0.5": "use --conf P",
    "batch CARD": "--output DIR|URL: .*such as results",
    "info --model default": "pass MODEL without an option",
}  # fmt: skip


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_command_gives_one_line_with_the_right_one(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    expected = WRONG[line].replace("|", r"\|")
    assert re.search(expected, refuse(*shlex.split(line)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("call", "hint"),
    [
        (lambda: vd.track("drive.mp4", workers=2), "jobs"),
        (lambda: vd.process_video("drive.mp4", None, None, vid_stride=2), "every"),
        (lambda: vd.Detector(n_jobs=2), "jobs"),
        (lambda: vd.VehicleDetector(confidence=0.5), "conf"),
        (lambda: vd.detect("road.jpg", threshold=0.5), "conf"),
        (lambda: vd.Camera.dashcam(field_of_view=90), "fov"),
        (lambda: vd.open_camera(height=1.2), "height_m"),
    ],
)
def test_a_wrong_keyword_gives_the_right_one(call, hint):
    with pytest.raises(TypeError, match=f"did you mean '{hint}'"):
        call()


@pytest.mark.parametrize(
    ("name", "hint"), [("VehicleDetecter", "VehicleDetector"), ("readimage", "read_image")]
)
def test_a_misspelt_name_gives_the_right_one(name, hint):
    with pytest.raises(AttributeError, match=f"did you mean {hint}"):
        getattr(vd, name)
