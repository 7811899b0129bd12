import json
import os
import re
import signal
import subprocess
import sys

import pytest
import typer

import vehicle_detection
from tests.cli.commands import (
    COMMANDS,
    contents,
    finish,
    patches_of,
    refuse,
    refuse_each,
    run,
    start,
    start_changed,
    succeed,
)
from vehicle_detection.cli.app import app
from vehicle_detection.cli.demo import draw_clip
from vehicle_detection.scenes import render_drive


def test_help_has_a_short_option():
    for words in ((), ("video",), ("train",)):
        assert "Show this message and exit" in succeed(*words, "-h")


HEAVY = {"numba", "scipy", "sklearn", "skimage", "pandas", "matplotlib", "moviepy", "jinja2", "pooch"}
HEAVY |= {"pydantic"}


@pytest.mark.parametrize(
    ("words", "heavy"),
    [
        (["info"], HEAVY),
        (["detect", "road.png", "--output", "found", "--conf", "0.6"], HEAVY | {"rich", "PIL"}),
        (["video", "clip.mp4", "--output", "found.mp4", "--tracks", "found.csv"], HEAVY | {"rich"}),
    ],
)
def test_a_command_imports_only_what_it_needs(material, tmp_path, words, heavy):
    words = [material / word if (material / word).is_file() else word for word in words]
    words = [tmp_path / word if str(word).startswith("found") else word for word in words]
    code = "import atexit, sys; atexit.register(lambda: print(*sys.modules, file=sys.stderr))"
    exit_code, _, errors = finish(start_changed(code, *words))
    assert exit_code == 0, errors
    assert not {name.split(".")[0] for name in errors.split()} & heavy


def test_options_are_listed_in_panels():
    page = succeed("video", "--help")
    titles = re.findall(r"^(\w+):$", page, re.MULTILINE)
    assert titles == ["Arguments", "Output", "Input", "Camera", "Search", "Drawing", "Options"]
    assert re.search(r"--live\s+Drop frames", page), "an option without a value has no type"


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
        start("--version"),
        start("detect", "--nonsense"),
    ]
    found, missing, version, usage = (finish(process) for process in runs)
    assert (found[0], found[2]) == (0, "")
    assert re.match(rf"{re.escape(str(picture))}: \d+ vehicles?( |\n)", found[1])
    assert contents(tmp_path) == ["out", "out/road.png"]
    assert missing[:2] == (2, "")
    assert re.fullmatch(r"error: IMAGE .+missing.png does not exist; check the path\n", missing[2])
    assert version == (0, f"{vehicle_detection.__version__}\n", "")
    assert usage[0] == 2
    assert "--nonsense" in usage[2]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signal")
def test_ctrl_c_leaves_nothing_behind(tmp_path, material):
    long = tmp_path / "long.mp4"
    draw_clip(render_drive(frames=1, shape=(270, 480), scenario="empty"), long, tmp_path / "labels.csv")
    slow = (
        "import time\n"
        "import vehicle_detection.{module} as module\n"
        "module.{name} = lambda *a, **k: (print('now', flush=True), time.sleep(600))"
    )
    out, patches = tmp_path / "out", patches_of(material)
    runs = {
        ("video", "process_video"): ["video", long, "-o", out / "x.mp4", "--tracks", out / "x.csv"],
        ("cli.demo", "draw_clip"): ["demo", "-o", tmp_path / "demo" / "deep"],
        ("training", "train_and_evaluate"): ["train", *patches, "-o", out / "x.safetensors"],
    }
    out.mkdir()
    processes = [
        start_changed(slow.format(module=module, name=name), *words) for (module, name), words in runs.items()
    ]
    for process in processes:
        assert process.stdout.readline() == "now\n"
        os.killpg(process.pid, signal.SIGINT)
        assert finish(process) == (130, "", "interrupted\n")
    assert contents(out) == []
    assert not (tmp_path / "demo").exists()


def test_batch_refuses_bad_input(material, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cases = {
        "": r"SOURCES\.\.\. must name at least one video",
        "nothing": r"SOURCES\.\.\. nothing does not exist; check the path",
        "{material}/empty": r"SOURCES\.\.\. .+empty holds no videos",
        "x --shard 9/3": "--shard must be a number and a count, such as 3/200 .* got '9/3'",
        "x --dry-run --summary s.csv": "--dry-run .* --summary; omit one of them",
        "--status --summary s.doc": "--summary must end in .csv",
        "x --model nothing": "model file nothing does not exist",
    }
    refuse_each("batch", {f"-o out {line}": message for line, message in cases.items()}, material=material)
    refuse_each("batch", {"-o nothing --status": "--output nothing is not a folder; pass"})
    assert succeed("batch", "-o", tmp_path, "--status").startswith("0 trips done, 0 failed, 0 errors\n")


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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["detcet"], r"No such command 'detcet'; use detect; see \S+ --help"),
        (["--fast"], r"No such option: --fast; see \S+ --help"),
        (["detect", "--fast"], r"No such option: --fast; see \S+ detect --help"),
        (["detect"], r"Missing argument 'IMAGE...'; IMAGE...: .*; see \S+ detect --help"),
        (["video", "a.mp4", "--jobs", "many"], r"Invalid value for '--jobs': .* a valid integer; .*"),
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


def test_existing_files_are_replaced_with_a_note(clip, picture, tmp_path):
    target, boxes = tmp_path / "out.mp4", tmp_path / "boxes.csv"
    runs = [["video", clip, "-o", target, "--end", 0.1], ["detect", picture, "--boxes", boxes]]
    for words, path in zip(runs, (target, boxes)):
        notes = [run(*words).stderr.count(f"note: {path} will be replaced when") for _ in range(2)]
        assert notes == [0, 1]
    assert "note" not in run(*runs[0], "--quiet").stderr
    for words, refused in ((runs[0], ["--jobs", 0]), (runs[0], ["--fov", 200]), (runs[1], ["--horizon", 9])):
        assert refuse(*words, *refused).startswith("error: --")
