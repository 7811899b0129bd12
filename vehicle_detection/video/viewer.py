"""Show frames while they are processed: in a window, or in the output of a notebook's cell."""

from __future__ import annotations

import importlib
import io
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from vehicle_detection._common import in_notebook
from vehicle_detection.errors import InvalidInputError

# Largest width in a notebook, which stores and sends each picture, and quality of the pictures (JPEG).
_NOTEBOOK_WIDTH, _QUALITY = 960, 95
# Fraction of the screen that a window may take.
_SCREEN_FRACTION = 0.9


class Viewer:
    """Shows one frame after the other, scaled down to `_size`, and at most one in `_interval` seconds."""

    closed = False
    """Whether the user has closed the window."""
    _interval: float
    _size: tuple[int, int]
    _last = -np.inf

    def show(self, frame: NDArray[np.uint8]) -> None:
        """Show an ``(H, W, 3)`` uint8 RGB frame; frames that follow too fast are left out."""
        now = time.monotonic()
        if not self.closed and now - self._last >= self._interval:
            self._last = now
            picture = Image.fromarray(frame)
            picture.thumbnail(self._size)
            self._show(picture)

    def _show(self, picture: Image.Image) -> None:
        raise NotImplementedError

    def close(self) -> None:
        """Close the window; a picture in a notebook stays."""


def open_viewer(title: str) -> Viewer:
    """Open a window, or the output of the notebook's cell in which this is called."""
    return NotebookViewer() if in_notebook() else WindowViewer(title)


class WindowViewer(Viewer):
    """A window of tkinter, which belongs to Python; OpenCV's headless package has none."""

    _interval = 1 / 30

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
        width, height = self._root.winfo_screenwidth(), self._root.winfo_screenheight()
        self._size = int(width * _SCREEN_FRACTION), int(height * _SCREEN_FRACTION)

    def _show(self, picture: Image.Image) -> None:
        """Show a picture, and process the window's events."""
        # The label keeps no reference.
        self._picture = self._tkinter.PhotoImage(data=b"P6 %d %d 255 " % picture.size + picture.tobytes())
        self._label.configure(image=self._picture)
        self._root.update()

    def close(self) -> None:
        """Close the window."""
        if not self.closed:
            self.closed = True
            self._root.destroy()


class NotebookViewer(Viewer):
    """A picture in the output of a cell, which is replaced."""

    _interval = 0.1
    _size = _NOTEBOOK_WIDTH, _NOTEBOOK_WIDTH

    def __init__(self) -> None:
        self._display: Any = importlib.import_module("IPython.display")
        self._handle: Any = None

    def _show(self, picture: Image.Image) -> None:
        data = io.BytesIO()
        picture.save(data, "jpeg", quality=_QUALITY)
        shown = self._display.Image(data=data.getvalue(), format="jpeg")
        if self._handle is None:
            self._handle = self._display.display(shown, display_id=True)
        else:
            self._handle.update(shown)
