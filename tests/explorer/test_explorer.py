import sys

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehicle_detection.boxes import Detections
from vehicle_detection.camera import Camera
from vehicle_detection.classifier import load_classifier
from vehicle_detection.datasets import load_frames
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.explorer import Explorer
from vehicle_detection.explorer import explorer as room
from vehicle_detection.explorer.explorer import VIEWS
from vehicle_detection.heatmap import frame_heat
from vehicle_detection.images import write_image
from vehicle_detection.params import FeatureParams, HeatParams, RegionParams, SearchParams
from vehicle_detection.synthetic import render_scene

SHAPE = (360, 640)


@pytest.fixture(scope="module")
def scenes():
    return [render_scene(shape=SHAPE, vehicles=3, random_state=seed).image for seed in (1, 2)]


@pytest.fixture
def explorer(scenes):
    return Explorer(scenes, horizon=0.56)


@pytest.fixture
def searches(monkeypatch):
    """Count the searches of a band."""
    counted = []
    find = room.BandSearch.find

    def counting(self, image, search):
        counted.append(search)
        return find(self, image, search)

    monkeypatch.setattr(room.BandSearch, "find", counting)
    return counted


# What it finds


@pytest.mark.parametrize("kind", ["fitted", "heat"])
@pytest.mark.parametrize("min_score", [-0.5, 0.0, 0.6])
def test_it_finds_what_the_detector_finds(explorer, scenes, kind, min_score):
    explorer.set_search(min_score=min_score)
    explorer.set_regions(kind)
    for number, scene in enumerate(scenes):
        explorer.set_frame(number)
        expected = VehicleDetector(
            load_classifier(), region_params=HeatParams() if kind == "heat" else None, search_params=SearchParams(bands=explorer.search.bands, horizon=0.56,
                                              min_score=min_score, horizontal_padding=0.5), n_jobs=1
        )  # fmt: skip
        windows = expected.search(scene).windows
        np.testing.assert_array_equal(explorer.windows().boxes, windows.boxes)
        np.testing.assert_array_equal(explorer.windows().scores, windows.scores)
        found, same = expected.detect(scene), explorer.detector(n_jobs=1).detect(scene)
        assert len(found)
        for boxes in (explorer.boxes(), same):
            np.testing.assert_array_equal(boxes.boxes, found.boxes)
            np.testing.assert_array_equal(boxes.scores, found.scores)


def test_the_parameters_reach_the_boxes(scenes):
    camera = Camera.for_frame(SHAPE, horizon=0.56, height_m=2.0)
    chosen = Explorer(
        scenes, regions="heat", search=SearchParams.preset("three-scales"),
        heat=HeatParams(weighting="count"), fit=RegionParams(min_peak=1.0), camera=camera,
    )  # fmt: skip
    assert chosen.kind == "heat"
    np.testing.assert_array_equal(
        chosen.heat_map(), frame_heat(SHAPE, chosen.windows(), HeatParams(weighting="count"))
    )
    detector = chosen.detector(n_jobs=1)
    assert detector.camera is camera
    assert detector.heat_params == HeatParams(weighting="count")
    assert detector.region_params.min_peak == 1.0
    assert detector.search_params == SearchParams.preset("three-scales")
    chosen.set_regions(
        "fitted", threshold=4.0, peak_fraction=0.1, weighting="score", min_peak=0.2, min_evidence=0.3
    )
    assert chosen.heat == HeatParams(threshold=4.0, peak_fraction=0.1)
    assert chosen.fit == RegionParams(min_peak=0.2, min_evidence=0.3)
    assert chosen.kind == "fitted"
    chosen.set_regions(threshold=0.0)
    assert (chosen.heat.threshold, chosen.kind) == (0.0, "fitted")


def test_a_higher_threshold_of_the_heat_leaves_less(explorer):
    explorer.set_regions("heat", threshold=0.0)
    many = len(explorer.boxes())
    explorer.set_regions(threshold=1e6)
    assert many > len(explorer.boxes()) == 0
    explorer.set_regions("fitted")
    assert len(explorer.boxes()) > 0
    explorer.set_regions(min_peak=100.0)
    assert len(explorer.boxes()) == 0


def test_bands_are_switched_on_and_off(explorer):
    explorer.set_search(min_score=-100.0)
    everything = explorer.windows()
    parts = []
    for band in range(len(explorer.search.bands)):
        explorer.set_search(bands=[band])
        part = explorer.windows()
        assert len(set((part.boxes[:, 2] - part.boxes[:, 0]).round().tolist())) <= 1
        parts.append(part.boxes)
    np.testing.assert_array_equal(np.concatenate(parts), everything.boxes)
    explorer.set_search(bands=(3, 1, 3))
    assert explorer.bands == (1, 3)
    assert len(explorer.windows()) == len(parts[1]) + len(parts[3])
    assert len(explorer.detector(n_jobs=1).search_params.bands) == 2
    explorer.set_search(bands=())
    assert len(explorer.windows()) == 0
    assert explorer.render().shape == (*SHAPE, 3)
    with pytest.raises(InvalidInputError, match="bands must be a tuple of SearchBand, at least one"):
        explorer.detector()


@settings(max_examples=20)
@given(steps=st.lists(st.floats(-3, 3), min_size=2, max_size=5))
def test_windows_are_those_above_the_threshold(scenes, steps):
    explorer = shared(scenes)
    explorer.set_search(min_score=-100.0)
    everything = explorer.windows()
    counts = []
    for step in sorted(steps):
        explorer.set_search(min_score=step)
        windows = explorer.windows()
        assert (windows.scores > step).all()
        assert len(windows) == (everything.scores > step).sum()
        counts.append(len(windows))
    assert counts == sorted(counts, reverse=True)


_SHARED = {}


def shared(scenes):
    """One explorer for all examples: what it remembers must not matter."""
    if not _SHARED:
        _SHARED["it"] = Explorer(scenes)
    return _SHARED["it"]


# What it remembers


def test_only_frame_and_horizon_need_a_search(explorer, searches):
    explorer.render()
    bands = len(searches)
    assert bands == len(SearchParams.preset().place(SHAPE))
    for score in (-1.0, 0.0, 0.7):
        explorer.set_search(min_score=score, bands=[0, 1])
        for kind in ("fitted", "heat"):
            explorer.set_regions(kind, threshold=1.0 + score**2, peak_fraction=0.2, min_peak=0.3)
            for view in VIEWS:
                explorer.set_view(view)
                explorer.render()
                explorer.summary()
    assert len(searches) == bands
    explorer.set_search(horizon=0.5)
    explorer.render()
    assert len(searches) == 2 * bands
    explorer.set_frame(1)
    explorer.render()
    assert len(searches) == 3 * bands
    explorer.set_frame(0)
    explorer.set_search(horizon=0.56)
    explorer.render()
    assert len(searches) == 3 * bands


def test_old_searches_and_images_are_forgotten(scenes, monkeypatch, searches):
    monkeypatch.setattr(room, "_KEPT_SEARCHES", 2)
    monkeypatch.setattr(room, "_KEPT_IMAGES", 1)
    explorer = Explorer(scenes)
    for horizon in (0.5, 0.52, 0.54):
        explorer.set_search(horizon=horizon)
        explorer.windows()
    explorer.set_frame(1)
    explorer.windows()
    assert len(explorer._searches) == 2
    assert len(explorer._images) == 1
    before = len(searches)
    explorer.set_frame(0)
    explorer.windows()  # 0.54 is still known
    assert len(searches) == before


def test_an_answer_is_made_once(explorer, monkeypatch):
    explorer.set_regions("heat")
    made = []
    monkeypatch.setattr(room, "frame_heat", lambda *args: made.append(1) or frame_heat(*args))
    explorer.set_view("heat")
    explorer.render()
    explorer.summary()
    assert len(made) == 1


def test_the_state_may_be_set_by_hand_too(explorer):
    before = len(explorer.windows())
    explorer.search = SearchParams(
        bands=explorer.search.bands, horizon=0.56, min_score=1.5, horizontal_padding=0.5
    )
    assert len(explorer.windows()) < before


# Pictures


def test_each_view_shows_something_else(explorer, scenes):
    pictures = {}
    for view in VIEWS:
        explorer.set_view(view)
        pictures[view] = explorer.render()
        assert pictures[view].shape == (*SHAPE, 3)
        assert pictures[view].dtype == np.uint8
    different = {picture.tobytes() for picture in pictures.values()}
    assert len(different) == 3
    boxes = explorer.boxes().boxes
    x1, y1, x2, _ = boxes[0].round().astype(int)
    assert (pictures["boxes"][y1, x1 + 2 : x2 - 2] == room._BOX).all()
    horizon = pictures["boxes"][round(0.56 * SHAPE[0])]
    assert (horizon[::4] == 255).all(axis=1).mean() > 0.5
    # Where nothing is drawn, the frame is as it was; the frames themselves are untouched.
    np.testing.assert_array_equal(pictures["boxes"][:100], scenes[0][:100])
    np.testing.assert_array_equal(scenes[0], render_scene(shape=SHAPE, vehicles=3, random_state=1).image)


def test_wide_frames_are_shown_small(scenes):
    large = cv2.resize(scenes[0], (1280, 720))
    explorer = Explorer([large], width=320)
    for view in VIEWS:
        explorer.set_view(view)
        assert explorer.render().shape == (180, 320, 3)
    x1, y1, x2, _ = (explorer.boxes().boxes[0] / 4).round().astype(int)
    explorer.set_view("boxes")
    assert (explorer.render()[y1, x1 + 3 : x2 - 3] == room._BOX).all()


def test_a_summary_counts(explorer):
    total = len(explorer._scored().windows)
    hits, found = len(explorer.windows()), len(explorer.boxes())
    assert explorer.summary() == f"frame 0, 640x360: {hits:,} of {total:,} windows above 0, {found} boxes"
    explorer.set_regions("heat", threshold=1e6)
    assert explorer.summary().endswith("0 boxes")


def test_a_horizon_at_the_frames_edge(explorer):
    explorer.set_search(horizon=1.0)
    with pytest.raises(InvalidInputError, match="holds no search window below the horizon at 1"):
        explorer.render()
    explorer.set_search(horizon=0.0)
    assert explorer.render().shape == (*SHAPE, 3)


# Frames


def test_frames_come_in_many_ways(scenes, tmp_path):
    (tmp_path / "more").mkdir()
    for path, scene in zip(("a.png", "more/a.png"), scenes):
        write_image(tmp_path / path, scene)
    first, second = tmp_path / "a.png", tmp_path / "more" / "a.png"
    assert Explorer(scenes).names == ("frame 0", "frame 1")
    assert Explorer([str(first), scenes[1]]).names == ("a.png", "frame 1")
    assert Explorer([first, second]).names == (str(first), str(second))
    named = Explorer({"one": scenes[0], 2: second})
    assert named.names == ("one", "2")
    named.set_frame("2")
    folder = Explorer(load_frames(tmp_path / "more"))
    assert folder.names == ("a.png",)
    for explorer in (named, folder):
        np.testing.assert_array_equal(explorer.windows().boxes, Explorer([scenes[1]]).windows().boxes)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], "frames must hold at least one image; got none"),
        ({}, "frames must hold at least one image; got none"),
        ("a.png", "frames must be a list of images or paths.*got 'a.png'.*wrap a single one in a list"),
        (np.zeros((9, 9, 3), np.uint8), "frames must be a list of images or paths"),
        ([np.zeros((9, 9))], r"frames\['frame 0'\] must be an \(H, W, 3\) uint8 RGB array"),
    ],
)
def test_frames_of_another_kind(frames, message):
    with pytest.raises(InvalidInputError, match=message):
        Explorer(frames)


@pytest.mark.parametrize(
    ("method", "arguments", "message"),
    [
        ("set_frame", {"frame": 2}, "frame must be an integer from 0 to 1; got 2"),
        ("set_frame", {"frame": "x"}, "frame must be one of 'frame 0', 'frame 1'; got 'x'"),
        ("set_view", {"view": "all"}, "view must be one of 'boxes', 'windows', 'heat'; got 'all'"),
        ("set_search", {"horizon": 2.0}, "horizon must be a number, at least 0 and at most 1"),
        ("set_search", {"min_score": "high"}, "min_score must be a number"),
        ("set_search", {"bands": [8]}, "bands must be an integer from 0 to 7; got 8"),
        ("set_regions", {"kind": "both"}, "kind must be one of 'fitted', 'heat'; got 'both'"),
        (
            "set_regions",
            {"peak_fraction": 1.5},
            "peak_fraction must be a number, at least 0 and at most 0.99",
        ),
        ("set_regions", {"min_peak": -1.0}, "min_peak must be a number, at least 0"),
    ],
)
def test_a_wrong_value_changes_nothing(explorer, method, arguments, message):
    state = [explorer.frame, explorer.view, explorer.search, explorer.bands, explorer.kind, explorer.heat]
    with pytest.raises(InvalidInputError, match=message):
        getattr(explorer, method)(**arguments)
    now = [explorer.frame, explorer.view, explorer.search, explorer.bands, explorer.kind, explorer.heat]
    assert now == state


def test_half_a_change_is_none(explorer):
    with pytest.raises(InvalidInputError, match="horizon must be a number"):
        explorer.set_search(bands=[1], horizon=7)
    with pytest.raises(InvalidInputError, match="min_peak must be a number"):
        explorer.set_regions("heat", threshold=9.0, min_peak=-1.0)
    assert explorer.bands == tuple(range(8))
    assert (explorer.kind, explorer.heat) == ("fitted", HeatParams())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"classifier": "m"}, "classifier must be a VehicleClassifier, got 'm'"),
        ({"search": "default"}, "search must be a SearchParams, got 'default'"),
        ({"heat": 1}, "heat must be a HeatParams"),
        ({"fit": 1}, "fit must be a RegionParams"),
        ({"camera": 1}, "camera must be a Camera"),
        ({"regions": "x"}, "regions must be one of 'fitted', 'heat'"),
        ({"width": 3}, "width must be an integer from 16 to 10000"),
    ],
)
def test_options_of_another_kind(scenes, options, message):
    with pytest.raises(InvalidInputError, match=message):
        Explorer(scenes, **options)


# The widgets


@pytest.fixture
def panel(explorer):
    left, right = explorer.widget().children
    controls = {control.description: control for control in left.children}
    return controls, *right.children


def decode(picture):
    return cv2.imdecode(np.frombuffer(picture.value, np.uint8), cv2.IMREAD_COLOR_RGB)


def test_the_controls_begin_with_the_state(explorer, panel):
    controls, line, picture = panel
    said, fit = {name: control.value for name, control in controls.items()}, RegionParams()
    assert said == {
        "frame": "frame 0", "show": "windows", "score above": 0.0, "horizon": 0.56,
        "windows (px)": tuple(range(8)), "boxes": "fitted", "least peak": fit.min_peak,
        "least evidence": fit.min_evidence, "heat above": 2.0,
        "share of peak": 0.35, "a window adds": "score",
    }  # fmt: skip
    assert line.value == explorer.summary()
    difference = decode(picture).astype(int) - explorer.render()
    assert np.abs(difference).mean() < 8  # JPEG


def test_each_control_does_what_it_says(explorer, panel, searches):
    controls, line, picture = panel
    before = picture.value
    controls["score above"].value = 1.0
    assert explorer.search.min_score == 1.0
    assert "windows above 1," in line.value
    assert picture.value != before
    assert not searches
    controls["windows (px)"].value = (0, 2)
    assert explorer.bands == (0, 2)
    controls["least peak"].value = 0.25
    controls["least evidence"].value = 0.5
    assert (explorer.fit.min_peak, explorer.fit.min_evidence) == (0.25, 0.5)
    controls["show"].value = "heat"
    assert explorer.view == "heat"
    controls["boxes"].value = "heat"
    controls["heat above"].value = 5.0
    controls["share of peak"].value = 0.5
    controls["a window adds"].value = "count"
    assert explorer.heat == HeatParams(threshold=5.0, peak_fraction=0.5, weighting="count")
    assert explorer.kind == "heat"
    assert not searches
    controls["horizon"].value = 0.5
    assert explorer.search.horizon == 0.5
    assert searches
    controls["frame"].value = "frame 1"
    assert explorer.frame == "frame 1"
    assert line.value == explorer.summary()


def test_controls_that_do_not_matter_are_off(panel):
    controls, *_ = panel

    def off():
        return {name for name, control in controls.items() if control.disabled}

    assert off() == {"heat above", "share of peak", "a window adds"}
    controls["boxes"].value = "heat"
    assert off() == {"least peak", "least evidence"}


def test_an_error_is_said_and_the_picture_stays(scenes, tmp_path):
    write_image(tmp_path / "a.png", scenes[0])
    explorer = Explorer([scenes[0], tmp_path / "gone & lost.png"])
    left, right = explorer.widget().children
    line, picture = right.children
    before = picture.value
    left.children[0].value = "gone & lost.png"
    assert line.value.startswith("<b>image file")
    assert "gone &amp; lost.png does not exist" in line.value
    assert picture.value == before
    left.children[0].value = "frame 0"
    assert line.value == explorer.summary()


def test_values_beyond_the_usual_range_widen_the_slider(scenes):
    search = SearchParams(bands=SearchParams.preset().bands, min_score=-7.0)
    left, _ = Explorer(scenes, search=search, heat=HeatParams(threshold=99.0)).widget().children
    controls = {control.description: control for control in left.children}
    assert (controls["score above"].value, controls["score above"].min) == (-7.0, -7.0)
    assert (controls["heat above"].value, controls["heat above"].max) == (99.0, 99.0)


def test_without_ipywidgets_it_works_but_for_the_sliders(explorer, monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    assert explorer.render().shape == (*SHAPE, 3)
    with pytest.raises(InvalidInputError, match=r"sliders need ipywidgets; pip install 'vehicle-detection\["):
        explorer.widget()


def test_a_notebook_shows_the_widgets(explorer, monkeypatch):
    import IPython.display

    shown = []
    monkeypatch.setattr(IPython.display, "display", shown.append)
    explorer._ipython_display_()
    assert [type(widget).__name__ for widget in shown] == ["HBox"]


def test_features_that_windows_cannot_share_are_refused(scenes):
    from tests.test_plotting import random_classifier

    with pytest.raises(InvalidInputError, match="find_cars needs whole HOG cells in a 64 pixel window"):
        Explorer(scenes, random_classifier(FeatureParams(pix_per_cell=10)))


@pytest.mark.realdata
def test_the_images_of_the_course(real_data):
    explorer = Explorer(load_frames(real_data / "test_images"))
    explorer.set_frame("test1.jpg")
    assert isinstance(explorer.boxes(), Detections)
    assert len(explorer.boxes()) >= 2
    assert explorer.render().shape == (540, 960, 3)
