"""Files: the page, and a video embedded in it or linked from it; and the axis and rows of its charts."""

import base64
import math
from itertools import combinations
from urllib.parse import unquote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.report_helpers import FRAMES, StrictParser, video_report, write_report
from tests.drive.test_history import PRESENCE, table_of
from tests.helpers import FULL_DISK
from vehicle_detection import InvalidInputError, ReportWriter
from vehicle_detection.drive import report as page
from vehicle_detection.drive.motion import track_histories


def test_a_large_video_is_linked(tmp_path):
    folder = tmp_path / "a #1 & 50%"
    (folder / "videos").mkdir(parents=True)
    (folder / "pages").mkdir()
    video = folder / "videos" / "my video: 1.mp4"
    video.write_bytes(b"\0" * 2_000_000)
    linked = write_report(folder / "pages", FRAMES, video=video, embed_limit=1_999_999)
    (source,) = StrictParser(linked).all("source")
    assert source["src"] == "../videos/my%20video%3A%201.mp4"
    assert (folder / "pages" / unquote(source["src"])).samefile(video)
    assert "The video of 2 MB is too large to be part of this page" in linked
    embedded = write_report(folder / "pages", FRAMES, video=video, embed_limit=2_000_000)
    assert "too large" not in embedded
    assert len(embedded) > 2_000_000 * 4 / 3


@pytest.mark.parametrize("size", range(9))
def test_a_video_is_embedded_in_pieces(tmp_path, monkeypatch, size):
    monkeypatch.setattr(page, "_CHUNK", 3)
    video = tmp_path / "video.mp4"
    video.write_bytes(bytes(range(size)))
    (source,) = StrictParser(write_report(tmp_path, FRAMES, video=video)).all("source")
    assert base64.b64decode(source["src"].split(",")[1], validate=True) == video.read_bytes()


def test_no_piece_of_a_page_holds_the_whole_video(tmp_path, monkeypatch):
    assert page._CHUNK % 3 == 0
    monkeypatch.setattr(page, "_CHUNK", 3000)
    video = tmp_path / "video.mp4"
    video.write_bytes(bytes(90_000))
    sizes, render = [], ReportWriter._render

    def watch(*args, **options):
        return (sizes.append(len(piece)) or piece for piece in render(*args, **options))

    monkeypatch.setattr(ReportWriter, "_render", watch)
    write_report(tmp_path, FRAMES, video=video)
    assert sizes.count(4000) >= 30
    assert max(sizes) < 20_000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"path": "report.pdf"}, "path must end in .html or .htm, got 'report.pdf'; write 'report.html'"),
        ({"path": "missing/report.html"}, "path needs an existing folder"),
        ({"path": "folder.html"}, "path must be a file, got the folder"),
        ({"video": "./page.html"}, "is also the video; choose another name"),
        ({"source": "page.html"}, "is also the source; choose another name"),
    ],
)
def test_bad_arguments_are_refused(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(InvalidInputError, match=message):
        ReportWriter(**{"path": "page.html", **options})
    assert list(tmp_path.iterdir()) == [tmp_path / "folder.html"]


def test_an_earlier_page_stays_if_a_new_one_fails(tmp_path, monkeypatch):
    video = tmp_path / "video.mp4"
    video.write_bytes(b"video")
    before = write_report(tmp_path, FRAMES)
    report = ReportWriter(tmp_path / "report.html", video=tmp_path / "missing.mp4")
    report.table.append(0, 0.0, [])
    with pytest.raises(InvalidInputError, match=r"missing.mp4 does not exist; call finish after"):
        report.finish(video_report(1))
    with pytest.raises(InvalidInputError, match="report must be a VideoReport, got None"):
        report.finish(None)
    monkeypatch.setattr(page.VideoEmbed, "base64_chunks", FULL_DISK)
    report = ReportWriter(tmp_path / "report.html", video=video)
    with pytest.raises(OSError, match="No space left"):
        report.finish(video_report(1))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.html", "video.mp4"]
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == before


@given(st.integers(1, 2_000_000), st.sampled_from([5.0, 25.0, 29.97, 60.0]))
def test_ticks_of_a_time_axis_lie_in_the_video(frames, fps):
    axis = page.TimeAxis(frames, fps)
    ticks = axis.ticks()
    assert ticks[0] == 0
    assert 1 <= len(ticks) <= 7
    assert ticks[-1] <= axis.seconds + 1e-9
    assert math.ceil(frames / axis.bin_width) <= 2000


@given(PRESENCE)
def test_tracks_that_share_a_row_do_not_overlap(frames):
    tracks = track_histories(table_of(frames))
    rows = page.assign_rows(tracks, page.TimeAxis(max(len(frames), 1), 25.0))
    for (one, row), (other, same) in combinations(zip(tracks, rows), 2):
        assert row != same or one.last < other.first
    assert sorted(set(rows)) == list(range(len(set(rows))))


@given(st.floats(0, 1e5))
def test_times_carry_when_they_are_rounded(seconds):
    text = page.format_time(seconds)
    *hours, minutes, rest = text.split(":")
    assert float(rest) < 60
    total = sum(int(part) * unit for part, unit in zip([*hours[:1], minutes][::-1], (60, 3600)))
    assert total + float(rest) == pytest.approx(seconds, abs=0.051)
