import re
import shutil
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli.commands import HEADER, contents, refuse, refuse_each, run, succeed
from tests.network.graphs import constant_network
from tests.video.clips import write_clip
from vehicle_detection import ImageDetections, detector, read_frames, read_image, read_labels, write_image
from vehicle_detection.scenes import SceneVehicle, render_scene


def road(*places, **options):
    """Render vehicles by their distances and lateral positions in meters."""
    cars = [SceneVehicle(distance_m=distance, lateral_m=lateral) for distance, lateral in places]
    return render_scene(vehicles=cars, lane=1, **options)


def test_detect_writes_annotated_images_and_boxes(monkeypatch, picture, tmp_path):
    found = [
        ImageDetections([[10, 20, 60.4, 70], [100, 50, 180, 120]], [1.5, 0.25], [0.82, 0.564]),
        ImageDetections(np.empty((0, 4)), np.empty(0)),
    ]
    answers = iter(found)
    monkeypatch.setattr(detector.Detector, "detect", lambda self, image: next(answers))
    other, folder, boxes = tmp_path / "other.jpg", tmp_path / "new" / "out", tmp_path / "boxes.csv"
    write_image(other, read_image(picture))
    out = succeed("detect", picture, other, "-o", folder, "--boxes", boxes, "--jobs", 1)
    assert out.splitlines() == [
        f"{picture}: 2 vehicles  [10 20 60 70] 82%  [100 50 180 120] 56%",
        f"{other}: 0 vehicles",
        f"wrote 2 boxes to {boxes}",
        f"wrote {folder}",
    ]
    assert boxes.read_text().splitlines() == [
        f"{HEADER},confidence,label",
        "road.png,,10.00,20.00,60.40,70.00,1.5000,0.8200,vehicle",
        "road.png,,100.00,50.00,180.00,120.00,0.2500,0.5640,vehicle",
    ]
    assert contents(tmp_path / "new") == ["out", "out/other.jpg", "out/road.png"]
    changed = (read_image(folder / "road.png") != read_image(picture)).any(axis=2)
    assert changed[20, 10:60].all()
    assert changed[50:120, 100].all()
    assert not changed[130:].any()
    assert changed[:20, 10:60].any()  # the score


def test_detect_keeps_boxes_of_a_minimum_confidence(tmp_path):
    write_image(tmp_path / "road.png", road((14, 0), (34, 3.6), shape=(360, 640), random_state=3).image)
    few, many = (succeed("detect", tmp_path / "road.png", "--conf", conf) for conf in (0.999, 0.1))
    assert few.count("%") < many.count("%")


def test_a_wrong_horizon_gives_a_warning(tmp_path):
    scene = road((13, 0), (16, 3.6), (18, -3.6), (22, 0.3), (24, 3.4), shape=(480, 854), random_state=3)
    write_image(tmp_path / "road.png", scene.image)
    assert ": 0 vehicles" not in succeed("detect", tmp_path / "road.png", "--horizon", 0.95)
    highway = "--model", "highway"  # the network searches all rows
    result = run("detect", tmp_path / "road.png", "--horizon", 0.95, *highway)
    assert result.exit_code == 0
    assert ": 0 vehicles" in result.stdout
    assert re.search(
        r"warning: no vehicle was found with --horizon 0.95, but a search of all rows found "
        r"\d boxes, whose horizon is 0.5\d; use --horizon 0.5\d",
        result.stderr,
    )
    write_image(tmp_path / "empty.png", np.full((180, 320, 3), 90, np.uint8))
    result = run("detect", tmp_path / "empty.png", "--horizon", 0.95, *highway)
    assert "leave it out if there are some (a search of all rows found too few vehicles" in result.stderr
    assert run("detect", tmp_path / "empty.png", *highway).stderr == ""
    assert run("detect", tmp_path / "empty.png", "--horizon", 0.95).stderr == ""


def test_patterns_of_images_are_expanded_and_each_image_searched_once(picture, tmp_path):
    for name in ("a.png", "b.png", "c[1].png"):
        shutil.copy(picture, tmp_path / name)
    (tmp_path / "d.png").mkdir()
    out = succeed("detect", tmp_path / "?.png", tmp_path / "c[1].png", "--model", "highway")
    assert [line.partition(":")[0] for line in out.splitlines()] == [
        str(tmp_path / name) for name in ("a.png", "b.png", "c[1].png")
    ]
    # A name with brackets is no pattern, so that a wrong one is refused.
    assert "[a].png does not exist; check the path" in refuse("detect", tmp_path / "[a].png")


def test_folders_are_searched_and_distances_stated_with_a_lens(picture, tmp_path):
    image = road((14, 0), (34, 3.6), shape=(360, 640), random_state=3).image
    for name in ("a/1.png", "b/1.png"):
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / "in" / name, image)
    (tmp_path / "in/b/1.png").rename(tmp_path / "in/b/1.jfif")  # as browsers name JPEG files
    words = "--fov", 58, "-o", tmp_path / "out", "--boxes", tmp_path / "boxes.csv"
    out = succeed("detect", tmp_path / "in", *words)
    assert len(re.findall(r"\d% \d+ ± \d+ m", out)) == 4
    assert contents(tmp_path / "out") == ["a", "a/1.png", "b", "b/1.jfif.png"]
    table = read_labels(tmp_path / "boxes.csv")
    assert table.frame_keys == ("a/1.png", "b/1.jfif")
    assert (np.abs(table["distance_m"] - [14, 34] * 2) < 2 * table["distance_std_m"]).all()


def test_images_are_searched_in_parallel_and_listed_in_order(tmp_path, monkeypatch):
    def detect(self, image):
        time.sleep(0.05 * (image[0, 0, 0] == 0))  # the first one takes longest
        threads.add(threading.get_ident())
        return ImageDetections([[0, 0, 9 + image[0, 0, 0], 9]], [1.0])

    threads = set()
    (tmp_path / "in").mkdir()
    monkeypatch.setattr(detector.Detector, "detect", detect)
    for number in range(6):
        write_image(tmp_path / "in" / f"{number}.png", np.full((96, 128, 3), number, np.uint8))
    out = succeed("detect", tmp_path / "in", "--jobs", 3)
    assert re.findall(r"0 0 (\d+) 9", out) == [str(9 + number) for number in range(6)]
    assert 1 < len(threads) <= 3


def test_a_vehicle_without_a_distance_is_mentioned(tmp_path):
    write_image(tmp_path / "1.png", road((4.0, 1.8), (14, 0), shape=(360, 640), random_state=3).image)
    result = run("detect", tmp_path / "1.png", "--fov", 58)
    unknown = sum("±" not in text for text in result.stdout.split("%")[1:])
    assert (f"no distance for {unknown} vehicle" in result.stderr) == (unknown > 0)


def test_a_damaged_but_readable_image_gives_a_warning(picture, tmp_path):
    write_image(tmp_path / "road.jpg", read_image(picture))
    data = bytearray((tmp_path / "road.jpg").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
    (tmp_path / "road.jpg").write_bytes(data)
    result = run("detect", tmp_path / "road.jpg")
    assert result.exit_code == 0
    assert re.fullmatch(r"(warning: .+road.jpg: Corrupt JPEG data[^\n]*\n)+", result.stderr)
    cv2.imwrite(str(tmp_path / "dark.png"), np.zeros((90, 160), np.uint16))
    assert re.match(r"warning: image file .+dark.png is nearly", run("detect", tmp_path / "dark.png").stderr)


BAD_IMAGES = {
    "{road} --blur plates": "--output must name a folder for --blur",
    "''": "IMAGE must be a file",
    "missing.png": "IMAGE missing.png does not exist; check the path",
    "{material}/empty": "IMAGE .+empty holds no image file",
    "{material}/clip.mp4": "clip.mp4 is a video; use vehicle-detection video",
    "{material}/text.png": "text.png must be a complete image file",
    "{material}/cut_road.png": "cut_road.png must be a complete image file",
    "nothing.png": "nothing.png must be a complete image file",
    "tiny.png --model highway": "image of 12x12 pixels holds no search window",
    "{road} -o {material}": "--output .+ is the folder of road.png, which would be overwritten",
    "{road} -o {road}": "--output must be a folder",
    "{road} twin/road.png -o out": "have the same file name, .*; process one folder at a time",
    "{road} --boxes {road}": "--boxes .+road.png is one of the images; choose another",
    "{road} --boxes boxes.doc": "--boxes must end in .csv or .*, got 'boxes.doc'",
    "{road} --boxes none/boxes.csv": "--boxes needs an existing folder",
    "{road} --model motorway": "model file motorway does not exist; .* a shipped model: default, h",
    "{road} --model {material}/text.safetensors": "text.safetensors is not a complete safetensors",
}
if cv2.__version__ >= "5":  # OpenCV 4 converts floating-point numbers
    BAD_IMAGES["floats.tiff"] = "floats.tiff must be a complete image file"


def test_detect_refuses_bad_input_and_changes_no_file(material, picture, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_image("tiny.png", np.zeros((12, 12, 3), np.uint8))
    cv2.imwrite("floats.tiff", np.zeros((90, 160, 3), np.float32))
    Path("nothing.png").touch()
    Path("twin").mkdir()
    shutil.copy(picture, "twin")
    before, original = (contents(tmp_path), contents(material)), picture.read_bytes()
    refuse_each("detect", BAD_IMAGES, material=material, road=picture)
    assert (contents(tmp_path), contents(material)) == before
    assert picture.read_bytes() == original


def test_images_that_cannot_be_decoded_are_left_out(picture, material, tmp_path):
    bad = [material / "cut_road.png", material / "text.png"]
    words = ("--boxes", tmp_path / "boxes.csv", "-o", tmp_path / "found")
    result = run("detect", bad[0], picture, bad[1], *words)
    assert result.exit_code == 3
    for line, path in zip(result.stderr.splitlines(), bad, strict=True):
        assert line.startswith(f"warning: image file {path} must be a complete image file")
        assert line.endswith("; left out")
    assert succeed("detect", picture, "--boxes", tmp_path / "alone.csv")
    assert (tmp_path / "boxes.csv").read_text() == (tmp_path / "alone.csv").read_text()
    assert contents(tmp_path / "found") == [picture.name]
    # A horizon that hides all vehicles is checked with the other images.
    assert run("detect", bad[0], picture, "--horizon", 0.95).exit_code == 3
    small = tmp_path / "small.png"
    write_image(small, np.zeros((20, 40, 3), np.uint8))
    result = run("detect", small, picture, "--model", "highway")
    assert result.exit_code == 3
    assert f"warning: {small}: image of 40x20 pixels holds no search window" in result.stderr


def test_no_image_that_can_be_decoded_prevents_the_table(material, tmp_path):
    (tmp_path / "boxes.csv").write_text("earlier")
    words = (material / "text.png", material / "cut_road.png", "--boxes", tmp_path / "boxes.csv")
    result = run("detect", *words)
    assert result.exit_code == 2
    assert [line.partition(":")[0] for line in result.stderr.splitlines()] == ["note", "warning", "error"]
    assert (tmp_path / "boxes.csv").read_text() == "earlier"
    assert contents(tmp_path) == ["boxes.csv"]


def test_detect_explains_each_box(tmp_path):
    image, why = tmp_path / "road.png", tmp_path / "why"
    write_image(image, road((14, 0), shape=(360, 640), random_state=1).image)
    out = succeed("detect", image, "--why", why)
    line = r"^  1: score (\S+): margin \1 = \S+ cells \S+ rest$"
    assert re.search(line, out, re.MULTILINE)
    assert contents(why) == ["road.png_1.png"]
    assert out.splitlines()[-1] == f"wrote {why}"
    assert "--why must be a folder" in refuse("detect", image, "--why", image)


def test_detect_and_video_blur_vehicles(tmp_path):
    image, clip = tmp_path / "road.png", tmp_path / "road.mp4"
    car = SceneVehicle(distance_m=14.0, kind="sedan", color="white")
    scene = render_scene(shape=(360, 640), vehicles=[car], lane=1, random_state=1)
    write_image(image, scene.image)
    write_clip(clip, [scene.image] * 3)
    x1, y1, x2, y2 = scene.boxes[0].tolist()
    inside = slice((3 * y1 + y2) // 4, (y1 + 3 * y2) // 4), slice((3 * x1 + x2) // 4, (x1 + 3 * x2) // 4)
    contrasts = []
    for folder, words in (("sharp", []), ("blurred", ["--blur", "vehicles"])):
        succeed("detect", image, "-o", tmp_path / folder, *words)
        succeed("video", clip, "-o", tmp_path / f"{folder}.mp4", "--preset", "ultrafast", *words)
        with read_frames(tmp_path / f"{folder}.mp4") as frames:
            pictures = read_image(tmp_path / folder / "road.png"), next(frames)[2]
        contrasts.append([np.abs(np.diff(picture[inside].mean(2), axis=0)).max() for picture in pictures])
    assert (np.array(contrasts[1]) < 0.5 * np.array(contrasts[0])).all()


def test_classes_of_a_network(picture, tmp_path):
    boxes = np.zeros((1, 8, 189), np.float32)
    boxes[0, :, 0], boxes[0, :, 1] = [48, 48, 24, 24, 0, 0, 0.9, 0], [30, 60, 20, 20, 0.8, 0, 0, 0]
    outputs = {"output0": boxes}
    names = {"names": "{0: 'person', 1: 'bicycle', 2: 'car', 3: 'dog'}"}
    path = tmp_path / "other.onnx"
    path.write_bytes(constant_network(outputs, metadata=names))
    assert "1 vehicle" in succeed("detect", picture, "--model", path)
    assert "2 vehicles" in succeed("detect", picture, "--model", path, "--classes", "0,car")
    assert "0 vehicles" in succeed("detect", picture, "--model", path, "--classes", "dog")
    assert re.search(r"classes +car\s", succeed("info", path))
    message = refuse("detect", picture, "--model", path, "--classes", "tram")
    assert re.search(r"--classes must be classes of .* got 'tram'; it has person \(0\), bicycle", message)
    message = refuse("detect", picture, "--model", "highway", "--classes", "car")
    assert "--classes must be omitted for 'highway', which is no network" in message
    message = refuse("detect", picture, "--model", path, "--device", "gpu")
    assert "--device must be one of 'cpu', 'cuda'; got 'gpu'" in message


@pytest.mark.realdata
def test_the_course_images_by_command(real_data, tmp_path):
    images = sorted((real_data / "test_images").glob("*.jpg"))
    succeed("detect", *images, "--boxes", tmp_path / "boxes.csv")
    labels = real_data / "labels" / "test_images.csv"
    assert "9 found, 0 missed, 0 false" in succeed("evaluate", tmp_path / "boxes.csv", labels)
