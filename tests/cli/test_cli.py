import csv
import errno
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import vehicle_detection
from tests.helpers import start_interruptible
from tests.network.graphs import constant_network
from tests.video.clips import damage_sizes, write_clip
from vehicle_detection import datasets, detector, training, video
from vehicle_detection._common import files as _files
from vehicle_detection._common import progress_bar
from vehicle_detection.annotator import DrawParams
from vehicle_detection.boxes import Detections
from vehicle_detection.camera import HorizonEstimate
from vehicle_detection.cli import output
from vehicle_detection.cli.app import app
from vehicle_detection.cli.demo import FILES, REPORT, SHEET, draw_clip, scored_truth
from vehicle_detection.cli.options import parse_time
from vehicle_detection.cli.output import (
    check_distinct_paths,
    output_folder,
    print_error,
    print_table,
    run_interruptible,
)
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.images import read_image, write_image
from vehicle_detection.loading import load_model
from vehicle_detection.scenes import SceneVehicle, render_drive, render_patches, render_scene
from vehicle_detection.svm import VehicleClassifier, load_classifier
from vehicle_detection.video import FrameSource, probe_video, read_frames

COMMANDS = ("demo", "detect", "video", "batch", "evaluate", "train", "train-frames", "tune", "fetch", "info")
HEADER = "frame,track_id,x1,y1,x2,y2,score"


def run(*words):
    """Run a command in this process; errors that it does not handle are raised here."""
    result = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert "\x1b" not in result.output, "colors without a terminal"
    return result


def succeed(*words):
    result = run(*words)
    assert result.exit_code == 0, result.output
    return result.stdout


def refuse(*words, code=2):
    """Run a command that must fail with one line on standard error; return the line."""
    result = run(*words)
    assert result.exit_code == code, result.output
    assert re.fullmatch(r"error: [^\n]+\n", result.stderr), result.stderr
    return result.stderr


def start(*words, **options):
    return start_interruptible(sys.executable, "-m", "vehicle_detection", *words, **options)


def finish(process):
    out, errors = process.communicate(timeout=300)
    return process.returncode, out, errors


def contents(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """Return a folder with a clip and its labels, a picture, patches and damaged copies."""
    folder = tmp_path_factory.mktemp("material")
    drive = render_drive(frames=10, shape=(270, 480), scenario="overtaking")
    draw_clip(drive, folder / "clip.mp4", folder / "labels.csv")
    write_image(folder / "road.png", drive[6].image)
    patches, labels = render_patches(40, random_state=3)
    for number, (patch, label) in enumerate(zip(patches, labels)):
        home = folder / ("vehicles" if label else "non-vehicles") / "drawn"
        home.mkdir(parents=True, exist_ok=True)
        write_image(home / f"{number}.png", patch)
    for name in ("clip.mp4", "road.png"):
        data = (folder / name).read_bytes()
        (folder / f"cut_{name}").write_bytes(data[: len(data) // 2])
    for name in ("text.mp4", "text.png", "text.safetensors"):
        (folder / name).write_text("not what the name says")
    (folder / "empty").mkdir()
    return folder


@pytest.fixture
def picture(material):
    return material / "road.png"


@pytest.fixture
def clip(material):
    return material / "clip.mp4"


# --- the program ---


def test_help_has_a_short_option():
    for words in ((), ("video",), ("train",)):
        assert "Show this message and exit" in succeed(*words, "-h")


def test_options_are_listed_in_panels():
    page = succeed("video", "--help")
    titles = re.findall(r"^╭─ (\w+) ─", page, re.MULTILINE)
    assert titles == ["Arguments", "Options", "Output", "Input", "Camera", "Search", "Drawing"]
    assert re.search(r"--live\s+Drop frames", page), "an option without a value has no type"


def test_shells_complete_commands_and_options():
    words = {"vehicle-detection ev": ["evaluate"], "vehicle-detection video --pa": ["--panel"]}
    for typed, expected in words.items():
        variables = {"COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}
        variables["_VEHICLE_DETECTION_COMPLETE"] = "complete_bash"
        process = start(env={**os.environ, **variables})
        assert finish(process) == (0, "\n".join(expected) + "\n", "")


def test_every_command_has_help_that_loads_no_heavy_library():
    code = (
        "import sys, json\n"
        "from typer.testing import CliRunner\n"
        "from vehicle_detection.cli.app import app\n"
        "pages = [[], *([command] for command in sys.argv[1:])]\n"
        "results = [CliRunner().invoke(app, [*words, '--help']) for words in pages]\n"
        "roots = sorted({name.split('.')[0] for name in sys.modules})\n"
        "print(json.dumps([[r.exit_code, r.stdout] for r in results] + [roots]))"
    )
    out = subprocess.run([sys.executable, "-c", code, *COMMANDS], capture_output=True, text=True, check=True)
    assert out.stderr == ""
    *pages, loaded = json.loads(out.stdout)
    assert not set(loaded) & {"numpy", "numba", "cv2", "sklearn", "moviepy", "matplotlib", "pandas", "scipy"}
    assert [code for code, _ in pages] == [0] * len(pages)
    for command, (_, page) in zip(COMMANDS, pages[1:]):
        assert command in pages[0][1]
        assert re.search(rf"Usage: \S+ {command}", page)


def test_module_runs_as_a_program(picture, tmp_path):
    # In parallel, as most of the time is spent on starting.
    runs = [
        start("detect", picture, "-o", tmp_path / "out", env={**os.environ, "NO_COLOR": "1"}),
        start("detect", tmp_path / "missing.png"),
        start("detect", tmp_path),
        start("--version"),
        start("detect", "--nonsense"),
    ]
    (found, missing, folder, version, usage) = (finish(process) for process in runs)
    assert found[0] == 0
    assert found[2] == ""
    assert re.match(rf"{re.escape(str(picture))}: \d+ vehicles?( |\n)", found[1])
    assert contents(tmp_path) == ["out", "out/road.png"]
    assert missing[:2] == (2, "")
    assert re.fullmatch(r"error: IMAGE .+missing.png does not exist; check the path\n", missing[2])
    assert folder[0] == 2
    assert re.fullmatch(r"error: IMAGE .+ is a folder; choose files in it, such as .+\n", folder[2])
    assert version == (0, f"{vehicle_detection.__version__}\n", "")
    assert usage[0] == 2
    assert "--nonsense" in usage[2]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signal")
def test_ctrl_c_leaves_nothing_behind(tmp_path, material):
    long = tmp_path / "long.mp4"
    draw_clip(render_drive(frames=1, shape=(270, 480), scenario="empty"), long, tmp_path / "labels.csv")
    slow = (
        "import time, sys\n"
        "import vehicle_detection.{module} as module\n"
        "module.{name} = lambda *a, **k: (print('now', flush=True), time.sleep(600))\n"
        "sys.argv = ['vehicle-detection', *sys.argv[1:]]\n"
        "from vehicle_detection.cli import main; main()"
    )
    out, patches = tmp_path / "out", (material / "vehicles", material / "non-vehicles")
    runs = {
        ("video", "process_video"): ["video", long, "-o", out / "x.mp4", "--tracks", out / "x.csv"],
        ("cli.demo", "draw_clip"): ["demo", "-o", tmp_path / "demo" / "deep"],
        ("training", "train_and_evaluate"): [
            "train", "--vehicles", patches[0], "--non-vehicles", patches[1], "-o", out / "x.safetensors",
        ],
    }  # fmt: skip
    out.mkdir()
    processes = [
        start_interruptible(sys.executable, "-c", slow.format(module=module, name=name), *words)
        for (module, name), words in runs.items()
    ]
    for process in processes:
        assert process.stdout.readline() == "now\n"
        os.killpg(process.pid, signal.SIGINT)
        assert finish(process) == (130, "", "interrupted\n")
    assert contents(out) == []
    assert not (tmp_path / "demo").exists()


def test_an_interrupted_command_leaves_no_file(monkeypatch, picture, tmp_path):
    def interrupt(self, image):
        raise KeyboardInterrupt

    monkeypatch.setattr(detector.VehicleDetector, "detect", interrupt)
    result = run("detect", picture, "-o", tmp_path / "a" / "b", "--boxes", tmp_path / "boxes.csv")
    assert (result.exit_code, result.stdout, result.stderr) == (130, "", "interrupted\n")
    assert contents(tmp_path) == []


def test_a_full_disk_is_one_line(monkeypatch, picture, tmp_path):
    def fill(source, target, *rest, **options):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", fill)
    assert "No space left" in refuse("detect", picture, "--boxes", tmp_path / "boxes.csv")
    assert contents(tmp_path) == []


def test_unexpected_errors_keep_their_traceback(monkeypatch, picture):
    def fail(self, image):
        raise RuntimeError("a bug")

    monkeypatch.setattr(detector.VehicleDetector, "detect", fail)
    with pytest.raises(RuntimeError, match="a bug"):
        run("detect", picture)


# --- detect ---


def test_the_segments_of_a_card_become_one_video(material, tmp_path):
    card = tmp_path / "card"
    card.mkdir()
    for second in range(3):
        shutil.copy(material / "clip.mp4", card / f"20260131_08150{second}_F.mp4")
    shutil.copy(material / "clip.mp4", card / "20260131_081500_R.mp4")
    error = refuse("video", card, "-o", tmp_path / "trip.mp4")
    assert "holds 2 trips (front" in error
    out = succeed("video", card / "*_F.mp4", "-o", tmp_path / "trip.mp4", "--tracks", tmp_path / "t.csv")
    assert out.startswith(f"{3 * probe_video(material / 'clip.mp4').frames} frames")
    assert contents(tmp_path)[-2:] == ["t.csv", "trip.mp4"]


def test_video_needs_something_to_do(material, picture, tmp_path):
    clip = material / "clip.mp4"
    assert "--output must name the video to write; or use --show" in refuse("video", clip)
    assert "--output must name a video for --report" in refuse("video", clip, "--report", tmp_path / "r.html")
    assert "--output must name a video for --clips" in refuse(
        "video", clip, "--show", "--clips", tmp_path / "clips"
    )
    tracks = ["--tracks", tmp_path / "t.csv"]
    assert "--output must name a video for --blur" in refuse("video", clip, *tracks, "--blur", "plates")
    assert "--output must name a folder for --blur" in refuse("detect", picture, "--blur", "plates")
    out = succeed("video", clip, "--tracks", tmp_path / "t.parquet", "--model", "highway")
    assert out.endswith(f"wrote {tmp_path / 't.parquet'}\n")
    assert contents(tmp_path) == ["t.parquet"]


def test_batch_refuses_bad_input_in_one_line(material, tmp_path):
    out = tmp_path / "out"
    for message, words in {
        r"SOURCES\.\.\. must name at least one video": [],
        r"SOURCES\.\.\. nothing does not exist; check the path": ["nothing"],
        r"SOURCES\.\.\. .+empty holds no videos": [material / "empty"],
        r"--shard must be a number and a count, such as 3/200 .* got '9/3'": ["x", "--shard", "9/3"],
        r"--group must be one of 'trip', 'file'": ["x", "--group", "day"],
        r"--output .+nothing is not a folder": ["--status", "-o", tmp_path / "nothing"],
        r"model file nothing does not exist": ["x", "--model", "nothing"],
        r"--preset must be one of": ["x", "--preset", "quick"],
        r"--every must be an integer": ["x", "--every", "0"],
        r"--fov must be a number": ["x", "--fov", "999"],
        r"--blur must be one of": ["x", "--blur", "faces"],
    }.items():
        assert re.search(message, refuse("batch", "-o", out, *words)), message
    assert succeed("batch", "-o", tmp_path, "--status").startswith("0 trips done, 0 failed, 0 errors\n")


def test_detect_writes_annotated_images_and_boxes(monkeypatch, picture, tmp_path):
    found = [
        Detections([[10, 20, 60.4, 70], [100, 50, 180, 120]], [1.5, 0.25], [0.82, 0.564]),
        Detections.empty(),
    ]
    answers = iter(found)
    monkeypatch.setattr(detector.VehicleDetector, "detect", lambda self, image: next(answers))
    other, folder, boxes = tmp_path / "other.jpg", tmp_path / "new" / "out", tmp_path / "boxes.csv"
    write_image(other, read_image(picture))
    out = succeed("detect", picture, other, "-o", folder, "--boxes", boxes)
    assert out.splitlines() == [
        f"{picture}: 2 vehicles  [10 20 60 70] 82%  [100 50 180 120] 56%",
        f"{other}: 0 vehicles",
        f"wrote 2 boxes to {boxes}",
        f"wrote {folder}",
    ]
    assert boxes.read_text().splitlines() == [
        f"{HEADER},confidence",
        "road.png,,10.00,20.00,60.40,70.00,1.5000,0.8200",
        "road.png,,100.00,50.00,180.00,120.00,0.2500,0.5640",
    ]
    assert contents(tmp_path / "new") == ["out", "out/other.jpg", "out/road.png"]
    changed = (read_image(folder / "road.png") != read_image(picture)).any(axis=2)
    assert changed[20, 10:60].all()
    assert changed[50:120, 100].all()
    assert not changed[130:].any()
    assert changed[:20, 10:60].any()  # the score


def test_detect_draws_scores_and_lines_as_asked(monkeypatch, picture, tmp_path):
    found = Detections([[100, 60, 180, 120]], [1.5])
    monkeypatch.setattr(detector.VehicleDetector, "detect", lambda self, image: found)
    image, changed = read_image(picture), {}
    for name, words in {"plain": [], "bare": ["--labels", "none"], "wide": ["--line-width", 5]}.items():
        succeed("detect", picture, "-o", tmp_path / name, *words)
        changed[name] = (read_image(tmp_path / name / "road.png") != image).any(axis=2)
    assert changed["plain"][:60].any()
    assert not changed["bare"][:60].any()
    assert changed["wide"][90, 100:140].sum() == 5


def test_detect_keeps_boxes_of_a_minimum_confidence(tmp_path):
    cars = [
        SceneVehicle(distance_m=distance, lateral_m=lateral) for distance, lateral in ((14, 0), (34, 3.6))
    ]
    scene = render_scene(shape=(360, 640), vehicles=cars, lane=1, random_state=3)
    write_image(tmp_path / "road.png", scene.image)
    counts = {}
    for conf in (0.1, 0.999):
        succeed("detect", tmp_path / "road.png", "--conf", conf, "--boxes", tmp_path / "boxes.csv")
        rows = (tmp_path / "boxes.csv").read_text().splitlines()[1:]
        assert all(float(row.split(",")[-1]) >= conf for row in rows)
        counts[conf] = len(rows)
    assert counts[0.1] > counts[0.999]


def test_a_wrong_horizon_gives_a_warning(tmp_path):
    cars = [
        SceneVehicle(distance_m=distance, lateral_m=lateral)
        for distance, lateral in ((15, 0), (19, 3.6), (28, -3.6), (38, 0.3), (42, 3.4))
    ]
    scene = render_scene(vehicles=cars, lane=1, random_state=3)
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


def test_video_takes_the_camera(tmp_path):
    tables = {}
    clip = tmp_path / "clip.mp4"
    drive = render_drive(frames=12, shape=(720, 1280), scenario="crossing", random_state=1)
    draw_clip(drive, clip, tmp_path / "labels.csv")
    camera = tmp_path / "camera.json"
    camera.write_text('{"field_of_view": 120, "height_m": 1.3}')
    for words in ((), ("--fov", 58), ("--fov", 120, "--camera-height", 1.3), ("--camera", camera)):
        tracks = tmp_path / "tracks.csv"
        result = run("video", clip, "-o", tmp_path / "out.mp4", "--tracks", tracks, *words)
        assert result.exit_code == 0
        rows = [row for row in csv.DictReader(tracks.read_text().splitlines()) if row["distance_m"]]
        assert rows
        warned = "warning: distances assume a lens of 58 degrees" in result.stderr
        assert warned == (not words)
        tables[words] = {(row["frame"], row["track_id"]): float(row["distance_m"]) for row in rows}
    standard, wide, file = (tables[words] for words in list(tables)[1:])
    ratios = [wide[key] / standard[key] for key in wide.keys() & standard.keys()]
    assert np.median(ratios) == pytest.approx(0.32, abs=0.06)
    ratios = [wide[key] / file[key] for key in wide.keys() & file.keys()]
    assert ratios == pytest.approx([1.0] * len(ratios), rel=0.02)
    for words, message in (
        (("--fov", 200), "--fov must be a number, at least 1 and at most 170"),
        (("--units", "nautical"), "--units must be one of 'metric', 'imperial'; got 'nautical'"),
        (("--camera-height", 0), "--camera-height must be a number"),
        (("--camera", "missing.json"), "--camera must be one of standard-58, "),
        (("--camera", "wide-90", "--fov", 90), "--fov must be omitted with a camera"),
    ):
        result = run("video", clip, "-o", tmp_path / "out.mp4", *words)
        assert result.exit_code == 2
        assert message in result.stderr


def test_video_warns_of_a_wrong_horizon(clip, tmp_path, monkeypatch):
    found = HorizonEstimate(horizon=0.551, horizon_std=0.012, camera_height_m=1.3, n_boxes=40)
    monkeypatch.setattr(video, "estimate_video_horizon", lambda *_, **__: found)
    words = ["video", clip, "-o", tmp_path / "out.mp4", "--end", 0.12, "--model", "highway"]
    result = run(*words, "--horizon", 0.95)
    assert "warning: no vehicle was found with --horizon 0.95, but a search of all rows" in result.stderr
    camera = tmp_path / "camera.json"
    camera.write_text('{"field_of_view": 58, "horizon": 0.95}')
    result = run(*words, "--camera", camera)
    assert f"warning: no vehicle was found with the horizon of --camera {camera}, but" in result.stderr


def test_the_horizon_of_images_is_checked_at_their_frame_rate(tmp_path):
    (tmp_path / "images").mkdir()
    for number in range(4):
        write_image(tmp_path / "images" / f"{number}.png", np.full((180, 320, 3), 90, np.uint8))
    words = ["--fps", 1, "--start", 2, "--horizon", 0.95, "--tracks", tmp_path / "tracks.csv"]
    result = run("video", tmp_path / "images", *words, "--model", "highway")
    assert result.exit_code == 0
    assert "a search of all rows found too few vehicles" in result.stderr


def test_an_image_given_twice_is_searched_once(picture, tmp_path):
    once = succeed("detect", picture, "--boxes", tmp_path / "once.csv")
    assert once.count("vehicle") == succeed("detect", picture, picture, "--boxes", tmp_path / "b.csv").count(
        "vehicle"
    )
    assert (tmp_path / "b.csv").read_text() == (tmp_path / "once.csv").read_text()


def test_patterns_of_images_are_expanded(picture, tmp_path):
    for name in ("a.png", "b.png", "c[1].png"):
        shutil.copy(picture, tmp_path / name)
    (tmp_path / "d.png").mkdir()
    out = succeed("detect", tmp_path / "?.png", tmp_path / "c[1].png", "--model", "highway")
    assert [line.partition(":")[0] for line in out.splitlines()] == [
        str(tmp_path / name) for name in ("a.png", "b.png", "c[1].png")
    ]
    # A name with brackets is no pattern, so that a wrong one is refused.
    assert "[a].png does not exist; check the path" in refuse("detect", tmp_path / "[a].png")


def test_two_names_of_a_file_are_one_file(tmp_path):
    (tmp_path / "a.csv").touch()
    os.link(tmp_path / "a.csv", tmp_path / "A2.csv")  # as A.csv on a disk that ignores case
    with pytest.raises(InvalidInputError, match=r"--json .+A2.csv is also LABELS .+a.csv; choose another"):
        check_distinct_paths({"--json": tmp_path / "A2.csv"}, {"LABELS": tmp_path / "a.csv"})


def test_detect_accepts_every_kind_of_image(picture, tmp_path):
    image = cv2.imread(str(picture))
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    kinds = {
        "rgba.png": cv2.cvtColor(image, cv2.COLOR_BGR2BGRA),
        "deep.png": image.astype(np.uint16) * 257,
        "gray.png": gray,
        "gray_deep.png": gray.astype(np.uint16) * 257,
        "plain.bmp": image,
    }
    for name, pixels in kinds.items():
        assert cv2.imwrite(str(tmp_path / name), pixels)
    out = succeed("detect", picture, *(tmp_path / name for name in kinds), "-o", tmp_path / "out")
    found = {Path(line.partition(": ")[0]).name: line.partition(": ")[2] for line in out.splitlines()[:-1]}
    assert list(found) == ["road.png", *kinds]
    assert found["rgba.png"] == found["deep.png"] == found["plain.bmp"] == found["road.png"]
    assert found["gray.png"] == found["gray_deep.png"]
    assert contents(tmp_path / "out") == sorted(found)


def test_detect_adds_a_suffix_to_an_image_without_one(picture, tmp_path):
    shutil.copy(picture, tmp_path / "frame7")
    succeed("detect", tmp_path / "frame7", "-o", tmp_path / "out")
    assert contents(tmp_path / "out") == ["frame7.png"]


def test_a_damaged_but_readable_image_gives_a_warning(picture, tmp_path):
    write_image(tmp_path / "road.jpg", read_image(picture))
    data = bytearray((tmp_path / "road.jpg").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
    (tmp_path / "road.jpg").write_bytes(data)
    result = run("detect", tmp_path / "road.jpg")
    assert result.exit_code == 0
    assert re.fullmatch(r"(warning: .+road.jpg: Corrupt JPEG data[^\n]*\n)+", result.stderr)


def bad_images(material, tmp):
    tiny = tmp / "tiny.png"
    write_image(tiny, np.zeros((12, 12, 3), np.uint8))
    floats = tmp / "floats.tiff"
    assert cv2.imwrite(str(floats), np.zeros((90, 160, 3), np.float32))
    (tmp / "nothing.png").touch()
    (tmp / "twin").mkdir()
    shutil.copy(material / "road.png", tmp / "twin")
    road = material / "road.png"
    return {
        r"IMAGE .+missing.png does not exist; check the path": [tmp / "missing.png"],
        r"IMAGE .+empty is a folder; choose files in it": [material / "empty"],
        r"clip.mp4 is a video; use vehicle-detection video": [material / "clip.mp4"],
        r"text.png must be a complete image file": [material / "text.png"],
        r"cut_road.png must be a complete image file": [material / "cut_road.png"],
        r"nothing.png must be a complete image file": [tmp / "nothing.png"],
        # OpenCV 4 converts floating-point numbers.
        **({} if cv2.__version__ < "5" else {r"floats.tiff must be a complete image file": [floats]}),
        r"image of 12x12 pixels holds no search window": [tiny, "--model", "highway"],
        r"--horizon must be a number, at least 0 and at most 1; got 2": [road, "--horizon", 2],
        r"--conf must be a number, at least 0 and at most 1; got 7": [road, "--conf", 7],
        r"--horizon must be a number, .* got nan": [road, "--horizon", "nan"],
        r"--output .+ is the folder of road.png, which would be overwritten": [road, "-o", material],
        r"--output must be a folder, .+ cannot be created: File exists": [road, "-o", road],
        r"have the same file name, which identifies the results": [
            road,
            tmp / "twin" / "road.png",
            "-o",
            tmp / "out",
        ],
        r"--boxes .+road.png is one of the images": [road, "--boxes", road],
        r"--labels must be one of 'score', 'none'; got 'id'": [road, "--labels", "id"],
        r"--line-width must be an integer from 1 to 1000; got 0": [road, "--line-width", 0],
        r"--boxes must end in .csv or .*, got 'boxes.doc'": [road, "--boxes", tmp / "boxes.doc"],
        r"--boxes needs an existing folder, .+none is not one": [
            road,
            "--boxes",
            tmp / "none" / "boxes.csv",
        ],
        r"model file .+none.safetensors does not exist": [road, "--model", tmp / "none.safetensors"],
        r"model file motorway does not exist; .* a shipped model: default, h": [road, "--model", "motorway"],
        r"model file .+empty is a folder": [road, "--model", material / "empty"],
        r"text.safetensors is not a complete safetensors": [road, "--model", material / "text.safetensors"],
    }


def test_detect_refuses_bad_input_and_changes_no_file(material, tmp_path):
    cases = bad_images(material, tmp_path)
    before = contents(tmp_path), contents(material)
    original = (material / "road.png").read_bytes()
    for message, words in cases.items():
        assert re.search(message, refuse("detect", *words)), message
    assert (contents(tmp_path), contents(material)) == before
    assert (material / "road.png").read_bytes() == original


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


def test_no_image_that_can_be_decoded_prevents_the_table(material, tmp_path):
    (tmp_path / "boxes.csv").write_text("earlier")
    words = (material / "text.png", material / "cut_road.png", "--boxes", tmp_path / "boxes.csv")
    result = run("detect", *words)
    assert result.exit_code == 2
    assert [line.partition(":")[0] for line in result.stderr.splitlines()] == ["note", "warning", "error"]
    assert (tmp_path / "boxes.csv").read_text() == "earlier"
    assert contents(tmp_path) == ["boxes.csv"]


def test_damaged_models_are_refused(picture, tmp_path):
    whole = tmp_path / "whole.safetensors"
    model = load_classifier()
    model.save(whole)
    data = whole.read_bytes()
    assert succeed("info", whole).startswith(f"{whole}: {model.params.length} features")
    swapped = bytearray(data)
    swapped[-5] ^= 255
    other = data.replace(b'\\"spatial_size\\": 32', b'\\"spatial_size\\": 16')
    assert len(other) == len(data)
    assert other != data
    damaged = {
        "cut": (data[: len(data) // 2], "is not a complete safetensors file"),
        "edited": (bytes(swapped), "was changed after it was written"),
        "other": (other, "was changed after it was written"),
    }
    for name, (content, message) in damaged.items():
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(content)
        assert message in refuse("detect", picture, "--model", path)
        assert message in refuse("info", path)
        assert message in refuse("video", tmp_path / "x.mp4", "-o", tmp_path / "y.mp4", "--model", path)


def test_a_model_inconsistent_with_its_parameters_is_refused(picture, tmp_path, monkeypatch):
    model = load_classifier()
    monkeypatch.setattr(VehicleClassifier, "__post_init__", lambda self: None)
    VehicleClassifier(replace(model.params, spatial_size=16), model.templates).save(
        tmp_path / "m.safetensors"
    )
    monkeypatch.undo()
    message = refuse("detect", picture, "--model", tmp_path / "m.safetensors")
    assert re.search(r"does not fit its own parameters: templates must have \d+ weights", message)


# --- video ---


def test_video_writes_an_annotated_copy_and_tracks(clip, tmp_path):
    target, tracks = tmp_path / "out.mp4", tmp_path / "tracks.csv"
    out = succeed("video", clip, "-o", target, "--tracks", tracks, "--preset", "ultrafast", "--profile")
    lines = out.splitlines()
    assert re.match(
        r"10 frames of 480x270 in \d+\.\d s: .* frames/s, .* times real time, \d+ vehicle", lines[0]
    )
    assert lines[1].split() == ["stage", "ms/frame", "fraction"]
    assert [line.split()[0] for line in lines[2:8]] == [
        "decode", "search", "regions", "track", "draw", "encode"
    ]  # fmt: skip
    assert lines[-1] == f"wrote {target}, {tracks}"
    assert tracks.read_text().splitlines()[0] == (
        f"{HEADER},distance_m,speed_mps,confidence,distance_std_m,speed_std_mps,time_s"
    )
    written, source = probe_video(target), probe_video(clip)
    assert (written.shape, written.fps, written.frames) == (source.shape, source.fps, source.frames)
    assert contents(tmp_path) == ["out.mp4", "tracks.csv"]


def test_video_prints_its_progress_where_no_bar_is_shown(clip, tmp_path, monkeypatch):
    words = ["video", clip, "--tracks", tmp_path / "t.csv", "--fov", 58]
    assert "frames/s" not in run(*words).stderr  # shorter than a minute
    monkeypatch.setattr("vehicle_detection.video.engine._LOG_INTERVAL", 0.0)
    assert re.search(r"^note: 0:00 of 0:00, \d+ frames/s$", run(*words).stderr, re.MULTILINE)
    assert "frames/s" not in run(*words, "--quiet").stderr


def test_video_writes_a_page_and_diagnostics(clip, tmp_path):
    target, tracks, page = tmp_path / "out.mp4", tmp_path / "tracks.csv", tmp_path / "page.html"
    words = ["--report", page, "--tracks", tracks, "--diagnostics", "--preset", "ultrafast"]
    out = succeed("video", clip, "-o", target, *words)
    assert out.splitlines()[-1] == f"wrote {target}, {tracks}, {page}"
    text = page.read_text(encoding="utf-8")
    assert "data:video/mp4;base64," in text
    assert clip.name in text
    with read_frames(target) as frames:
        mosaic = next(frames)[2]
    # The heat map is black in an empty corner of the road; no frame of the clip is.
    assert mosaic[-8:, :8].max() < 40


def test_detect_explains_each_box(tmp_path):
    image, why = tmp_path / "road.png", tmp_path / "why"
    scene = render_scene(shape=(360, 640), vehicles=[SceneVehicle(distance_m=14.0)], lane=1, random_state=1)
    write_image(image, scene.image)
    out = succeed("detect", image, "--why", why)
    line = r"^  1: score (\S+): margin \1 = \S+ cells \S+ rest$"
    assert re.search(line, out, re.MULTILINE)
    assert contents(why) == ["road.png_1.png"]
    assert out.splitlines()[-1] == f"wrote {why}"
    assert "--why must be a folder" in refuse("detect", image, "--why", image)


def test_detect_and_video_blur_vehicles(tmp_path):
    image, road = tmp_path / "road.png", tmp_path / "road.mp4"
    car = SceneVehicle(distance_m=14.0, kind="sedan", color="white")
    scene = render_scene(shape=(360, 640), vehicles=[car], lane=1, random_state=1)
    write_image(image, scene.image)
    write_clip(road, [scene.image] * 3)
    x1, y1, x2, y2 = scene.boxes[0].tolist()
    inside = slice((3 * y1 + y2) // 4, (y1 + 3 * y2) // 4), slice((3 * x1 + x2) // 4, (x1 + 3 * x2) // 4)
    contrasts = []
    for folder, words in (("sharp", []), ("blurred", ["--blur", "vehicles"])):
        succeed("detect", image, "-o", tmp_path / folder, *words)
        succeed("video", road, "-o", tmp_path / f"{folder}.mp4", "--preset", "ultrafast", *words)
        with read_frames(tmp_path / f"{folder}.mp4") as frames:
            pictures = read_image(tmp_path / folder / "road.png"), next(frames)[2]
        contrasts.append(
            [np.abs(np.diff(picture[inside].mean(axis=2), axis=0)).max() for picture in pictures]
        )
    assert (np.array(contrasts[1]) < 0.5 * np.array(contrasts[0])).all()


def test_video_writes_events_and_a_summary(clip, tmp_path):
    target, events, clips = tmp_path / "out.mp4", tmp_path / "events.json", tmp_path / "clips"
    words = ["--events", events, "--clips", clips, "--own-speed", 100, "--preset", "ultrafast"]
    lines = succeed("video", clip, "-o", target, *words).splitlines()
    assert re.search(
        r"overtook \d+ vehicles?, was overtaken by \d+, met \d+ oncoming.* in view on average", lines[1]
    )
    assert lines[-1] == f"wrote {target}, {events}, {clips}"
    found = json.loads(events.read_text())
    assert [path.suffix for path in clips.iterdir()] == [".mp4"] * len(found)


def test_video_explains_each_vehicle_in_the_report(tmp_path):
    drive, page = tmp_path / "drive.mp4", tmp_path / "page.html"
    draw_clip(render_drive(frames=25, shape=(360, 640), scenario="traffic"), drive, tmp_path / "labels.csv")
    words = ["video", drive, "-o", tmp_path / "out.mp4", "--report", page, "--preset", "ultrafast"]
    succeed(*words, "--start", 0.2, "--why", "--blur", "vehicles")
    text = page.read_text()
    listed = re.findall(r'<th scope="row"><span class="dot c\d"></span>#(\d+)', text)
    explained = re.findall(r"<h3>#(\d+) at 0:0[\d.]+</h3><p>score [\d.]+: margin", text)
    assert sorted(explained) == sorted(listed) != []
    succeed(*words)
    assert "Why these boxes" not in page.read_text()


def test_a_source_that_is_read_once_is_not_opened_again(clip, tmp_path, monkeypatch):
    """Such as a camera or a named pipe, whose path exists."""
    monkeypatch.setattr(FrameSource, "rereadable", False)
    words = ["video", clip, "-o", tmp_path / "out.mp4", "--preset", "ultrafast"]
    page = tmp_path / "page.html"
    assert "--why needs a source that can be read again" in refuse(*words, "--report", page, "--why")
    assert contents(tmp_path) == []
    result = run(*words, "--horizon", 0.95, "--model", "highway")
    assert result.exit_code == 0
    assert "no vehicle was found" not in result.stderr


def test_video_writes_subtitles_with_the_own_speed(clip, tmp_path):
    target, subtitles, speed = tmp_path / "out.mp4", tmp_path / "out.srt", tmp_path / "speed.csv"
    speed.write_text("time_s,speed_kmh\n100,90\n101,90\n")
    words = ["video", clip, "-o", target, "--srt", subtitles, "--gpx", speed, "--preset", "ultrafast"]
    assert run(*words, "--gpx-offset", 100).stderr.count("own speed") == 0
    assert "own speed 90 km/h" in subtitles.read_text()
    warning = "warning: the own speed is known for 0% of the video; check --gpx-offset"
    result = run(*words, "--units", "imperial")
    assert (result.exit_code, warning in result.stderr) == (0, True)
    assert "own speed" not in subtitles.read_text()
    assert "warning" not in run(*words, "--quiet").stderr


def test_existing_files_are_replaced_with_a_note(clip, picture, tmp_path):
    target, boxes = tmp_path / "out.mp4", tmp_path / "boxes.csv"
    runs = [["video", clip, "-o", target, "--end", 0.1], ["detect", picture, "--boxes", boxes]]
    for words, path in zip(runs, (target, boxes)):
        notes = [run(*words).stderr.count(f"note: {path} will be replaced when") for _ in range(2)]
        assert notes == [0, 1]
    assert "note" not in run(*runs[0], "--quiet").stderr
    for words, refused in ((runs[0], ["--jobs", 0]), (runs[0], ["--fov", 200]), (runs[1], ["--horizon", 9])):
        assert refuse(*words, *refused).startswith("error: --")


def test_a_damaged_video_has_an_exit_code_of_its_own(clip, tmp_path):
    lost, target = damage_sizes(clip, tmp_path / "lost.mp4", entry=3, byte=0, flip=64), tmp_path / "out.mp4"
    result = run("video", lost, "-o", target, "-q")
    assert result.exit_code == 3
    # Some versions of ffmpeg also report an error.
    assert result.stderr.startswith(f"warning: {lost} is damaged: 7 of 10 frames cannot be decoded")
    assert result.stderr.endswith("; copy or record it again\n")
    with read_frames(target) as frames:
        assert len(list(frames)) == 3
    target.unlink()
    assert "7 of 10 frames cannot be decoded" in refuse("video", lost, "-o", target, "--strict")
    assert contents(tmp_path) == ["lost.mp4"]


def test_video_can_be_quiet_and_take_a_part(clip, tmp_path):
    target = tmp_path / "out.mov"
    words = ["--start", 0.08, "--end", 0.2, "--horizon", 0.56, "--no-audio", "--quiet"]
    assert run("video", clip, "-o", target, *words).output == ""
    assert probe_video(target).frames == 3
    out = succeed("video", clip, "-o", target, *words, "--profile")
    assert out.startswith("3 frames of 480x270")
    assert "wrote" not in out


def test_video_draws_as_asked(clip, tmp_path, monkeypatch):
    drawn = []
    process = video.process_video

    def watch(source, target, detector, **options):
        drawn.append(detector.draw_params)
        return process(source, target, detector, **options)

    monkeypatch.setattr(video, "process_video", watch)
    target = tmp_path / "out.mp4"
    succeed("video", clip, "-o", target, "--end", 0.1)
    words = ["--labels", "id, score", "--line-width", 3, "--color-by", "distance", "--panel", "side"]
    succeed("video", clip, "-o", target, "--end", 0.1, *words)
    assert probe_video(target).shape == (270, 480 + 82, 3)
    succeed("video", clip, "-o", target, "--end", 0.1, "--labels", "none", "--panel", "corner")
    assert probe_video(target).shape == (270, 480, 3)
    wide = DrawParams(labels=("id", "score"), line_width=3, color_by="distance", panel="side")
    assert drawn == [DrawParams(), wide, DrawParams(labels=(), panel="corner")]


def test_video_estimates_the_horizon(clip, tmp_path, monkeypatch):
    words = ["video", clip, "-o", tmp_path / "out.mp4", "--end", 0.12, "--horizon", "auto"]
    found = HorizonEstimate(horizon=0.551, horizon_std=0.012, camera_height_m=1.3, n_boxes=40)
    monkeypatch.setattr(video, "estimate_video_horizon", lambda *_, **__: found)
    assert "horizon 0.551 (standard error 0.012, 40 boxes)" in succeed(*words)
    monkeypatch.setattr(video, "estimate_video_horizon", lambda *_, **__: None)
    result = run(*words)
    assert result.exit_code == 0
    assert (
        "warning: --horizon auto: too few vehicles to estimate the horizon; searching near the middle"
        in result.stderr
    )
    assert run(*words, "--quiet").output == ""


def bad_videos(material, tmp):
    clip, target = material / "clip.mp4", tmp / "out.mp4"
    tiny = tmp / "tiny.mp4"
    fourcc = cv2.VideoWriter.fourcc(*"mp4v")
    for path, size, frames in ((tiny, (32, 32), 3), (tmp / "none.mp4", (64, 64), 0)):
        writer = cv2.VideoWriter(str(path), fourcc, 25, size)
        for _ in range(frames):
            writer.write(np.zeros((*size, 3), np.uint8))
        writer.release()
    return {
        r"SOURCE .+missing.mp4 does not exist": [tmp / "missing.mp4", "-o", target],
        r"SOURCE .+empty holds no videos and no images": [material / "empty", "-o", target],
        r"text.mp4 is a text file, not a video": [material / "text.mp4", "-o", target],
        r"cut_clip.mp4 is not a video .*its index is missing": [material / "cut_clip.mp4", "-o", target],
        r"none.mp4 (has no|is not a video)": [tmp / "none.mp4", "-o", target],
        r"image of 32x32 pixels holds no search window": [tiny, "-o", target, "--model", "highway"],
        r"--output .+clip.mp4 is also SOURCE": [clip, "-o", clip],
        r"--output needs an existing folder, .+none is not one": [clip, "-o", tmp / "none" / "out.mp4"],
        r"--output must end in .mp4, .* got 'out.gif'": [clip, "-o", tmp / "out.gif"],
        r"--output must be a file, got the folder": [clip, "-o", tmp],
        r"--end must be later than the start; got 3 s to 2 s": [clip, "-o", target, "--start", 3, "--end", 2],
        r"--start must be less than the video's length of 0.4 s; got 3 s": [clip, "-o", target, "--start", 3],
        r"--start must be a number, at least 0": [clip, "-o", target, "--start", -1],
        r"--start must be less .* 0.4 s; got 3606.5 s": [clip, "-o", target, "--start", "1:00:06.5"],
        r"--end must be a time in seconds or as \[H:\]M:S, .*; got '1:2:'": [
            clip,
            "-o",
            target,
            "--end",
            "1:2:",
        ],
        r"--end must be a number, .* got nan": [clip, "-o", target, "--end", "nan"],
        r"--preset must be one of 'ultrafast'": [clip, "-o", target, "--preset", "hasty"],
        r"--labels must be one of 'id', .*; got 'name'": [clip, "-o", target, "--labels", "id,name"],
        r"--labels must be one of 'id', .*; got ''": [clip, "-o", target, "--labels", ""],
        r"--line-width must be an integer from 1 to 1000": [clip, "-o", target, "--line-width", 0],
        r"--color-by must be one of 'id', 'distance'": [clip, "-o", target, "--color-by", "speed"],
        r"--panel must be one of 'none', 'corner', 'side'": [clip, "-o", target, "--panel", "left"],
        r"--horizon must be a number": [clip, "-o", target, "--horizon", -0.5],
        r"--horizon must be a fraction .* or auto; got 'high'": [clip, "-o", target, "--horizon", "high"],
        r"--tracks must end in .csv or .*, got 'tracks.doc'; write 'tracks.csv'\n": [
            clip,
            "-o",
            target,
            "--tracks",
            tmp / "tracks.doc",
        ],
        r"--tracks needs an existing folder": [clip, "-o", target, "--tracks", tmp / "none" / "tracks.csv"],
        r"--report must end in .html or .htm, got 'page.pdf'": [
            clip,
            "-o",
            target,
            "--report",
            tmp / "page.pdf",
        ],
        r"--report .+ is also --output .+;": [clip, "-o", target, "--report", target],
        r"--blur must be one of 'vehicles', 'plates'; got 'faces'": [clip, "-o", target, "--blur", "faces"],
        r"--events must end in .csv or .json, got 'e.txt'": [clip, "-o", target, "--events", tmp / "e.txt"],
        r"--own-speed must be a speed of at most 500": [clip, "-o", target, "--own-speed", -1],
        r"--srt must end in .srt or .ass, got 's.txt'": [clip, "-o", target, "--srt", tmp / "s.txt"],
        r"--gpx must end in .gpx or .csv, got 'clip.mp4'": [clip, "-o", target, "--gpx", clip],
        r"--gpx .+none.gpx does not exist": [clip, "-o", target, "--gpx", tmp / "none.gpx"],
        r"--own-speed and --gpx both state": [clip, "-o", target, "--own-speed", 9, "--gpx", tmp / "a.gpx"],
        r"--gpx-offset needs --gpx": [clip, "-o", target, "--gpx-offset", 9],
        r"--why needs --report, which shows": [clip, "-o", target, "--why"],
        r"--clips must be a folder": [clip, "-o", target, "--clips", clip],
        r"--clips-of needs --clips": [clip, "-o", target, "--clips-of", "met"],
        r"--clips-of must be one of 'headway', .*; got 'cutin'": [
            clip,
            "-o",
            target,
            "--clips",
            tmp / "clips",
            "--clips-of",
            "met,cutin",
        ],
        r"--tracks .+ is also SOURCE .+;": [tmp / "a.csv", "-o", target, "--tracks", tmp / "a.csv"],
    }


def test_video_refuses_bad_input_and_changes_no_file(material, tmp_path):
    cases = bad_videos(material, tmp_path)
    before = contents(tmp_path), contents(material)
    original = (material / "clip.mp4").read_bytes()
    for message, words in cases.items():
        assert re.search(message, refuse("video", *words, "--quiet")), message
    assert (contents(tmp_path), contents(material)) == before
    assert (material / "clip.mp4").read_bytes() == original


def test_the_help_of_each_option_shows_what_to_write():
    choices = re.compile(r"[a-z]+(\|[a-z]+)+")  # all values
    example = re.compile(r'such as \S|"\w+"|\.[a-z]{3,}|\d')
    types = {None, "TEXT", "INTEGER", "FLOAT", "BOOLEAN", "STR", "INT"}
    command = typer.main.get_command(app)
    assert set(command.commands) == set(COMMANDS)
    for name, each in command.commands.items():
        for option in each.params:
            assert option.help.endswith((".", "'")), (name, option.opts)
            if getattr(option, "is_flag", False):
                continue
            words = f"{name} {option.opts[0]} {option.metavar}: {option.help}"
            assert option.metavar not in types, words
            given = option.default is not None and not callable(option.default)  # printed by --help
            shown = given or choices.fullmatch(option.metavar) or "." in option.metavar
            assert shown or example.search(option.help), words


def test_video_refuses_bad_input_before_it_estimates_the_horizon(material, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise AssertionError("estimated")

    monkeypatch.setattr(video, "estimate_video_horizon", fail)
    clip, target = material / "clip.mp4", tmp_path / "out.mp4"
    lens = tmp_path / "lens.json"
    lens.write_text('{"image_size": [640, 480], "focal_px": 600}')
    cases = bad_videos(material, tmp_path) | {
        r"--fov must be omitted with a camera": [clip, "-o", target, "--camera", "wide-90", "--fov", 90],
        r"--camera must be one of standard-58, .* or an existing JSON file; got 'gopro'; or state": [
            clip,
            "-o",
            target,
            "--camera",
            "gopro",
        ],
        r"--fov must be a number": [clip, "-o", target, "--fov", 500],
        r"lens.json: image_size must have the aspect ratio": [clip, "-o", target, "--camera", lens],
        r"--conf must be a number": [clip, "-o", target, "--conf", 2],
        r"--every must be an integer": [clip, "-o", target, "--every", 0],
        r"--jobs must be an integer": [clip, "-o", target, "--jobs", 0],
    }
    for message, words in cases.items():
        if "--horizon" not in words and "no search window" not in message:
            assert re.search(message, refuse("video", *words, "--quiet", "--horizon", "auto")), message
    assert not target.exists()


def test_read_only_folders_are_refused(monkeypatch, material, clip, picture, tmp_path):
    # The tests may run as root, to whom the system grants any access.
    monkeypatch.setattr(_files.os, "access", lambda path, mode: not (mode & os.W_OK))
    read_only = r"needs a writable folder, .+ is read-only; choose another"
    for words in (
        ["video", clip, "-o", tmp_path / "out.mp4"],
        ["video", clip, "-o", tmp_path / "out.mp4", "--tracks", tmp_path / "tracks.csv"],
        ["detect", picture, "--boxes", tmp_path / "boxes.csv"],
        ["evaluate", material / "labels.csv", material / "labels.csv", "--json", tmp_path / "scores.json"],
        ["train", "--vehicles", "v", "--non-vehicles", "n", "-o", tmp_path / "m.safetensors"],
    ):
        assert re.search(read_only, refuse(*words))
    result = run("detect", picture, "-o", tmp_path / "out")
    assert (result.exit_code, bool(re.search(read_only, result.stderr))) == (2, True)
    assert contents(tmp_path) == []


# --- demo ---


def test_demo_draws_annotates_and_scores(tmp_path):
    out = succeed("demo", "-o", tmp_path / "shown", "--frames", 5, "--seed", 4)
    assert out.startswith("5 rendered frames of 1280x720")
    for name in ("F1", "mean IoU", "MOTA", "identity switches"):
        assert re.search(rf"^  {name} +(-?\d\S*|nan)\s*$", out, re.MULTILINE), out
    assert re.search(r"speed +\d+\.\d frames/s", out)
    assert contents(tmp_path / "shown") == sorted(FILES)
    for name in ("clip.mp4", "annotated.mp4"):
        info = probe_video(tmp_path / "shown" / name)
        assert (info.shape, info.frames, float(info.fps)) == ((720, 1280, 3), 5, 25.0)
    assert read_image(tmp_path / "shown" / "contact_sheet.png").shape == (SHEET[0] * 360, SHEET[1] * 640, 3)
    words = [tmp_path / "shown" / "tracks.csv", tmp_path / "shown" / "labels.csv"]
    assert "Detections in" in succeed("evaluate", *words)


def test_demo_writes_a_report(tmp_path):
    folder = tmp_path / "shown"
    out = succeed("demo", "-o", folder, "--frames", 3, "--report")
    assert contents(folder) == sorted([*FILES, REPORT])
    assert out.splitlines()[-1] == f"wrote {', '.join(FILES)}, {REPORT} in {folder}"
    assert "data:video/mp4;base64," in (folder / REPORT).read_text(encoding="utf-8")
    assert re.search(r"boxes +\d+ on a vehicle, \d+ missed, \d+ false", out)


def test_demo_scores_oncoming_vehicles():
    drive = render_drive(frames=120)
    rows = [row for frame in range(0, 120, 8) for row in drive.truth_of(frame)]
    for row, scored in zip(rows, scored_truth(rows), strict=True):
        assert scored == replace(row, ignore=row.hard_to_see)
        assert row.ignore == (row.hard_to_see or row.speed_mps < -40)
    assert any(row.ignore and not row.hard_to_see for row in rows)


def test_demo_refuses_bad_input(tmp_path, picture):
    assert "--frames must be an integer at least 1" in refuse(
        "demo", "-o", tmp_path / "a" / "b", "--frames", 0
    )
    assert "--seed must be" in refuse("demo", "-o", tmp_path / "a", "--seed", -1)
    assert "--output must be a folder" in refuse("demo", "-o", picture)
    assert contents(tmp_path) == []


# --- evaluate ---


def test_evaluate_scores_boxes_and_tracks(tmp_path):
    labels, tracks = tmp_path / "labels.csv", tmp_path / "tracks.csv"
    labels.write_text(
        "frame,track,x1,y1,x2,y2,occluded,truncated,ignore\n0,1,10,10,60,50,0,0,0\n1,1,12,10,62,50,0,0,0\n"
    )
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
    labels.write_text(
        "frame,track,x1,y1,x2,y2,occluded,truncated,ignore\n0,1,0,0,900,500,0,0,1\n1,1,12,10,62,50,0,0,0\n"
    )
    assert "1 found, 0 missed, 1 false, 0 ignored" in succeed("evaluate", stills, labels)
    assert "1 found, 0 missed, 0 false, 1 ignored" in succeed(
        "evaluate", stills, labels, "--ignored-as-regions"
    )


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
    assert "names no frame of the labels, such as f0.jpg" in refuse(
        "evaluate", found, labels, "--frames", "0-9"
    )
    labels.write_text("frame,track,x1,y1,x2,y2\n" + "".join(f"{n},1,{box}\n" for n in range(10)))
    found.write_text(f"{HEADER}\n" + "".join(f"{n},1,{box},1.5\n" for n in (0, 1, 9)))
    out = succeed("evaluate", found, labels, "--frames", "0-1")
    assert "2 found, 0 missed, 0 false" in out
    assert "1 tracks of 1 vehicles in 2 frames" in out
    for listed, frames in {"0,1": 2, "0, 3-5": 4, "0-9:3": 4}.items():
        assert f"Detections in {frames} frames" in succeed("evaluate", found, labels, "--frames", listed)
    for listed in ("0,x", "5-9:0", "none.txt"):
        message = refuse("evaluate", found, labels, "--frames", listed)
        assert "--frames must be numbers such as 0,6,12 or 0-299" in message
        assert f"or a file with a frame in each line, got '{listed}'" in message


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


def test_evaluate_reads_yolo_folders_with_the_sizes_of_images(tmp_path):
    found, labels, images = tmp_path / "found.csv", tmp_path / "labels", tmp_path / "images"
    for folder in (labels, images):
        folder.mkdir()
    write_image(images / "000001.png", np.zeros((100, 200, 3), np.uint8))
    (labels / "000001.txt").write_text("0 0.5 0.5 0.2 0.4\n")
    found.write_text(f"{HEADER}\n000001.png,,80,30,120,70,1\n")
    assert "1 found, 0 missed, 0 false" in succeed("evaluate", found, labels, "--images", images)
    assert "the folder of the images as images= or --images" in refuse("evaluate", found, labels)


def test_evaluate_names_the_files_whose_frames_differ(tmp_path):
    labels, found = tmp_path / "labels.csv", tmp_path / "found.csv"
    labels.write_text("frame,track,x1,y1,x2,y2\na,1,10,10,60,50\n")
    found.write_text(f"{HEADER}\nin/a.jpg,1,10,10,60,50,1\n")
    for words in ((), ("--frames", tmp_path / "part.txt")):
        (tmp_path / "part.txt").write_text("a\n")
        assert "1 found, 0 missed, 0 false" in succeed("evaluate", found, labels, *words)
    found.write_text(f"{HEADER}\nin/a.jpg,1,10,10,60,50,1\nout/a.jpg,1,10,10,60,50,1\n")
    assert f"frame names of {found} and {labels} differ: 'out/a.jpg'" in refuse("evaluate", found, labels)


def test_images_that_are_too_small_are_left_out(tmp_path):
    small, image = tmp_path / "small.png", tmp_path / "image.png"
    write_image(small, np.zeros((20, 40, 3), np.uint8))
    write_image(image, np.zeros((360, 640, 3), np.uint8))
    result = run("detect", small, image, "--model", "highway")
    assert result.exit_code == 3
    assert f"warning: {small}: image of 40x20 pixels holds no search window" in result.stderr
    assert str(small) in refuse("detect", small, "--model", "highway")


def test_evaluate_reads_coco_results_with_their_truth(tmp_path):
    from vehicle_detection.evaluation import FrameBoxes, write_labels

    boxes = [[0, 0, 100, 60], [5, 0, 105, 60]]
    write_labels(FrameBoxes([0, 2], [1, 1], boxes), tmp_path / "truth.json")
    found = FrameBoxes([0, 2], [1, 1], boxes, scores=[2.0, 1.0])
    write_labels(found, tmp_path / "found.json", format="coco_results", truth=tmp_path / "truth.json")
    out = succeed("evaluate", tmp_path / "found.json", tmp_path / "truth.json")
    assert "HOTA               1.000 (DetA 1.000, AssA 1.000, LocA 1.000)" in out


def test_evaluate_refuses_bad_input(material, tmp_path):
    labels = material / "labels.csv"
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    cases = {
        r"missing.csv does not exist": [tmp_path / "missing.csv", labels],
        r"other.csv lacks the columns": [tmp_path / "other.csv", labels],
        r"--iou must be a number, greater than 0 and at most 1": [labels, labels, "--iou", 0],
        r"--json needs an existing folder": [labels, labels, "--json", tmp_path / "none" / "s.json"],
        r"--json .+ is also LABELS .+;": [tmp_path / "other.csv", labels, "--json", labels],
    }
    original = labels.read_bytes()
    for message, words in cases.items():
        assert re.search(message, refuse("evaluate", *words)), message
    assert labels.read_bytes() == original
    assert contents(tmp_path) == ["other.csv"]


# --- train, fetch, info ---


def patches_of(folder):
    return ["--vehicles", folder / "vehicles", "--non-vehicles", folder / "non-vehicles"]


def test_train_writes_model_report_and_card(material, tmp_path):
    with zipfile.ZipFile(tmp_path / "vehicles.zip", "w") as archive:
        for path in sorted((material / "vehicles").rglob("*.png")):
            archive.write(path, path.relative_to(material))
    patches = ["--vehicles", tmp_path / "vehicles.zip", "--non-vehicles", material / "non-vehicles"]
    model, report, card = (tmp_path / name for name in ("m.safetensors", "r.json", "c.md"))
    words = ["--features", "luv-2384", "--compare", "ycrcb-6156", "--split", "sequences", "--seed", 2]
    out = succeed("train", *patches, "-o", model, *words, "--report", report, "--card", card)
    assert "luv-2384: 20 vehicles, 20 others, accuracy" in out
    assert "GTI" not in out  # splits of the course's patches
    assert out.endswith(f"wrote {model}, {report}, {card}\n")
    written = json.loads(report.read_text())
    assert set(written["splits"]) == {"random", "sequences"}
    assert written["params"]["color_space"] == "LUV"
    assert written["others"][0]["features"] == "ycrcb-6156"
    assert {"features", "calibration", "random", "sequences", "leakage", "final"} == set(written["seconds"])
    text = card.read_text()
    assert (
        "vehicle-detection train --vehicles vehicles.zip --non-vehicles non-vehicles --features luv-2384 "
        "--split sequences --C 0.0001 --seed 2 --gamma 0.4 --degraded 0.05 --compare ycrcb-6156 "
        "-o m.safetensors --card c.md\n"
    ) in text
    assert str(tmp_path) not in text
    again = tmp_path / "again.safetensors"
    succeed("train", *patches_of(material), "-o", again, *words)
    assert again.read_bytes() == model.read_bytes()
    out = succeed("info", model)
    assert out.startswith(f"{model}: 2384 features, 1 template\n")
    for line in (r"color_space +LUV", r"C +0.0001", r"sources +drawn 40", r"last fifth of each folder +\d"):
        assert re.search(line, out), line
    assert load_classifier(model).metadata["training"]["random_state"] == 2


def bad_training(material, tmp):
    (tmp / "small" / "vehicles").mkdir(parents=True)
    write_image(tmp / "small" / "vehicles" / "1.png", np.zeros((32, 32, 3), np.uint8))
    (tmp / "cut").mkdir()
    shutil.copy(material / "cut_road.png", tmp / "cut")
    shutil.copy(material / "vehicles" / "drawn" / "0.png", tmp / "small.zip")
    (tmp / "one").mkdir()
    shutil.copy(material / "vehicles" / "drawn" / "0.png", tmp / "one")
    good, vehicles, others = patches_of(material), material / "vehicles", material / "non-vehicles"
    model = ["-o", tmp / "m.safetensors"]
    return {
        r"--vehicles .+none does not exist; check the path": [
            "--vehicles", tmp / "none", "--non-vehicles", others, *model],
        r"--non-vehicles .+empty holds no PNG or JPEG patches": [
            "--vehicles", vehicles, "--non-vehicles", material / "empty", *model],
        r"1.png of .+small is 32x32 pixels, expected 64x64": [
            "--vehicles", tmp / "small", "--non-vehicles", others, *model],
        r"cut_road.png of .+ must be a complete image file": [
            "--vehicles", tmp / "cut", "--non-vehicles", others, *model],
        r"small.zip is not a zip": ["--vehicles", tmp / "small.zip", "--non-vehicles", others, *model],
        r"--non-vehicles .+ is also --vehicles .+;": [
            "--vehicles", vehicles, "--non-vehicles", vehicles, *model],
        r"1 vehicles and 20 non-vehicles are too few": [
            "--vehicles", tmp / "one", "--non-vehicles", others, *model],
        r"--output needs an existing folder": [*good, "-o", tmp / "none" / "m.safetensors"],
        r"--output must be a file, got the folder": [*good, "-o", tmp],
        r"--output .+small.zip is also --vehicles .+;": [
            "--vehicles", tmp / "small.zip", "--non-vehicles", others, "-o", tmp / "small.zip"],
        r"--report .+ is also --output .+;": [*good, *model, "--report", tmp / "m.safetensors"],
        r"--card needs an existing folder": [*good, *model, "--card", tmp / "none" / "card.md"],
        r"--features must be one of 'luv-2384'": [*good, *model, "--features", "hog"],
        r"--compare must be one of 'luv-2384', .* got 'sift'": [*good, *model, "--compare", "sift"],
        r"--split must be one of 'random', 'sequences'": [*good, *model, "--split", "half"],
        r"--C must be a number, greater than 0": [*good, *model, "--C", 0],
        r"--C must be a number, .* got nan": [*good, *model, "--C", "nan"],
        r"--seed must be an integer from 0": [*good, *model, "--seed", -1],
    }  # fmt: skip


def test_train_refuses_bad_input_and_writes_nothing(material, tmp_path):
    cases = bad_training(material, tmp_path)
    before, original = contents(tmp_path), (tmp_path / "small.zip").read_bytes()
    for message, words in cases.items():
        assert re.search(message, refuse("train", *words)), message
    assert contents(tmp_path) == before
    assert (tmp_path / "small.zip").read_bytes() == original


def test_defaults_are_those_of_the_library(monkeypatch, material, tmp_path):
    given = {}

    def note(patches, **options):
        given.update(options)
        raise InvalidInputError("enough")

    monkeypatch.setattr(training, "train_and_evaluate", note)
    refuse("train", *patches_of(material), "-o", tmp_path / "m.safetensors")
    assert given["C"] == training.DEFAULT_C
    assert given["params"] == load_classifier().params
    assert (given["mirror"], given["random_state"], given["split"]) == (True, 0, "random")
    recipe = load_classifier().metadata["training"]
    for name in ("C", "gamma", "degraded", "mirror", "random_state"):
        assert given[name] == recipe[name], name


def test_fetch_prints_the_paths_of_the_patches(monkeypatch, tmp_path):
    monkeypatch.setattr(
        datasets,
        "fetch_patches",
        lambda output, progress: (output / "vehicles.zip", output / "non-vehicles.zip"),
    )
    assert succeed("fetch", "-o", tmp_path).splitlines() == [
        str(tmp_path / "vehicles.zip"),
        str(tmp_path / "non-vehicles.zip"),
    ]


def test_fetch_refuses_a_file_as_its_folder(picture):
    assert "--output must be a folder" in refuse("fetch", "-o", picture)


def test_a_failed_fetch_leaves_no_folder(monkeypatch, tmp_path):
    def fail(output, progress):
        raise DatasetError("the server cannot\nbe reached")

    monkeypatch.setattr(datasets, "fetch_patches", fail)
    assert refuse("fetch", "-o", tmp_path / "new") == "error: the server cannot be reached\n"
    assert contents(tmp_path) == []


def test_info_of_the_shipped_models():
    out = succeed("info", "highway")
    model = load_classifier()
    assert out.startswith(f"highway: {model.params.length} features, 1 template\n")
    assert re.search(rf"color_space +{model.params.color_space}\s", out)
    assert re.search(r"numpy +\d", out)
    split = model.metadata["metrics"]["splits"]["sequences"]
    rates = f"{split['false_negative_rate']:.2%} +{split['false_positive_rate']:.2%}"
    assert re.search(rf"last fifth of each folder +3,553 +{split['accuracy']:.4f} +{rates} +", out)
    out = succeed("info", "default")
    assert succeed("info") == out
    default = load_model()
    assert re.match(r"default: network, threshold at a probability of 0\.\d+\n", out)
    assert re.search(r"input +640 px\n", out)
    assert re.search(r"file +\d\.\d MB\n", out)
    for name, scores in default.metadata["metrics"]["left_out"].items():
        assert re.search(rf"{name} .*{scores['f1']:.3f}", out)


def test_info_of_a_model_with_incomplete_scores(tmp_path):
    model, path = load_classifier(), tmp_path / "m.safetensors"

    def info(metrics):
        VehicleClassifier(model.params, model.templates, {"metrics": metrics}).save(path)
        return succeed("info", path)

    assert re.search(r"road\W+0\.250", info({"left_out": {"road": {"f1": 0.25}}}))
    scores = info({"splits": {"random": {"accuracy": 0.5, "test": "x"}}})
    assert re.search(r"accuracy\s+─+\s+random fifth +0\.5000", scores)
    assert "random fifth" in info({"splits": {"random": {"accuracy": 10**400}}})


def test_info_of_a_missing_model(material):
    assert "model file motorway does not exist; check the path" in refuse("info", "motorway")
    assert "is a folder; choose a file in it" in refuse("info", material / "empty")


def test_models_by_name(picture):
    assert re.search(r": \d+ vehicle", succeed("detect", picture))
    assert succeed("detect", picture, "--model", "default") == succeed("detect", picture)
    assert re.search(r": \d+ vehicle", succeed("detect", picture, "--model", "highway"))


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


def test_info_of_a_model_with_other_metadata(tmp_path):
    model, path = load_classifier(), tmp_path / "m.safetensors"
    VehicleClassifier(model.params, model.templates, {"metrics": 0.5, "by": "hand", "n": {"a": 1}}).save(path)
    assert succeed("info", path).endswith("by\n    hand\nmetrics\n    0.5\nn\n  a  1\n")


# --- helpers ---


def test_a_terminal_breaks_lines_at_spaces(monkeypatch, capsys):
    monkeypatch.setattr(output, "_terminal_width", lambda stream: 24)
    with progress_bar(True, 5, unit="frame"):
        output.print_error("warning: /a/path/that/is/too/long/to/fit\nis used")
    assert "warning:\n  /a/path/that/is/too/long/to/fit\n  is used\n" in capsys.readouterr().err
    output.print_facts("data", {"sources": "GTI 3900, KITTI 5966", "n": 1})
    assert capsys.readouterr().out == "data\n  sources  GTI 3900,\n           KITTI 5966\n  n        1\n"


@pytest.mark.parametrize("width", [80, 50, 41])
def test_a_table_breaks_no_word(monkeypatch, capsys, width):
    monkeypatch.setattr(output, "_terminal_width", lambda stream: width)
    words = ["project_clip", "false negatives", "near duplicates", "0.954", "KITTI and Extras"]
    output.print_table("scores", ["tested on", *words[1:3]], [[words[0], "0.954", "1"], [words[4], "1", "2"]])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    printed = " ".join(lines).split()
    assert {word for text in words for word in text.split()} <= set(printed)
    if width == 80:
        assert any("false negatives" in line for line in lines)


def test_a_table_that_is_too_wide_is_complete(monkeypatch, capsys):
    monkeypatch.setattr(output, "_terminal_width", lambda stream: 12)
    output.print_table("t", ["a", "b"], [["0123456789", "abcdefghij"]])
    printed = "".join(capsys.readouterr().out.split())
    assert set("0123456789abcdefghij") <= set(printed)


def test_a_pipe_gets_one_line_for_each_message(capsys):
    output.print_error("warning: " + "word " * 50)
    assert capsys.readouterr().err.count("\n") == 1


def test_run_interruptible_returns_results_and_raises_errors():
    assert run_interruptible(lambda: 5) == 5
    with pytest.raises(InvalidInputError, match="wrong"):
        run_interruptible(lambda: (_ for _ in ()).throw(InvalidInputError("wrong")))


def test_an_output_folder_with_files_is_kept(tmp_path):
    def fill(folder):
        with output_folder(folder, "-o"):
            (folder.parent / "kept").touch()
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        fill(tmp_path / "a" / "b")
    assert contents(tmp_path) == ["a", "a/kept"]


# --- real data ---


@pytest.mark.realdata
def test_the_course_images_by_command(real_data, tmp_path):
    images = sorted((real_data / "test_images").glob("*.jpg"))
    succeed("detect", *images, "--boxes", tmp_path / "boxes.csv")
    labels = real_data / "labels" / "test_images.csv"
    assert "9 found, 0 missed, 0 false" in succeed("evaluate", tmp_path / "boxes.csv", labels)


@pytest.mark.realdata
def test_the_course_clip_by_command(real_data, tmp_path):
    source, target = real_data / "videos" / "test_video.mp4", tmp_path / "out.mp4"
    began = time.process_time()  # of this program, however busy the machine is
    succeed("video", source, "-o", target, "--tracks", tmp_path / "tracks.csv", "--preset", "ultrafast")
    assert time.process_time() - began < 60
    assert probe_video(target).has_audio
    labels = real_data / "labels" / "test_video.csv"
    scores = tmp_path / "scores.json"
    succeed("evaluate", tmp_path / "tracks.csv", labels, "--json", scores)
    track_scores = json.loads(scores.read_text())["tracks"]
    assert track_scores["f1"] == 1.0
    assert track_scores["mean_iou"] >= 0.7


def test_a_piped_video_whose_index_is_at_its_end_is_refused(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (20, 180, 320, 3), np.uint8)
    clip = write_clip(tmp_path / "noise.mp4", list(noise))
    words = [sys.executable, "-m", "vehicle_detection", "video", "-", "-o", str(tmp_path / "out.mp4")]
    result = subprocess.run(words, input=clip.read_bytes(), capture_output=True, check=False)
    assert result.returncode == 2
    assert (
        b"pass the file's path, because MP4 needs its index at the start to come through a pipe"
        in result.stderr
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["detcet"], r"No such command 'detcet'.*; see \S+ --help"),
        (["--fast"], r"No such option: --fast; see \S+ --help"),
        (["detect", "--fast"], r"No such option: --fast; see \S+ detect --help"),
        (["detect"], r"Missing argument 'IMAGE...'; see \S+ detect --help"),
        (
            ["video", "a.mp4", "--jobs", "many"],
            r"Invalid value for '--jobs': .*(should be|is not) a valid integer; .*",
        ),
        (
            ["video", *(f"CARD/{number}.MP4" for number in range(1000))],
            r"Got unexpected .* \(CARD/1.MP4 [^;]{10,120} \.\.\.\); SOURCE is one argument: for several "
            r"files, pass their folder or a quoted pattern, such as 'CARD/\*.MP4'; see \S+ video --help",
        ),
        (["video", "a.mp4", "--labels"], r"Option '--labels' requires an argument; see \S+ --help"),
    ],
)
def test_a_wrong_call_is_an_error_of_one_line(words, message):
    assert re.fullmatch(f"error: {message}\n", refuse(*words))


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("12", 12), ("0.5", 0.5), ("-1", -1), ("12:00", 720), ("00:12:00", 720), (" 1:02:06.5", 3726.5)],
)
def test_times_in_seconds_or_as_players_show_them(text, seconds):
    assert parse_time(text, "--start") == seconds


@pytest.mark.parametrize("text", ["", "noon", "1:2:3:4", "-1:00", "1:200", "12.5:00", "5s"])
def test_times_that_cannot_be_read(text):
    with pytest.raises(InvalidInputError, match=r"^--end must be a time in seconds or as \[H:\]M:S"):
        parse_time(text, "--end")


@pytest.mark.parametrize(("text", "mps"), [("100", 100 / 3.6), ("62mph", 62 * 0.44704), ("90 km/h", 25.0)])
def test_own_speed_in_units(text, mps):
    from vehicle_detection.cli.video_outputs import read_speed

    assert read_speed(text, None, 0.0).at([1.0]) == pytest.approx(mps)


@pytest.mark.parametrize("text", ["fast", "-5", "501", "10 m/s"])
def test_own_speed_that_cannot_be_read(text):
    from vehicle_detection.cli.video_outputs import read_speed

    with pytest.raises(InvalidInputError, match="--own-speed must be a speed of at most 500, such as 100"):
        read_speed(text, None, 0.0)


def test_images_have_a_frame_rate(tmp_path):
    for number in range(4):
        write_image(tmp_path / f"{number}.png", np.zeros((360, 640, 3), np.uint8))
    succeed("video", tmp_path, "-o", tmp_path / "out.mp4", "--fps", 2, "--model", "highway", "-q")
    assert probe_video(tmp_path / "out.mp4").duration == pytest.approx(2.0)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_lines_are_wrapped_at_spaces_in_a_terminal_only(monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    for stream, lines in ((Terminal(), 3), (io.StringIO(), 1)):
        monkeypatch.setattr(sys, "stderr", stream)
        print_error("warning: " + "word " * 20)
        printed = stream.getvalue().splitlines()
        assert len(printed) == lines
        assert all(len(line) <= 40 and line.split()[-1] == "word" for line in printed) or lines == 1


def test_a_table_in_a_terminal_breaks_no_words(monkeypatch):
    monkeypatch.setenv("COLUMNS", "44")
    stream = Terminal()
    monkeypatch.setattr(sys, "stdout", stream)
    name = "\u8eca\u4e21\u30c7\u30fc\u30bf.mp4"  # each of these five characters takes two columns
    print_table("title", ["name", "precision", "average recall"], [[name, "0.5", "0.75"]])
    words = re.sub(r"\x1b\[[\d;]*m", "", stream.getvalue()).split()
    assert {name, "precision", "average", "recall"} <= {*words}
