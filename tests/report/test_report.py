import base64
import hashlib
import html
import json
import math
import re
import sys
from fractions import Fraction
from html.parser import HTMLParser
from itertools import combinations, pairwise
from types import SimpleNamespace
from urllib.parse import unquote

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vehicle_detection.camera import Camera
from vehicle_detection.classifier import load_classifier
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.drawing import TRACK_COLORS
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture import load_model
from vehicle_detection.params import TrackParams
from vehicle_detection.report import ReportWriter
from vehicle_detection.report import assets as _report_assets
from vehicle_detection.report import charts as _report_charts
from vehicle_detection.report import page as _report_html
from vehicle_detection.report import writer as report
from vehicle_detection.report.charts import COLORS, Clock, Label, Scale, _apart, _lanes
from vehicle_detection.report.history import TrackHistory, TrackLog, binned
from vehicle_detection.video import VideoReport

FPS = 25
EVIL = "\"><img src=x onerror=alert(1)>&amp;'</title><script>.mp4"
VOID = {"meta", "link", "source"}


def track(number, *, distance=20.0, error=2.0, speed=1.5, vague=0.5, score=1.0, shown=True):
    return SimpleNamespace(
        id=number,
        shown=shown,
        distance_m=distance,
        distance_std_m=error,
        speed_mps=speed,
        speed_std_mps=vague,
        score=score,
    )


def run_of(frames, **options):
    facts = {"fps": Fraction(FPS), "shape": (720, 1280, 3), "seconds": 2.0, "tracks": 1}
    facts["stages"] = {"decode": 1.0, "search": 3.0}
    return VideoReport(frames=frames, **(facts | options))


def written(folder, frames, **options):
    """Write a report of the tracks of each frame; return its text."""
    write = ReportWriter(folder / "report.html", **options)
    for index, tracks in enumerate(frames):
        write.write(index, index / FPS, tracks)
    write.finish(run_of(len(frames)))
    return (folder / "report.html").read_text(encoding="utf-8")


class Reader(HTMLParser):
    """Reads a page strictly: each element must be closed, in order."""

    def __init__(self, page):
        super().__init__(convert_charrefs=True)
        self.open, self.elements, self.texts = [], [], {}
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, name, attributes):
        assert len(dict(attributes)) == len(attributes)
        self.elements.append((name, dict(attributes)))
        if name not in VOID:
            self.open.append(name)

    def handle_endtag(self, name):
        assert self.open.pop() == name

    def handle_data(self, data):
        place = "/".join(self.open[-2:])
        self.texts[place] = self.texts.get(place, "") + data

    def all(self, name):
        return [attributes for kind, attributes in self.elements if kind == name]


def json_of(page):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page)[1])


FRAMES = [
    [track(1, distance=30 - index / 5)] + ([track(2, distance=None, speed=None)] if 10 <= index < 20 else [])
    for index in range(50)
]


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "found.mp4"
    path.write_bytes(bytes(range(256)) * 7)
    return path


# --- the page ---


def test_the_page_is_whole_and_holds_everything_itself(tmp_path, video):
    with VehicleDetector(n_jobs=1) as detector:
        page = written(tmp_path, FRAMES, video=video, source="drive.mp4", detector=detector)
    reader = Reader(page)
    assert page.startswith("<!DOCTYPE html>\n")
    assert reader.all("html") == [{"lang": "en"}]
    assert reader.texts["head/title"] == "Vehicles in drive.mp4"
    (source,) = reader.all("source")
    kind, data = source["src"].split(",")
    assert kind == "data:video/mp4;base64"
    assert base64.b64decode(data, validate=True) == video.read_bytes()
    addresses = [
        value for _, each in reader.elements for name, value in each.items() if name in ("src", "href")
    ]
    assert all(address.startswith("data:") for address in addresses)
    assert not re.search(r"https?:|url\(|@import|//[a-z]", page.replace(data, "").replace("// ", ""))
    identifiers = [each["id"] for _, each in reader.elements if "id" in each]
    assert len(set(identifiers)) == len(identifiers)


def test_its_policy_allows_its_own_script_and_style_only(tmp_path):
    page = written(tmp_path, FRAMES)
    (policy,) = [each["content"] for each in Reader(page).all("meta") if "http-equiv" in each]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    for element, rule in (("script", "script-src"), ("style", "style-src")):
        (code,) = re.findall(f"<{element}>(.*?)</{element}>", page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
        assert rules[rule] == f"'sha256-{digest}'"
    # Neither would be allowed.
    assert not re.search(r'<[^>]* (style|on\w+)="', page)


def test_names_of_files_stay_text(tmp_path):
    (tmp_path / "in").mkdir()
    name = EVIL.replace("/", "_")
    film = tmp_path / "in" / (name if sys.platform != "win32" else "found.mp4")
    film.write_bytes(b"film")
    page = written(tmp_path, FRAMES, source=f"/roads/{name}", video=film, embed_limit=3)
    reader = Reader(page)
    assert reader.all("img") == []
    assert len(reader.all("script")) == 2
    assert reader.texts["head/title"] == f"Vehicles in {name}"
    assert reader.texts["h1/bdi"] == name
    assert reader.texts["a/bdi"] == film.name


def test_names_that_are_no_text_are_written_all_the_same(tmp_path):
    name = b"road \xff.mp4".decode("utf-8", "surrogateescape")
    assert "Vehicles in road ?.mp4" in written(tmp_path, FRAMES, source=name)


def test_a_large_video_is_linked(tmp_path):
    folder = tmp_path / "a #1 & 50%"
    (folder / "films").mkdir(parents=True)
    (folder / "pages").mkdir()
    film = folder / "films" / "my film: 1.mp4"
    film.write_bytes(b"\0" * 2_000_000)
    page = written(folder / "pages", FRAMES, video=film, embed_limit=1_999_999)
    (source,) = Reader(page).all("source")
    assert source["src"] == "../films/my%20film%3A%201.mp4"
    assert (folder / "pages" / unquote(source["src"])).samefile(film)
    assert "The video of 2 MB is too large to be part of this page" in page
    again = written(folder / "pages", FRAMES, video=film, embed_limit=2_000_000)
    assert "too large" not in again
    assert len(again) > 2_000_000 * 4 / 3


def test_the_limit_is_sixty_megabytes():
    assert report.EMBED_LIMIT == 60_000_000


@pytest.mark.parametrize("size", range(9))
def test_a_video_is_put_into_the_page_in_pieces(tmp_path, monkeypatch, size):
    monkeypatch.setattr(report, "_CHUNK", 3)
    film = tmp_path / "film.mp4"
    film.write_bytes(bytes(range(size)))
    (source,) = Reader(written(tmp_path, FRAMES, video=film)).all("source")
    assert base64.b64decode(source["src"].split(",")[1], validate=True) == film.read_bytes()
    assert report._CHUNK % 3 == 0


def test_matroska_is_not_for_every_browser(tmp_path):
    film = tmp_path / "film.MKV"
    film.write_bytes(b"film")
    page = written(tmp_path, FRAMES, video=film)
    assert 'type="video/x-matroska"' in page
    assert "Not every browser plays Matroska" in page


def test_a_run_that_wrote_no_video(tmp_path):
    page = written(tmp_path, FRAMES)
    reader = Reader(page)
    assert reader.all("video") == []
    assert "No video was written." in page
    assert "go to that time in the video" not in page
    assert reader.texts["head/title"] == "Vehicles"


@pytest.mark.parametrize("tracks", [[], [track(1, shown=False)], [track(0, shown=False)] * 2])
def test_a_road_without_vehicles(tmp_path, tracks):
    page = written(tmp_path, [tracks] * 10)
    Reader(page)
    assert page.count("No vehicle was shown.") == 2
    assert json_of(page)["tracks"] == []


def test_vehicles_of_which_nothing_is_known(tmp_path):
    bare = [[SimpleNamespace(id=7, shown=True)]] * 5
    page = written(tmp_path, bare)
    Reader(page)
    assert "No distance is known." in page
    assert "No relative speed is known." in page
    assert json_of(page)["tracks"][0]["distance"] == [None] * 5


def test_counts_are_those_of_the_run(tmp_path):
    page = written(tmp_path, FRAMES)
    facts = dict(re.findall(r"<dt>([^<]*)</dt><dd>([^<]*)</dd>", page))
    assert facts["Vehicles"] == "2"
    assert facts["Frames"] == "50"
    assert facts["Length"] == "0:02.0"
    assert facts["Most at once"] == "2"
    assert facts["Longest track"] == "#1, 2.0 s"
    assert facts["Nearest"] == "21 m, #1"
    rows = re.findall(r"<tr><th scope=\"row\">(.*?)</tr>", page)
    cells = [[re.sub("<.*?>", "", cell) for cell in row.split("</t")] for row in rows]
    assert [cell.removeprefix("d>").removeprefix("h>") for cell in cells[1]][:7] == [
        "#2", "0:00.4", "0:00.8", "10", "\N{EN DASH}", "\N{EN DASH}", "1.00",
    ]  # fmt: skip
    assert "decode" in page
    assert "20.00" in page  # milliseconds a frame
    assert "75.0%" in page


def test_the_source_may_start_later(tmp_path):
    write = ReportWriter(tmp_path / "report.html")
    for index in range(5):
        write(SimpleNamespace(index=index, time=75.5 + index / FPS, tracks=[track(1)]))
    write.finish(run_of(5))
    page = (tmp_path / "report.html").read_text()
    assert "Times count from 1:15.5 of the source." in page
    assert "Times count" not in written(tmp_path, FRAMES)


def test_the_script_gets_what_the_charts_show(tmp_path):
    frames = [
        [track(3, distance=10 + index, speed=-1.25)] if index not in (4, 5) else [] for index in range(9)
    ]
    data = json_of(written(tmp_path, frames))
    assert data["fps"] == FPS
    assert data["frames"] == 9
    assert data["step"] == 1
    assert data["tracks"] == [
        {
            "id": 3,
            "color": 2,
            "spans": [[0, 4], [6, 9]],
            "first": 0,
            "distance": [10.0, 11.0, 12.0, 13.0, None, None, 16.0, 17.0, 18.0],
            "speed": [-1.2, -1.2, -1.2, -1.2, None, None, -1.2, -1.2, -1.2],
        }
    ]


def test_vague_speeds_are_left_out(tmp_path):
    frames = [[track(1, speed=9.0, vague=3.5 - index)] for index in range(3)]
    assert json_of(written(tmp_path, frames))["tracks"][0]["speed"] == [None, 9.0, 9.0]


def test_the_same_run_gives_the_same_page(tmp_path, video):
    assert written(tmp_path, FRAMES, video=video) == written(tmp_path, FRAMES, video=video)


def test_an_hour_of_video_is_a_small_page(tmp_path):
    frames = 90_000
    write = ReportWriter(tmp_path / "report.html")
    for index in range(frames):
        write.write(index, None, [track(1 + index // 900, distance=10 + index % 900 / 10)])
    write.finish(run_of(frames))
    page = (tmp_path / "report.html").read_text()
    assert len(page) < 300_000
    Reader(page)
    assert "Most shown at once in each 15 seconds" in page
    data = json_of(page)
    assert len(data["tracks"]) == 100
    assert max(len(each["distance"]) for each in data["tracks"]) <= 9


# --- settings and model ---


def test_settings_and_model_are_those_of_the_detector(tmp_path):
    camera = Camera.for_frame((720, 1280), height_m=1.75)
    options = {"camera": camera, "track": TrackParams(gate=0.625)}
    with VehicleDetector(load_classifier(), n_jobs=1, **options) as detector:
        page = written(tmp_path, FRAMES, detector=detector)
    assert "<dt>gate</dt><dd>0.625</dd>" in page
    assert "<dt>height m</dt><dd>1.75</dd>" in page
    assert "<summary>Camera</summary>" in page
    assert "<summary>Regions (fitted boxes)</summary>" in page
    assert "64\xa0\xd7\xa064" in page
    metadata = load_classifier().metadata
    assert metadata["data"]["fingerprint"] in page
    assert f"{metadata['metrics']['splits']['random']['accuracy']:.4f}" in page
    assert re.search(r"lab-(8460|9432): [89],\d{3} values", page)
    assert "CC BY-NC-SA 3.0" in page


def test_a_mixture_of_templates_tells_what_it_reaches_on_other_roads(tmp_path):
    with VehicleDetector(n_jobs=1, horizon=0.5) as detector:
        page = written(tmp_path, FRAMES, detector=detector)
    assert "<dt>horizon</dt><dd>0.5</dd>" in page
    assert "<summary>Camera (assumed)</summary>" in page
    assert "fitted boxes" not in page
    assert "6 templates, for boxes of 6\xa0\xd7\xa08, 7\xa0\xd7\xa06" in page
    for name, scores in load_model().metadata["metrics"]["left_out"].items():
        assert name in page
        assert f"{scores['f1']:.6g}" in page
    assert "inherits the terms of the frames" in page


def test_settings_of_the_course_s_way(tmp_path):
    with VehicleDetector(n_jobs=1, region_params=HeatParams(), horizon=0.5) as detector:
        page = written(tmp_path, FRAMES, detector=detector)
    assert "<summary>Regions (heat map)</summary>" in page
    assert "<dt>threshold</dt><dd>2</dd>" in page
    assert "fitted boxes" not in page
    assert "<summary>Camera (assumed)</summary>" in page
    assert "<dt>horizon px</dt><dd>360</dd>" in page


@pytest.mark.parametrize(
    "metadata",
    [
        {},
        {"note": "<i>mine</i>", "data": {"sources": {"own": 3}}, "metrics": 0.5},
        {"data": "own", "metrics": {"splits": {"other": {"accuracy": 1.0}}}},
        {"metrics": {"splits": {"random": "good", "sequences": {"accuracy": "high"}}}},
    ],
)
def test_a_model_may_tell_what_it_likes(tmp_path, metadata):
    shipped = load_classifier()
    classifier = type(shipped)(shipped.params, shipped.templates, metadata)
    page = written(tmp_path, FRAMES, detector=SimpleNamespace(classifier=classifier))
    Reader(page)
    assert "Licence: the model inherits the terms of the patches it is made of." in page
    assert "<i>" not in page


def test_a_detector_without_settings(tmp_path):
    page = written(tmp_path, FRAMES, detector=SimpleNamespace(classifier=None))
    assert "Settings" not in page
    assert "Model" not in page


# --- what is refused ---


def test_pages_that_cannot_be_written(tmp_path, video):
    with pytest.raises(InvalidInputError, match=r"path must be a file name, got 3; pass a name"):
        ReportWriter(3)
    with pytest.raises(InvalidInputError, match=r"video must be a file name, got 3"):
        ReportWriter(tmp_path / "report.html", video=3)
    with pytest.raises(InvalidInputError, match=r"source must be a file name, got \['a'\]"):
        ReportWriter(tmp_path / "report.html", source=["a"])
    with pytest.raises(
        InvalidInputError, match=r"path must end in .html, got 'report.pdf'; write 'report.html'"
    ):
        ReportWriter(tmp_path / "report.pdf")
    with pytest.raises(InvalidInputError, match="path needs an existing folder"):
        ReportWriter(tmp_path / "missing" / "report.html")
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(InvalidInputError, match="path must be a file, got the folder"):
        ReportWriter(tmp_path / "folder.html")
    page = tmp_path / "page.html"
    with pytest.raises(InvalidInputError, match=r"is the video as well; choose another name"):
        ReportWriter(page, video=tmp_path / "." / "page.html")
    with pytest.raises(InvalidInputError, match=r"is the source as well; choose another name"):
        ReportWriter(page, source=page)
    with pytest.raises(InvalidInputError, match="embed_limit must be an integer at least 0"):
        ReportWriter(page, embed_limit=-1)
    assert list(tmp_path.iterdir()) == [tmp_path / "folder.html"]


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ((1, 0.0, []), "frame_index must be 0, as frames come one by one from 0; got 1; use a new writer"),
        ((0.5, 0.0, []), "frame_index must be an integer at least 0"),
        ((0, math.nan, []), "time must be a number"),
        ((0, 0.0, None), r"tracks must be Track objects, got None; pass result.tracks"),
        ((0, 0.0, "abc"), "tracks must be Track objects, got 'abc'"),
        ((0, 0.0, [(1, 2)]), r"tracks must be Track objects, got \(1, 2\) \(tuple\)"),
        ((0, 0.0, [track(1), track(1)]), "tracks must have an id each, got 1 twice in one frame"),
        ((0, 0.0, [track(-1)]), "track.id must be an integer at least 0; got -1"),
        (
            (0, 0.0, [track(1, distance="far")]),
            r"track.distance_m must be a number or None, got 'far'",
        ),
        ((0, 0.0, [track(1, speed=True)]), "track.speed_mps must be a number or None, got True"),
    ],
)
def test_frames_that_are_refused(tmp_path, frame, message):
    write = ReportWriter(tmp_path / "report.html")
    with pytest.raises(InvalidInputError, match=message):
        write.write(*frame)
    # Nothing of it is kept: the right frame can still come.
    write.write(0, 0.0, [track(1)])
    with pytest.raises(InvalidInputError, match="frame_index must be 1, as frames come one by one"):
        write.write(0, 0.0, [])


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, 1e300, 10**400, np.float32(math.inf)])
def test_numbers_beyond_all_use_are_unknown(tmp_path, value):
    page = written(tmp_path, [[track(1, distance=value, error=value, speed=value, score=value)]] * 3)
    Reader(page)
    assert "No distance is known." in page
    assert not re.search(r"\b(nan|NaN|inf|Infinity)\b", page.split("<main>")[1].split("<script>")[0])


def test_an_earlier_page_stays_where_a_new_one_fails(tmp_path, video, monkeypatch):
    before = written(tmp_path, FRAMES)
    write = ReportWriter(tmp_path / "report.html", video=tmp_path / "missing.mp4")
    write.write(0, 0.0, [])
    with pytest.raises(
        InvalidInputError, match=r"missing.mp4 does not exist; call finish after process_video"
    ):
        write.finish(run_of(1))
    with pytest.raises(InvalidInputError, match="report must be a VideoReport, got None"):
        write.finish(None)

    def fail(*_):
        raise OSError("the disk is full")

    monkeypatch.setattr(report, "_put_base64", fail)
    write = ReportWriter(tmp_path / "report.html", video=video)
    with pytest.raises(OSError, match="the disk is full"):
        write.finish(run_of(1))
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == before


# --- what is kept of the frames ---

presence = st.lists(st.sets(st.integers(1, 4)), max_size=40)


def log_of(frames):
    log = TrackLog()
    for index, numbers in enumerate(frames):
        log.add(index, None, [track(number, distance=index + number) for number in sorted(numbers)])
    return log


@given(presence)
def test_the_log_keeps_who_was_shown_when(frames):
    log = log_of(frames)
    assert list(log.counts) == [len(numbers) for numbers in frames]
    found = log.histories()
    assert {each.id for each in found} == set().union(*frames)
    for each in found:
        assert each.frames.tolist() == [index for index, numbers in enumerate(frames) if each.id in numbers]
        assert each.columns["distance_m"].tolist() == [index + each.id for index in each.frames]
        spans = each.spans()
        assert [index for start, stop in spans for index in range(start, stop)] == each.frames.tolist()
        assert all(stop < start for (_, stop), (start, _) in pairwise(spans))
    assert [(each.first, each.id) for each in found] == sorted((each.first, each.id) for each in found)


@given(st.sets(st.integers(0, 60), min_size=1), st.integers(1, 10), st.data())
def test_bins_are_means(frames, step, data):
    frames = np.array(sorted(frames))
    values = np.array(data.draw(st.lists(st.floats(-100, 100) | st.just(math.nan), min_size=len(frames),
                                         max_size=len(frames))))  # fmt: skip
    bins, means = binned(frames, values, step)
    groups = {}
    for frame, value in zip(frames, values):
        if not math.isnan(value):
            groups.setdefault(frame // step, []).append(value)
    assert bins.tolist() == sorted(groups)
    assert means == pytest.approx([np.mean(groups[number]) for number in sorted(groups)], abs=1e-9)


def history(frames, distances, errors=None):
    columns = {name: np.full(len(frames), math.nan) for name in ("speed_mps", "speed_std_mps", "score")}
    columns["distance_m"] = np.array(distances, float)
    columns["distance_std_m"] = np.ones(len(frames)) if errors is None else np.array(errors, float)
    return TrackHistory(1, np.array(frames, np.int64), columns)


def test_one_wrong_frame_is_no_nearest_approach():
    distances = [30.0 - index / 10 for index in range(100)]
    distances[3] = 1.0
    near = history(range(100), distances).nearest(25.0)
    assert near.meters == pytest.approx(20.5, abs=0.2)
    assert near.frame > 90
    assert near.error == 1.0
    assert history([5], [12.0]).nearest(25.0) == (5, 12.0, 1.0)
    assert history([5, 6], [math.nan, 12.0]).nearest(0.1).frame == 6
    assert history([5], [math.nan]).nearest(25.0) is None


# --- axes and texts ---


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.booleans())
def test_an_axis_holds_its_values_between_round_ticks(one, other, whole):
    low, high = min(one, other), max(one, other)
    assume(high - low > 1e-3)
    scale = Scale.around(low, high, 100, whole=whole)
    assert scale.low <= low + 1e-6 * (high - low)
    assert scale.high >= high - 1e-6 * (high - low)
    assert 2 <= len(scale.ticks) <= 7
    assert scale.ticks[0] == scale.low
    assert scale.ticks[-1] == scale.high
    assert all(after > before for before, after in pairwise(scale.ticks))
    assert scale.y(scale.low) == pytest.approx(100)
    assert scale.y(scale.high) == 0
    if whole:
        assert all(tick == round(tick) for tick in scale.ticks)


def test_axes_of_a_single_value():
    assert Scale.around(0, 0, 70, whole=True).ticks == (0, 1)
    assert Scale.around(0, 1, 70, whole=True, most=3).ticks == (0, 1)
    assert Scale.around(0, 38.4, 150).ticks == (0, 10, 20, 30, 40)


@given(st.integers(1, 2_000_000), st.sampled_from([5.0, 25.0, 29.97, 60.0]))
def test_times_of_an_axis_lie_in_the_video(frames, fps):
    axis = Clock(frames, fps)
    ticks = axis.ticks()
    assert ticks[0] == 0
    assert 1 <= len(ticks) <= 7
    assert ticks[-1] <= axis.seconds + 1e-9
    assert math.ceil(frames / axis.step) <= 800


@given(st.lists(st.tuples(st.floats(0, 100), st.floats(-10, 160)), max_size=20))
def test_labels_do_not_lie_on_each_other(places):
    labels = [Label(x, y, number) for number, (x, y) in enumerate(places)]
    kept = _apart(labels, 150)
    for one, other in combinations(kept, 2):
        assert abs(one.x - other.x) >= 5 or abs(one.y - other.y) >= 13 - 1e-9
    assert all(0 < label.y <= 150 for label in kept)
    assert len({label.track for label in kept}) == len(kept)


@given(presence)
def test_tracks_that_share_a_row_do_not_touch(frames):
    tracks = log_of(frames).histories()
    lanes = _lanes(tracks, Clock(max(len(frames), 1), 25.0))
    for (one, lane), (other, same) in combinations(zip(tracks, lanes), 2):
        assert lane != same or one.last < other.first
    assert sorted(set(lanes)) == list(range(len(set(lanes))))


def test_many_tracks_share_rows(tmp_path):
    frames = [[track(1 + index // 10)] for index in range(300)]
    page = written(tmp_path, frames)
    Reader(page)
    bars = re.findall(r'<g class="bar c\d".*?</g>', page)
    assert len(bars) == 30
    assert len({y for bar in bars for y in re.findall(r' y="([\d.]+)"', bar)}) <= 2
    assert all("show in the video" in bar for bar in bars)


@given(st.text())
def test_text_is_escaped_and_nothing_else(words):
    written_words = _report_html.text(words)
    assert not set(written_words) & set("<>\"'")
    assert html.unescape(written_words) == words.encode("utf-8", "replace").decode()


@given(st.floats(0, 1e5))
def test_clocks_round_as_a_whole(seconds):
    words = _report_html.clock(seconds)
    *hours, minutes, rest = words.split(":")
    assert float(rest) < 60
    total = sum(int(part) * unit for part, unit in zip([*hours[:1], minutes][::-1], (60, 3600)))
    assert total + float(rest) == pytest.approx(seconds, abs=0.051)


# --- colors ---


def luminance(color):
    parts = [int(color[start : start + 2], 16) / 255 for start in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one, other):
    light, dark = sorted((luminance(one), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("scheme", [_report_assets.LIGHT, _report_assets.DARK], ids=["light", "dark"])
def test_colors_can_be_told_from_their_ground(scheme):
    # The levels AA of the Web Content Accessibility Guidelines 2.2: texts 4.5, graphics 3.
    for ground in ("ground", "panel"):
        for ink in ("ink", "soft", "link"):
            assert contrast(scheme[ink], scheme[ground]) >= 4.5, (ink, ground)
    for number in range(COLORS):
        assert contrast(scheme[f"c{number}"], scheme["ground"]) >= 3.0, number


def test_tracks_have_as_many_colors_as_in_the_video():
    assert len(TRACK_COLORS) == COLORS
    for scheme in (_report_assets.LIGHT, _report_assets.DARK):
        assert [name for name in scheme if re.fullmatch(r"c\d", name)] == [f"c{n}" for n in range(COLORS)]
    assert _report_charts.COLORS == COLORS
