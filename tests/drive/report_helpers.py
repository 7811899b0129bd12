"""Runs and pages of reports for the tests."""

import math
import re
from fractions import Fraction
from html.parser import HTMLParser
from types import SimpleNamespace

from vehicle_detection.drive import ReportWriter
from vehicle_detection.video import VideoReport

FPS = 25
VOID_ELEMENTS = {"meta", "link", "source", "img"}


def track(number, *, distance=20.0, distance_std=2.0, speed=1.5, speed_std=0.5, confidence=1.0, shown=True):
    return SimpleNamespace(
        id=number, box=(math.nan,) * 4, shown=shown, distance_m=distance, distance_std_m=distance_std,
        speed_mps=speed, speed_std_mps=speed_std, confidence=confidence,
    )  # fmt: skip


FRAMES = [
    [track(1, distance=30 - index / 5)] + ([track(2, distance=None, speed=None)] if 10 <= index < 20 else [])
    for index in range(50)
]
"""Tracks of each frame of a run: one in all frames, another in those from 10 to 19."""


def video_report(frames, **options):
    defaults = {"fps": Fraction(FPS), "shape": (720, 1280, 3), "seconds": 2.0, "tracks": 1}
    defaults["stages"] = {"decode": 1.0, "search": 3.0}
    return VideoReport(frames=frames, **(defaults | options))


def write_report(folder, frames, *, events=None, pictures=(), report=None, **options):
    """Write a report of the tracks of each frame, with changes of the `VideoReport`; return its text."""
    writer = ReportWriter(folder / "report.html", **options)
    for index, tracks in enumerate(frames):
        writer.table.append(index, index / FPS, tracks)
    writer.finish(video_report(len(frames), **(report or {})), events=events, pictures=pictures)
    return (folder / "report.html").read_text(encoding="utf-8")


class StrictParser(HTMLParser):
    """Parses a page whose elements must all be closed, in order."""

    def __init__(self, page):
        super().__init__(convert_charrefs=True)
        self.open, self.elements, self.texts = [], [], {}
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, name, attributes):
        assert len(dict(attributes)) == len(attributes)
        self.elements.append((name, dict(attributes)))
        if name not in VOID_ELEMENTS:
            self.open.append(name)

    def handle_endtag(self, name):
        assert self.open.pop() == name

    def handle_data(self, data):
        place = "/".join(self.open[-2:])
        self.texts[place] = self.texts.get(place, "") + data

    def all(self, name):
        return [attributes for kind, attributes in self.elements if kind == name]


def script_data(page):
    """Text of the JSON that the script reads."""
    return re.search(r'<script type="application/json" id="data">(.*?)</script>', page)[1]
