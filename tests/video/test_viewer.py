"""Frames that are shown while they are processed."""

import os
import sys
import types
from unittest.mock import MagicMock

import numpy as np
import pytest

from tests.helpers import StubDetector
from tests.video.clips import frame_numbers, gray_frames, sound_seconds, write_clip
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video import process_video, viewer, writing


class Recorder:
    """A window that its user closes after some frames."""

    def __init__(self, last=1000):
        self.frames, self.last, self.closed, self.ended = [], last, False, False

    def show(self, frame):
        self.frames.append(frame)
        self.closed = len(self.frames) >= self.last

    def close(self):
        self.ended = True


@pytest.mark.parametrize("written", [True, False])
def test_the_shown_frames_are_those_that_are_written(clip, tmp_path, monkeypatch, written):
    window = Recorder()
    monkeypatch.setattr(writing, "open_viewer", lambda title: window)
    target = tmp_path / "out.mp4" if written else None
    report = process_video(clip, target, StubDetector(), show=True)
    assert len(window.frames) == report.frames == 20
    assert all((frame[:6, :6] == 255).all() for frame in window.frames)
    assert [round((frame[8:-8, 8:-8].mean() - 10) / 10) for frame in window.frames] == list(range(20))
    assert window.ended
    assert not written or frame_numbers(target) == list(range(20))


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_closing_the_window_ends_the_run_and_completes_the_video(folder, tmp_path, monkeypatch, suffix):
    # A pipe holds about 60 of these small frames, which are read after its ffmpeg has ended.
    clip = write_clip(folder / f"long.{suffix}", gray_frames(20) * 8, sound=True)
    window, target = Recorder(last=3), tmp_path / f"out.{suffix}"
    monkeypatch.setattr(writing, "open_viewer", lambda title: window)
    report = process_video(clip, target, StubDetector(pause=0.01), show=True, jobs=1)
    assert 3 <= report.frames < 160
    assert frame_numbers(target) == [number % 20 for number in range(report.frames)]
    assert sound_seconds(target) == pytest.approx(float(report.frames / report.fps), abs=0.07)
    assert os.listdir(tmp_path) == [target.name]


def test_without_a_display_or_tkinter(clip, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if sys.platform == "linux":
        with pytest.raises(InvalidInputError, match=r"show needs (a display|tkinter)"):
            process_video(clip, None, StubDetector(), show=True)
    monkeypatch.setitem(sys.modules, "tkinter", None)
    with pytest.raises(InvalidInputError, match=r"show needs tkinter, .*, or write a video$"):
        process_video(clip, None, StubDetector(), show=True)


def test_a_window_scales_large_frames_down_and_can_be_closed(monkeypatch):
    tkinter = MagicMock(TclError=RuntimeError, PhotoImage=lambda data: data)
    root, label = tkinter.Tk(), tkinter.Label()
    root.winfo_screenwidth.return_value, root.winfo_screenheight.return_value = 1000, 500
    monkeypatch.setitem(sys.modules, "tkinter", tkinter)
    monkeypatch.setattr(viewer.WindowViewer, "_interval", 0)
    monkeypatch.setitem(sys.modules, "IPython", None)
    window = viewer.open_viewer("drive.mp4")
    window.show(np.full((100, 200, 3), 7, np.uint8))
    window.show(np.zeros((900, 1000, 3), np.uint8))
    root.title.assert_called_with("drive.mp4")
    shown = [call.kwargs["image"] for call in label.configure.call_args_list]
    assert shown[0] == b"P6 200 100 255 " + b"\7" * 60_000
    assert shown[1].startswith(b"P6 500 450 255 ")
    key, close = root.bind.call_args.args
    assert key == "<Escape>"
    close(None)
    assert window.closed
    window.show(np.zeros((9, 9, 3), np.uint8))
    window.close()
    assert len(label.configure.call_args_list) == 2
    root.destroy.assert_called_once()


def test_a_notebook_shows_one_picture_that_changes(monkeypatch):
    display = pytest.importorskip("IPython.display")
    pictures = []
    handle = types.SimpleNamespace(update=pictures.append)
    monkeypatch.setattr(display, "display", lambda picture, display_id: pictures.append(picture) or handle)
    shell = types.SimpleNamespace(kernel=object())
    monkeypatch.setattr(sys.modules["IPython"], "get_ipython", lambda: shell)
    monkeypatch.setattr(viewer.NotebookViewer, "_interval", 0)
    view = viewer.open_viewer("drive.mp4")
    for value in (0, 255):
        view.show(np.full((720, 1280, 3), value, np.uint8))
    view.close()
    assert len(pictures) == 2
    assert all(picture.data[:2] == b"\xff\xd8" for picture in pictures)
    assert not view.closed
    # A plain interpreter has no kernel.
    monkeypatch.setattr(sys.modules["IPython"], "get_ipython", lambda: None)
    monkeypatch.setitem(sys.modules, "tkinter", None)
    with pytest.raises(InvalidInputError, match="show needs tkinter"):
        viewer.open_viewer("drive.mp4")
