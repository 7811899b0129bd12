import dataclasses
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from vehicle_detection import Explorer, HeatParams, RegionParams, iou_matrix, load_frames, write_image
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.network import NetworkParams
from vehicle_detection.notebook import explorer as module
from vehicle_detection.notebook.explorer import METHODS, VIEWS
from vehicle_detection.scenes import render_scene
from vehicle_detection.search import SearchParams

SHAPE = (360, 640)


@pytest.fixture(scope="module")
def scenes():
    return [render_scene(shape=SHAPE, vehicles=3, random_state=seed).image for seed in (1, 2)]


def explore(frames, **options):
    """Explore with the classifier of patches: its search has bands, and its windows are grouped."""
    return Explorer(frames, "highway", **options)


@pytest.fixture
def explorer(scenes):
    return explore(scenes, horizon=0.56)


@pytest.fixture
def count_searches(monkeypatch):
    """Make an explorer count the searches of its model."""

    def count(explorer):
        searches = []
        find = explorer._search.find
        monkeypatch.setattr(explorer._search, "find", lambda *args: searches.append(args) or find(*args))
        return searches

    return count


# Windows and boxes


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("min_score", [-0.5, 0.6])
@pytest.mark.parametrize("model", ["default", "highway"])
def test_windows_and_boxes_equal_those_of_the_detector(scenes, model, method, min_score):
    explorer = Explorer(scenes, model)
    explorer.set_search(min_score=min_score, horizon=0.56)
    explorer.set_regions(method, threshold=0.5)
    kind = type(explorer.search_params)
    search_params = dataclasses.replace(kind.default(), min_score=min_score)
    if model == "highway":
        search_params = search_params.with_horizon(0.56)
    region_params = HeatParams(threshold=0.5) if method == "heat" else RegionParams()
    expected = VehicleDetector(model, region_params=region_params, search_params=search_params, jobs=1)
    for number, scene in enumerate(scenes):
        explorer.set_frame(number)
        windows, found = expected.search(scene).windows, expected.detect(scene)
        assert len(windows)
        assert len(found)
        for actual, wanted in (
            (explorer.windows(), windows),
            (explorer.boxes(), found),
            (explorer.detector(jobs=1).detect(scene), found),
        ):
            np.testing.assert_array_equal(actual.boxes, wanted.boxes)
            np.testing.assert_array_equal(actual.scores, wanted.scores)
        if method == "groups":
            np.testing.assert_array_equal(explorer.boxes().confidences, found.confidences)


def test_the_horizon_of_a_network_is_that_of_the_camera(scenes):
    explorer = Explorer(scenes)
    assert explorer.bands == ()
    image = explorer.render()
    explorer.set_search(horizon=0.56)
    assert explorer.camera.horizon == pytest.approx(0.56)
    assert explorer.detector(camera="wide-90").camera.horizon == pytest.approx(0.56)
    assert (explorer.render() != image).any()
    with pytest.raises(InvalidInputError, match="bands must be None"):
        explorer.set_search(bands=[0])


def test_bands_are_selected(explorer):
    explorer.set_search(min_score=-100.0)
    everything = explorer.windows()
    parts = []
    for band in range(len(explorer.search_params.bands)):
        explorer.set_search(bands=[band])
        part = explorer.windows()
        assert len(set((part.boxes[:, 2] - part.boxes[:, 0]).round().tolist())) <= 1
        parts.append(part.boxes)
    np.testing.assert_array_equal(np.concatenate(parts), everything.boxes)
    explorer.set_search(bands=(3, 1, 3))
    assert explorer.bands == (1, 3)
    assert len(explorer.windows()) == len(parts[1]) + len(parts[3])
    assert len(explorer.detector(jobs=1).detector.search_params.bands) == 2
    explorer.set_search(bands=())
    assert len(explorer.windows()) == 0
    assert explorer.render().shape == (*SHAPE, 3)
    with pytest.raises(InvalidInputError, match="bands must be a tuple of SearchBand, at least one"):
        explorer.detector()


# The cache


def test_only_another_frame_horizon_or_selection_of_bands_needs_a_search(explorer, count_searches):
    searches = count_searches(explorer)
    explorer.render()
    for score in (-1.0, 0.0, 0.7):
        explorer.set_search(min_score=score)
        for method in METHODS:
            explorer.set_regions(method, threshold=1.0 + score**2, peak_fraction=0.2, min_peak=0.3)
            for view in VIEWS:
                explorer.set_view(view)
                explorer.render()
                explorer.summary()
    assert len(searches) == 1
    explorer.set_search(bands=[0, 1])
    explorer.render()
    explorer.set_search(horizon=0.5)
    explorer.render()
    explorer.set_frame(1)
    explorer.render()
    assert len(searches) == 4
    explorer.set_frame(0)
    explorer.set_search(horizon=0.56)
    explorer.render()
    assert len(searches) == 4


# Images


def test_each_view_shows_another_image(explorer, scenes):
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
    assert (pictures["boxes"][y1, x1 + 2 : x2 - 2] == module._BOX_COLOR).all()
    horizon = pictures["boxes"][round(0.56 * SHAPE[0])]
    assert (horizon[::4] == 255).all(axis=1).mean() > 0.5
    # pixels without drawings are unchanged, and so are the frames
    np.testing.assert_array_equal(pictures["boxes"][:100], scenes[0][:100])
    np.testing.assert_array_equal(scenes[0], render_scene(shape=SHAPE, vehicles=3, random_state=1).image)


# Frames


def test_frames_are_arrays_or_files(scenes, tmp_path):
    (tmp_path / "more").mkdir()
    for path, scene in zip(("a.png", "more/a.png"), scenes):
        write_image(tmp_path / path, scene)
    first, second = tmp_path / "a.png", tmp_path / "more" / "a.png"
    assert explore(scenes).names == ("frame 0", "frame 1")
    assert explore([str(first), scenes[1]]).names == ("a.png", "frame 1")
    assert explore([first, second]).names == (str(first), str(second))
    named = explore({"one": scenes[0], 2: second})
    assert named.names == ("one", "2")
    named.set_frame("2")
    folder = explore(load_frames(tmp_path / "more"))
    assert folder.names == ("a.png",)
    for explorer in (named, folder):
        np.testing.assert_array_equal(explorer.windows().boxes, explore([scenes[1]]).windows().boxes)


@pytest.mark.parametrize(
    "frames", [[], {}, "a.png", np.zeros((9, 9, 3), np.uint8), [np.zeros((9, 9))], {"a": 3}]
)
def test_malformed_frames_are_rejected(frames):
    with pytest.raises(InvalidInputError, match=r"^frames"):
        Explorer(frames)


@pytest.mark.parametrize(
    ("method", "arguments", "refused"),
    [
        ("set_frame", {"frame": 2}, "frame"),
        ("set_search", {"min_score": "high"}, "min_score"),
        ("set_search", {"bands": [1], "horizon": 7}, "horizon"),
        ("set_search", {"bands": [9], "horizon": 0.4}, "bands must be an integer from 0 to 7"),
        ("set_regions", {"peak_fraction": 1.5}, "peak_fraction"),
        ("set_regions", {"method": "heat", "threshold": 9.0, "min_peak": -1.0}, "min_peak"),
    ],
)
def test_an_invalid_value_changes_nothing(explorer, method, arguments, refused):
    before = explorer._state, explorer.view, explorer.box
    with pytest.raises(InvalidInputError, match=f"^{refused}"):
        getattr(explorer, method)(**arguments)
    assert (explorer._state, explorer.view, explorer.box) == before


# The widgets


def open_panel(explorer):
    """Controls by label, the text and the image of an explorer's widget."""
    left, right = explorer.widget().children
    return {control.description: control for control in left.children}, *right.children


@pytest.fixture
def panel(explorer):
    return open_panel(explorer)


def decode(picture):
    return cv2.imdecode(np.frombuffer(picture.value, np.uint8), cv2.IMREAD_COLOR_RGB)


def test_the_controls_start_with_the_parameters(explorer, panel):
    controls, text, image = panel
    groups, heat = RegionParams(), HeatParams().for_search(SearchParams.preset())
    assert {name: control.value for name, control in controls.items()} == {
        "frame": "frame 0", "show": "windows", "explain box": 0, "min. score": 0.0, "horizon": 0.56,
        "windows (px)": tuple(range(8)), "boxes from": "groups", "min. peak": groups.min_peak,
        "min. evidence": groups.min_evidence, "min. heat": heat.threshold,
        "peak fraction": heat.peak_fraction, "heat is": "score",
    }  # fmt: skip
    assert text.value == explorer.summary()
    difference = decode(image).astype(int) - explorer.render()
    assert np.abs(difference).mean() < 8  # JPEG


def test_each_control_sets_its_parameter(explorer, panel, count_searches):
    searches = count_searches(explorer)
    controls, text, image = panel
    before = image.value
    controls["min. score"].value = 1.0
    assert explorer.search_params.min_score == 1.0
    assert "windows above 1," in text.value
    assert image.value != before
    controls["windows (px)"].value = (0, 2)
    assert explorer.bands == (0, 2)
    controls["min. peak"].value = 0.25
    controls["min. evidence"].value = 0.5
    assert explorer.region_params == RegionParams(min_peak=0.25, min_evidence=0.5)
    controls["show"].value = "heat"
    assert explorer.view == "heat"
    controls["boxes from"].value = "heat"
    controls["min. heat"].value = 5.0
    controls["peak fraction"].value = 0.5
    controls["heat is"].value = "count"
    assert explorer.region_params == HeatParams(threshold=5.0, peak_fraction=0.5, weighting="count")
    assert len(searches) == 1
    controls["horizon"].value = 0.5
    assert explorer.search_params.horizon == 0.5
    assert len(searches) == 2
    controls["frame"].value = "frame 1"
    assert explorer.frame == "frame 1"
    assert text.value == explorer.summary()


def test_a_network_has_no_controls_for_bands_and_groups(scenes):
    explorer = Explorer(scenes)
    controls, text, _ = open_panel(explorer)
    assert list(controls) == [
        "frame", "show", "explain box", "min. score", "horizon", "boxes from", "min. heat", "peak fraction",
        "heat is",
    ]  # fmt: skip
    controls["min. score"].value = 0.5
    # Only changed controls are applied: the horizon is still unknown.
    assert explorer.search_params == NetworkParams(min_score=0.5)
    assert not explorer.camera.horizon_is_known
    controls["horizon"].value = 0.56
    assert explorer.camera.horizon == pytest.approx(0.56)
    assert text.value == explorer.summary()


def test_an_error_is_shown_and_the_image_stays(scenes, tmp_path):
    explorer = explore([scenes[0], tmp_path / "gone & lost.png"])
    controls, text, image = open_panel(explorer)
    before = image.value
    controls["frame"].value = "gone & lost.png"
    assert text.value.startswith("<b>image file")
    assert "gone &amp; lost.png does not exist" in text.value
    assert image.value == before
    controls["frame"].value = "frame 0"
    assert text.value == explorer.summary()


@pytest.mark.parametrize("model", ["default", "highway"])
def test_a_box_is_explained(scenes, model):
    explorer = Explorer(scenes, model, width=SHAPE[1] // 2)
    controls, text, _ = open_panel(explorer)
    assert explorer.explanation() is None
    plain = explorer.render()
    controls["explain box"].value = 1
    explanation = explorer.explanation()
    best = explorer.boxes().boxes[explorer.boxes().scores.argmax()]
    overlap = iou_matrix(best[None], explanation.box[None])[0, 0]
    assert overlap > 0.5
    assert text.value == explorer.summary()
    assert f"; box 1: score {explanation.score:.2f}" in text.value
    changed = np.argwhere((explorer.render() != plain).any(axis=2))[:, ::-1]
    left, top, right, bottom = explanation.window / 2
    assert (changed >= (left - 1, top - 1)).all()
    assert (changed <= (right + 1, bottom + 1)).all()
    controls["explain box"].value = 99
    assert explorer.explanation() is None


def test_a_click_explains_the_box(scenes, monkeypatch):
    handlers = []

    class Event:
        def __init__(self, source, watched_events):
            assert watched_events == ["click"]

        def on_dom_event(self, handler):
            handlers.append(handler)

    monkeypatch.setitem(sys.modules, "ipyevents", SimpleNamespace(Event=Event))
    explorer = Explorer(scenes, width=SHAPE[1] // 2)
    controls, *_ = open_panel(explorer)
    (click,) = handlers
    for row in range(len(explorer.boxes())):
        x1, y1, x2, y2 = explorer.boxes().boxes[row] / 2
        click({"dataX": (x1 + x2) / 2, "dataY": (y1 + y2) / 2})
        number = controls["explain box"].value
        order = np.argsort(-explorer.boxes().scores, kind="stable")
        assert order[number - 1] == row
        assert explorer.explanation() is not None
    click({"dataX": 0, "dataY": 0})
    assert (explorer.box, explorer.explanation()) == (0, None)


def test_only_the_sliders_need_ipywidgets(explorer, monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    assert explorer.render().shape == (*SHAPE, 3)
    with pytest.raises(InvalidInputError, match="pip install ipywidgets"):
        explorer.widget()
