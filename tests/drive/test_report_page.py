"""The content of the page."""

import base64
import dataclasses
import hashlib
import html
import json
import math
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.drive.report_helpers import (
    FPS,
    FRAMES,
    StrictParser,
    script_data,
    track,
    video_report,
    write_report,
)
from vehicle_detection import Annotator, Camera, InvalidInputError, TrackParams, TrackTable, load_classifier
from vehicle_detection.detector import VehicleDetector, load_model
from vehicle_detection.drawing import TRACK_COLORS
from vehicle_detection.drive import Event, OwnSpeed, ReportWriter, TrackPicture
from vehicle_detection.drive import report as page

UNSAFE_NAME = "\"><img src=x onerror=alert(1)>&amp;'</title><script>.mp4"


@pytest.fixture
def video(tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "found.mp4"
    path.write_bytes(bytes(range(256)) * 7)
    return path


class TestPage:
    def test_is_complete_and_self_contained(self, tmp_path, video):
        with VehicleDetector(jobs=1) as detector:
            about = {"video": video, "source": "drive.mp4", "detector": detector}
            text = write_report(tmp_path, FRAMES, **about)
            assert write_report(tmp_path, FRAMES, **about) == text, "the same run gives another page"
        parsed = StrictParser(text)
        assert text.startswith("<!DOCTYPE html>\n")
        assert parsed.all("html") == [{"lang": "en"}]
        assert parsed.texts["head/title"] == "Vehicles in drive.mp4"
        (source,) = parsed.all("source")
        kind, data = source["src"].split(",")
        assert kind == "data:video/mp4;base64"
        assert base64.b64decode(data, validate=True) == video.read_bytes()
        addresses = [
            value for _, each in parsed.elements for name, value in each.items() if name in ("src", "href")
        ]
        assert all(address.startswith("data:") for address in addresses)
        assert not re.search(r"https?:|url\(|@import|//[a-z]", text.replace(data, "").replace("// ", ""))
        identifiers = [each["id"] for _, each in parsed.elements if "id" in each]
        assert len(set(identifiers)) == len(identifiers)

    def test_its_policy_allows_its_own_script_and_style_only(self, tmp_path):
        text = write_report(tmp_path, FRAMES)
        (policy,) = [each["content"] for each in StrictParser(text).all("meta") if "http-equiv" in each]
        rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
        assert rules["default-src"] == "'none'"
        for element, rule in (("script", "script-src"), ("style", "style-src")):
            (code,) = re.findall(f"<{element}>(.*?)</{element}>", text, re.DOTALL)
            digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
            assert rules[rule] == f"'sha256-{digest}'"
        # The policy forbids inline styles and event handlers.
        assert not re.search(r'<[^>]* (style|on\w+)="', text)

    def test_file_names_stay_text(self, tmp_path):
        (tmp_path / "in").mkdir()
        name = UNSAFE_NAME.replace("/", "_")
        video = tmp_path / "in" / (name if sys.platform != "win32" else "found.mp4")
        video.write_bytes(b"video")
        text = write_report(tmp_path, FRAMES, source=f"/roads/{name}", video=video, embed_limit=3)
        parsed = StrictParser(text)
        assert parsed.all("img") == []
        assert len(parsed.all("script")) == 2
        assert parsed.texts["head/title"] == f"Vehicles in {name}"
        assert parsed.texts["h1/bdi"] == name
        assert parsed.texts["a/bdi"] == video.name

    def test_passwords_and_bytes_that_are_not_utf8_are_replaced(self, tmp_path):
        name = b"road \xff.mp4".decode("utf-8", "surrogateescape")
        assert "Vehicles in road ?.mp4" in write_report(tmp_path, FRAMES[:1], source=name)
        text = write_report(tmp_path, FRAMES[:1], source="rtsp://anna:se@cret@camera")
        assert "Vehicles in ***@camera" in text
        assert "anna" not in text

    def test_a_run_without_a_video_and_events(self, tmp_path):
        text = write_report(tmp_path, FRAMES)
        parsed = StrictParser(text)
        assert parsed.all("video") == []
        assert "No video was written." in text
        assert "go to that time in the video" not in text
        assert "No event was found." in text
        assert parsed.texts["head/title"] == "Vehicles"

    @pytest.mark.parametrize("tracks", [[], [track(1, shown=False)], [track(0, shown=False)] * 2])
    def test_a_road_without_vehicles(self, tmp_path, tracks):
        text = write_report(tmp_path, [tracks] * 10)
        StrictParser(text)
        assert text.count("No vehicle was shown.") == 2
        assert "No event was found." not in text
        assert json.loads(script_data(text))["tracks"] == []

    def test_vehicles_without_distance_and_speed(self, tmp_path):
        text = write_report(tmp_path, [[track(7, distance=None, speed=None, confidence=None)]] * 5)
        StrictParser(text)
        assert "No distance is known." in text
        assert "No relative speed is known." in text
        assert json.loads(script_data(text))["tracks"][0]["distance"] == [None] * 5

    def test_counts_are_those_of_the_run(self, tmp_path):
        text = write_report(tmp_path, FRAMES)
        counts = dict(re.findall(r"<dt>([^<]*)</dt><dd>([^<]*)</dd>", text))
        assert counts.items() >= {
            "Vehicles": "2", "Frames": "50", "Length": "0:02.0", "Most at once": "2",
            "Longest track": "#1, 2.0 s", "Nearest": "21 \N{PLUS-MINUS SIGN} 2 m, #1",
        }.items()  # fmt: skip
        rows = re.findall(r"<tr>(<th scope=\"row\">.*?)</tr>", text, re.DOTALL)
        cells = [re.findall(r"<t[hd].*?>(.*?)</t[hd]>", row) for row in rows]
        assert [re.sub("<.*?>", "", cell) for cell in cells[2]] == [
            "#2", "0:00.4", "0:00.8", "10", "\N{EN DASH}", "\N{EN DASH}", "100 %",
        ]  # fmt: skip
        assert "decode" in text
        assert "20.00" in text  # milliseconds per frame
        assert "75.0%" in text

    def test_notices(self, tmp_path):
        assert '<ul class="notices">' not in write_report(tmp_path, FRAMES)
        detector, source = SimpleNamespace(camera=Camera.dashcam()), tmp_path / "<a>.mp4"
        report = {"damage": f"{source} is damaged: 3 frames are missing", "dropped": 2}
        text = write_report(tmp_path, [[track(1)]], detector=detector, source=source, report=report)
        (notices,) = re.findall(r'<ul class="notices">(.*?)</ul>', text, re.DOTALL)
        assert re.findall(r"<li>(.*)</li>", notices) == [
            "&lt;a&gt;.mp4 is damaged: 3 frames are missing.",
            "2 frames of the live source were dropped.",
            "The lens is unknown: distances and speeds may be wrong by a factor of 2 or more.",
        ]
        text = write_report(tmp_path, [[track(1, distance=None, speed=None)]], detector=detector)
        assert "The lens is unknown" not in text

    def test_speeds_over_ground_where_the_own_speed_is_known(self, tmp_path):
        own = OwnSpeed([0.0, 2.0], [10.0, 20.0])
        detector = SimpleNamespace(annotator=Annotator(own_speed=own))
        text = write_report(tmp_path, FRAMES, detector=detector)
        StrictParser(text)
        assert "<h3>Speed over ground</h3>" in text
        assert "from 36 to 77 km/h" in text  # the own speed, and 1.5 m/s above it
        data = json.loads(script_data(text))
        assert (data["own"][0], data["tracks"][0]["ground"][0]) == (36.0, 41.4)
        assert "Speed over ground</h3>" not in write_report(tmp_path, FRAMES)

    def test_units(self, tmp_path):
        frames = [[track(1, distance=30.48, speed=10.0)] for _ in range(5)]
        text = write_report(tmp_path, frames, units="imperial")
        assert "100 \N{PLUS-MINUS SIGN} 7 ft, #1" in text
        assert "Miles per hour relative to the camera" in text
        data = json.loads(script_data(text))
        assert data["units"] == ["ft", "mph"]
        assert (data["tracks"][0]["distance"], data["tracks"][0]["speed"]) == ([100.0] * 5, [22.4] * 5)
        with pytest.raises(InvalidInputError, match="units must be one of 'metric', 'imperial'; got 'si'"):
            ReportWriter(tmp_path / "report.html", units="si")

    def test_the_script_gets_the_values_of_the_charts(self, tmp_path):
        frames = [
            [track(3, distance=10 + index, speed=-1.25)] if index not in (4, 5) else [] for index in range(9)
        ]
        data = json.loads(script_data(write_report(tmp_path, frames)))
        assert (data["fps"], data["frames"], data["step"]) == (FPS, 9, 1)
        (found,) = data["tracks"]
        assert (found["id"], found["color"], found["spans"], found["first"]) == (3, 2, [[0, 4], [6, 9]], 0)
        assert found["distance"] == [10.0, 11.0, 12.0, 13.0, None, None, 16.0, 17.0, 18.0]
        assert found["std"] == [2.0] * 4 + [None] * 2 + [2.0] * 3
        assert found["speed"] == [-4.5] * 4 + [None] * 2 + [-4.5] * 3
        assert found["rough"] == [0] * 9

    def test_large_standard_errors_mark_distances_and_hide_speeds(self, tmp_path):
        stds = ((3.0, 3.5), (4.5, 2.5), (9.0, 1.5))
        frames = [
            [track(1, distance=20.0, distance_std=first, speed=9.0, speed_std=second)]
            for first, second in stds
        ]
        (found,) = json.loads(script_data(write_report(tmp_path, frames)))["tracks"]
        assert (found["rough"], found["speed"]) == ([0, 1, 1], [None, 32.4, 32.4])

    @pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, 1e300, np.float32(math.inf)])
    def test_infinite_and_absurd_numbers_are_unknown(self, tmp_path, value):
        extreme = track(1, distance=value, distance_std=value, speed=value, confidence=value)
        text = write_report(tmp_path, [[extreme]] * 3)
        StrictParser(text)
        assert "No distance is known." in text
        body = text.split("<main>")[1].split("<script>")[0]
        assert not re.search(r"\b(nan|NaN|inf|Infinity|None)\b", body)

    def test_the_page_of_an_hour_of_video_is_small(self, tmp_path):
        frames = 90_000
        report = ReportWriter(tmp_path / "report.html")
        index = np.arange(frames)
        columns = {"distance_m": 10 + index % 900 / 10, "distance_std_m": np.full(frames, 2.0)}
        report.table = TrackTable(index, 1 + index // 900, np.full((frames, 4), 9.0), **columns)
        report.finish(video_report(frames))
        text = (tmp_path / "report.html").read_text()
        assert len(text) < 300_000
        StrictParser(text)
        assert "Most shown at once in each 15 seconds" in text
        data = json.loads(script_data(text))
        assert len(data["tracks"]) == 100
        assert max(len(each["distance"]) for each in data["tracks"]) <= 21


class TestSettingsAndModel:
    def test_of_a_classifier_of_patches(self, tmp_path):
        camera = Camera.for_frame((720, 1280), height_m=1.75)
        options = {"camera": camera, "track_params": TrackParams(confirm_score=0.625)}
        with VehicleDetector("highway", jobs=1, **options) as detector:
            text = write_report(tmp_path, FRAMES, detector=detector)
        assert "<dt>confirm score</dt><dd>0.625</dd>" in text
        assert "<dt>height m</dt><dd>1.75</dd>" in text
        assert "<summary>Camera</summary>" in text
        assert "<summary>Regions (fitted boxes)</summary>" in text
        model = load_classifier()
        assert f"<p>{model.summary()[0]}</p>" in text
        assert f"<dt>color space</dt><dd>{model.params.color_space}</dd>" in text
        assert "non-commercial use only" in text

    def test_of_a_network(self, tmp_path):
        with VehicleDetector(jobs=1) as detector:
            text = write_report(tmp_path, FRAMES, detector=detector)
        assert "<dt>horizon px</dt><dd>360</dd>" in text
        assert "<summary>Camera (assumed)</summary>" in text
        assert "Regions" not in text
        title, facts = load_model().summary()
        assert f"<p>{title}</p>" in text
        assert all(html.escape(fact) in text for fact in facts.values() if "'" not in fact)
        assert "non-commercial use only" in text

    @pytest.mark.parametrize(
        "metadata",
        [{}, {"note": "<i>mine</i>", "data": {"sources": {"own": 3}}, "metrics": 0.5}, {"data": "own"}],
    )
    @pytest.mark.parametrize("load", [load_classifier, load_model])
    def test_metadata_may_hold_anything(self, tmp_path, load, metadata):
        shipped = load()
        if isinstance(shipped, type(load_classifier())):
            model = type(shipped)(shipped.params, shipped.templates, metadata)
        else:
            model = dataclasses.replace(shipped, metadata=metadata)
        text = write_report(tmp_path, FRAMES, detector=SimpleNamespace(model=model))
        StrictParser(text)
        assert "the weights have the terms of the data they were trained on." in text
        assert "<i>" not in text

    @pytest.mark.parametrize("model", [None, SimpleNamespace(summary=print)])
    def test_a_detector_of_another_library_has_neither(self, tmp_path, model):
        text = write_report(tmp_path, FRAMES, detector=SimpleNamespace(model=model))
        assert "Settings" not in text
        assert "Model" not in text


def color_schemes():
    """Custom properties of the light and the dark color scheme."""
    css = (Path(page.__file__).parent / "report.css").read_text(encoding="utf-8")
    light, dark = re.findall(r":root \{(.*?)\}", css, re.DOTALL)
    return [dict(re.findall(r"--(\w+): (#\w+);", scheme)) for scheme in (light, dark)]


def linear_rgb(color):
    parts = np.array([int(color[start : start + 2], 16) / 255 for start in (1, 3, 5)])
    return np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)


def luminance(color):
    return float(linear_rgb(color) @ [0.2126, 0.7152, 0.0722])


def contrast(one, other):
    light, dark = sorted((luminance(one), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("scheme", color_schemes(), ids=["light", "dark"])
class TestColors:
    def test_contrast_with_the_background(self, scheme):
        # Level AA of the Web Content Accessibility Guidelines 2.2: 4.5 for text, 3 for graphics.
        for background in ("background", "panel"):
            for color in ("text", "muted", "link"):
                assert contrast(scheme[color], scheme[background]) >= 4.5, (color, background)
        for number in range(len(TRACK_COLORS)):
            assert contrast(scheme[f"c{number}"], scheme["background"]) >= 3.0, number

    def test_there_are_as_many_track_colors_as_in_the_video(self, scheme):
        names = [name for name in scheme if re.fullmatch(r"c\d", name)]
        assert names == [f"c{number}" for number in range(len(TRACK_COLORS))]


def test_events_and_counts_are_listed_with_buttons_that_seek(tmp_path):
    events = [
        Event(kind="cut_in", track_id=2, frame=12, start_frame=8, end_frame=14, time_s=0.48, side="left",
              distance_m=12.5, distance_std_m=1.5),
        Event(kind="we_overtook", track_id=1, frame=40, start_frame=30, end_frame=40, time_s=1.6,
              side="right"),
    ]  # fmt: skip
    page = write_report(tmp_path, FRAMES, events=events)
    parser = StrictParser(page)
    markers = [each for each in parser.all("g") if "vehicle" in each.get("aria-label", "")]
    assert [marker["data-frame"] for marker in markers] == ["12", "40"]
    buttons = [each for each in parser.all("button") if "vehicle" in each.get("aria-label", "")]
    assert [button["data-frame"] for button in buttons] == ["12", "40"]
    assert "<td>12.5 ± 1.5 m</td>" in page
    row = re.search(r">0:00</button></th>(.*?)</tr>", page)[1]
    assert re.findall("<td>(.*?)</td>", row) == ["0", "1", "0", "0", "1.2", "2"]


def test_events_are_in_the_units_of_the_page(tmp_path):
    event = Event(kind="met", track_id=2, frame=12, start_frame=8, end_frame=14, time_s=0.48, side="left",
                  distance_m=12.5, distance_std_m=1.5, closing_std_mps=1.0, speed_mps=-20.0)  # fmt: skip
    page = write_report(tmp_path, FRAMES, events=[event], units="imperial")
    assert "<td>41.0 ± 4.9 ft</td>\n<td>45 ± 2 mph, oncoming</td>" in page
    assert "distance 41.0 ± 4.9 ft: show in the video" in page
    assert "12.5 ± 1.5 m" not in page


def test_pictures_are_part_of_the_page(tmp_path):
    image = np.full((180, 320, 3), (200, 90, 0), np.uint8)
    picture = TrackPicture(2, 25, image, "A vehicle <here>")
    page = write_report(tmp_path, FRAMES, pictures=[picture])
    (shown,) = (each for each in StrictParser(page).all("img") if each["class"] == "why")
    data = base64.b64decode(shown["src"].removeprefix("data:image/jpeg;base64,"))
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert np.abs(decoded.astype(int) - image).max() < 10
    assert re.search(r'<h3>#2 at <button [^>]*data-frame="25".*</h3><p>A vehicle &lt;here&gt;</p>', page)
    assert "Why these boxes" not in write_report(tmp_path, FRAMES)
