"""Make the gallery's pictures of explorer and report: ``python -m tools.screenshots -o docs/gallery``.

Both show a rendered drive with the shipped default model, in headless Chromium (Debian packages ``chromium``
and ``chromium-driver``). If a box of the pictured frame is false or missing, nothing is written; choose
another seed in `SCENE` then. `RECORD` keeps the hashes of model and pictures for a test.
"""

from __future__ import annotations

import argparse
import base64
import html
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.browser import Browser
from tools.pictures import MODEL, file_hash, find_errors
from vehicle_detection import Camera, DetectorError, Explorer, VehicleDetectionError, VehicleDetector
from vehicle_detection._common import atomic_write, write_text
from vehicle_detection.cli.demo import draw_clip
from vehicle_detection.drive import ReportWriter, find_events
from vehicle_detection.scenes import render_drive
from vehicle_detection.video import process_video

SCENE: dict[str, Any] = {"scenario": "passing", "frames": 200, "random_state": 0, "shape": (540, 960)}
"""Options of `render_drive`."""

EXPLORER_FRAME, REPORT_FRAME = 0, 112
"""Frames of the drive that the pictures show."""

EXPLORER, REPORT, RECORD = "explorer.jpg", "report.jpg", "screenshots.json"
FILES = (EXPLORER, REPORT)

_WIDTH = 800  # of the browser's window, and of the pictures
_REPORT_HEIGHT = 1240
_JPEG_QUALITY = 86
# Looks like the explorer in a notebook: a line of text above the picture.
_EXPLORER_PAGE = """<!DOCTYPE html><meta charset="utf-8">
<style>body {{ margin: 8px; font: 14px sans-serif }} img {{ width: 100%; margin-top: 6px }}</style>
<div id="explorer">{text}<br><img src="data:image/png;base64,{picture}"></div>"""


def make_screenshots(folder: Path, detector: VehicleDetector) -> None:
    """Write `FILES` and `RECORD` into a folder, unless a box is false or missing in the pictured frame."""
    with tempfile.TemporaryDirectory(prefix="vehicle-screenshots-") as name:
        temporary = Path(name)
        with Browser(temporary) as browser:  # first, because it may be missing
            pages = {EXPLORER: _write_explorer_page(temporary), REPORT: _write_report(temporary, detector)}
            pictures = {name: _photograph(browser, page) for name, page in pages.items()}
    for name, picture in pictures.items():
        _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        with atomic_write(folder / name) as part:
            part.write_bytes(data.tobytes())
    record = {"model": file_hash(MODEL), "files": {name: file_hash(folder / name) for name in FILES}}
    write_text(folder / RECORD, json.dumps(record, indent=2) + "\n")


def _write_explorer_page(folder: Path) -> Path:
    """Write a page with the picture of an `Explorer` that explains the best box of a frame."""
    drive = render_drive(**SCENE)
    scene = drive[EXPLORER_FRAME]
    explorer = Explorer({f"{EXPLORER_FRAME / drive.fps:.1f} s": scene.image})
    _check(explorer.boxes().boxes.tolist(), scene.truth)
    explorer.set_box(1)
    _, data = cv2.imencode(".png", explorer.render()[..., ::-1])
    text, picture = html.escape(explorer.summary()), base64.b64encode(data.tobytes()).decode()
    page = folder / "explorer.html"
    page.write_text(_EXPLORER_PAGE.format(text=text, picture=picture), encoding="utf-8")
    return page


def _write_report(folder: Path, detector: VehicleDetector) -> Path:
    """Process the drive, and write the report page."""
    drive = render_drive(**SCENE)
    clip, annotated, page = (folder / name for name in ("drive.mp4", "annotated.mp4", "report.html"))
    draw_clip(drive, clip, folder / "labels.csv", progress=True)
    boxes: list[list[float]] = []
    write = ReportWriter(page, video=annotated, source=clip, detector=detector)

    def add(result: Any) -> None:
        if result.index == REPORT_FRAME:
            boxes.extend(track.box.tolist() for track in result.shown)
        write(result)

    done = process_video(clip, annotated, detector, on_result=add)
    _check(boxes, drive.truth_of(REPORT_FRAME))
    camera = detector.camera.for_shape(done.shape)
    write.finish(done, events=find_events(write.table, fps=drive.fps, shape=done.shape, camera=camera))
    return page


def _check(boxes: Sequence[Sequence[float]], truth: Any) -> None:
    """Raise an error if a box is false or missing."""
    errors = find_errors([boxes], [truth])
    if errors:
        raise DetectorError("; ".join(errors) + "; choose another random_state of SCENE")


def _photograph(browser: Browser, page: Path) -> NDArray[np.uint8]:
    """Picture of a page: all of the explorer's, the upper part of a report."""
    size = {"width": _WIDTH, "height": _REPORT_HEIGHT, "deviceScaleFactor": 1, "mobile": False}
    browser.open(page, size=size)
    bottom = browser.run("document.querySelector('#explorer')?.getBoundingClientRect().bottom")
    if bottom is not None:
        return browser.screenshot(round(bottom) + 4)
    browser.run("document.querySelector('h1 + p').remove()")  # the speed depends on the machine
    browser.run(f"seek({REPORT_FRAME})")
    browser.wait_until("!document.querySelector('video').seeking")
    time.sleep(1)  # until the controls no longer show that the video loads
    return browser.screenshot(_REPORT_HEIGHT)


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, process, check and write the pictures."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.screenshots", description="Make the gallery's pictures of explorer and report."
    )
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, default=Path("docs/gallery"), help="folder"
    )
    folder = parser.parse_args(arguments).output
    try:
        with VehicleDetector(camera=Camera.dashcam(fov=58)) as detector:
            make_screenshots(folder, detector)
    except (VehicleDetectionError, FileNotFoundError) as error:
        parser.error(str(error))
    for name in FILES:
        print(f"{folder / name}: {(folder / name).stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
