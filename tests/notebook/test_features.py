import numpy as np
import pytest

from tests.helpers import rendered_patches
from tests.notebook.helpers import SMALL, titles
from vehicle_detection import FeatureParams, VehicleClassifier, notebook
from vehicle_detection.svm import Template


def test_hog_has_a_panel_per_channel_and_cell_size():
    patches, _ = rendered_patches(2)
    figure = notebook.plot_hog({"car": patches[0], "road": patches[1]}, SMALL, pix_per_cell=[8, 16, 32])
    assert len(figure.axes) == 4 * 6
    assert titles(figure)[:6] == [
        "car: Y", "car: Cr", "car: Cb", "road: Y", "road: Cr", "road: Cb",
    ]  # fmt: skip
    assert [figure.axes[row * 6].get_ylabel() for row in (1, 2, 3)] == [
        "8 px cells", "16 px cells", "32 px cells",
    ]  # fmt: skip
    for axes in figure.axes[6:]:
        assert len(axes.collections) == 1
        assert (*axes.get_xlim(), *axes.get_ylim()) == (0, 64, 64, 0)
    gray = notebook.plot_hog(patches[0], FeatureParams(hog_channel="GRAY"), pix_per_cell=[8])
    assert titles(gray) == ["gray", ""]
    single = notebook.plot_hog({"x": patches[0]}, FeatureParams(hog_channel=2), pix_per_cell=[8])
    assert single.axes[0].get_title() == "x: Cb"


@pytest.mark.parametrize(
    ("ahead", "slope"), [((0, 1), (0, 1)), ((1, 0), (1, 0)), ((1, -1), (1, 1)), ((1, 1), (1, -1))]
)
def test_a_glyph_is_parallel_to_the_edge(ahead, slope):
    """The image is dark on one side of a line through its center, and bright in the direction `ahead`."""
    rows, columns = np.mgrid[-32:32, -32:32] + 0.5
    bright = rows * ahead[0] + columns * ahead[1] > 0
    image = np.repeat((bright * 200).astype(np.uint8)[..., None], 3, axis=2)
    params = FeatureParams(hog_channel="GRAY", orient=18, cell_per_block=2)
    lines = notebook.plot_hog(image, params, pix_per_cell=[16]).axes[1].collections[0]
    start, stop = lines.get_segments()[int(lines.get_array().argmax())]
    along = (stop - start) / np.linalg.norm(stop - start)
    # direction of the line, of either sign; a bin is 10 degrees wide
    expected = np.array(slope) if ahead[0] and ahead[1] else np.array(ahead)
    expected = expected / np.linalg.norm(expected)
    assert abs(along @ expected) == pytest.approx(1, abs=0.02)


def classifier_with_mean(params):
    """A classifier whose mean patch is random too."""
    rng = np.random.default_rng(0)
    mean, scale = rng.uniform(50, 150, params.length), rng.uniform(1, 9, params.length)
    return VehicleClassifier(params, (Template(mean, scale, rng.normal(size=params.length), 0.1),))


def test_weights_are_arranged_as_in_the_window():
    classifier = classifier_with_mean(SMALL)
    coef = classifier.templates[0].coef
    figure = notebook.plot_weights(classifier)
    grid = np.array(figure.axes[:15]).reshape(3, 5)
    assert [axes.get_title() for axes in grid[0]] == [
        "HOG, positive", "HOG, negative", "spatial bins", "histogram", "in color",
    ]  # fmt: skip
    for channel, row in enumerate(grid):
        spatial = row[2].images[0].get_array().ravel()
        np.testing.assert_array_equal(spatial, coef[channel * 64 : (channel + 1) * 64])
        start = 192 + 8 * channel
        np.testing.assert_array_equal(row[3].patches[0].get_data().values, coef[start : start + 8])
        # each orientation of each cell is either positive or negative
        lines = [len(axes.collections[0].get_segments()) for axes in row[:2]]
        assert sum(lines) == 4 * 4 * 6
    mean = classifier.templates[0].mean[:192].reshape(3, 8, 8).transpose(1, 2, 0).round().astype(np.uint8)
    shown = grid[1, 4].images[0].get_array()
    assert shown.shape == (8, 8, 3)
    assert (shown != grid[0, 4].images[0].get_array()).any()
    rgb = FeatureParams(**{**SMALL.__dict__, "color_space": "RGB"})
    plain = notebook.plot_weights(classifier_with_mean(rgb))
    np.testing.assert_array_equal(np.array(plain.axes[:15]).reshape(3, 5)[1, 4].images[0].get_array(), mean)


def test_hog_weights_are_the_sums_over_the_blocks():
    params = FeatureParams(spatial_feat=False, hist_feat=False, orient=4, pix_per_cell=32, hog_channel=0)
    weights = np.arange(16.0) - 7.5
    template = Template(np.zeros(16), np.ones(16), weights, 0.0)
    figure = notebook.plot_weights(VehicleClassifier(params, (template,)))
    assert len(figure.axes) == 2  # one channel, no other parts
    found = [sorted(axes.collections[0].get_array().tolist()) for axes in figure.axes]
    assert found == [sorted(weights[weights > 0].tolist()), sorted((-weights[weights < 0]).tolist())]
    assert {axes.collections[0].get_clim() for axes in figure.axes} == {(0, 7.5)}


@pytest.mark.parametrize("space", ["RGB", "HSV", "LUV", "HLS", "YUV", "YCrCb", "LAB"])
def test_weights_in_every_color_space(space):
    params = FeatureParams(hog_feat=False, spatial_size=4, hist_bins=4, color_space=space)
    assert len(notebook.plot_weights(classifier_with_mean(params)).axes) == 3 * 3 + 3
