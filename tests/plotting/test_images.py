import numpy as np
import pytest

from tests.plotting.helpers import drawn_boxes, gray_image, titles
from vehicle_detection import plotting
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import FrameBoxes
from vehicle_detection.plotting.style import SKY, TRUTH


def test_an_image_is_described():
    image = np.zeros((4, 6, 3), np.uint8)
    image[..., 0], image[0, 0, 2] = 10, 240
    described = plotting.describe_image(image)
    assert (described.shape, described.dtype, described.min, described.max) == ((4, 6, 3), "uint8", 0, 240)
    assert described.mean == (10, 0, 10)
    assert str(described) == "uint8 array of shape (4, 6, 3), values 0 to 240, mean 10, 0, 10"
    assert described.problem == ""


@pytest.mark.parametrize(
    ("array", "mean", "problem"),
    [
        (np.full((2, 2, 3), 0.5, np.float32), (0.5, 0.5, 0.5), "scale a 0-1 float image"),
        (np.zeros((2, 2), np.uint8), (0,), "convert a grayscale image"),
        (np.full((5, 2, 2, 3), 9, np.uint8), (9,), "pass one image with three color channels"),
    ],
)
def test_the_description_of_other_arrays_names_the_remedy(array, mean, problem):
    described = plotting.describe_image(array)
    assert described.mean == mean
    assert problem in described.problem
    assert str(described).endswith(described.problem)


@pytest.mark.parametrize("value", ["road.png", np.empty((0, 3)), np.array(["a"])])
def test_only_arrays_of_numbers_are_described(value):
    with pytest.raises(InvalidInputError, match=r"image must be an array of numbers, got .*; read a file"):
        plotting.describe_image(value)


def test_images_have_titles_and_boxes():
    found = Detections([[10, 20, 30, 40], [50, 20, 60, 40]], [1.0, 0.5])
    truth = FrameBoxes([0, 0], None, [[11, 20, 30, 40], [70, 0, 90, 20]], ignore=[False, True])
    figure = plotting.show_images(
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


def test_the_grid_has_no_empty_panels():
    figure = plotting.show_images([gray_image()] * 5, columns=2)
    places = [axes.get_subplotspec().get_geometry()[:2] for axes in figure.axes]
    assert places == [(3, 2)] * 5
    assert len(plotting.show_images([gray_image()] * 4).axes) == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([],), "images must be a list of images, at least one; got an empty list"),
        ((gray_image(),), r"images must be a list of images, got an array of shape \(90, 160, 3\)"),
        (([gray_image() / 255],), r"images\[0\] must be an \(H, W, 3\) uint8 RGB array.*scale a 0-1 float"),
        (([gray_image()], ["a", "b"]), "titles must have one value for each of the 1 images, got 2"),
    ],
)
def test_malformed_images_are_rejected(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.show_images(*arguments)


def test_malformed_boxes_are_rejected():
    with pytest.raises(InvalidInputError, match="boxes must have one value for each of the 2 images, got 1"):
        plotting.show_images([gray_image()] * 2, boxes=[[]])
    with pytest.raises(InvalidInputError, match=r"boxes\[0\] must be an \(N, 4\) number array"):
        plotting.show_images([gray_image()], boxes=[[1, 2, 3, 4]])
    with pytest.raises(InvalidInputError, match="columns must be an integer from 1 to 100"):
        plotting.show_images([gray_image()], columns=0)


def test_methods_are_shown_side_by_side():
    found = [Detections([[0, 0, 9, 9]], [1.0]), Detections.empty()]
    none = [Detections.empty()] * 2
    figure = plotting.plot_methods(
        {"x": gray_image(), "y": gray_image()}, {"count": found, "fitted": none}, truth=[[[1, 1, 8, 8]], None]
    )
    assert titles(figure) == [
        "x, count: 1 box",
        "x, fitted: 0 boxes",
        "y, count: 0 boxes",
        "y, fitted: 0 boxes",
    ]
    assert drawn_boxes(figure.axes[0].collections[1]).tolist() == [[0, 0, 9, 9]]
    assert drawn_boxes(figure.axes[1].collections[0]).tolist() == [[1, 1, 8, 8]]
    with pytest.raises(InvalidInputError, match=r"methods\['count'\] must have one value for each"):
        plotting.plot_methods([gray_image()], {"count": found})
    with pytest.raises(InvalidInputError, match="methods must map names to a list of Detections, got"):
        plotting.plot_methods([gray_image()], [found])
