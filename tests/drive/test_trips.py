"""Trips of dash-cam files, from their names."""

import itertools
import os
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import StubDetector
from tests.video.clips import gray_frames, write_clip
from vehicle_detection import InvalidInputError, open_trip, track
from vehicle_detection.drive import find_trips, segment_clock
from vehicle_detection.video import is_video_file


def summary(names, seconds=60.0):
    """Cameras and files of the trips, if each file is that long."""
    found = find_trips(names, duration=lambda _: seconds)
    return [(trip.camera, [str(file) for file in trip.files]) for trip in found]


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        ("20260131_081500_F.MP4", "front"),
        ("20260131_081500_PR.mp4", "rear"),
        ("2026-01-31T08:15:00Z_front.mp4", "front"),
        ("260131_081500.mov", "unknown"),
        ("20260131081500_000001A.MP4", "unknown"),
        ("DCIM/Movie_Rear/20260131_081500.mp4", "rear"),
    ],
)
def test_the_camera_and_the_time_of_a_name(name, camera):
    (trip,) = find_trips([name])
    assert (trip.camera, trip.start) == (camera, datetime(2026, 1, 31, 8, 15))


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        ("drive.mp4", "unknown"),
        ("drive b.mp4", "unknown"),
        ("MOVI0001F.MP4", "front"),
        ("front.mp4", "front"),
        ("20269931_081500.mp4", "unknown"),
    ],
)
def test_a_name_without_a_time(name, camera):
    (trip,) = find_trips([name])
    assert (trip.camera, trip.start) == (camera, None)


def test_segments_of_two_cameras_and_two_drives():
    minutes = [f"2026013108{minute:02}00" for minute in (15, 16, 17, 18)]
    evening = [f"2026013118{minute:02}02" for minute in (1, 2)]
    names = [f"{time}_{camera}.mp4" for time in (*minutes, *evening) for camera in "RF"]
    assert summary(reversed(names)) == [
        (name, [f"{time}_{letter}.mp4" for time in times])
        for name, letter in (("front", "F"), ("rear", "R"))
        for times in (minutes, evening)
    ]


def test_folders_are_different_trips_and_clocks_may_drift_by_a_second():
    names = ["a/20260131_081500.mp4", "b/20260131_081600.mp4"]
    assert [files for _, files in summary(names)] == [[names[0]], [names[1]]]
    names = [f"20260131_08{time}_F.mp4" for time in ("1500", "1601", "1701", "1800", "1859")]
    assert summary(names) == [("front", names)]


@pytest.mark.parametrize(
    ("seconds", "starts", "trips"),
    [
        (59.9, (0, 60), [2]),
        (30.0, (0, 60), [1, 1]),
        (63.0, (0, 60), [2]),
        (64.0, (0, 60), [1, 1]),
        (2.0, (0, 120, 240, 360), [1, 1, 1, 1]),  # equal gaps
        (60.0, (0, 30, 60), [1, 1, 1]),  # overlaps
        (0.0, (0, 60, 120), [1, 1, 1]),  # of unknown length
    ],
)
def test_a_segment_begins_where_the_one_before_it_ends(seconds, starts, trips):
    names = [f"20260131_08{15 + start // 60}{start % 60:02}_F.mp4" for start in starts]
    found = find_trips(names, duration=lambda name: seconds)
    assert [len(trip.files) for trip in found] == trips
    gaps = [after - before - seconds if seconds else None for before, after in itertools.pairwise(starts)]
    assert [trip.gap_s for trip in found] == [None, *gaps][: len(trips)]


def test_numbers_without_times():
    assert summary([f"GRMN{n:04}.MP4" for n in (9, 10, 11, 13)]) == [
        ("unknown", ["GRMN0009.MP4", "GRMN0010.MP4", "GRMN0011.MP4"]),
        ("unknown", ["GRMN0013.MP4"]),
    ]
    assert summary(["GX020007.MP4", "GX010008.MP4", "GX010007.MP4"]) == [
        ("unknown", ["GX010007.MP4", "GX020007.MP4"]),
        ("unknown", ["GX010008.MP4"]),
    ]
    assert summary(["GOPR0007.MP4", "GP010007.MP4", "GP020007.MP4", "GL010007.MP4"]) == [
        ("unknown", ["GOPR0007.MP4", "GP010007.MP4", "GP020007.MP4"]),
        ("unknown", ["GL010007.MP4"]),
    ]
    assert len(find_trips(["drive1.mp4", "drive2.mp4", "drive3.mp4"])) == 3


@pytest.mark.parametrize(
    ("ends", "trips", "warned"),
    [
        ((0, 0.5, 1, 1.5, 2), [5], True),  # copied without their times
        ((0, 9, 18, 26, 29), [5], True),  # copied slowly: two files are never recorded at once
        ((0, 60, 120, 180, 200), [5], False),  # the last one is short
        ((0, 60, 120, 180, 3600), [4, 1], False),
        ((0, 60, 120, 190, 250), [3, 1, 1], False),  # equal steps of 60 s, to a file of 20 s
        ((0, 600, 1200, 1800, 2400), [1, 1, 1, 1, 1], False),  # equal gaps
    ],
)
def test_numbers_with_modification_times(tmp_path, caplog, ends, trips, warned):
    files = [tmp_path / f"GRMN{number:04}.MP4" for number in range(5)]
    for file, end in zip(files, ends, strict=True):
        file.touch()
        os.utime(file, (1.77e9 + end, 1.77e9 + end))
    found = find_trips(files, duration=lambda file: 20.0 if file == files[4] else 60.0)
    assert [len(trip.files) for trip in found] == trips
    assert ("cp -p" in caplog.text) == warned


# File names of a maker for the seconds of a day, and the camera.
MAKERS = {
    "{0:%Y%m%d_%H%M%S}_NF.mp4": "front",  # BlackVue
    "{0:%Y%m%d_%H%M%S}_EI.mp4": "interior",
    "{0:%Y%m%d_%H%M%S}_NFS.mp4": "front",
    "{0:%Y_%m%d_%H%M%S}_{1:06}F.MP4": "front",  # Viofo
    "{0:%Y_%m%d_%H%M%S}_{1:06}PI.MP4": "interior",
    "NO{0:%Y%m%d-%H%M%S}-{1:06}B.MP4": "rear",  # 70mai
    "{0:%y%m%d_%H%M%S}_{1:03}_FH.MP4": "front",  # Nextbase
    "{0:%y%m%d_%H%M%S}_{1:03}_CL_RADR.MP4": "interior",
    "FILE{0:%y%m%d-%H%M%S}R.MP4": "rear",  # Mio
    "GRMN{1:04}.MP4": "unknown",  # Garmin
    "REC_{0:%Y_%m_%d_%H_%M_%S}_R.MP4": "rear",  # Thinkware
    "{0:%Y%m%d_%H%M%S}_{1:05}_N_A.MP4": "front",  # Vantrue
    "{0:%Y%m%d_%H%M%S}_{1:05}_N_C.MP4": "rear",
    "{0:%Y-%m-%d_%H-%M-%S}-left_pillar.mp4": "left",  # Tesla
}


@pytest.mark.parametrize("form", MAKERS)
def test_generated_trips_of_the_common_makers(tmp_path, form):
    """Files of any length with pauses of up to 2 s, gaps, overlaps and a last file that cannot be read."""
    rng = np.random.default_rng(len(form))
    dated = not form.startswith("GRMN")  # else overlaps are those of copies without their times
    for folder in range(40):
        begin, lengths, expected = datetime(2026, 1, 31, 8), {}, [[]]
        count, broken = int(rng.integers(2, 12)), rng.random() < 0.3
        for number in range(1, count + 1):
            length = float(rng.integers(30, 301))
            file = tmp_path / str(folder) / form.format(begin, number)
            file.parent.mkdir(exist_ok=True)
            file.touch()
            end = begin.timestamp() + length
            os.utime(file, (end, end))
            lengths[file] = 0.0 if broken and number == count else length
            expected[-1].append(file)
            step = rng.choice(["follows", "follows", "gap", "overlap" if dated else "gap"])
            pause = {
                "follows": rng.integers(0, 3),
                "gap": rng.integers(10, 3000),
                "overlap": -rng.integers(4, 25),
            }
            begin += timedelta(seconds=length + int(pause[step]))
            if step != "follows" and number < count:
                expected.append([])
        if not dated and broken and len(expected[-1]) == 1 and len(expected) > 1:
            continue  # without a time or a length, whether it follows is unknown
        found = find_trips(rng.permutation([*lengths]).tolist(), duration=lengths.__getitem__)
        assert [list(trip.files) for trip in found] == expected
        assert {trip.camera for trip in found} == {MAKERS[form]}


def test_cameras_kinds_of_recording_and_copies_in_low_resolution_are_told_apart():
    time, names = "20260131_081500", "NF NR NI NFS EF"
    assert len(find_trips([f"{time}_{name}.mp4" for name in names.split()])) == 5
    names = [f"{time}_NF.mp4", "20260131_081600_EF.mp4", "20260131_081700_NFL.mp4"]  # one camera, in order
    assert summary(names) == [("front", names)]
    names = [f"2026_0131_0815{n}0_000{n}F.{suffix}" for suffix in ("mp4", "TS") for n in range(3)]
    assert summary(names, 10.0) == [("front", names[:3]), ("front", names[3:])]  # converted


def test_paths_and_urls_keep_their_type():
    (trip,) = find_trips([Path("a/20260131_081500.mp4")])
    assert trip.files == (Path("a/20260131_081500.mp4"),)
    (trip,) = find_trips(["s3://bucket/a/20260131_081500.mp4"])
    assert trip.files == ("s3://bucket/a/20260131_081500.mp4",)


def test_the_query_of_a_url_tells_no_time():
    names = [f"https://nas/card/20260131_08150{n}_F.mp4?X-Amz-Date=20300101T120000Z&sig=a/b" for n in (0, 1)]
    (trip,) = find_trips(names, duration=lambda _: 1.0)
    assert (trip.camera, len(trip.files), trip.start.year) == ("front", 2, 2026)


@pytest.mark.parametrize(
    "names",
    [
        ("car07_{}", "car08_{}"), ("ch1_{}", "ch2_{}"), ("{}_ch1", "{}_ch2"), ("{}_1", "{}_2"),
        ("Front_01_{}", "Front_02_{}"), ("AB123CD_{}_F", "AB456CD_{}_F"), ("123AB_{}_F", "456AB_{}_F"),
    ],
)  # fmt: skip
def test_vehicles_and_channels_are_trips_of_their_own(names):
    times = [f"20260131_0815{second:02}" for second in (0, 5, 10, 15)]
    found = summary([f"{name.format(time)}.mp4" for name in names for time in times], 5.0)
    assert [files for _, files in found] == [[f"{name.format(time)}.mp4" for time in times] for name in names]


@pytest.mark.parametrize(
    ("form", "camera"),
    [
        ("DJI_202601310815{:02}_{:04}_D.MP4", "unknown"),
        ("{1:04}_20260131_0815{0:02}.MP4", "unknown"),
        ("2026_0131_0815{:02}_{:04}T.MP4", "unknown"),
        ("260131_0815{:02}_{:03}_RH.MP4", "rear"),
        ("20260131_0815{:02}_REC{:04}.MP4", "unknown"),
        ("20260131_0815{:02}_N{:03}F.MP4", "front"),
    ],
)
def test_counters_of_files_are_no_names(form, camera):
    names = [form.format(second, 7 + number) for number, second in enumerate((0, 5, 10, 15))]
    assert summary(names, 5.0) == [(camera, names)]
    assert find_trips(names)[0].start == datetime(2026, 1, 31, 8, 15)


def test_a_short_year_that_looks_like_a_long_one():
    names = [f"200108_081{minute}00_00{minute}_FH.MP4" for minute in range(5, 8)]
    assert summary(names) == [("front", names)]
    assert find_trips(names)[0].start == datetime(2020, 1, 8, 8, 15)


@pytest.fixture(scope="module")
def card(tmp_path_factory):
    folder = tmp_path_factory.mktemp("card")
    for second, camera in itertools.product((0, 1), "FR"):
        write_clip(folder / f"20260131_08150{second}_{camera}.mp4", gray_frames(8), fps=8)
    return folder


def test_the_segments_of_a_pattern_become_one_video_and_several_trips_are_listed(card):
    with open_trip(str(card / "*F.mp4")) as source:
        assert [index for index, _, _ in source] == list(range(16))
    message = r"2 trips \(front, 2 files from 20260131_081500_F.mp4; rear,.*, such as with '.*/\*F.mp4', or"
    with pytest.raises(InvalidInputError, match=message):
        open_trip(card)


@pytest.mark.parametrize(
    ("times", "selected"),
    [
        (("081500", "081501", "082000"), r"20260131_08150\*.mp4"),
        (("081500", "081501", "081509"), "081500_F.mp4"),
    ],
)
def test_the_pattern_for_the_first_of_several_trips_selects_no_others(card, tmp_path, times, selected):
    clip = next(card.iterdir()).read_bytes()
    for time in times:
        (tmp_path / f"20260131_{time}_F.mp4").write_bytes(clip)
    with pytest.raises(InvalidInputError, match=rf"such as with '\S*{selected}', or process all"):
        open_trip(tmp_path)


def test_the_clock_of_the_camera_runs_on_while_it_pauses(card, tmp_path):
    """Names hold whole seconds, so only a step of more than a second counts."""
    clip = next(card.iterdir()).read_bytes()
    for second in (0, 1, 4, 7, 8):  # of one second each
        (tmp_path / f"20260131_08150{second}_F.mp4").write_bytes(clip)
    with open_trip(tmp_path) as source:
        assert source.info.duration == pytest.approx(5)
        clock = segment_clock(source)
    np.testing.assert_allclose(clock, [(0, 0), (2, 4), (3, 7)], atol=0.01)
    with open_trip(next(tmp_path.iterdir())) as source:
        assert segment_clock(source) == ((0.0, 0.0),)
    with open_trip("test_images/*.jpg", fps=10) as source:
        assert segment_clock(source) == ()


def test_other_sources_are_those_of_open_source(card):
    assert [is_video_file(Path(name)) for name in ("a.MP4", "._a.mp4", "a.thm")] == [True, False, False]
    file = next(card.iterdir())
    with open_trip(file) as source, open_trip(source) as same:
        assert source is same
        assert source.info.frames == 8
    with pytest.raises(InvalidInputError, match="source must be"):
        open_trip(None)


@pytest.mark.parametrize(
    ("names", "breaks", "warning"),
    [
        (("20260131_081500_F.mp4", "20260131_081501_F.mp4"), set(), ""),
        (("20260131_081500_F.mp4", "20260131_081600_F.mp4"), {8}, "59 s after the end of"),
        (("20260131_081600_F.mp4", "20260131_081500_F.mp4"), {8}, "61 s before the end of"),
        (("a.mp4", "b.mp4"), set(), ""),
    ],
)
def test_tracks_end_at_gaps_between_files_of_a_list(card, names, breaks, warning, tmp_path, caplog):
    files = [tmp_path / name for name in names]
    for file in files:
        file.write_bytes((card / "20260131_081500_F.mp4").read_bytes())
    with open_trip(files) as source:
        assert source.breaks == breaks
        assert warning in caplog.text
        assert bool(caplog.text) == bool(breaks)
        detector = StubDetector()
        cuts = []
        follow = detector.track
        detector.track = lambda found, **options: cuts.append(options["cut"]) or follow(found, **options)
        assert len(list(track(source, detector, every=1))) == 16
    assert {number for number, cut in enumerate(cuts) if cut} == breaks


@pytest.mark.parametrize(
    ("dates", "warned"),
    [
        (("20260131", "20260201"), False),
        (("20990131",), True),
        (("20000131",), True),
        (("20150101", "20260131"), True),
        (("20260101", "20260131"), False),
    ],
)
def test_dates_of_a_clock_that_is_not_set_give_a_warning(dates, warned, caplog):
    find_trips([f"{date}_081500_F.MP4" for date in dates], duration=lambda _: 60.0)
    assert ("the clock of the camera seems to be wrong" in caplog.text) == warned
