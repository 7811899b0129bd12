import numpy as np
import pytest
from matplotlib.colors import to_rgb

from tests.notebook.helpers import drawn_boxes, gray_image, legend, new_axes, texts, titles
from vehicle_detection import notebook
from vehicle_detection.boxes import Detections
from vehicle_detection.datasets import PatchSet, Split, find_near_duplicates
from vehicle_detection.notebook.style import OTHER, SKY, TRUTH, VEHICLE, evenly_spaced
from vehicle_detection.tables import TrackTable


def test_an_image_is_described():
    image = np.zeros((4, 6, 3), np.uint8)
    image[..., 0], image[0, 0, 2] = 10, 240
    described = notebook.describe_image(image)
    assert (described.shape, described.dtype, described.min, described.max) == ((4, 6, 3), "uint8", 0, 240)
    assert described.mean == (10, 0, 10)
    assert str(described) == "uint8 array of shape (4, 6, 3), values 0 to 240, mean 10, 0, 10"
    assert described.problem == ""


@pytest.mark.parametrize(
    ("array", "mean", "problem"),
    [
        (np.full((2, 2, 3), 0.5, np.float32), (0.5, 0.5, 0.5), "scale its values 0-1"),
        (np.zeros((2, 2), np.uint8), (0,), "convert a grayscale image"),
        (np.full((5, 2, 2, 3), 9, np.uint8), (9,), "pass one image after the other"),
    ],
)
def test_the_description_of_other_arrays_names_the_remedy(array, mean, problem):
    described = notebook.describe_image(array)
    assert described.mean == mean
    assert problem in described.problem
    assert str(described).endswith(described.problem)


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


def test_methods_are_shown_side_by_side():
    found = [Detections([[0, 0, 9, 9]], [1.0]), Detections.empty()]
    none = [Detections.empty()] * 2
    figure = notebook.plot_methods(
        {"x": gray_image(), "y": gray_image()}, {"count": found, "fitted": none}, truth=[[[1, 1, 8, 8]], None]
    )
    assert titles(figure)[:3] == ["x, count: 1 box", "x, fitted: 0 boxes", "y, count: 0 boxes"]
    assert drawn_boxes(figure.axes[0].collections[1]).tolist() == [[0, 0, 9, 9]]
    assert drawn_boxes(figure.axes[1].collections[0]).tolist() == [[1, 1, 8, 8]]


def test_patches_of_a_set_show_class_and_source(patch_set):
    axes = notebook.plot_patches(patch_set, count=8, columns=4, scores=np.arange(40.0), ax=new_axes())
    rows = evenly_spaced(40, 8)
    np.testing.assert_array_equal(axes.images[7].get_array(), patch_set.patches[39])
    assert texts(axes.texts)[0] == "Far\nscore +0.00"
    assert texts(axes.texts)[-1] == "Road\nscore +39.00"
    colors = [tuple(lines.get_colors()[0][:3]) for lines in axes.collections]
    assert colors == [pytest.approx(VEHICLE if label else OTHER) for label in patch_set.labels[rows]]
    left, right, bottom, top = np.array([image.get_extent() for image in axes.images]).T
    assert (right <= axes.get_xlim()[1]).all()
    assert (bottom <= axes.get_ylim()[0]).all()
    assert (np.diff(left[:4]) > 0).all()
    assert top[4] > bottom[0]


def test_the_balance_counts_the_patches_of_each_source(patch_set):
    some = patch_set[:30]
    axes = notebook.plot_balance(some, ax=new_axes())
    assert texts(axes.get_yticklabels()) == ["Far", "Road"]
    widths = [patch.get_width() for patch in axes.patches]
    assert widths == [int(some.labels.sum()), int((~some.labels).sum())]
    assert [to_rgb(patch.get_facecolor()) for patch in axes.patches] == [VEHICLE, OTHER]
    assert legend(axes) == ["vehicles: 20 (66.7%)", "other: 10 (33.3%)"]
    assert axes.get_xlabel() == "patches"
    # a single class
    assert legend(notebook.plot_balance(some[some.labels], ax=new_axes())) == ["vehicles: 20 (100.0%)"]


@pytest.fixture(scope="module")
def duplicates():
    patches = np.random.default_rng(0).integers(0, 256, (30, 64, 64, 3), np.uint8)
    patches[20:] = patches[:10] // 2
    return PatchSet(patches, [1] * 30, [f"vehicles/drawn/{row}.png" for row in range(30)])


def test_near_duplicates_are_shown_below_each_other(duplicates):
    pairs = find_near_duplicates(duplicates)
    axes = notebook.plot_near_duplicates(duplicates, pairs, count=4, ax=new_axes())
    assert axes.get_title() == "20 of 30 patches have a near duplicate (66.7%)"
    chosen = pairs[evenly_spaced(20, 4)]
    for place, row in enumerate([*chosen[:, 0], *chosen[:, 1]]):
        np.testing.assert_array_equal(axes.images[place].get_array(), duplicates.patches[row])
    assert texts(axes.texts)[:4] == ["drawn"] * 4
    assert all(0.95 <= float(text.removeprefix("r = ")) <= 1 for text in texts(axes.texts)[4:])
    # the second row of pairs is not full
    wide = notebook.plot_near_duplicates(duplicates, pairs, count=13, ax=new_axes())
    assert len(wide.images) == len(wide.texts) == 26


def test_near_duplicates_in_both_parts_of_a_split(duplicates):
    pairs = find_near_duplicates(duplicates)
    split = Split(np.arange(20), np.arange(20, 30))
    axes = notebook.plot_near_duplicates(duplicates, pairs, split=split, ax=new_axes())
    assert axes.get_title().startswith(
        "10 of 10 test patches have their nearest duplicate in the training part"
    )
    np.testing.assert_array_equal(axes.images[0].get_array(), duplicates.patches[20])
