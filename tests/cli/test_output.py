import _thread
import os
import signal
import sys
import threading
import time

import pytest

from tests.helpers import failing
from vehicle_detection._common import progress_bar
from vehicle_detection.cli import output
from vehicle_detection.cli.output import check_distinct_paths, print_error, print_table, run_interruptible
from vehicle_detection.errors import InvalidInputError


def test_a_line_is_printed_above_a_progress_bar(capsys):
    with progress_bar(True, 5, unit="frame"):
        print_error("warning: a/path\nis used")
    assert "warning: a/path is used\n" in capsys.readouterr().err
    output.print_facts("data", {"sources": "GTI 3900", "n": 1})
    assert capsys.readouterr().out == "data\n  sources  GTI 3900\n  n        1\n"


@pytest.mark.parametrize("width", [80, 50, 41])
def test_a_table_breaks_no_word(monkeypatch, capsys, width):
    monkeypatch.setattr(output, "_PIPE_WIDTH", width)
    japanese = "\u8eca\u4e21\u30c7.mp4"  # each of these three characters takes two columns
    words = [japanese, "false negatives", "near duplicates", "0.954", "KITTI and Extras"]
    print_table("scores", ["tested on", *words[1:3]], [[words[0], "0.954", "1"], [words[4], "1", "2"]])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    assert {word for text in words for word in text.split()} <= set(" ".join(lines).split())
    if width == 80:
        assert any("false negatives" in line for line in lines)


def test_two_names_of_a_file_are_one_file(tmp_path):
    (tmp_path / "a.csv").touch()
    os.link(tmp_path / "a.csv", tmp_path / "A2.csv")  # as A.csv on a disk that ignores case
    with pytest.raises(InvalidInputError, match=r"--json .+A2.csv is also LABELS .+a.csv; choose another"):
        check_distinct_paths({"--json": tmp_path / "A2.csv"}, {"LABELS": tmp_path / "a.csv"})


def test_control_characters_of_names_are_escaped(capsys):
    print_error("error: a\x1b[2J\u202eb\x9b.mp4 is missing")
    print_table("names", ["name"], [["c\x1b]0;title\x07"]])
    output.print_facts("d\x1b[1m", {"e": "f\rg"})
    out, err = capsys.readouterr()
    assert err == "error: a\\x1b[2J\\u202eb\\x9b.mp4 is missing\n"
    assert all(name in out for name in ("c\\x1b]0;title\\x07", "d\\x1b[1m", "f\\rg"))
    assert "\x1b" not in out


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGUSR1")
def test_a_signal_right_before_the_wait_for_a_computation_is_noticed():
    """Like `interrupt_main`, it does not end a wait."""
    before, ended, late = signal.signal(signal.SIGUSR1, failing(KeyboardInterrupt())), threading.Event(), []

    def compute():
        time.sleep(0.5)  # until the wait has begun
        _thread.interrupt_main(signal.SIGUSR1)
        late.append(not ended.wait(5))

    try:
        with pytest.raises(KeyboardInterrupt):
            run_interruptible(compute)
        assert not late
    finally:
        ended.set()
        signal.signal(signal.SIGUSR1, before)
