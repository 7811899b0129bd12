"""Show frames while they are processed: in a window, or in the output of a notebook's cell."""

from __future__ import annotations

import importlib
import time
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import in_notebook
from vehicle_detection.errors import InvalidInputError

# Seconds between pictures, and largest width in a notebook, which stores and sends each of them.
_WINDOW_INTERVAL, _NOTEBOOK_INTERVAL = 1 / 30, 0.1
_NOTEBOOK_WIDTH = 960
# Fraction of the screen that a window may take.
_SCREEN_FRACTION = 0.9


class Viewer(Protocol):
    """Shows one frame after the other."""

    closed: bool
    """Whether the user has closed the window."""

    def show(self, frame: NDArray[np.uint8]) -> None:
        """Show an ``(H, W, 3)`` uint8 RGB frame; frames that follow too fast are left out."""

    def close(self) -> None:
        """Close the window; a picture in a notebook stays."""


def open_viewer(title: str) -> Viewer:
    """Open a window, or the output of the notebook's cell in which this is called."""
    return NotebookViewer() if in_notebook() else WindowViewer(title)


class WindowViewer:
    """A window of tkinter, which belongs to Python; OpenCV's headless package has none."""

    def __init__(self, title: str) -> None:
        try:
            import tkinter
        except ImportError:
            raise InvalidInputError(
                "show needs tkinter, which this Python lacks; install it (such as python3-tk), or write a "
                "video"
            ) from None
        try:
            self._root = tkinter.Tk()
        except tkinter.TclError as error:
            raise InvalidInputError(
                f"show needs a display ({error}); run it on a desktop or in a notebook, or write a video"
            ) from None
        self._tkinter: Any = tkinter
        self._root.title(title)
        self._root.protocol("WM_DELETE_WINDOW", self.close)
        self._root.bind("<Escape>", lambda _: self.close())
        self._label = tkinter.Label(self._root)
        self._label.pack()
        screen = self._root.winfo_screenwidth(), self._root.winfo_screenheight()
        self._width, self._height = (int(side * _SCREEN_FRACTION) for side in screen)
        self._last = -np.inf
        self.closed = False

    def show(self, frame: NDArray[np.uint8]) -> None:
        """Show a frame, scaled down to the screen, and process the window's events."""
        now = time.monotonic()
        if self.closed or now - self._last < _WINDOW_INTERVAL:
            return
        self._last = now
        frame = _fit(frame, self._width, self._height)
        height, width = frame.shape[:2]
        # The label keeps no reference.
        self._picture = self._tkinter.PhotoImage(data=b"P6 %d %d 255 " % (width, height) + frame.tobytes())
        self._label.configure(image=self._picture)
        self._root.update()

    def close(self) -> None:
        """Close the window."""
        if not self.closed:
            self.closed = True
            self._root.destroy()


class NotebookViewer:
    """A picture in the output of a cell, which is replaced."""

    closed = False

    def __init__(self) -> None:
        self._display: Any = importlib.import_module("IPython.display")
        self._handle: Any = None
        self._last = -np.inf

    def show(self, frame: NDArray[np.uint8]) -> None:
        """Replace the picture."""
        now = time.monotonic()
        if now - self._last < _NOTEBOOK_INTERVAL:
            return
        self._last = now
        frame = _fit(frame, _NOTEBOOK_WIDTH, _NOTEBOOK_WIDTH)
        _, data = cv2.imencode(".jpg", np.ascontiguousarray(frame[..., ::-1]))
        picture = self._display.Image(data=data.tobytes(), format="jpeg")
        if self._handle is None:
            self._handle = self._display.display(picture, display_id=True)
        else:
            self._handle.update(picture)

    def close(self) -> None:
        """Keep the last picture."""


def _fit(frame: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Scale a frame down to a size."""
    scale = min(width / frame.shape[1], height / frame.shape[0])
    if scale >= 1:
        return frame
    size = max(1, round(frame.shape[1] * scale)), max(1, round(frame.shape[0] * scale))
    return np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), np.uint8)
