"""Speed of the own vehicle: GPX tracks, tables, and their refusal."""

import functools
import math
import os
import string
from datetime import datetime, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection import InvalidInputError, read_own_speed
from vehicle_detection.drive import OwnSpeed

POINT = '<trkpt lat="{lat}" lon="{lon}"><ele>5</ele><time>{time}</time>{speed}</trkpt>'
GPX = (
    '<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1" xmlns:x="x" xmlns:t="t">'
    "<trk><trkseg>{}</trkseg></trk></gpx>"
)
DEGREE_M = 6_371_009 * math.pi / 180


def write_gpx(path, points):
    """Write a track of (latitude, longitude, time, speed element)."""
    rows = [POINT.format(lat=lat, lon=lon, time=time, speed=speed) for lat, lon, time, speed in points]
    path.write_text(GPX.format("".join(rows)))
    return path


def time_of(second):
    return f"2024-05-01T08:{second // 60:02d}:{second % 60:02d}.000Z"


class TestGpx:
    @pytest.mark.parametrize(
        "speed", ["<speed>{}</speed>", "<x:extensions><t:speed>{}</t:speed></x:extensions>"]
    )
    def test_stated_speeds(self, tmp_path, speed):
        points = [(50, 10, time_of(second), speed.format(20 + second)) for second in range(5)]
        found = read_own_speed(write_gpx(tmp_path / "a.gpx", points))
        np.testing.assert_allclose(found.at([0, 1.5, 4, 4.1]), [20, 21.5, 24, np.nan])

    @pytest.mark.parametrize("period", [1, 5])
    def test_positions_give_speeds(self, tmp_path, period):
        """25 m/s to the east at 60 degrees north, across the date line; a new position each `period` s."""
        step = 25 / DEGREE_M / math.cos(math.radians(60))
        longitude = [(179.9999 + step * (n - n % period) + 180) % 360 - 180 for n in range(21)]
        points = [(60, lon, time_of(second), "") for second, lon in enumerate(longitude)]
        found = read_own_speed(write_gpx(tmp_path / "a.gpx", points))
        np.testing.assert_allclose(found.at(np.arange(20)), 25, rtol=1e-4)

    def test_a_standing_receiver_has_a_small_speed(self, tmp_path):
        rng = np.random.default_rng(0)
        places = np.cumsum(rng.normal(scale=0.3 / DEGREE_M, size=(60, 2)), axis=0) * 0.3
        points = [(50 + lat, lon, time_of(second), "") for second, (lat, lon) in enumerate(places)]
        assert read_own_speed(write_gpx(tmp_path / "a.gpx", points)).at(np.arange(60)).max() < 0.3

    @pytest.mark.parametrize(
        ("hours", "zones"),
        [(2, ("", "Z")), (-2, ("Z", "")), (-1, ("", "")), (-1, ("Z", "Z")), (-5.5, ("", "+00:00"))],
    )
    def test_times_of_two_zones_are_an_error(self, hours, zones, tmp_path):
        """The receiver finds its zone after 30 s, or summer time ends."""
        start = datetime(2026, 10, 25, 8)
        points = []
        for second in range(60):
            time = start + timedelta(seconds=second, hours=hours * (second >= 30))
            points.append((50 + 20 * second / DEGREE_M, 10, time.isoformat() + zones[second >= 30], ""))
        with pytest.raises(InvalidInputError, match=r"point 31, .+ another time zone than .+ before it"):
            read_own_speed(write_gpx(tmp_path / "a.gpx", points))

    def test_stated_zones_may_differ(self, tmp_path):
        times = enumerate(["10:00:00+02:00", "08:00:01Z", "08:00:02", "09:00:03+01:00"])
        points = [(50 + 20 * second / DEGREE_M, 10, f"2026-05-01T{time}", "") for second, time in times]
        assert read_own_speed(write_gpx(tmp_path / "a.gpx", points)).at([0, 3]) == pytest.approx(20, rel=1e-3)

    def test_positions_on_both_sides_of_a_gap_give_no_speed(self, tmp_path):
        """20 m/s; the receiver was off for 20 s, and for 60 s while the car stood."""
        seconds = [*range(21), *range(41, 61), *range(121, 141)]
        meters = [20 * second + (5000 if second > 20 else 0) for second in seconds[:41]]
        meters += [meters[-1] + 20 * (second - 120) for second in seconds[41:]]
        points = [(50 + way / DEGREE_M, 10, time_of(second), "") for second, way in zip(seconds, meters)]
        found = read_own_speed(write_gpx(tmp_path / "a.gpx", points))
        np.testing.assert_allclose(found.at(seconds), 20, rtol=1e-3)
        assert np.isnan(found.at([30, 90])).all()

    def test_segments_of_several_points_or_of_one(self, tmp_path):
        points = [(50 + 20 * second / DEGREE_M, 10, time_of(second), "") for second in range(10)]
        points += [(60 + 20 * second / DEGREE_M, 10, time_of(second), "") for second in range(12, 20)]
        path, cut = write_gpx(tmp_path / "a.gpx", points), "</trkseg><trkseg>"
        text = path.read_text()
        for place in ('<trkpt lat="60.002', "<trkpt "):
            path.write_text(text.replace(place, cut + place))
            np.testing.assert_allclose(read_own_speed(path).at([0, 5, 9, 12, 19]), 20, rtol=1e-3)

    def test_positions_too_far_apart(self, tmp_path):
        points = [(50, 10 + second, time_of(second), "") for second in range(0, 60, 10)]
        with pytest.raises(InvalidInputError, match="no positions at most 5 s apart to compute them"):
            read_own_speed(write_gpx(tmp_path / "a.gpx", points))

    def test_the_offset_is_the_start_of_the_video(self, tmp_path):
        points = [(50, 10, time_of(second), f"<speed>{second}</speed>") for second in range(9)]
        path = write_gpx(tmp_path / "a.gpx", points)
        assert read_own_speed(path, offset=3.5).at([0.0]).tolist() == [3.5]
        np.testing.assert_array_equal(read_own_speed(path, offset=-2).at([1, 2]), [np.nan, 0])

    def test_repeated_unsorted_and_untimed_points(self, tmp_path):
        known = (time_of(2), 3), (time_of(0), 1), (time_of(0), 7), ("noon", 90)
        points = [(50, 10, time, f"<speed>{speed}</speed>") for time, speed in known]
        assert read_own_speed(write_gpx(tmp_path / "a.gpx", points)).at([0, 2]).tolist() == [1, 3]

    @pytest.mark.parametrize(
        ("factor", "word"),
        [(1.0, ""), (3.6, "km/h"), (2.237, "mph"), (1.944, "knots"), (0.0, "0 at 20 points")],
    )
    def test_speeds_in_other_units_and_zeros_agree_with_the_positions(self, tmp_path, caplog, factor, word):
        speeds = 15 + np.arange(20) % 3
        way = np.cumsum(speeds) / DEGREE_M
        points = [
            (50 + place, 10, time_of(second), f"<speed>{speed * factor}</speed>")
            for second, (place, speed) in enumerate(zip(way, speeds, strict=True))
        ]
        found = read_own_speed(write_gpx(tmp_path / "a.gpx", points))
        np.testing.assert_allclose(found.at(np.arange(20)), speeds, rtol=1e-3 if factor else 0.1)
        assert word in caplog.text
        assert len(caplog.records) == (factor != 1)

    def test_speeds_that_contradict_the_positions_are_refused(self, tmp_path):
        points = [(50 + 15 * n / DEGREE_M, 10, time_of(n), f"<speed>{7 + n % 5}</speed>") for n in range(20)]
        with pytest.raises(InvalidInputError, match=r"0 s after the first point, the speed is 7.0 m/s, but"):
            read_own_speed(write_gpx(tmp_path / "a.gpx", points))

    def test_single_zeros_and_a_standing_receiver_are_believed(self, tmp_path, caplog):
        points = [(50, 10, time_of(n), f"<speed>{20 * (n % 2)}</speed>") for n in range(20)]
        assert read_own_speed(write_gpx(tmp_path / "a.gpx", points)).at([4, 5]).tolist() == [0, 20]
        assert not caplog.records

    def test_points_with_a_date_of_years_before_are_left_out(self, tmp_path, caplog):
        points = [(50, 10, time_of(n), f"<speed>{10 + n}</speed>") for n in range(9)]
        points[:2] = [(0, 0, "1980-01-06T00:00:00Z", "<speed>0</speed>")] * 2
        assert read_own_speed(write_gpx(tmp_path / "a.gpx", points)).at([0, 1]).tolist() == [12, 13]
        assert "left out 1 point years from the others, such as of 1980-01-06" in caplog.text

    def test_a_speed_of_a_plane_is_told(self, tmp_path, caplog):
        points = [(50, 10, time_of(n), "<speed>100</speed>") for n in range(9)]
        assert read_own_speed(write_gpx(tmp_path / "a.gpx", points)).at([3]) == 100
        assert "360 km/h 0 s after the first point; check its unit" in caplog.text

    def test_declarations_are_refused(self, tmp_path):
        """An entity of ten nested levels would expand to gigabytes."""
        entities = '<!ENTITY a0 "ha">' + "".join(
            f'<!ENTITY {name} "{f"&{before};" * 10}">'
            for before, name in zip(("a0", *string.ascii_lowercase), string.ascii_lowercase[:10])
        )
        for number, declared in enumerate((entities, '<!ENTITY x SYSTEM "file:///etc/passwd">')):
            text = f'<?xml version="1.0"?><!DOCTYPE gpx [{declared}]><gpx>&j;</gpx>'
            for encoding in ("utf-8", "utf-16"):
                path = tmp_path / f"{number}{encoding}.gpx"
                path.write_bytes(text.encode(encoding))
                with pytest.raises(InvalidInputError, match="gpx is refused: it has a document type decl"):
                    read_own_speed(path)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("no XML", "a.gpx is no GPX file: .*; export it again"),
            ("", "a.gpx is no GPX file"),
            ("<gpx><trk>", "a.gpx is no GPX file"),
            ('<?xml version="1.0" encoding="GB2312"?><gpx/>', "no GPX file: .*; export it again as UTF-8"),
            ('<?xml version="1.0" encoding="none"?><gpx/>', "a.gpx is no GPX file"),
            (GPX.format(""), "a.gpx must have at least two track points with times, got 0"),
            (GPX.format('<trkpt lat="500" lon="x"><time>2024-05-01T08:00:00Z</time></trkpt>'
                        '<trkpt><time>2024-05-01T08:00:01</time></trkpt>'), "a.gpx has no speeds"),
        ],
    )  # fmt: skip
    def test_other_files_are_refused(self, tmp_path, text, message):
        path = tmp_path / "a.gpx"
        path.write_text(text)
        with pytest.raises(InvalidInputError, match=message):
            read_own_speed(path)


def sentence(second, knots, status="A", *, date="310126", clock=True):
    place = f"5000.{second * 10:04},N,01000.0000,W" if date and clock else ",,,"
    time = f"08150{second}.500" if clock else ""
    text = f"GNRMC,{time},{status},{place},{knots},84.4,{date},,,A"
    check = functools.reduce(lambda bits, letter: bits ^ ord(letter), text, 0)
    return f"[1769847300123]${text}*{check:02X}\r\n$GPGSV,3,1,11*4A\r\n"


class TestNmea:
    def test_speeds_of_valid_sentences(self, tmp_path):
        path = tmp_path / "a.NMEA"
        text = "".join(sentence(second, 36.0 / 1.852 * 1.0) for second in range(5))
        path.write_text(text + sentence(7, 99, "V") + sentence(8, 99).replace("310126", "310127"))
        found = read_own_speed(path)
        np.testing.assert_allclose(found.at([0, 2.5, 4]), 10, rtol=1e-6)
        assert np.isnan(found.at([4.1]))

    @pytest.mark.parametrize(("date", "clock"), [("310126", True), ("060180", True), ("", True), ("", False)])
    def test_the_record_starts_before_the_first_position(self, tmp_path, caplog, date, clock):
        """Also if the clock of the receiver is wrong or not set until then."""
        path = tmp_path / "a.nmea"
        void = [sentence(second, "", "V", date=date, clock=clock) for second in range(3)]
        path.write_text("".join([*void, *(sentence(second, 36 / 1.852) for second in range(3, 9))]))
        known = np.isfinite(read_own_speed(path).at(np.arange(10)))
        assert known.tolist() == [3 <= second < 9 for second in range(10)]
        assert "first position is 3 s after the first sentence" in caplog.text

    def test_other_files_are_refused(self, tmp_path):
        (tmp_path / "a.nmea").write_bytes(b"\xff no sentences")
        with pytest.raises(InvalidInputError, match="got 0; record RMC sentences"):
            read_own_speed(tmp_path / "a.nmea")


class TestTable:
    def test_a_wrong_unit_beside_positions(self, tmp_path, caplog):
        path = tmp_path / "speed.csv"
        rows = [f"{n},{50 + 10 * n / DEGREE_M},10,36\n" for n in range(9)]
        path.write_text("time_s,latitude,longitude,speed_mps\n" + "".join(rows) + "9,,,36\n")
        np.testing.assert_allclose(read_own_speed(path).at([0, 4, 9]), 10, rtol=1e-6)
        assert "3.60 times those of the positions, so they are read as km/h" in caplog.text

    @pytest.mark.parametrize(("unit", "factor"), [("mps", 1), ("kmh", 1 / 3.6), ("mph", 1609.344 / 3600)])
    def test_units(self, tmp_path, unit, factor):
        path = tmp_path / "speed.csv"
        path.write_text(f"\ufefftime_s,name,speed_{unit}\n1.71e9,a,50\n\n1710000002,b,60\n")
        np.testing.assert_allclose(
            read_own_speed(path, offset=1.71e9).at([0, 1, 2]), np.array([50, 55, 60]) * factor
        )

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "must have the columns time_s and one of speed_mps, speed_kmh, speed_mph; got no header"),
            ("time,speed\n", "must have the columns .*; got time, speed"),
            ("time_s,speed_mps\n", "has no rows below its header"),
            ("time_s,speed_mps\n0,fast\n", "line 2: time_s and speed_mps must be numbers"),
            ("time_s,speed_mps\n0\n", "line 2: time_s and speed_mps must be numbers"),
            (
                "time_s,speed_mps\n0,-1\n",
                "line 2: time_s and speed_mps must be numbers, and the speed from 0 to 150 m/s; got 0,-1",
            ),
            ("time_s,speed_kmh\nnan,5\n", "line 2: time_s and speed_kmh must be numbers"),
            ("time_s,\xff", "is no CSV table"),
        ],
    )
    def test_other_tables_are_refused(self, tmp_path, text, message):
        path = tmp_path / "a.csv"
        path.write_text(text, encoding="latin-1")
        with pytest.raises(InvalidInputError, match=message):
            read_own_speed(path)


def test_the_record_follows_the_clock_of_the_camera():
    """The camera paused for 2 s after 60 s of video."""
    own = OwnSpeed(np.arange(200.0), np.arange(200.0), clock=((0.0, 0.0), (60.0, 62.0)))
    assert own.at([-1, 0, 59.5, 60, 100]).tolist() == pytest.approx([np.nan, 0, 59.5, 62, 102], nan_ok=True)


def test_other_paths_are_refused(tmp_path, monkeypatch):
    with pytest.raises(InvalidInputError, match=r"path must end in .gpx or .nmea or .csv, got 'a.kml'"):
        read_own_speed(tmp_path / "a.kml")
    with pytest.raises(InvalidInputError, match=r"a.gpx does not exist; check the path"):
        read_own_speed(tmp_path / "a.gpx")
    os.mkfifo(tmp_path / "pipe.gpx")
    with pytest.raises(InvalidInputError, match="is a device or a pipe"):
        read_own_speed(tmp_path / "pipe.gpx")
    (tmp_path / "large.csv").write_text("time_s,speed_mps\n" + "0,1\n" * 100)
    monkeypatch.setenv("VEHICLE_DETECTION_MAX_RECORD_BYTES", "200")
    with pytest.raises(InvalidInputError, match=r"larger than 200 bytes; .*MAX_RECORD_BYTES"):
        read_own_speed(tmp_path / "large.csv")


@given(
    st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=20, unique=True).map(sorted),
    st.floats(0, 100),
    st.lists(st.floats(-2e6, 2e6), max_size=10),
)
def test_a_speed_lies_between_those_around_it(seconds, speed, times):
    speeds = speed + np.arange(len(seconds))
    own = OwnSpeed(seconds, speeds)
    np.testing.assert_allclose(own.at(seconds), speeds)
    for time, found in zip(times, own.at(times).tolist()):
        after = int(np.searchsorted(seconds, time))
        if not seconds[0] <= time <= seconds[-1]:
            assert math.isnan(found)
        elif not math.isnan(found):
            assert speeds[max(after - 1, 0)] - 1e-6 <= found <= speeds[after] + 1e-6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], []), "seconds must be a list of numbers, got .*; pass at least one"),
        (([0], [[1]]), "speeds_mps must be a list of numbers"),
        (([0, 1], [1]), "speeds_mps must have one value for each of the 2 seconds, got 1"),
        (([1, 1], [1, 2]), "seconds must ascend"),
        (([0, np.nan], [1, 2]), "seconds must be finite"),
        (([0, 1], [1, -2]), "speeds_mps must be at least 0, got -2"),
    ],
)
def test_malformed_speeds_are_refused(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        OwnSpeed(*arguments)
    with pytest.raises(InvalidInputError, match="speed_mps must be a number, at least 0 and at most 150"):
        OwnSpeed.constant(-1)
