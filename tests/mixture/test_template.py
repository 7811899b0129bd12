import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import mixture_template
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture import (
    N_CHANNELS,
    CellGrid,
    FeatureMap,
    MixtureTemplate,
    frame_grid,
    mirror_channels,
)

BORDER_TEMPLATE = mixture_template(5, 6, seed=4, border=True)


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (2, 5), (3, 4), (8, 9)])
@pytest.mark.parametrize("shape", [(8, 9), (9, 12), (12, 30)])
def test_margins_are_sums_of_products(rows, columns, shape):
    rng = np.random.default_rng(7)
    channels = rng.uniform(0, 0.4, (N_CHANNELS, *shape)).astype(np.float32)
    template = mixture_template(columns, rows, bias=0.25, padding=(0.0, 0.0))
    expected = np.empty((shape[0] - rows + 1, shape[1] - columns + 1))
    for y in range(expected.shape[0]):
        for x in range(expected.shape[1]):
            window = channels[:, y : y + rows, x : x + columns].transpose(1, 2, 0).astype(np.float64)
            expected[y, x] = (window * template.weights).sum() + 0.25
    found = template.margins(channels)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_map_smaller_than_a_template_has_no_window():
    template = mixture_template(9, 8)
    for shape in ((7, 20), (20, 8), (1, 1)):
        assert template.margins(np.zeros((N_CHANNELS, *shape), np.float32)).size == 0


def test_a_mirrored_template_gives_the_same_margins_on_a_mirrored_map():
    channels = np.random.default_rng(1).uniform(0, 0.4, (N_CHANNELS, 12, 20)).astype(np.float32)
    template = mixture_template()
    weights = mirror_channels(template.weights.transpose(2, 0, 1)).transpose(1, 2, 0)
    mirrored = MixtureTemplate(weights, template.bias, template.padding)
    np.testing.assert_allclose(
        mirrored.margins(mirror_channels(channels)), template.margins(channels)[:, ::-1], atol=1e-5
    )


def test_boxes_exclude_the_padding():
    template = mixture_template(9, 8, padding=(1.0, 0.5))
    assert template.box_cells == (7, 7)
    grid = frame_grid(8.0, (160, 160))
    first = np.array([0])
    (box,) = template.boxes(grid, first, first)
    assert box.tolist() == [grid.left + 8, grid.top + 4, grid.left + 64, grid.top + 60]
    (box,) = template.boxes(grid, first + 3, first + 5)
    assert box.tolist() == [grid.left + 48, grid.top + 28, grid.left + 104, grid.top + 84]


def test_a_border_template_has_padding_on_one_side():
    assert BORDER_TEMPLATE.box_cells == (4, 4)


@given(seed=st.integers(0, 1000), columns=st.integers(3, 12), rows=st.integers(4, 9))
def test_both_borders_give_the_same_windows(seed, columns, rows):
    rng = np.random.default_rng(seed)
    channels = rng.uniform(0, 0.3, (N_CHANNELS, rows, columns)).astype(np.float32)
    grid = CellGrid(0.0, 4.0, 8.0, 8.0, rows, columns)
    template, width = BORDER_TEMPLATE, columns * 8.0
    strip = template.border_strip(FeatureMap(channels, grid), width, left=False)
    other = template.border_strip(FeatureMap(mirror_channels(channels), grid), 0.0, left=True)
    assert (strip is None) == (other is None) == (columns < 5)
    if strip is None or other is None:
        return
    margins = template.margins(strip)
    assert margins.shape == (max(rows - 5, 0), 1)
    np.testing.assert_array_equal(template.margins(other), margins)
    boxes = template.border_boxes(grid, np.arange(len(margins)), width, left=False)
    assert (boxes[:, 2] == width).all()
    assert (boxes[:, 2:] - boxes[:, :2] == 32).all()
    others = template.border_boxes(grid, np.arange(len(margins)), 0.0, left=True)
    np.testing.assert_array_equal(others[:, [1, 3]], boxes[:, [1, 3]])
    np.testing.assert_array_equal(others[:, [0, 2]], width - boxes[:, [2, 0]])


def test_windows_of_a_grid_that_begins_outside_the_frame_end_at_the_border():
    channels = np.random.default_rng(3).uniform(0, 0.3, (N_CHANNELS, 9, 14)).astype(np.float32)
    feature_map = FeatureMap(channels, CellGrid(-16.0, 4.0, 8.0, 10.0, 9, 14))
    right = BORDER_TEMPLATE.border_strip(feature_map, 80.0, left=False)
    np.testing.assert_array_equal(right, channels[:, :, 7:12])
    left = BORDER_TEMPLATE.border_strip(feature_map, 0.0, left=True)
    np.testing.assert_array_equal(left, mirror_channels(channels[:, :, 2:7]))
    # The box is 4 by 4 cells, and one row of padding is above it.
    rows, grid = np.array([0, 3]), feature_map.grid
    assert BORDER_TEMPLATE.border_boxes(grid, rows, 80.0, left=False).tolist() == [
        [48, 14, 80, 54],
        [48, 44, 80, 84],
    ]
    assert BORDER_TEMPLATE.border_boxes(grid, rows, 0.0, left=True)[1].tolist() == [0, 44, 32, 84]


def test_nearly_half_of_a_window_may_be_padding():
    template = MixtureTemplate(np.zeros((3, 4, N_CHANNELS)), 0.0, (1.9, 1.4))
    assert template.box_cells == pytest.approx((0.2, 0.2))


def test_weights_are_copied_and_read_only():
    weights = np.zeros((3, 4, N_CHANNELS), np.float32)
    template = MixtureTemplate(weights, 0.0, (0.0, 0.0))
    weights[0] = 1
    assert not template.weights.any()
    with pytest.raises(ValueError, match="read-only"):
        template.weights[0] = 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"weights": np.zeros((3, 4, 28))},
            r"weights must be finite numbers of shape \(any, any, 20\), got an",
        ),
        ({"weights": np.zeros((4, N_CHANNELS))}, r"weights must be .*; train again"),
        ({"weights": np.zeros((0, 4, N_CHANNELS))}, "weights must be finite numbers"),
        ({"weights": np.full((3, 4, N_CHANNELS), np.nan)}, "weights must be finite numbers"),
        ({"weights": "none"}, "weights must be finite numbers"),
        ({"bias": np.inf}, "bias must be a number"),
        (
            {"padding": (2.0, 0.0)},
            r"padding must be less than half of the window's 4x3 cells, got \(2.0, 0.0\)",
        ),
        ({"padding": (0.0, 1.5)}, "padding must be less than half"),
        ({"padding": 1.0}, "padding must be two numbers of cells, got 1.0"),
        ({"padding": (np.nan, 0.0)}, "padding must be a number"),
        ({"border": 1}, "border must be True or False; got 1"),
    ],
)
def test_invalid_templates_are_rejected(changes, message):
    options = {"weights": np.zeros((3, 4, N_CHANNELS)), "bias": 0.0, "padding": (0.0, 0.0)}
    with pytest.raises(InvalidInputError, match=message):
        MixtureTemplate(**(options | changes))
