import numpy as np
import pytest

from tests.notebook.helpers import drawn_boxes, gray_image, texts, titles
from vehicle_detection import notebook
from vehicle_detection.boxes import Detections
from vehicle_detection.heatmap import HeatParams, bounding_boxes, frame_heat
from vehicle_detection.notebook.style import SKY, VERMILION, YELLOW
from vehicle_detection.search import SearchParams
from vehicle_detection.windows import band_windows


@pytest.mark.parametrize("preset", ["130-windows", "three-scales", "default"])
def test_bands_are_drawn_where_they_are_searched(preset):
    frame, search = gray_image(720, 1280), SearchParams.preset(preset)
    figure = notebook.plot_bands(frame, search)
    bands = search.place(frame.shape)
    assert len(figure.axes) == len(bands)
    total = 0
    for axes, band in zip(figure.axes, bands):
        windows = band_windows(band)
        total += len(windows)
        bound, nexts, first = axes.collections
        assert drawn_boxes(bound).tolist() == [[band.x1, band.y1, band.x2, band.y2]]
        assert drawn_boxes(first).tolist() == windows[:1].tolist()
        for window in drawn_boxes(nexts):
            assert (windows == window).all(axis=1).any()
            assert np.abs(window - windows[0]).max() in band.step
        assert f"{len(windows):,} windows" in axes.get_title()
        assert axes.lines[0].get_ydata() == [search.horizon * 720] * 2
    if preset == "130-windows":
        assert total == 114  # of 130, those that fit into the regions
    assert texts(figure.legends[0].get_texts())[:2] == ["band", "first window"]
    colors = [lines.get_colors()[0][:3] for lines in figure.axes[0].collections]
    assert colors == [pytest.approx(color) for color in (YELLOW, SKY, VERMILION)]


def test_the_heat_map_and_its_regions():
    windows = Detections([[10, 10, 50, 50], [20, 10, 60, 50], [100, 20, 140, 60]], [1.5, 1.0, 3.0])
    params = HeatParams(threshold=1.0, peak_fraction=0.2)
    figure = notebook.plot_heatmap(gray_image(), windows, params=params)
    first, second, third, bar = figure.axes
    assert drawn_boxes(first.collections[0]).tolist() == windows.boxes.tolist()
    np.testing.assert_array_equal(second.images[0].get_array(), frame_heat((90, 160), windows, params))
    expected = bounding_boxes((90, 160), windows, params=params)
    assert drawn_boxes(third.collections[0]).tolist() == expected.boxes.tolist()
    assert third.get_title() == "2 regions above 1"
    assert bar.get_ylabel() == "sum of scores"
    painted = third.images[0].get_array()
    gray = painted[0, 0]
    inside = (painted[30, 40], painted[40, 120])
    assert not (inside[0] == gray).all()
    assert not (inside[0] == inside[1]).all()  # regions have different colors
    assert (painted[30, 90] == gray).all()


def test_a_given_heat_map_is_used():
    heat = np.zeros((90, 160), np.float32)
    heat[10:20, 30:60] = 5
    figure = notebook.plot_heatmap(
        gray_image(), Detections.empty(), params=HeatParams(weighting="count", threshold=2), heat=heat
    )
    assert drawn_boxes(figure.axes[2].collections[0]).tolist() == [[30, 10, 60, 20]]
    assert titles(figure)[:3] == ["0 windows", "heat, peak 5.0", "1 region above 2"]
    assert figure.axes[3].get_ylabel() == "windows"
    without = notebook.plot_heatmap(gray_image(), Detections.empty())
    assert without.axes[2].get_title() == "0 regions above 2"
    assert without.axes[1].images[0].get_clim() == (0, 1)
