import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.plotting.helpers import SMALL, legend, new_axes
from vehicle_detection import plotting
from vehicle_detection.classifier import Template, VehicleClassifier
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import FeatureParams


def random_classifier(params):
    """A classifier whose mean patch is random too."""
    rng = np.random.default_rng(0)
    mean, scale = rng.uniform(50, 150, params.length), rng.uniform(1, 9, params.length)
    return VehicleClassifier(params, (Template(mean, scale, rng.normal(size=params.length), 0.1),))


def test_weights_are_arranged_as_in_the_window():
    classifier = random_classifier(SMALL)
    coef = classifier.templates[0].coef
    figure = plotting.plot_weights(classifier)
    grid = np.array(figure.axes[:15]).reshape(3, 5)
    assert [axes.get_title() for axes in grid[0]] == [
        "HOG, positive", "HOG, negative", "spatial bins", "histogram", "in color",
    ]  # fmt: skip
    for channel, row in enumerate(grid):
        np.testing.assert_array_equal(
            row[2].images[0].get_array().ravel(), coef[channel * 64 : (channel + 1) * 64]
        )
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
    plain = plotting.plot_weights(random_classifier(rgb))
    np.testing.assert_array_equal(np.array(plain.axes[:15]).reshape(3, 5)[1, 4].images[0].get_array(), mean)


def test_hog_weights_are_the_sums_over_the_blocks():
    params = FeatureParams(spatial_feat=False, hist_feat=False, orient=4, pix_per_cell=32, hog_channel=0)
    weights = np.arange(16.0) - 7.5
    template = Template(np.zeros(16), np.ones(16), weights, 0.0)
    figure = plotting.plot_weights(VehicleClassifier(params, (template,)))
    assert len(figure.axes) == 2  # one channel, no other parts
    found = [sorted(axes.collections[0].get_array().tolist()) for axes in figure.axes]
    assert found == [sorted(weights[weights > 0].tolist()), sorted((-weights[weights < 0]).tolist())]
    assert {axes.collections[0].get_clim() for axes in figure.axes} == {(0, 7.5)}


@pytest.mark.parametrize("space", ["RGB", "HSV", "LUV", "HLS", "YUV", "YCrCb", "LAB"])
def test_weights_in_every_color_space(space):
    params = FeatureParams(hog_feat=False, spatial_size=4, hist_bins=4, color_space=space)
    assert len(plotting.plot_weights(random_classifier(params)).axes) == 3 * 3 + 3


def test_malformed_options_of_the_weights_are_rejected():
    with pytest.raises(InvalidInputError, match="classifier must be a VehicleClassifier, got 'm'"):
        plotting.plot_weights("m")
    with pytest.raises(InvalidInputError, match="template must be an integer from 0 to 0; got 1"):
        plotting.plot_weights(random_classifier(SMALL), template=1)


def test_the_legend_counts_the_errors_of_both_classes():
    scores, labels = [2.0, 1.0, -0.25, 0.0, -1.0, 0.5], [1, 1, 1, 1, 0, 0]
    axes = plotting.plot_scores(scores, labels, bins=12, ax=new_axes())
    assert legend(axes) == [
        "vehicles: 2 of 4 missed", "other: 1 of 2 classified as vehicles", "threshold 0",
    ]  # fmt: skip
    assert axes.get_yscale() == "log"
    assert axes.get_xlabel() == "score (decision value)"
    assert axes.lines[0].get_xdata() == [0, 0]
    strict = plotting.plot_scores(scores, labels, threshold=1.5, ax=new_axes())
    assert legend(strict)[:2] == ["vehicles: 3 of 4 missed", "other: 0 of 2 classified as vehicles"]


@settings(max_examples=30)
@given(
    scores=st.lists(st.floats(-50, 50), min_size=1, max_size=30),
    threshold=st.floats(-60, 60),
    bins=st.integers(1, 80),
)
def test_every_score_is_in_a_bin_and_the_threshold_is_an_edge(scores, threshold, bins):
    axes = plotting.plot_scores(
        scores, [index % 2 for index in range(len(scores))], threshold=threshold, bins=bins, ax=new_axes()
    )
    data = [patch.get_data() for patch in axes.patches[::2]]
    assert sum(part.values.sum() for part in data) == len(scores)
    assert np.abs(data[0].edges - threshold).min() == 0


@pytest.mark.parametrize(
    ("scores", "labels", "message"),
    [
        ([], [], "scores must be a list of finite numbers, at least one"),
        ([np.nan], [1], "scores must be a list of finite numbers"),
        ([1.0], [1, 0], "labels must be 0 or 1 for each of the 1 scores"),
        ([1.0, 2.0], [1, -1], "labels must be 0 or 1"),
    ],
)
def test_malformed_scores_are_rejected(scores, labels, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.plot_scores(scores, labels)
