"""The guides of the documentation: their code runs as it stands, on rendered roads."""

import io
import json
import re
import shlex

import numpy as np
import pytest

from tests.cli.commands import succeed
from tests.helpers import ROOT
from tests.network.graphs import constant_network
from tests.video.clips import write_clip
from vehicle_detection import render_scene, write_image
from vehicle_detection.cli.demo import draw_clip
from vehicle_detection.scenes import SceneVehicle, render_drive

SHAPE = (360, 640)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    draw_clip(
        render_drive(frames=15, shape=SHAPE, scenario="traffic"), folder / "drive.mp4", folder / "a.csv"
    )
    return (folder / "drive.mp4").read_bytes()


def run_guide(name, folder, monkeypatch, **names):
    """Run the blocks of a guide in their order, in a folder; return the names that they define."""
    monkeypatch.chdir(folder)
    text = (ROOT / "docs" / f"{name}.md").read_text()
    blocks = re.findall(r"^```(python|bash)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert blocks
    for language, code in blocks:
        if language == "python":
            exec(compile(code, f"{name}.md", "exec"), names)
            continue
        for line in code.splitlines():
            program, *words = shlex.split(line)
            assert program in ("vehicle-detection", "pip")
            if program == "vehicle-detection":
                succeed(*words)
    return names


def junction(count):
    """Frames of a camera that stands: one vehicle comes and one drives away."""
    for part in np.linspace(0, 1, count):
        coming = SceneVehicle(
            distance_m=40 - 32 * part, lateral_m=-3.6, kind="sedan", color="white", view="front"
        )
        leaving = SceneVehicle(distance_m=9 + 30 * part, lateral_m=0.5, kind="suv", color="red")
        view = {"camera_height_m": 2.5, "horizon": 0.45, "light": "day", "rain": 0.0}
        yield render_scene(vehicles=[coming, leaving], lane=1, shape=SHAPE, random_state=3, **view).image


def test_counting(tmp_path, monkeypatch, capsys):
    pytest.importorskip("supervision")
    write_clip(tmp_path / "junction.mp4", list(junction(30)), fps=12)
    names = run_guide("counting", tmp_path, monkeypatch)
    assert (names["line"].in_count, names["line"].out_count) == (1, 1)
    assert names["ways"] == {("far", "near"): 1, ("near", "far"): 1}
    assert capsys.readouterr().out.startswith("1 upwards 1 downwards\n")


def test_dataframe(tmp_path, monkeypatch, drive):
    (tmp_path / "drive.mp4").write_bytes(drive)
    write_image(tmp_path / "road.jpg", next(junction(2)))
    names = run_guide("dataframe", tmp_path, monkeypatch)
    assert len(names["nearest"]) == len(names["seconds"]) == names["frame"]["track_id"].nunique() > 0
    assert (tmp_path / "confident.csv").read_text().count("\n") == len(names["edited"]) + 1


def test_web_service(tmp_path, monkeypatch):
    names = run_guide("web_service", tmp_path, monkeypatch)
    write_image(tmp_path / "road.png", next(junction(2)))

    def post(body):
        answered = []
        environ = {"CONTENT_LENGTH": str(len(body)), "wsgi.input": io.BytesIO(body)}
        (answer,) = names["application"](environ, lambda *given: answered.append(given))
        return answered[0][0][:3], json.loads(answer)

    status, found = post((tmp_path / "road.png").read_bytes())
    assert status == "200"
    assert found
    assert all(len(each["box"]) == 4 and 0 < each["confidence"] <= 1 for each in found)
    status, answer = post(b"GIF89a and no more")
    assert (status, list(answer)) == ("400", ["error"])
    monkeypatch.setitem(names, "MAX_BYTES", 3)
    assert post(b"four")[0] == "413"


def test_own_model(tmp_path, monkeypatch, drive):
    rows = np.zeros((1, 300, 6), np.float32)
    rows[0, 0] = 290, 180, 350, 220, 0.9, 0
    names = {"names": "{0: 'car', 1: 'bus', 2: 'truck'}"}
    network = constant_network({"output0": rows}, size=(640, 640), metadata=names)
    (tmp_path / "mine.onnx").write_bytes(network)
    (tmp_path / "drive.mp4").write_bytes(drive)
    boxes = ([[290, 180, 350, 220]], [0.9])
    names = run_guide(
        "own_model", tmp_path, monkeypatch, my_network=lambda image: boxes, found_elsewhere=[boxes] * 5
    )
    assert names["report"].tracks == 1
    assert [track.id for track in names["result"].shown] == [track.id for track in names["tracks"]] == [1]


def test_fleet(tmp_path, monkeypatch, drive, capsys):
    (tmp_path / "CARD").mkdir()
    (tmp_path / "CARD" / "20260131_221500_F.MP4").write_bytes(drive)
    (tmp_path / "camera-7.mp4").write_bytes(drive)
    names = run_guide("fleet", tmp_path, monkeypatch)
    assert names["trips"]["status"].tolist() == ["done"]
    assert set(names["tracks"]["camera"]) == {"front"}
