import numpy as np
import pytest

from tests.notebook.helpers import drawn_boxes, gray_image, new_axes, texts
from vehicle_detection import Detections, TrackTable, notebook
from vehicle_detection.notebook.style import OTHER, SKY, TRUTH, VEHICLE


def test_images_have_titles_and_boxes():
    found = Detections([[10, 20, 30, 40], [50, 20, 60, 40]], [1.0, 0.5])
    truth = TrackTable([0, 0], None, [[11, 20, 30, 40], [70, 0, 90, 20]], ignore=[False, True])
    figure = notebook.show_images(
        {"a": gray_image(), "b": np.arange(12.0).reshape(3, 4)}, boxes=[found, None], truth=[truth, None]
    )
    first, second = figure.axes
    assert (first.get_title(), second.get_title()) == ("a", "b")
    true, boxes = first.collections
    assert drawn_boxes(boxes).tolist() == found.boxes.tolist()
    assert drawn_boxes(true).tolist() == [[11, 20, 30, 40]]  # without the ignored box
    assert boxes.get_colors()[0][:3] == pytest.approx(SKY)
    assert true.get_colors()[0][:3] == pytest.approx(TRUTH)
    assert not second.collections
    # Half-open pixels are the panel's coordinates.
    assert first.images[0].get_extent() == [0, 160, 90, 0]
    assert second.images[0].get_cmap().name == "gray"


def test_patches_of_a_set_show_class_and_source(patch_set):
    axes = notebook.plot_patches(patch_set, count=8, columns=4, scores=np.arange(40.0), ax=new_axes())
    rows = np.linspace(0, 39, 8).round().astype(int)
    np.testing.assert_array_equal(axes.images[7].get_array(), patch_set.patches[39])
    assert texts(axes.texts)[0] == "Far\nscore +0.00"
    assert texts(axes.texts)[-1] == "Road\nscore +39.00"
    colors = [tuple(lines.get_colors()[0][:3]) for lines in axes.collections]
    assert colors == [pytest.approx(VEHICLE if label else OTHER) for label in patch_set.labels[rows]]
