"""The report page in headless Chromium, controlled by chromedriver over HTTP."""

import itertools
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.drawing.cases import track
from tests.drive.report_helpers import track as report_track
from tests.drive.report_helpers import write_report
from tools.browser import PHONE, Browser
from vehicle_detection import Annotator, Detections, FrameResult, VehicleDetector, process_video, render_drive
from vehicle_detection.cli.demo import draw_clip
from vehicle_detection.drive import OwnSpeed, ReportWriter

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="process groups and file names of POSIX")

FRAMES, FPS = 50, 25
SOURCE, TARGET = 'a <b>&amp; "c" #1.mp4', "50% <i> 'd' #2?.mp4"
VIDEO = "document.querySelector('video')"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    try:
        browser = Browser(tmp_path_factory.mktemp("browser"))
    except FileNotFoundError as error:
        pytest.skip(str(error))
    yield browser
    browser.close()


class ScriptedDetector:
    """A detector with one vehicle in all frames and another in frames 20 to 39."""

    def reset(self, *, fps):
        self.index = -1

    def search(self, frame):
        return None

    def track(self, found, *, time, frames, cut):
        self.index += 1
        box = np.array([100.0 + self.index, 120, 180 + self.index, 180])
        distance = {"distance_m": 20 + self.index / 10, "distance_std_m": 2.0 if self.index < 45 else 8.0}
        first = track(id=1, box=box, speed_mps=2.5, speed_std_mps=0.5, **distance)
        second = replace(first, id=2, box=box + 150, distance_m=None, speed_mps=-1.0)
        tracks = (first, second) if 20 <= self.index < 40 else (first,)
        none = Detections.empty()
        return FrameResult(self.index, time, none, none, tracks, {"search": 0.01})

    annotator = Annotator()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with two pages, one with an embedded and one with a linked video."""
    folder = tmp_path_factory.mktemp("a #1 folder & 100%")
    (folder / "pages").mkdir()
    drive = render_drive(frames=FRAMES, fps=FPS, shape=(270, 480), scenario="empty")
    draw_clip(drive, folder / SOURCE, folder / "labels.csv")
    with VehicleDetector(jobs=1) as detector:
        about = {"video": folder / TARGET, "source": folder / SOURCE, "detector": detector}
        writers = [
            ReportWriter(folder / "embedded.html", **about),
            ReportWriter(folder / "pages" / "linked.html", **about, embed_limit=1000),
        ]
        report = process_video(
            folder / SOURCE,
            folder / TARGET,
            ScriptedDetector(),
            progress=False,
            on_result=lambda result: [write(result) for write in writers],
        )
        for write in writers:
            write.finish(report)
    return folder


@pytest.fixture
def embedded(folder):
    return folder / "embedded.html"


def current_frame(browser):
    browser.wait_until(f"!{VIDEO}.seeking")
    return int(browser.run(f"{VIDEO}.currentTime") * FPS)


@pytest.mark.parametrize("name", ["embedded.html", "pages/linked.html"])
def test_the_video_plays_and_nothing_else_is_loaded(browser, folder, name):
    browser.open(folder / name)
    assert browser.run(f"[{VIDEO}.videoWidth, {VIDEO}.videoHeight]") == [480, 270]
    assert browser.run(f"{VIDEO}.duration") == pytest.approx(FRAMES / FPS, abs=0.05)
    browser.run(f"{VIDEO}.muted = true, {VIDEO}.play()")
    browser.wait_until(f"{VIDEO}.currentTime > 0.3")
    browser.wait_until(f"{VIDEO}.ended")
    # The playhead has moved along.
    browser.wait_until("document.querySelector('.playhead').getAttribute('x1') === '99%'")
    assert browser.log("browser") == []
    schemes = {url.split(":")[0] for url in browser.requests()}
    assert "file" in schemes
    assert schemes <= {"file", "data", "blob"}
    assert browser.run(f"{VIDEO}.currentSrc").startswith("file:" if "linked" in name else "blob:")


@pytest.mark.parametrize("name", ["embedded.html", "pages/linked.html"])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_a_phone(browser, folder, name, scheme):
    browser.open(folder / name, size=PHONE, scheme=scheme)
    browser.run("document.querySelectorAll('details').forEach(each => each.open = true)")
    assert browser.run("innerWidth") == PHONE["width"]
    assert browser.run("document.documentElement.scrollWidth") <= PHONE["width"]
    assert browser.run("document.querySelectorAll('details').length") >= 4
    # The text of charts keeps its size.
    sizes = browser.run(
        "[...document.querySelectorAll('svg text')].map(t => t.getBoundingClientRect().height)"
    )
    assert min(sizes) >= 10


def test_bars_and_charts_seek_in_the_video(browser, embedded):
    browser.open(embedded)
    browser.click(".bar[data-track='2']")
    assert current_frame(browser) == 20
    browser.type(".bar[data-track='1']", "\ue007")  # the enter key
    assert current_frame(browser) == 0
    browser.click("td:nth-child(2) button[data-frame='20']")
    assert current_frame(browser) == 20
    browser.point("figure:nth-of-type(3) .plot", 0.5, press=True)
    assert current_frame(browser) == pytest.approx(25, abs=1)
    assert browser.log("browser") == []


def test_hovering_over_a_chart_shows_the_values_there(browser, embedded):
    browser.open(embedded)
    assert browser.run("document.querySelector('.readout').textContent") == "0:00.0#1 20 m +9 km/h"
    browser.point("figure:nth-of-type(4) .plot", 0.609)
    readout = browser.run("document.querySelector('.readout').textContent")
    assert readout == "0:01.2#1 23 m +9 km/h#2 \u22124 km/h"
    assert browser.run("document.querySelectorAll('.cursor.visible').length") == 4
    assert browser.run("document.querySelector('.cursor').getAttribute('x1')") == "61%"
    browser.point("figure:nth-of-type(4) .plot", 0.97)
    assert browser.run("document.querySelector('.readout').textContent") == "0:01.9#1 ~25 m +9 km/h"
    assert browser.run(f"{VIDEO}.currentTime") == 0
    browser.point("h1", 0.5)
    assert browser.run("document.querySelectorAll('.cursor.visible').length") == 0
    assert browser.run("document.querySelector('.readout').textContent") == "0:00.0#1 20 m +9 km/h"
    # Hovering over a bar fades the other tracks.
    browser.point(".bar[data-track='2']", 0.5)
    assert browser.run("[...document.querySelectorAll('.faded')].every(part => part.dataset.track === '1')")
    assert browser.run("document.querySelectorAll('.faded').length") == 3


def test_charts_show_lines_bands_bars_and_labels(browser, tmp_path):
    own = SimpleNamespace(annotator=Annotator(own_speed=OwnSpeed([0.0, 2.0], [10.0, 10.0])))
    # Many vehicles at one distance; one is seen once, one with a gap.
    frames = [[report_track(number, distance=38, speed=-12) for number in range(1, 8)] for _ in range(50)]
    frames[20].append(report_track(8, distance=9, speed=None))
    for index in (0, 1, 2, 4, 5):
        frames[index].append(report_track(9, distance=20 + index, speed=2))
    write_report(tmp_path, frames, detector=own)
    browser.open(tmp_path / "report.html")
    charts = "[...document.querySelectorAll('.plot[data-series]')]"
    series = browser.run(f"{charts}.map(each => each.dataset.series)")
    assert series == ["count", "distance", "ground", "speed"]
    ticks = browser.run(
        f"{charts}.map(each => [...each.closest('.graph').querySelectorAll('.values text')]"
        ".map(text => +text.textContent.replace('\\u2212', '-')))"
    )
    assert ticks == [[0, 5, 10], [0, 10, 20, 30, 40], [-20, 0, 20, 40, 60], [-60, -40, -20, 0, 20]]
    paths = browser.run(
        f"{charts}.map(each => [...each.querySelectorAll('path')].map(path => path.getAttribute('d')))"
    )
    assert "NaN" not in str(paths)
    assert [len(each) for each in paths] == [1, 18, 9, 8]  # with bands; the own speed; no speed of one
    assert [path.count("h") for path in paths[1][-4:]] == [0, 0, 0, 1]  # a point is a short line
    assert [path.count("M") for path in paths[1][-4:]] == [2, 2, 1, 1]  # band and line of each
    places = browser.run(
        "[...document.querySelector('[data-series=distance]').querySelectorAll('.track-name')]"
        ".map(text => +text.getAttribute('y'))"
    )
    assert 2 <= len(places) <= 4  # of seven, those near their lines
    assert all(abs(one - other) >= 13 - 1e-3 for one, other in itertools.combinations(places, 2))
    assert browser.log("browser") == []


def test_charts_zoom_and_scroll_together(browser, tmp_path):
    frames = [[report_track(1)] if index % 100 < 90 else [] for index in range(60 * FPS)]
    write_report(tmp_path, frames)
    browser.open(tmp_path / "report.html")
    assert browser.run("document.querySelector('.zoom output').textContent") == "whole video"
    browser.click(".zoom [data-factor='2']")
    browser.click(".zoom [data-factor='2']")
    assert browser.run("document.querySelector('.zoom output').textContent") == "0:15 of 1:00"
    assert browser.run("document.querySelectorAll('.zoom button')[1].disabled")  # 10 s is the limit
    widths = browser.run("scrolls.map(each => each.scrollWidth / each.clientWidth)")
    assert widths == pytest.approx([4.0] * len(widths), rel=0.01)
    browser.run("scrolls[0].scrollLeft = 200")
    browser.wait_until("scrolls.every(each => each.scrollLeft === 200)")
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    browser.click(".zoom [data-factor='0.5']")
    browser.click(".zoom [data-factor='0.5']")
    assert browser.run("scrolls.every(each => each.scrollWidth <= each.clientWidth)")


def test_headings_charts_and_controls_have_names(browser, embedded):
    browser.open(embedded)
    nodes = browser.command("Accessibility.getFullAXTree")["nodes"]
    named = {"heading", "image", "button", "region", "Video", "group", "link"}
    found = [node for node in nodes if not node["ignored"] and node["role"]["value"] in named]
    inside = ("details", "summary")
    nameless = [
        node["role"]["value"]
        for node in found
        if not node.get("name", {}).get("value") and node["role"]["value"] not in inside
    ]
    assert {node["role"]["value"] for node in found} >= {"heading", "image", "button", "region", "Video"}
    assert set(nameless) <= {"group"}, nameless  # a <details> is a group without a name of its own
    heads = browser.run("[...document.querySelectorAll('h1, h2, h3')].map(head => +head.tagName[1])")
    assert heads[0] == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(heads))


def test_without_its_script_the_page_still_shows_the_video(browser, embedded):
    browser.command("Emulation.setScriptExecutionDisabled", value=True)
    try:
        browser.open(embedded)
        assert browser.run(f"{VIDEO}.currentSrc").startswith("data:video/mp4;base64,")
        assert browser.run(f"{VIDEO}.videoWidth") == 480
    finally:
        browser.command("Emulation.setScriptExecutionDisabled", value=False)
