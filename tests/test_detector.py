import copy
import dataclasses
import pickle
import random
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

import vehicle_detection
from tests.helpers import ROOT
from tests.video.clips import write_clip
from vehicle_detection.annotator import DrawParams, draw_tracks
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.camera import Camera, write_camera
from vehicle_detection.datasets import load_frames
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.drive import OwnSpeed
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.evaluation import LabelledFrames, evaluate_detections
from vehicle_detection.features import FeatureParams
from vehicle_detection.formats import read_labels
from vehicle_detection.heatmap import HeatParams
from vehicle_detection.loading import load_model
from vehicle_detection.network import NetworkParams
from vehicle_detection.regions import RegionParams
from vehicle_detection.scenes import SceneVehicle, render_drive, render_scene
from vehicle_detection.search import SearchBand, SearchParams
from vehicle_detection.svm import Template, VehicleClassifier
from vehicle_detection.tables import TrackTable
from vehicle_detection.tracking import FrameResult, Tracker, TrackParams
from vehicle_detection.video import process_video

# Most of these frames come without times.
pytestmark = pytest.mark.filterwarnings("ignore:the speeds assume:UserWarning")

HEIGHT, WIDTH = 180, 320
SIDES = (160, 200, 250)  # of windows in a 1280 wide frame: 40, 50 and 62 pixels in these
SEARCH = SearchParams(
    bands=tuple(SearchBand(window=(side, side), y=(-100, 300)) for side in SIDES),
    horizon=0.5,
    horizontal_padding=0.3,
)
# No flanks: the red squares are flat.
FIT = RegionParams(face_width=0.78, face_height=0.78, face_offset_y=0.0, flank_length_m=0.0)
HEAT = HeatParams(frames=3, threshold=3.0, peak_fraction=0.5)
REGIONS = ["fitted", "heat"]


def red_detector():
    """A classifier by hand: 5 for a red square of three quarters of the window, -3 for gray."""
    params = FeatureParams(color_space="RGB", spatial_size=8, hist_feat=False, hog_feat=False)
    inner = np.zeros((8, 8))
    inner[1:7, 1:7] = 1
    place = 8 * (inner / 36 - (1 - inner) / 28) / 255
    weights = np.stack([place, -place / 2, -place / 2]).ravel()
    return VehicleClassifier(params, (Template(np.zeros(192), np.ones(192), weights, -3.0),))


CLASSIFIER = red_detector()


def frame_with(*boxes, light=100, height=HEIGHT, width=WIDTH):
    frame = np.full((height, width, 3), light, np.uint8)
    frame += np.random.default_rng(0).integers(0, 6, frame.shape, dtype=np.uint8)
    for x1, y1, x2, y2 in boxes:
        frame[y1:y2, x1:x2] = (240, 15, 15)
    return frame


CAR = [140, 90, 180, 130]
OTHER = [220, 92, 258, 130]


def moved(box, x, y=0):
    return [box[0] + x, box[1] + y, box[2] + x, box[3] + y]


def make(*, regions="fitted", **options):
    region_params = FIT if regions == "fitted" else HEAT
    options = {"search_params": SEARCH, "region_params": region_params, "n_jobs": 1, **options}
    return VehicleDetector(CLASSIFIER, **options)


def drive(frames=12):
    """A car that drifts to the right, and one that comes and goes."""
    return [
        frame_with(moved(CAR, 2 * index), *([OTHER] if 4 <= index < 9 else [])) for index in range(frames)
    ]


def ids_of(result):
    return [track.id for track in result.tracks if track.id]


def assert_same(one, other):
    assert one.index == other.index
    assert one.time == other.time
    for name in ("windows", "detections"):
        np.testing.assert_array_equal(getattr(one, name).boxes, getattr(other, name).boxes)
        np.testing.assert_array_equal(getattr(one, name).scores, getattr(other, name).scores)
    assert len(one.tracks) == len(other.tracks)
    for a, b in zip(one.tracks, other.tracks):
        assert (a.id, a.state, a.shown, a.score, a.distance_m) == (
            b.id,
            b.state,
            b.shown,
            b.score,
            b.distance_m,
        )
        np.testing.assert_array_equal(a.box, b.box)


def assert_same_drive(one, other):
    assert len(one) == len(other)
    for a, b in zip(one, other):
        assert_same(a, b)


@pytest.mark.parametrize("regions", REGIONS)
def test_a_still_shows_its_vehicles(regions):
    detector = make(regions=regions)
    for boxes in ([CAR], [moved(CAR, -60, 5), OTHER]):
        found = detector.detect(frame_with(*boxes))
        assert len(found) == len(boxes)
        assert iou_matrix(boxes, found.boxes).max(axis=1).min() > 0.5
        assert (found.scores > 0.5).all()
    assert len(detector.detect(frame_with())) == 0


@pytest.mark.parametrize("regions", REGIONS)
def test_a_still_neither_uses_nor_changes_the_video(regions):
    frames = drive(6)
    plain, interrupted = make(regions=regions), make(regions=regions)
    stills = frame_with(OTHER), frame_with(light=200), frame_with(CAR, height=120, width=200)
    first = [interrupted.detect(still).boxes for still in stills]
    expected = [plain.process(frame) for frame in frames]
    results = []
    for index, frame in enumerate(frames):
        results.append(interrupted.process(frame))
        np.testing.assert_array_equal(interrupted.detect(stills[index % 3]).boxes, first[index % 3])
    assert_same_drive(results, expected)


@pytest.mark.parametrize("regions", REGIONS)
def test_a_vehicle_is_followed(regions):
    detector = make(regions=regions)
    results = [detector.process(frame) for frame in drive()]
    assert [result.index for result in results] == list(range(12))
    for index, result in enumerate(results[6:], 6):
        (first, *_) = result.shown
        assert first.id == 1
        assert iou_matrix([first.box], [moved(CAR, 2 * index)])[0, 0] > 0.45
    assert {track.id for result in results for track in result.shown} <= {1, 2}


def test_a_result_tells_what_was_found():
    detector = make()
    results = [detector.process(frame_with(CAR), time=0.04 * index) for index in range(8)]
    last = results[-1]
    assert isinstance(last, FrameResult)
    assert (last.index, last.time) == (7, 0.28)
    assert len(last.windows) > len(last.detections) == 1
    assert (last.windows.scores > SEARCH.min_score).all()
    assert last.shown == tuple(track for track in last.tracks if track.shown)
    assert last.shown[0].age == pytest.approx(0.28)
    assert set(last.seconds) == {"search", "regions", "track"}
    assert all(seconds >= 0 for seconds in last.seconds.values())
    assert detector.process(frame_with(CAR)).time is None


def test_what_is_too_weak_for_a_still_is_for_the_tracker_alone():
    model, road = load_model(), render_scene(shape=(360, 640), vehicles=3, random_state=5).image
    with VehicleDetector(model, n_jobs=1) as detector:
        scores = detector.detect(road).scores
        clear = detector.process(road)
    assert (scores > 0).all()
    # The best one is now a little below a vehicle.
    strict = dataclasses.replace(model, threshold=model.threshold + scores.max() + 0.2)
    with VehicleDetector(strict, n_jobs=1) as detector:
        assert len(detector.detect(road)) == 0
        weak = detector.search(road).vehicles.scores
        assert weak.max() == pytest.approx(-0.2)
        assert weak.min() >= -1.5
        result = detector.process(road)
        assert len(result.detections) == 0
        assert [track.state for track in result.tracks].count("tentative") > 0
    assert len(clear.detections) == len(scores)
    blunt = TrackParams(low_threshold=0.0, high_threshold=0.0)
    with VehicleDetector(strict, track_params=blunt, n_jobs=1) as detector:
        assert len(detector.search(road).vehicles) == 0
        assert detector.process(road).tracks == ()


@pytest.mark.parametrize("regions", ["fitted", "heat"])
def test_search_in_any_order_and_follow_in_order_is_process(regions):
    frames = drive()
    expected = [make(regions=regions).process(frame) for frame in frames[:1]]
    straight = make(regions=regions)
    expected = [straight.process(frame, time=index / 30) for index, frame in enumerate(frames)]
    order = list(range(len(frames)))
    random.Random(0).shuffle(order)
    with make(regions=regions, n_jobs=2) as split, ThreadPoolExecutor(4) as pool:
        found = dict(zip(order, pool.map(lambda index: split.search(frames[index]), order)))
        results = [split.track(found[index], time=index / 30) for index in range(len(frames))]
    assert_same_drive(results, expected)


@pytest.mark.parametrize("regions", REGIONS)
def test_threads_do_not_change_anything(regions):
    frames = drive(7)
    drives = []
    for n_jobs in (1, 2, 3):
        with make(regions=regions, n_jobs=n_jobs) as detector:
            drives.append([detector.process(frame) for frame in frames])
    assert_same_drive(drives[0], drives[1])
    assert_same_drive(drives[0], drives[2])


@pytest.mark.parametrize("regions", ["fitted", "heat"])
def test_reset_forgets_everything(regions):
    detector = make(regions=regions)
    first = [detector.process(frame) for frame in drive()]
    detector.reset()
    again = [detector.process(frame) for frame in drive()]
    assert_same_drive(first, again)


def test_reset_takes_the_frame_rate():
    slow, fast = make(), make()
    slow.reset(fps=5)
    for detector, frames in ((slow, 4), (fast, 4)):
        results = [detector.process(frame_with(CAR)) for _ in range(frames)]
        assert results[-1].tracks[0].age == pytest.approx(3 / (5 if detector is slow else 25))
    for fps in (0, -25, np.nan, "25"):
        with pytest.raises(InvalidInputError, match="fps must be a number, greater than 0"):
            slow.reset(fps=fps)


def test_every_second_frame_is_predicted():
    frames = drive(20)
    every, second = make(), make(every=2)
    expected = [every.process(frame) for frame in frames]
    results = [second.process(frame) for frame in frames]
    assert [result.index for result in results] == list(range(20))
    assert [result.searched for result in results] == [True, False] * 10
    for result, other in zip(results[8:], expected[8:]):
        (first, *_), (same, *_) = result.shown, other.shown
        assert first.id == same.id == 1
        assert iou_matrix([first.box], [same.box])[0, 0] > 0.9
    predicted = results[9]
    assert len(predicted.windows) == len(predicted.detections) == 0
    assert predicted.tracks[0].state == "coasting"
    # Times are those of the frames, also where they are not given.
    assert results[18].tracks[0].age == pytest.approx(18 / 25)
    timed = make(every=2)
    again = [timed.process(frame, time=index / 25) for index, frame in enumerate(frames)]
    np.testing.assert_allclose(again[18].tracks[0].box, results[18].tracks[0].box)


def test_drawing_as_asked():
    detector = make(draw_params=DrawParams(labels=(), line_width=1, panel="side"))
    for frame in drive(20):
        result = detector.process(frame)
    assert result.shown
    drawn = detector.annotate(frame, result)
    assert drawn.shape == detector.annotated_shape(frame.shape)
    assert drawn.shape[1] > frame.shape[1]
    plain = draw_tracks(frame, result.tracks, labels=(), line_width=1)
    np.testing.assert_array_equal(drawn[:, : frame.shape[1]], plain)
    mosaic = make(diagnostics=True, draw_params=DrawParams(panel="side"))
    assert mosaic.annotate(frame, mosaic.process(frame)).shape == mosaic.annotated_shape(frame.shape)
    with pytest.raises(InvalidInputError, match="style must be a DrawParams, got 3"):
        make(draw_params=3)


def test_labels_state_speeds_over_ground_where_the_own_speed_is_known():
    detector = make(own_speed=OwnSpeed([0.0, 0.5], [25.0, 25.0]))
    detector.reset(fps=25)
    for frame in drive(20):
        result = detector.process(frame)
    fast, unknown = (
        dataclasses.replace(
            result,
            time=time,
            tracks=tuple(
                dataclasses.replace(track, speed_mps=40.0, speed_std_mps=0.5) for track in result.shown
            ),
        )
        for time in (0.5, 0.6)
    )
    assert fast.tracks
    relative = draw_tracks(frame, fast.tracks)
    assert (detector.annotate(frame, fast) != relative).any()
    np.testing.assert_array_equal(make().annotate(frame, fast), relative)
    detector.reset(fps=25)
    np.testing.assert_array_equal(detector.annotate(frame, unknown), relative)
    with pytest.raises(InvalidInputError, match=r"own_speed must have a method at, got 25.0"):
        make(own_speed=25.0)


def test_boxes_between_searches_are_not_dashed():
    # Without labels, whose places depend on the frames before.
    frames, second = drive(20), make(every=2, draw_params=DrawParams(labels=()))
    results = [second.process(frame) for frame in frames]
    assert not results[19].searched
    confirmed = [dataclasses.replace(track, state="confirmed") for track in results[19].tracks]
    for frame, result in zip(frames[:-1], results):
        second.annotate(frame, result)
    drawn = second.annotate(frames[19], results[19])
    np.testing.assert_array_equal(drawn, draw_tracks(frames[19], confirmed, labels=()))


def test_a_cut_is_searched_at_once():
    detector = make(every=5)
    for _ in range(12):
        detector.process(frame_with(CAR))
    result = detector.process(frame_with(CAR, light=200))
    assert result.searched
    assert 1 not in ids_of(result)
    assert not detector.process(frame_with(CAR, light=200)).searched


def test_a_frame_that_does_not_follow_is_searched():
    detector = make(every=50)
    assert detector.process(frame_with(CAR), time=1.0).searched
    assert not detector.process(frame_with(CAR), time=1.04).searched
    assert detector.process(frame_with(CAR), time=0.5).searched  # back in time
    assert detector.process(frame_with(CAR), time=9.0).searched  # a gap
    wide = frame_with(CAR, width=WIDTH + 40)
    assert detector.process(wide, time=9.04).searched
    assert not detector.process(wide, time=9.08).searched


@pytest.mark.parametrize(
    ("options", "fps", "interval"),
    [
        ({}, 10, 1),
        ({}, 23.976, 2),
        ({}, 24, 2),
        ({}, 30, 2),
        ({}, 60, 5),
        ({"every": 1}, 60, 1),
        ({"every": 3}, 10, 3),
        ({"regions": "heat"}, 60, 1),
        ({"diagnostics": True}, 60, 1),
    ],
)
def test_the_interval_of_searches_in_a_video(options, fps, interval):
    assert make(**options).search_interval(fps) == interval


def test_a_video_is_interpolated_between_searches(tmp_path):
    source = write_clip(tmp_path / "drive.mp4", drive(21))
    runs = []
    for workers in (1, 3):
        results = []
        process_video(source, None, make(every=2), workers=workers, on_result=results.append)
        runs.append(results)
    assert_same_drive(*runs)
    results = runs[0]
    assert [result.searched for result in results] == [True, False] * 10 + [True]
    for index in range(9, 19, 2):
        before, between, after = (results[index + step].shown[0] for step in (-1, 0, 1))
        assert before.id == between.id == after.id == 1
        np.testing.assert_allclose(between.box, (before.box + after.box) / 2)


def test_frames_between_need_times():
    detector = make()
    before, after = (detector.process(frame_with(CAR)) for _ in range(2))
    with pytest.raises(InvalidInputError, match="before and after must have times; pass time= to track"):
        detector.interpolate(before, after, [0.02])


@pytest.mark.parametrize("every", [0, -1, 1.5, "2", True])
def test_a_bad_interval_is_refused(every):
    with pytest.raises(InvalidInputError, match="every must be an integer from 1 to 1000"):
        make(every=every)


@pytest.mark.parametrize("regions", ["fitted", "heat"])
def test_a_cut_ends_the_tracks(regions):
    detector = make(regions=regions)
    before = [detector.process(frame_with(CAR)) for _ in range(10)][-1]
    assert [track.id for track in before.shown] == [1]
    # Another scene with a vehicle at the same place: it is another vehicle.
    after = detector.process(frame_with(CAR, light=200))
    assert 1 not in ids_of(after)
    assert after.index == 10
    later = [detector.process(frame_with(CAR, light=200)) for _ in range(10)][-1]
    assert [track.id for track in later.shown] == [2]


def test_a_cut_to_an_empty_road_leaves_no_heat():
    detector = make(regions="heat")
    for _ in range(5):
        detector.process(frame_with(CAR))
    assert len(detector.process(frame_with(light=200)).detections) == 0


def test_a_change_of_light_is_no_cut():
    detector = make()
    lights = [100, 100, 100, 100, 100, 110, 130, 120, 100, 90]
    results = [detector.process(frame_with(CAR, light=light)) for light in lights]
    assert [track.id for track in results[-1].shown] == [1]


def test_a_time_that_goes_back_ends_the_tracks():
    detector = make()
    for index in range(10):
        detector.process(frame_with(CAR), time=10 + index / 25)
    assert 1 not in ids_of(detector.process(frame_with(CAR), time=3.0))


def test_heat_is_the_mean_of_the_last_frames():
    detector = make(regions="heat")
    single = make(regions="heat").process(frame_with(CAR)).detections.scores[0]
    peaks = []
    for boxes in ([CAR], [CAR], [], [], []):
        regions = detector.process(frame_with(*boxes)).detections
        peaks.append(regions.scores[0] if len(regions) else 0.0)
    expected = [single, single, single * 2 / 3, single / 3, 0]
    expected = [peak if peak > HEAT.threshold else 0.0 for peak in expected]
    np.testing.assert_allclose(peaks, expected, rtol=1e-5)


@pytest.mark.parametrize("regions", ["fitted", "heat"])
def test_frames_of_another_size_are_another_video(regions):
    detector = make(regions=regions)
    for _ in range(10):
        detector.process(frame_with(CAR))
    double = frame_with([2 * value for value in CAR], height=2 * HEIGHT, width=2 * WIDTH)
    result = detector.process(double)
    assert 1 not in ids_of(result)
    for _ in range(9):
        result = detector.process(double)
    (track,) = result.shown
    assert track.id == 2
    assert iou_matrix([track.box], [[2 * value for value in CAR]])[0, 0] > 0.5


def test_distances_after_another_size_are_those_of_that_size():
    double = frame_with([2 * value for value in CAR], height=2 * HEIGHT, width=2 * WIDTH)
    fresh, used = make(), make()
    used.process(frame_with(CAR))
    for _ in range(8):
        expected, found = fresh.process(double), used.process(double)
    assert found.shown[0].distance_m == pytest.approx(expected.shown[0].distance_m)


def test_the_camera_gives_the_distance():
    # The same picture through a lens of twice the focal length: twice as far.
    distances = []
    for factor in (1, 2):
        camera = Camera(focal_px=280.0 * factor, horizon_px=90.0)
        detector = make(camera=camera)
        result = [detector.process(frame_with(CAR)) for _ in range(8)][-1]
        distances.append(result.shown[0].distance_m)
    assert distances[1] == pytest.approx(2 * distances[0], rel=0.2)


def test_the_horizon_overrides_the_searchs():
    assert make(horizon=0.3).search_params == dataclasses.replace(SEARCH, horizon=0.3)
    assert make().search_params is SEARCH
    low = make(horizon=0.9)
    assert len(low.detect(frame_with([140, 20, 180, 60]))) == 0


def test_half_a_vehicle_at_the_edge():
    frame = frame_with([0, 90, 32, 130])
    found = make().detect(frame)
    assert ((found.boxes >= 0) & (found.boxes <= (WIDTH, HEIGHT, WIDTH, HEIGHT))).all()
    # Windows reach beyond the frame: what is half in the picture is found.
    assert iou_matrix(found.boxes, [[0, 90, 32, 130]]).max(initial=0) > 0.5


def test_frames_are_left_as_they_were():
    detector = make()
    frame = frame_with(CAR)
    before = frame.copy()
    for _ in range(6):
        picture = detector(frame)
    np.testing.assert_array_equal(frame, before)
    assert picture.shape == frame.shape
    assert picture.dtype == np.uint8
    assert (picture != frame).any()
    assert not np.shares_memory(picture, frame)


def test_calling_it_processes_and_annotates():
    one, other = make(), make()
    other.reset(fps=25)
    for frame in drive(8):
        result = one.process(frame)
        np.testing.assert_array_equal(other(frame), one.annotate(frame, result))


def test_diagnostics_are_another_picture_of_the_same_result():
    plain, detailed = make(), make(diagnostics=True)
    for frame in drive(6):
        result, other = plain.process(frame), detailed.process(frame)
    assert_same(result, other)
    picture = detailed.annotate(frame, other)
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.shape != frame.shape or (picture != plain.annotate(frame, result)).any()


def test_warming_up_leaves_no_trace():
    warm, cold = make(), make()
    warm.process(GOOD)
    cold.process(GOOD)
    warm.warm_up()
    warm.warm_up((HEIGHT, WIDTH))
    assert_same(warm.process(GOOD), cold.process(GOOD))


def test_a_frame_that_cannot_be_written_is_fine():
    frame = frame_with(CAR)
    frame.setflags(write=False)
    detector = make()
    for _ in range(6):
        detector(frame)
    assert len(detector.detect(frame)) == 1


def test_a_closed_detector_starts_again():
    with make(n_jobs=2) as detector:
        first = detector.detect(frame_with(CAR))
    again = detector.detect(frame_with(CAR))
    detector.close()
    detector.close()
    np.testing.assert_array_equal(again.boxes, first.boxes)


GOOD = frame_with(CAR)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (GOOD[..., 0], "COLOR_GRAY2RGB"),
        (np.dstack([GOOD, GOOD[..., 0]]), "drop the alpha channel"),
        (GOOD / 255, r"scale its values 0-1"),
        (GOOD.astype(np.uint16) * 257, "scale 16-bit values"),
        (GOOD[:0], "the image is empty"),
        (GOOD[None], "pass one image"),
        (None, "read files with vehicle_detection.read_image"),
        (b"\xff\xd8\xff", r"decode it with vehicle_detection.read_image\(data\)"),
    ],
)
def test_bad_frames_are_refused_and_change_nothing(frame, message):
    detector, plain = make(), make()
    detector.process(GOOD)
    plain.process(GOOD)
    for take in (detector.detect, detector.process, detector.search, detector):
        name = "image" if take == detector.detect else "frame"
        with pytest.raises(InvalidInputError, match=f"^{name} must be an .*{message}"):
            take(frame)
    assert_same(detector.process(GOOD), plain.process(GOOD))


@pytest.mark.parametrize("method", ["process", "track"])
def test_frames_without_times_and_frame_rate_warn_once_of_their_speeds(method):
    def follow(detector, times):
        for frame, time in zip(drive(), times, strict=True):
            if method == "process":
                detector.process(frame, time)
            else:
                detector.track(detector.search(frame), time=time)

    unknown, known, timed = make(), make(), make()
    with pytest.warns(UserWarning, match="speeds assume 25 frames per second.*reset") as caught:
        follow(unknown, [None] * 12)
    assert [warning.filename for warning in caught] == [__file__]
    known.reset(fps=10)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        follow(known, [None] * 12)
        follow(timed, [index / 10 for index in range(12)])
        unknown.reset()
        follow(unknown, [None] * 12)


def test_the_documented_code_for_own_frames_and_images(capsys):
    page = (ROOT / "docs" / "sources.md").read_text()
    sections = dict(section.split("\n", 1) for section in page.split("\n## ")[1:])
    blocks = {
        title: text.partition("```python\n")[2].partition("\n```")[0] for title, text in sections.items()
    }
    drive = render_drive(frames=3, shape=(360, 640), scenario="overtaking")
    names = {"vd": vehicle_detection, "frames": [scene.image for scene in drive]}
    exec(blocks["Frames of your own"], names)
    assert names["picture"].shape == (360, 640, 3)
    assert len(capsys.readouterr().out.splitlines()) == 3
    exec(blocks["Images in a web service"], names)
    data = (ROOT / "test_images" / "road1.jpg").read_bytes()
    with ThreadPoolExecutor(2) as executor:
        first, second = executor.map(names["find_vehicles"], [data, data])
    assert first == second
    assert first
    assert set(first[0]) == {"box", "confidence"}
    with pytest.raises(InvalidInputError, match="the bytes must be a complete image"):
        names["find_vehicles"](data[:50])


def test_only_single_images_are_read_from_files():
    detector = make()
    for take in (detector.process, detector.search):
        with pytest.raises(
            InvalidInputError, match=r"^frame must be .*read files with vehicle_detection\.read_"
        ):
            take("frame.png")
    for take in (detector.detect, detector):
        with pytest.raises(InvalidInputError, match=r"frame\.png"):
            take("frame.png")


def test_a_frame_too_small_for_a_window_is_refused():
    with pytest.raises(InvalidInputError, match="image of 40x40 pixels holds no search window"):
        VehicleDetector(CLASSIFIER).detect(GOOD[:40, :40])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 1.5}, "horizon must be a number, at least 0 and at most 1"),
        ({"horizon": 400}, "horizon must be a number, at least 0 and at most 1"),
        ({"n_jobs": 0}, "n_jobs must be an integer from 1"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(InvalidInputError, match=message):
        make(**options)


@pytest.mark.parametrize("name", ["search_params", "region_params", "track_params", "camera"])
@pytest.mark.parametrize("value", ["default", 5, {}])
def test_parameters_of_another_kind_are_refused(name, value):
    with pytest.raises(InvalidInputError, match=rf"^{name} must be a [\w ]+,.* got .*; omit it"):
        make(**{name: value})


def test_what_is_no_model_is_refused():
    with pytest.raises(InvalidInputError, match="model must be a VehicleClassifier or NetworkModel, got 5"):
        VehicleDetector(5)
    with pytest.raises(ModelFileError, match=r"model file model\.safetensors does not exist"):
        VehicleDetector("model.safetensors")


def test_features_that_cannot_be_shared_are_rejected():
    params = FeatureParams(color_space="RGB", spatial_size=6, hist_feat=False, hog_feat=False)
    odd = VehicleClassifier(params, (Template(np.zeros(108), np.ones(108), np.ones(108), 0.0),))
    with pytest.raises(InvalidInputError, match="got spatial_size=6; use search_windows"):
        VehicleDetector(odd, search_params=SEARCH)


def test_the_default_is_the_shipped_model():
    detector = VehicleDetector()
    assert detector.model.threshold == load_model("default").threshold
    gray = np.full((720, 1280, 3), 90, np.uint8)
    assert len(detector.detect(gray)) == 0
    assert detector.process(gray).tracks == ()


@pytest.mark.parametrize("shape", [(540, 960), (375, 1242), (360, 480)])
def test_the_default_takes_frames_of_other_cameras(shape):
    noise = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    found = VehicleDetector(horizon=0.45).detect(noise)
    height, width = shape
    assert ((found.boxes >= 0) & (found.boxes <= (width, height, width, height))).all()


def test_heat_thresholds_depend_on_the_model():
    thresholds = {
        model: VehicleDetector(model, region_params=HeatParams()).region_params.threshold
        for model in ("default", "highway")
    }
    assert thresholds == {"default": 0.0, "highway": 2.0}
    assert make(region_params=HeatParams(threshold=7.0)).region_params.threshold == 7
    with pytest.warns(UserWarning, match="the heat threshold 50 does not fit the density") as caught:
        VehicleDetector("highway", region_params=HeatParams(threshold=50.0))
    assert caught[0].filename == __file__


@pytest.mark.realdata
@pytest.mark.parametrize("model", ["default", "highway"])
@pytest.mark.parametrize("weighting", ["score", "count"])
def test_heat_finds_all_vehicles_of_the_courses_images(real_data, model, weighting):
    labels = read_labels(real_data / "labels" / "test_images.csv")
    images = LabelledFrames("test images", load_frames(real_data / "test_images"), labels)
    with VehicleDetector(model, region_params=HeatParams(weighting=weighting)) as detector:
        found = TrackTable.from_detections({key: detector.detect(image) for key, image in images})
    scores = evaluate_detections(found, images.labels, frames=images.keys)
    assert (scores.tp, scores.fn, scores.fp) == (9, 0, 0)


def test_tracks_become_detections_of_supervision(monkeypatch):
    monkeypatch.setitem(sys.modules, "supervision", SimpleNamespace(Detections=SimpleNamespace))
    detector = make()
    for frame in drive(8):
        result = detector.process(frame)
    converted = result.to_supervision()
    assert converted.tracker_id.tolist() == [track.id for track in result.shown]
    np.testing.assert_allclose(converted.xyxy, [track.box for track in result.shown], rtol=1e-6)


def test_a_tracker_accepts_detections_of_supervision():
    tracker = Tracker()
    for _ in range(8):
        found = SimpleNamespace(xyxy=np.array([CAR]), confidence=np.array([0.9]))
        tracks = tracker.update(found, (HEIGHT, WIDTH))
    assert [track.id for track in tracks] == [1]
    assert 1 < tracks[0].score < np.log(9)  # rising from 0


def track_cars(scenes, **options):
    """Tracks of one car each, with a detector per scene, and the last detector."""
    tracks = []
    for scene in scenes:
        with VehicleDetector(**options) as detector:
            detector.reset(fps=10)
            for _ in range(8):
                result = detector.process(scene.image)
        tracks += result.shown
    assert len(tracks) == len(scenes)
    return tracks, detector


def median_distance(tracks):
    return float(np.median([track.distance_m for track in tracks]))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda each: pickle.loads(pickle.dumps(each))])
@pytest.mark.parametrize("regions", ["fitted", "heat"])
def test_a_copy_continues_the_tracks(copied, regions):
    detector = make(regions=regions)
    frames = drive()
    for frame in frames[:6]:
        detector.process(frame)
    copy_of_it = copied(detector)
    for frame in frames[6:]:
        expected, found = detector.process(frame), copy_of_it.process(frame)
        assert [str(each) for each in found.tracks] == [str(each) for each in expected.tracks]


@pytest.fixture(scope="module")
def wide_scenes():
    # The distance of one car depends on a pixel of its box: several cars.
    cars = [SceneVehicle(distance_m=9.0, kind=kind) for kind in ("sedan", "hatchback", "mpv")]
    return [
        render_scene(vehicles=[car], lane=1, focal_px=640.0, camera_height_m=1.5, random_state=2)
        for car in cars
    ]


def test_a_known_lens_gives_the_distance(wide_scenes, tmp_path):
    tracks, detector = track_cars(wide_scenes, field_of_view=90, camera_height_m=1.5, horizon=0.56)
    assert detector.lens_is_known
    assert median_distance(tracks) == pytest.approx(9.0, rel=0.1)
    assert all(track.distance_std_m < 0.2 * track.distance_m for track in tracks)
    write_camera(wide_scenes[0].camera, tmp_path / "camera.json", (720, 1280))
    tracks, detector = track_cars(wide_scenes, camera=tmp_path / "camera.json")
    assert detector.lens_is_known
    assert median_distance(tracks) == pytest.approx(9.0, rel=0.1)
    tracks, _ = track_cars(wide_scenes, camera="wide-90", camera_height_m=1.5)
    assert median_distance(tracks) == pytest.approx(9.0, rel=0.2)


def test_an_unknown_lens_gives_a_large_error(wide_scenes):
    ((track,), detector) = track_cars(wide_scenes[:1])
    assert not detector.lens_is_known
    assert track.distance_m > 1.3 * 9.0
    assert track.distance_std_m >= 0.25 * track.distance_m


def test_the_search_takes_the_horizon_of_a_camera_file(tmp_path):
    shape = (720, 1280)
    default = NetworkParams()
    camera = Camera.for_frame(shape, horizon=0.4)
    write_camera(camera, tmp_path / "camera.json", shape)
    (tmp_path / "lens.json").write_text('{"field_of_view": 90}')
    file = {"camera": tmp_path / "camera.json"}
    for size in (shape, (360, 640)):
        found = VehicleDetector(**file).search_params_of(size)
        assert found == dataclasses.replace(default, horizon=0.4)
    given = VehicleDetector(**file, horizon=0.6).search_params_of(shape)
    assert given == default.with_horizon(0.6)
    assert VehicleDetector(**file, search_params=default).search_params_of(shape) == default
    for other in (None, camera, tmp_path / "lens.json", "wide-90"):
        assert VehicleDetector(camera=other).search_params_of(shape) == default
    bands = VehicleDetector("highway", **file).search_params_of(shape)
    assert bands == SearchParams.default().with_horizon(0.4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"field_of_view": 200}, "field_of_view must be a number, at least 1 and at most 170; got 200"),
        ({"camera_height_m": 0}, "camera_height_m must be a number, greater than 0"),
        ({"camera": "wide-90", "field_of_view": 90}, "field_of_view must be omitted with a camera"),
        (
            {"camera": Camera.for_frame((72, 128)), "camera_height_m": 1},
            "camera_height_m must be omitted with a",
        ),
        ({"camera": 7}, "camera must be a Camera or str or PathLike, got 7"),
    ],
)
def test_invalid_camera_options(options, message):
    with pytest.raises(InvalidInputError, match=message):
        VehicleDetector(**options)


def test_a_given_horizon_is_that_of_the_camera_too(tmp_path):
    shape = (720, 1280)
    camera = Camera.for_frame(shape, horizon=0.4)
    write_camera(camera, tmp_path / "camera.json", shape)
    found = [
        VehicleDetector(camera=each, horizon=0.6).camera_of(shape)
        for each in (camera, tmp_path / "camera.json")
    ]
    assert found[0] == found[1]
    assert found[0].horizon_px == pytest.approx(432)
    assert VehicleDetector(camera=camera).camera_of(shape) is camera


def test_a_camera_of_another_size_is_scaled_or_refused():
    camera = Camera.for_frame((720, 1280), field_of_view=60)
    detector = VehicleDetector(camera=camera)
    assert detector.camera_of((360, 640)) == camera.for_shape((360, 640))
    assert VehicleDetector(camera=camera, horizon=0.5).camera_of((360, 640)).horizon_px == 180
    image = np.zeros((480, 640, 3), np.uint8)
    with pytest.raises(InvalidInputError, match=r"frames of 640x480 pixels .* got one for 1280x720"):
        detector.process(image)


def test_times_become_floats():
    assert type(make().process(frame_with(CAR), np.float32(1)).time) is float


def test_a_shallow_copy_shares_the_search_and_has_its_own_tracks():
    detector, frames = make(), drive()
    for frame in frames[:6]:
        detector.process(frame)
    other = copy.copy(detector)
    assert other.model is detector.model
    assert other._search is detector._search
    other.process(np.zeros_like(frames[6]))  # a cut
    assert detector.process(frames[6]).tracks
    assert not other.process(np.zeros_like(frames[6])).tracks


def test_short_descriptions():
    detector = VehicleDetector()
    result = detector.process(np.full((180, 320, 3), 90, np.uint8), 0.0)
    assert repr(detector.model).startswith("NetworkModel(network, threshold at a probability of 0.")
    assert repr(detector) == f"VehicleDetector({detector.model!r}, 1 frame processed)"
    assert repr(result) == "FrameResult(0 at 0.00 s: 0 detections, 0 vehicles shown)"
    assert len(repr(load_model("highway"))) < 100
    assert len(repr(detector.search(np.full((180, 320, 3), 90, np.uint8)))) < 200


def test_a_second_thread_is_refused():
    detector, frames = make(), drive()
    with detector._one_thread(), ThreadPoolExecutor(1) as pool:
        detector.process(frames[0])  # the same thread may go on
        for call in (detector.process, lambda frame: detector.track(detector.search(frame))):
            with pytest.raises(InvalidInputError, match="frames must be processed one after the other"):
                pool.submit(call, frames[1]).result()
        assert len(pool.submit(detector.detect, frames[1]).result()) > 0
    assert detector.process(frames[1]).index == 1


def test_every_frame_is_searched_where_vehicles_are_blurred():
    assert VehicleDetector(blur="plates").search_interval(30) == 1
    assert VehicleDetector(blur="plates", every=2).search_interval(30) == 2
