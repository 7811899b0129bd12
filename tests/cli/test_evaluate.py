import json
from pathlib import Path

import numpy as np

from tests.cli.commands import HEADER, contents, refuse, refuse_each, run, succeed
from vehicle_detection.images import write_image


def test_evaluate_scores_boxes_and_tracks(tmp_path):
    labels, tracks = tmp_path / "labels.csv", tmp_path / "tracks.csv"
    labels.write_text("frame,track,x1,y1,x2,y2\n0,1,10,10,60,50\n1,1,12,10,62,50\n")
    tracks.write_text(f"{HEADER}\n0,4,10,10,60,50,1.5\n1,4,12,10,62,50,1.5\n1,5,300,10,350,50,0.5\n")
    out = succeed("evaluate", tracks, labels, "--json", tmp_path / "scores.json")
    assert "Detections in 2 frames at IoU 0.5" in out
    assert "2 tracks of 1 vehicles in 2 frames" in out
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert (scores["detections"]["tp"], scores["detections"]["fp"], scores["tracks"]["mota"]) == (2, 1, 0.5)
    stills = tmp_path / "stills.csv"
    stills.write_text(f"{HEADER}\n0,,10,10,60,50,1.5\n1,,12,10,62,50,1.5\n")
    assert "tracks of" not in succeed("evaluate", stills, labels, "--iou", 0.9)
    stills.write_text(f"{HEADER}\n0,7,10,10,60,50,1.5\n1,,12,10,62,50,1.5\n")
    mixed = run("evaluate", stills, labels)
    assert "tracks of" not in mixed.stdout
    assert "the tracks are not scored: 1 box has no track in" in mixed.stderr
    labels.write_text("frame,track,x1,y1,x2,y2,ignore\n0,1,0,0,900,500,1\n1,1,12,10,62,50,0\n")
    assert "1 found, 0 missed, 1 false, 0 ignored" in succeed("evaluate", stills, labels)
    assert "0 missed, 0 false, 1 ignored" in succeed("evaluate", stills, labels, "--ignored-as-regions")


def test_evaluate_scores_some_frames(tmp_path):
    labels, found = tmp_path / "labels.csv", tmp_path / "found.csv"
    box = "10,10,60,50"
    labels.write_text("frame,track,x1,y1,x2,y2\n" + "".join(f"f{n}.jpg,{n},{box}\n" for n in range(10)))
    found.write_text(f"{HEADER}\n" + "".join(f"f{n}.jpg,,{box},1.5\n" for n in (0, 1, 9)))
    whole = run("evaluate", found, labels)
    assert "3 found, 7 missed" in whole.stdout
    assert "note: 7 of 10 labelled frames have no box in" in whole.stderr
    (tmp_path / "part.txt").write_text("f0.jpg\r\nf1.jpg\r\nf2.jpg\r\nempty.jpg\r\n")
    part = run("evaluate", found, labels, "--frames", tmp_path / "part.txt")
    assert "Detections in 4 frames" in part.stdout
    assert "2 found, 1 missed, 0 false" in part.stdout
    assert part.stderr == ""
    assert "names no frame of the labels, such as f0" in refuse("evaluate", found, labels, "--frames", "0-9")
    labels.write_text("frame,track,x1,y1,x2,y2\n" + "".join(f"{n},1,{box}\n" for n in range(10)))
    found.write_text(f"{HEADER}\n" + "".join(f"{n},1,{box},1.5\n" for n in (0, 1, 9)))
    out = succeed("evaluate", found, labels, "--frames", "0-1")
    assert "2 found, 0 missed, 0 false" in out
    for listed, frames in {"0,1": 2, "0, 3-5": 4, "0-9:3": 4}.items():
        assert f"Detections in {frames} frames" in succeed("evaluate", found, labels, "--frames", listed)
    for listed in ("0,x", "5-9:0", "none.txt"):
        message = refuse("evaluate", found, labels, "--frames", listed)
        assert "--frames must be numbers such as 0,6,12 or 0-299" in message


def test_evaluate_notes_boxes_in_frames_without_labels(tmp_path):
    labels, found = tmp_path / "labels.csv", tmp_path / "found.csv"
    labels.write_text("frame,track,x1,y1,x2,y2\n0,1,10,10,60,50\n6,1,10,10,60,50\n")
    found.write_text(f"{HEADER}\n" + "".join(f"{n},1,10,10,60,50,1.{n}\n" for n in range(10)))
    result = run("evaluate", found, labels)
    assert result.stderr == (
        f"note: 8 of 10 frames with boxes have no row in {labels}, so their boxes count as false; pass "
        "--frames if not all of them are labelled\n"
    )
    assert run("evaluate", found, labels, "--frames", "0-9:6").stderr == ""
    message = refuse("evaluate", labels, found)
    assert f"{found} has scores and {labels} has none, so they seem to be swapped" in message
    found.write_text(f"{HEADER}\n" + "".join(f"{n},1,10,10,60,50,1\n" for n in (0, 6)))
    assert "2 found, 0 missed, 0 false" in succeed("evaluate", labels, found)  # a constant may be a flag
    found.write_text(f"{HEADER}\n" + "".join(f"{n},1,10,10,60,50,1.{n}\n" for n in (0, 6)))
    assert f"note: {found} has scores, as results do" in run("evaluate", found, found).stderr
    found.write_text(f"{HEADER}\n0,1,20,20,120,100,1\n6,1,20,20,120,100,1\n")
    assert "note: no box is on a label; check" in run("evaluate", found, labels).stderr


def test_evaluate_reads_yolo_folders_with_the_sizes_of_images(tmp_path):
    found, labels, images = tmp_path / "found.csv", tmp_path / "labels", tmp_path / "images"
    for folder in (labels, images):
        folder.mkdir()
    write_image(images / "000001.png", np.zeros((100, 200, 3), np.uint8))
    (labels / "000001.txt").write_text("0 0.5 0.5 0.2 0.4\n")
    found.write_text(f"{HEADER}\n000001.png,,80,30,120,70,1\n")
    assert "1 found, 0 missed, 0 false" in succeed("evaluate", found, labels, "--images", images)
    assert "the folder of the images as images= or --images" in refuse("evaluate", found, labels)


def test_evaluate_refuses_bad_input(material, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("other.csv").write_text("a,b\n1,2\n")
    labels = material / "labels.csv"
    original = labels.read_bytes()
    cases = {
        "missing.csv {labels}": "missing.csv does not exist",
        "other.csv {labels}": "other.csv lacks the columns",
        "{labels} {labels} --json none/s.json": "--json needs an existing folder",
        "other.csv {labels} --json {labels}": "--json .+ is also LABELS .+;",
    }
    refuse_each("evaluate", cases, labels=labels)
    assert labels.read_bytes() == original
    assert contents(tmp_path) == ["other.csv"]
