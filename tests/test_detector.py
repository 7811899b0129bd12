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
from vehicle_detection import HeatParams, RegionParams, TrackTable, iou_matrix, load_frames, read_labels
from vehicle_detection.annotator import Annotator, DrawParams
from vehicle_detection.camera import Camera, write_camera
from vehicle_detection.detector import Detector, VehicleDetector, load_model
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames, evaluate_detections
from vehicle_detection.features import FeatureParams
from vehicle_detection.scenes import SceneVehicle, render_drive, render_scene
from vehicle_detection.search import SearchBand, SearchParams
from vehicle_detection.svm import Template, VehicleClassifier
from vehicle_detection.tracking import FrameResult, Tracker, TrackParams

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
MODES = ["fitted", "heat"]


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
    """Red boxes on a plain road, or, in another light, in another scene."""
    frame = np.full((height, width, 3), light, np.uint8)
    if light != 100:
        pattern = np.random.default_rng(light).integers(
            0, 40, (height // 10 + 1, width // 10 + 1, 1), np.uint8
        )
        frame += pattern.repeat(10, axis=0).repeat(10, axis=1)[:height, :width]
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
    options = {"search_params": SEARCH, "region_params": region_params, "jobs": 1, **options}
    return VehicleDetector(CLASSIFIER, **options)


def drive(frames=12):
    """A car that drifts to the right, and one that comes and goes."""
    return [frame_with(moved(CAR, 2 * index), *[OTHER] * (4 <= index < 9)) for index in range(frames)]


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
        for name in ("id", "state", "shown", "score", "distance_m"):
            assert getattr(a, name) == getattr(b, name)
        np.testing.assert_array_equal(a.box, b.box)


def assert_same_drive(one, other):
    assert len(one) == len(other)
    for a, b in zip(one, other):
        assert_same(a, b)


@pytest.mark.parametrize("regions", MODES)
def test_a_still_shows_its_vehicles(regions):
    detector = make(regions=regions)
    for boxes in ([CAR], [moved(CAR, -60, 5), OTHER]):
        found = detector.detect(frame_with(*boxes))
        assert len(found) == len(boxes)
        assert iou_matrix(boxes, found.boxes).max(axis=1).min() > 0.5
        assert (found.scores > 0.5).all()
    assert len(detector.detect(frame_with())) == 0


@pytest.mark.parametrize("regions", MODES)
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


@pytest.mark.parametrize("regions", MODES)
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
    with VehicleDetector(model, jobs=1) as detector:
        scores = detector.detect(road).scores
        clear = detector.process(road)
    assert (scores > 0).all()
    # The best one is now a little below a vehicle.
    strict = dataclasses.replace(model, threshold=model.threshold + scores.max() + 0.2)
    with VehicleDetector(strict, jobs=1) as detector:
        assert len(detector.detect(road)) == 0
        weak = detector.search(road).vehicles.scores
        assert weak.max() == pytest.approx(-0.2)
        assert weak.min() >= -1.5
        result = detector.process(road)
        assert len(result.detections) == 0
        assert [track.state for track in result.tracks].count("tentative") > 0
    assert len(clear.detections) == len(scores)
    blunt = TrackParams(low_threshold=0.0, high_threshold=0.0)
    with VehicleDetector(strict, track_params=blunt, jobs=1) as detector:
        assert len(detector.search(road).vehicles) == 0
        assert detector.process(road).tracks == ()


@pytest.mark.parametrize("regions", ["fitted", "heat"])
def test_search_in_any_order_and_follow_in_order_is_process(regions):
    frames = drive()
    straight = make(regions=regions)
    expected = [straight.process(frame, time=index / 30) for index, frame in enumerate(frames)]
    order = list(range(len(frames)))
    random.Random(0).shuffle(order)
    with make(regions=regions, jobs=2) as split, ThreadPoolExecutor(4) as pool:
        found = dict(zip(order, pool.map(lambda index: split.search(frames[index]), order)))
        results = [split.track(found[index], time=index / 30) for index in range(len(frames))]
    assert_same_drive(results, expected)


@pytest.mark.parametrize("regions", MODES)
def test_reset_forgets_everything(regions):
    detector = make(regions=regions)
    first = [detector.process(frame) for frame in drive()]
    detector.reset()
    again = [detector.process(frame) for frame in drive()]
    assert_same_drive(first, again)


def test_every_second_frame_is_predicted():
    frames = drive(20)
    every, second = make(), make()
    expected = [every.process(frame) for frame in frames]
    results = [second.process(frame, search=index % 2 == 0) for index, frame in enumerate(frames)]
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
    timed = make()
    again = [timed.process(frame, index / 25, search=index % 2 == 0) for index, frame in enumerate(frames)]
    np.testing.assert_allclose(again[18].tracks[0].box, results[18].tracks[0].box)


def test_a_cut_is_searched_at_once():
    detector = make()
    for _ in range(12):
        detector.process(frame_with(CAR))
    result = detector.process(frame_with(CAR, light=200), search=False)
    assert result.searched
    assert 1 not in ids_of(result)
    assert not detector.process(frame_with(CAR, light=200), search=False).searched


def test_a_frame_that_does_not_follow_is_searched():
    detector, frame, wide = make(), frame_with(CAR), frame_with(CAR, width=WIDTH + 40)
    for given, time, searched in (
        (frame, 1.0, True),
        (frame, 1.04, False),
        (frame, 0.5, True),  # back in time
        (frame, 9.0, True),  # a gap
        (wide, 9.04, True),
        (wide, 9.08, False),
    ):
        assert detector.process(given, time, search=False).searched is searched


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


def test_the_search_and_the_camera_have_one_horizon(tmp_path):
    shape, given = (720, 1280), Camera.dashcam(horizon=0.4)
    write_camera(given, tmp_path / "camera.json")
    (tmp_path / "lens.json").write_text('{"fov": 90}')
    for camera in (given, tmp_path / "camera.json"):
        assert Detector("highway", camera=camera).search_params.horizon == 0.4
    assert Detector("highway", camera=given).camera == given
    for other in (None, tmp_path / "lens.json", "wide-90"):
        assert Detector("highway", camera=other).search_params == SearchParams.default()
    # Parameters of the search that are passed are kept.
    assert make(camera=given).detector.search_params is SEARCH
    unknown = Detector("highway").camera
    assert unknown.horizon == pytest.approx(SearchParams.default().horizon)
    assert unknown.horizon_std_px / 720 == pytest.approx(0.04)
    network = Detector(camera="wide-90").camera.for_shape(shape)
    assert (network.focal_px, network.horizon_px) == (pytest.approx(640), 360)


def test_calling_it_processes_and_annotates():
    one, other = make(), make()
    other.reset(fps=25)
    for frame in drive(8):
        result = one.process(frame)
        np.testing.assert_array_equal(other(frame), one.annotate(frame, result))


GOOD = frame_with(CAR)


@pytest.mark.parametrize(
    ("frame", "message"),
    [(GOOD[..., 0], "COLOR_GRAY2RGB"), (np.dstack([GOOD, GOOD[..., 0]]), "drop the alpha channel")],
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


def test_the_documented_code_for_own_frames(capsys):
    page = (ROOT / "docs" / "sources.md").read_text()
    sections = dict(section.split("\n", 1) for section in page.split("\n## ")[1:])
    blocks = {title: text.split("```python\n", 1)[-1].split("\n```")[0] for title, text in sections.items()}
    drive = render_drive(frames=3, shape=(360, 640), scenario="overtaking")
    names = {"vd": vehicle_detection, "frames": [scene.image for scene in drive]}
    exec(blocks["Frames of your own"], names)
    assert names["picture"].shape == (360, 640, 3)
    assert len(capsys.readouterr().out.splitlines()) == 3


def test_only_single_images_are_read_from_files():
    detector = make()
    for take in (detector.process, detector.search):
        with pytest.raises(InvalidInputError, match=r"^frame must be .*read files with"):
            take("frame.png")
    for take in (detector.detect, detector):
        with pytest.raises(InvalidInputError, match=r"frame\.png"):
            take("frame.png")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"conf": 0.5, "region_params": HeatParams()}, "conf must be None with a heat map.*HeatParams"),
        ({"model": Detector(CLASSIFIER), "conf": 0.5}, "conf must be omitted with a Detector"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(InvalidInputError, match=message):
        VehicleDetector(**options)


def test_heat_thresholds_depend_on_the_model():
    thresholds = [
        Detector(each, region_params=HeatParams()).heat_params.threshold for each in ("default", "highway")
    ]
    assert thresholds == [0.0, 2.0]
    assert make(region_params=HeatParams(threshold=7.0)).detector.heat_params.threshold == 7
    with pytest.warns(UserWarning, match="the heat threshold 50 does not fit the density") as caught:
        VehicleDetector("highway", region_params=HeatParams(threshold=50.0))
    assert len(caught) == 1


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


def test_a_second_thread_is_refused():
    detector, frames = make(), drive()
    with detector._one_thread, ThreadPoolExecutor(1) as pool:
        detector.process(frames[0])  # the same thread may go on
        for call in (detector.process, lambda frame: detector.track(detector.search(frame))):
            with pytest.raises(InvalidInputError, match="frames must be processed one after the other"):
                pool.submit(call, frames[1]).result()
        assert len(pool.submit(detector.detect, frames[1]).result()) > 0
    assert detector.process(frames[1]).index == 1


def test_a_shallow_copy_shares_the_search_and_has_its_own_tracks():
    detector, frames = make(), drive()
    for frame in frames[:6]:
        detector.process(frame)
    other = copy.copy(detector)
    assert other.model is detector.model
    assert other.detector is detector.detector
    other.process(frame_with(light=200))  # a cut
    assert detector.process(frames[6]).tracks
    assert not other.process(frame_with(light=200)).tracks


def test_parts_can_be_passed_in():
    annotator = Annotator(DrawParams(labels=()))
    with Detector(CLASSIFIER, search_params=SEARCH, region_params=FIT) as part:
        detector = VehicleDetector(part, annotator=annotator)
        for frame in drive(8):
            result = detector.process(frame)
        assert detector.detector is part
        assert result.shown
        np.testing.assert_array_equal(
            detector.annotate(frame, result), Annotator(DrawParams(labels=())).draw(frame, result)
        )


@pytest.fixture(scope="module")
def scene():
    cars = [SceneVehicle(distance_m=ahead, lateral_m=lateral) for ahead, lateral in ((14, 0), (30, 3.6))]
    return render_scene(shape=(360, 640), vehicles=cars, lane=1, random_state=3)


@pytest.mark.parametrize("name", ["default", "highway"])
def test_boxes_have_at_least_the_confidence(scene, name):
    with VehicleDetector(name) as detector:
        everything = detector.detect(scene.image)
    found = {}
    for conf in (0.1, 0.5, 0.9):
        with VehicleDetector(name, conf=conf) as detector:
            found[conf] = detector.detect(scene.image)
        assert (found[conf].confidences >= conf - 1e-6).all()
    assert len(found[0.1]) >= len(found[0.5]) >= len(found[0.9])
    assert len(found[0.5]) >= 1
    # The threshold does not change the probability of a box.
    best = max(everything.confidences)
    assert max(found[0.1].confidences) == pytest.approx(best, abs=1e-6)


def test_a_heat_map_has_no_confidence(scene):
    with VehicleDetector("highway", region_params=HeatParams()) as detector:
        assert detector.detect(scene.image).confidences is None
        assert all(track.confidence is None for track in detector.process(scene.image).tracks)
