import json
from fractions import Fraction

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure, SubFigure

from vehicle_detection import plotting
from vehicle_detection.boxes import Detections
from vehicle_detection.classifier import Template, VehicleClassifier
from vehicle_detection.datasets import PatchSet, Split, find_near_duplicates, load_frames
from vehicle_detection.detector import FrameResult
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import (
    FrameBoxes,
    LabelledFrames,
    evaluate_detections,
    precision_recall_curve,
)
from vehicle_detection.features import extract_features, hog_image
from vehicle_detection.heatmap import bounding_boxes, frame_heat
from vehicle_detection.images import write_image
from vehicle_detection.params import FeatureParams, HeatParams, SearchBand, SearchParams
from vehicle_detection.plotting.features import put_glyphs, sum_blocks
from vehicle_detection.plotting.style import COLORS, OTHER, SKY, TRUTH, VEHICLE, VERMILION, YELLOW, spread
from vehicle_detection.synthetic import render_drive, render_patches
from vehicle_detection.tracking import Track
from vehicle_detection.training import train_and_evaluate
from vehicle_detection.tuning import ResultTable
from vehicle_detection.video import VideoReport
from vehicle_detection.windows import band_windows

SMALL = FeatureParams(spatial_size=8, hist_bins=8, orient=6, pix_per_cell=16)


@pytest.fixture(autouse=True)
def nothing_left_behind():
    """No test may change a setting of matplotlib; figures of pyplot are those of single panels."""
    before = dict(matplotlib.rcParams)
    yield
    assert dict(matplotlib.rcParams) == before
    plt.close("all")


def panel():
    return Figure().add_subplot()


def blank(height=90, width=160, value=90):
    return np.full((height, width, 3), value, np.uint8)


def segments(collection):
    """Boxes that a collection of outlines draws."""
    lines = np.array(collection.get_segments()).reshape(-1, 5, 2)
    return np.concatenate([lines.min(axis=1), lines.max(axis=1)], axis=1)


def texts(artists):
    return [artist.get_text() for artist in artists]


def legend(axes):
    return texts(axes.get_legend().get_texts())


@pytest.fixture(scope="module")
def patch_set():
    patches, labels = render_patches(40, random_state=3)
    names = [
        f"{'vehicles/Far' if label else 'non-vehicles/Road'}/{number}.png"
        for number, label in enumerate(labels)
    ]
    return PatchSet(patches, labels, names)


def random_classifier(params, seed=0):
    rng = np.random.default_rng(seed)
    template = Template(
        rng.uniform(50, 150, params.length),
        rng.uniform(1, 9, params.length),
        rng.normal(size=params.length),
        0.1,
    )
    return VehicleClassifier(params, (template,))


# What all have in common


def test_every_public_name_is_handed_out_and_starts_like_the_others():
    assert sorted(plotting.__all__) == plotting.__all__
    for name in plotting.__all__:
        assert getattr(plotting, name).__name__ == name


def test_figures_of_several_panels_are_none_of_pyplots():
    figure = plotting.show_images([blank()])
    assert not plt.get_fignums()
    assert figure._repr_png_().startswith(b"\x89PNG")
    given = Figure()
    assert plotting.show_images([blank()], figure=given) is given
    left, right = given.subfigures(1, 2)
    assert isinstance(left, SubFigure)
    assert plotting.plot_heatmap(blank(), Detections.empty(), figure=right) is right
    with pytest.raises(InvalidInputError, match=r"figure must be a FigureBase, got 3 \(int\); pass a Figure"):
        plotting.show_images([blank()], figure=3)


def test_one_panel_goes_where_it_is_told_or_to_pyplot():
    axes = panel()
    assert plotting.plot_windows(blank(), [[1, 2, 30, 40]], ax=axes) is axes
    assert not plt.get_fignums()
    own = plotting.plot_windows(blank(), [[1, 2, 30, 40]])
    assert plt.get_fignums() == [own.figure.number]
    with pytest.raises(InvalidInputError, match="ax must be a Axes, got 'here'"):
        plotting.plot_windows(blank(), [], ax="here")


def test_no_input_is_changed(patch_set):
    image, windows = blank(), Detections([[0.0, 0, 64, 64]], [1.0])
    before = image.copy(), windows.boxes.copy(), patch_set.fingerprint
    plotting.plot_heatmap(image, windows)
    plotting.plot_windows(image, windows, ax=panel())
    plotting.plot_patches(patch_set, ax=panel())
    np.testing.assert_array_equal(image, before[0])
    np.testing.assert_array_equal(windows.boxes, before[1])
    assert patch_set.fingerprint == before[2]


@given(count=st.integers(0, 300), wanted=st.integers(1, 50))
def test_rows_are_spread_over_the_whole(count, wanted):
    rows = spread(count, wanted)
    assert len(rows) == min(count, wanted)
    assert len(set(rows.tolist())) == len(rows)
    if count > wanted > 1:
        assert (rows[0], rows[-1]) == (0, count - 1)


# Images


def test_an_image_in_words():
    image = np.zeros((4, 6, 3), np.uint8)
    image[..., 0], image[0, 0, 2] = 10, 240
    facts = plotting.describe_image(image)
    assert (facts.shape, facts.dtype, facts.low, facts.high) == ((4, 6, 3), "uint8", 0, 240)
    assert facts.means == (10, 0, 10)
    assert str(facts) == "uint8 array of shape (4, 6, 3), values 0 to 240, mean 10, 0, 10"
    assert facts.problem == ""


@pytest.mark.parametrize(
    ("array", "means", "problem"),
    [
        (np.full((2, 2, 3), 0.5, np.float32), (0.5, 0.5, 0.5), "scale a 0-1 float image"),
        (np.zeros((2, 2), np.uint8), (0,), "convert a grayscale image"),
        (np.full((5, 2, 2, 3), 9, np.uint8), (9,), "pass one image with three color channels"),
    ],
)
def test_what_is_no_image_is_described_with_the_remedy(array, means, problem):
    facts = plotting.describe_image(array)
    assert facts.means == means
    assert problem in facts.problem
    assert str(facts).endswith(facts.problem)


@pytest.mark.parametrize("value", ["road.png", np.empty((0, 3)), np.array(["a"])])
def test_what_is_no_array_is_not_described(value):
    with pytest.raises(InvalidInputError, match=r"image must be an array of numbers, got .*; read a file"):
        plotting.describe_image(value)


def test_images_with_titles_and_boxes():
    found = Detections([[10, 20, 30, 40], [50, 20, 60, 40]], [1.0, 0.5])
    truth = FrameBoxes([0, 0], None, [[11, 20, 30, 40], [70, 0, 90, 20]], ignore=[False, True])
    figure = plotting.show_images(
        {"a": blank(), "b": np.arange(12.0).reshape(3, 4)}, boxes=[found, None], truth=[truth, None]
    )
    first, second = figure.axes
    assert (first.get_title(), second.get_title()) == ("a", "b")
    true, boxes = first.collections
    assert segments(boxes).tolist() == found.boxes.tolist()
    assert segments(true).tolist() == [[11, 20, 30, 40]]  # what is to be ignored is left out
    assert boxes.get_colors()[0][:3] == pytest.approx(SKY)
    assert true.get_colors()[0][:3] == pytest.approx(TRUTH)
    assert not second.collections
    # Half-open pixels are the panel's coordinates.
    assert first.images[0].get_extent() == [0, 160, 90, 0]
    assert second.images[0].get_cmap().name == "gray"


def test_images_stand_in_a_grid_without_empty_panels():
    figure = plotting.show_images([blank()] * 5, columns=2)
    places = [axes.get_subplotspec().get_geometry()[:2] for axes in figure.axes]
    assert places == [(3, 2)] * 5
    assert len(plotting.show_images([blank()] * 4).axes) == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([],), "images must hold at least one of images; got none"),
        ((blank(),), r"images must be a list of images, got an array of shape \(90, 160, 3\)"),
        (([blank() / 255],), r"images\[0\] must be an \(H, W, 3\) uint8 RGB array.*scale a 0-1 float"),
        (([blank()], ["a", "b"]), "titles must be one for each of the 1 images, got 2"),
    ],
)
def test_images_that_cannot_be_shown(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.show_images(*arguments)


def test_boxes_that_do_not_fit_the_images():
    with pytest.raises(InvalidInputError, match="boxes must be one for each of the 2 images, got 1"):
        plotting.show_images([blank()] * 2, boxes=[[]])
    with pytest.raises(InvalidInputError, match=r"boxes\[0\] must be an \(N, 4\) number array"):
        plotting.show_images([blank()], boxes=[[1, 2, 3, 4]])
    with pytest.raises(InvalidInputError, match="columns must be an integer from 1 to 100"):
        plotting.show_images([blank()], columns=0)


def test_methods_stand_side_by_side():
    found = [Detections([[0, 0, 9, 9]], [1.0]), Detections.empty()]
    none = [Detections.empty()] * 2
    figure = plotting.plot_methods(
        {"x": blank(), "y": blank()}, {"count": found, "fitted": none}, truth=[[[1, 1, 8, 8]], None]
    )
    titles = ["x, count: 1 box", "x, fitted: 0 boxes", "y, count: 0 boxes", "y, fitted: 0 boxes"]
    assert texts([axes.title for axes in figure.axes]) == titles
    assert segments(figure.axes[0].collections[1]).tolist() == [[0, 0, 9, 9]]
    assert segments(figure.axes[1].collections[0]).tolist() == [[1, 1, 8, 8]]
    with pytest.raises(InvalidInputError, match=r"methods\['count'\] must be one for each of the 1 images"):
        plotting.plot_methods([blank()], {"count": found})
    with pytest.raises(InvalidInputError, match="methods must map names to a list of Detections, got"):
        plotting.plot_methods([blank()], [found])


# Patches


def test_patches_with_their_class_and_source(patch_set):
    axes = plotting.plot_patches(patch_set, count=8, columns=4, scores=np.arange(40.0), ax=panel())
    rows = spread(40, 8)
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


def test_patches_without_a_set(patch_set):
    axes = plotting.plot_patches(list(patch_set.patches[:3]), captions=["a", "", "c"], ax=panel())
    assert texts(axes.texts) == ["a", "c"]
    assert not axes.collections
    assert axes.get_legend() is None
    labelled = plotting.plot_patches(patch_set.patches[:3], labels=[1, 0, 1], ax=panel())
    assert len(labelled.collections) == 3
    assert legend(labelled) == ["vehicle", "other"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"labels": [1]}, "labels must be one number for each of 40 patches"),
        ({"scores": ["a"] * 40}, "scores must be one number for each of 40 patches"),
        ({"captions": ["a"]}, "captions must be one for each of the 40 patches, got 1"),
        ({"count": 0}, "count must be an integer from 1 to 1000"),
        ({"columns": 0}, "columns must be an integer from 1 to 100"),
    ],
)
def test_patches_with_columns_that_do_not_fit(patch_set, options, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.plot_patches(patch_set, **options)
    with pytest.raises(InvalidInputError, match="patches must hold at least one patch; got none"):
        plotting.plot_patches(patch_set[:0])


def test_the_balance_counts_each_source(patch_set):
    some = patch_set[:30]
    axes = plotting.plot_balance(some, ax=panel())
    assert texts(axes.get_yticklabels()) == ["Far", "Road"]
    widths = [patch.get_width() for patch in axes.patches]
    assert widths == [int(some.labels.sum()), int((~some.labels).sum())]
    assert [to_rgb(patch.get_facecolor()) for patch in axes.patches] == [VEHICLE, OTHER]
    assert legend(axes) == ["vehicles: 20 (66.7%)", "other: 10 (33.3%)"]
    assert axes.get_xlabel() == "patches"
    # One class alone.
    assert legend(plotting.plot_balance(some[some.labels], ax=panel())) == ["vehicles: 20 (100.0%)"]


def test_a_balance_of_nothing(patch_set):
    with pytest.raises(InvalidInputError, match="patch_set must be a PatchSet, got an array"):
        plotting.plot_balance(patch_set.patches)
    with pytest.raises(InvalidInputError, match="patch_set must hold patches, got none"):
        plotting.plot_balance(patch_set[:0])


@pytest.fixture(scope="module")
def copies():
    patches = np.random.default_rng(0).integers(0, 256, (30, 64, 64, 3), np.uint8)
    patches[20:] = patches[:10] // 2
    return PatchSet(patches, [1] * 30, [f"vehicles/drawn/{row}.png" for row in range(30)])


def test_near_duplicates_stand_one_above_the_other(copies):
    pairs = find_near_duplicates(copies)
    axes = plotting.plot_near_duplicates(copies, pairs, count=4, ax=panel())
    assert axes.get_title() == "20 of 30 patches have a near duplicate (66.7%)"
    chosen = pairs[spread(20, 4)]
    for place, row in enumerate([*chosen[:, 0], *chosen[:, 1]]):
        np.testing.assert_array_equal(axes.images[place].get_array(), copies.patches[row])
    assert texts(axes.texts)[:4] == ["drawn"] * 4
    assert all(0.95 <= float(text.removeprefix("r = ")) <= 1 for text in texts(axes.texts)[4:])
    # A second line of pairs that is not full.
    wide = plotting.plot_near_duplicates(copies, pairs, count=13, ax=panel())
    assert len(wide.images) == 40
    assert len(wide.texts) == 26


def test_near_duplicates_across_a_split(copies):
    pairs = find_near_duplicates(copies)
    split = Split(np.arange(20), np.arange(20, 30))
    axes = plotting.plot_near_duplicates(copies, pairs, split=split, ax=panel())
    assert axes.get_title().startswith("10 of 10 tested patches have their nearest copy among the training")
    np.testing.assert_array_equal(axes.images[0].get_array(), copies.patches[20])
    apart = Split(np.arange(10, 20), np.r_[:10, 20:30])
    with pytest.raises(InvalidInputError, match="pairs must hold at least one pair to show; got none"):
        plotting.plot_near_duplicates(copies, pairs, split=apart)
    with pytest.raises(InvalidInputError, match="split must be a Split, got"):
        plotting.plot_near_duplicates(copies, pairs, split=(1, 2))


@pytest.mark.parametrize("pairs", [[1, 2], [[0, 30]], [[-1, 2]], [[0.5, 1.0]]])
def test_pairs_of_another_kind(copies, pairs):
    with pytest.raises(InvalidInputError, match=r"pairs must be \(M, 2\) row numbers of the 30 patches"):
        plotting.plot_near_duplicates(copies, pairs)


# Features


def test_the_channels_of_an_image():
    image = np.zeros((10, 10, 3), np.uint8)
    image[:5] = (255, 0, 0)
    figure = plotting.plot_channels(image, "RGB")
    red = figure.axes[0].patches[0]
    assert red.get_data().values.sum() == pytest.approx(100)
    assert red.get_data().values[[0, 127]].tolist() == [50, 50]
    assert figure.axes[0].get_ylabel() == "share of the pixels (%)"
    points = figure.axes[3].collections[0]
    colors = points.get_facecolors()[:, :3]
    # Each point in its own color.
    np.testing.assert_array_equal(colors[:, 0] * 255, points.get_offsets()[:, 0])
    assert figure.axes[0].get_legend() is None


def test_the_channels_of_two_classes(patch_set):
    figure = plotting.plot_channels(patch_set, "LAB", points=50)
    assert legend(figure.axes[0]) == ["vehicle", "other"]
    assert [axes.get_xlabel() for axes in figure.axes[:3]] == ["L", "a", "b"]
    for axes in figure.axes[:3]:
        assert [stairs.get_data().values.sum() for stairs in axes.patches] == pytest.approx([100, 100])
    assert [len(points.get_offsets()) for points in figure.axes[4].collections] == [50, 50]
    again, other = (
        plotting.plot_channels(patch_set, "LAB", points=50, random_state=seed).axes[4].collections[0]
        for seed in (0, 1)
    )
    offsets = figure.axes[4].collections[0].get_offsets()
    np.testing.assert_array_equal(again.get_offsets(), offsets)
    assert (other.get_offsets() != offsets).any()


@pytest.mark.parametrize(
    ("images", "options", "message"),
    [
        (blank(), {"color_space": "XYZ"}, "color_space must be one of 'RGB', 'HSV'"),
        ([blank()], {"labels": [1, 0]}, "labels must be one number for each of 1 images"),
        ([], {}, "images must hold at least one of images"),
        ([blank()[..., 0]], {}, r"images\[0\] must be an \(H, W, 3\) uint8 RGB array"),
        (blank(), {"points": 0}, "points must be an integer from 1"),
    ],
)
def test_channels_of_what_is_no_image(images, options, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.plot_channels(images, **options)


def test_each_channel_at_each_cell_size():
    patches, _ = render_patches(2, random_state=1)
    figure = plotting.plot_hog({"car": patches[0], "road": patches[1]}, SMALL, pix_per_cell=[8, 16, 32])
    assert len(figure.axes) == 4 * 6
    assert [axes.get_title() for axes in figure.axes[:6]] == [
        "car: Y", "car: Cr", "car: Cb", "road: Y", "road: Cr", "road: Cb",
    ]  # fmt: skip
    assert [figure.axes[row * 6].get_ylabel() for row in (1, 2, 3)] == [
        "8 px cells", "16 px cells", "32 px cells",
    ]  # fmt: skip
    for axes in figure.axes[6:]:
        assert len(axes.collections) == 1
        assert (*axes.get_xlim(), *axes.get_ylim()) == (0, 64, 64, 0)
    gray = plotting.plot_hog(patches[0], FeatureParams(hog_channel="GRAY"), pix_per_cell=[8])
    assert [axes.get_title() for axes in gray.axes] == ["gray", ""]
    single = plotting.plot_hog([patches[0]], FeatureParams(hog_channel=2), titles=["x"], pix_per_cell=[8])
    assert single.axes[0].get_title() == "x: Cb"


@pytest.mark.parametrize(
    ("ahead", "slope"),
    [((0, 1), (0, 1)), ((1, 0), (1, 0)), ((1, -1), (1, 1)), ((1, 1), (1, -1))],
)
def test_a_glyph_lies_along_the_edge(ahead, slope):
    """Dark on one side of a line through the middle, bright ahead of it (rows, columns)."""
    rows, columns = np.mgrid[-32:32, -32:32] + 0.5
    bright = rows * ahead[0] + columns * ahead[1] > 0
    image = np.repeat((bright * 200).astype(np.uint8)[..., None], 3, axis=2)
    params = FeatureParams(hog_channel="GRAY", orient=18, cell_per_block=2)
    lines = plotting.plot_hog(image, params, pix_per_cell=[16]).axes[1].collections[0]
    start, stop = lines.get_segments()[int(lines.get_array().argmax())]
    along = (stop - start) / np.linalg.norm(stop - start)
    # Slope in rows and columns, of either sign; a bin is 10 degrees wide.
    expected = np.array(slope) if ahead[0] and ahead[1] else np.array(ahead)
    expected = expected / np.linalg.norm(expected)
    assert abs(along @ expected) == pytest.approx(1, abs=0.02)
    # scikit-image's picture has its brightest pixels along the same line.
    picture = hog_image(image[..., 0], 18, 16)
    y, x = np.nonzero(picture[16:48, 16:48] > 0.8 * picture.max())
    if ahead[0] and ahead[1]:
        assert np.sign(np.corrcoef(x, y)[0, 1]) == np.sign(along[0] * along[1])


def test_hog_of_what_is_too_small():
    with pytest.raises(InvalidInputError, match="img must be at least one block large"):
        plotting.plot_hog(blank(30, 30), pix_per_cell=[16])
    with pytest.raises(InvalidInputError, match="pix_per_cell must be an integer at least 2"):
        plotting.plot_hog(blank(), pix_per_cell=[1])
    with pytest.raises(InvalidInputError, match="titles must be one for each of the 1 images, got 2"):
        plotting.plot_hog(blank(), titles=["a", "b"])


@settings(max_examples=25)
@given(
    blocks=st.tuples(st.integers(1, 5), st.integers(1, 5), st.integers(1, 3), st.integers(1, 4)).flatmap(
        lambda n: hnp.arrays(np.float64, (n[0], n[1], n[2], n[2], n[3]), elements=st.floats(-9, 9))
    )
)
def test_cells_hold_what_their_blocks_hold(blocks):
    sums, counts = sum_blocks(blocks)
    side = blocks.shape[2]
    assert sums.shape == (blocks.shape[0] + side - 1, blocks.shape[1] + side - 1, blocks.shape[4])
    assert sums.sum() == pytest.approx(blocks.sum(), abs=1e-9)
    assert counts.sum() == blocks.shape[0] * blocks.shape[1] * side**2
    assert counts.min() >= 1


def test_glyphs_of_nothing():
    axes = panel()
    assert not len(put_glyphs(axes, np.zeros((2, 3, 9))).get_segments())
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, 3), (2, 0))


def test_the_vector_before_and_after_scaling(patch_set):
    classifier = random_classifier(SMALL)
    figure = plotting.plot_features(patch_set, classifier, rows=[3, 30], names=["car", "road"])
    above, below = figure.axes
    raw = extract_features(patch_set.patches[[3, 30]], SMALL)
    template = classifier.templates[0]
    for line, scaled, values in zip(above.lines, below.lines, raw):
        np.testing.assert_array_equal(line.get_ydata(), values)
        np.testing.assert_allclose(scaled.get_ydata(), (values - template.mean) / template.scale)
    assert legend(above) == ["car", "road"]
    parts = ["spatial bins (192)", "color histogram (24)", "HOG (648)"]
    assert texts(above.texts) == parts
    assert below.get_ylabel() == "value (standard deviations)"


def test_without_a_classifier_the_patches_themselves_are_the_scale(patch_set):
    rows = range(len(patch_set))
    figure = plotting.plot_features(patch_set, SMALL, rows=rows)
    scaled = np.array([line.get_ydata() for line in figure.axes[1].lines])
    np.testing.assert_allclose(scaled.mean(axis=0), 0, atol=1e-6)
    deviation = scaled.std(axis=0)
    assert np.allclose(deviation[deviation > 0], 1)
    assert figure.axes[0].get_legend() is None
    # A part that is switched off has no shade.
    params = FeatureParams(spatial_feat=False, hist_feat=False)
    assert len(plotting.plot_features(patch_set, params).axes[0].texts) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rows": [40]}, "rows must be an integer from 0 to 39; got 40"),
        ({"rows": []}, "rows must hold at least one of row numbers"),
        ({"names": ["a", "b"]}, "names must be one for each of the 1 rows, got 2"),
        ({"template": 1}, "template must be an integer from 0 to 0"),
    ],
)
def test_features_of_rows_that_do_not_exist(patch_set, options, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.plot_features(patch_set, random_classifier(SMALL), **options)


def test_features_by_neither_model_nor_parameters(patch_set):
    with pytest.raises(
        InvalidInputError, match="model must be a VehicleClassifier or FeatureParams, got 'm'"
    ):
        plotting.plot_features(patch_set, "m")


# Training


def test_weights_lie_where_they_belong():
    classifier = random_classifier(SMALL)
    coef = classifier.templates[0].coef
    figure = plotting.plot_weights(classifier)
    grid = np.array(figure.axes[:15]).reshape(3, 5)
    assert [axes.get_title() for axes in grid[0]] == [
        "HOG for a vehicle", "HOG against", "spatial bins", "histogram", "in color",
    ]  # fmt: skip
    for channel, row in enumerate(grid):
        np.testing.assert_array_equal(
            row[2].images[0].get_array().ravel(), coef[channel * 64 : (channel + 1) * 64]
        )
        start = 192 + 8 * channel
        np.testing.assert_array_equal(row[3].patches[0].get_data().values, coef[start : start + 8])
        # Every orientation of every cell speaks either for a vehicle or against it.
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


def test_weights_of_what_is_no_classifier():
    with pytest.raises(InvalidInputError, match="classifier must be a VehicleClassifier, got 'm'"):
        plotting.plot_weights("m")
    with pytest.raises(InvalidInputError, match="template must be an integer from 0 to 0; got 1"):
        plotting.plot_weights(random_classifier(SMALL), template=1)


def test_scores_of_both_classes():
    scores, labels = [2.0, 1.0, -0.25, 0.0, -1.0, 0.5], [1, 1, 1, 1, 0, 0]
    axes = plotting.plot_scores(scores, labels, bins=12, ax=panel())
    assert legend(axes) == [
        "vehicles: 2 of 4 missed", "other: 1 of 2 taken for vehicles", "threshold 0",
    ]  # fmt: skip
    assert axes.get_yscale() == "log"
    assert axes.get_xlabel() == "score (decision value)"
    assert axes.lines[0].get_xdata() == [0, 0]
    strict = plotting.plot_scores(scores, labels, threshold=1.5, ax=panel())
    assert legend(strict)[:2] == ["vehicles: 3 of 4 missed", "other: 0 of 2 taken for vehicles"]


@settings(max_examples=30)
@given(
    scores=st.lists(st.floats(-50, 50), min_size=1, max_size=30),
    threshold=st.floats(-60, 60),
    bins=st.integers(1, 80),
)
def test_every_score_is_in_a_bin_and_the_threshold_between_two(scores, threshold, bins):
    axes = plotting.plot_scores(
        scores, [index % 2 for index in range(len(scores))], threshold=threshold, bins=bins, ax=panel()
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
def test_scores_of_another_kind(scores, labels, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.plot_scores(scores, labels)


def test_splits_show_both_kinds_of_mistakes(patch_set):
    _, report = train_and_evaluate(patch_set, params=SMALL, seeds=2, n_jobs=1)
    axes = plotting.plot_split_scores(report, ax=panel())
    shares = [100 * score.false_negative_rate for score in report.splits.values()]
    shares += [100 * score.false_positive_rate for score in report.splits.values()]
    assert [bar.get_width() for bar in axes.patches] == pytest.approx(shares)
    assert len(axes.get_yticklabels()) == len(report.splits)
    assert f"accuracy {report.accuracy:.4f}" in axes.get_yticklabels()[0].get_text()
    with pytest.raises(InvalidInputError, match="report must be a TrainingReport, got None"):
        plotting.plot_split_scores(None)


# Search


def test_windows_lie_by_their_scores():
    found = Detections([[0, 0, 64, 64], [8, 0, 72, 64], [16, 0, 80, 64]], [1.5, -0.5, 0.5])
    axes = plotting.plot_windows(blank(), found, truth=[[1, 1, 60, 60]], ax=panel())
    lines, true = axes.collections
    assert lines.get_array().tolist() == [-0.5, 0.5, 1.5]
    assert segments(lines).tolist() == found.boxes[[1, 2, 0]].tolist()
    assert segments(true).tolist() == [[1, 1, 60, 60]]
    assert (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) == ("3 windows", "x (px)", "y (px)")
    assert axes.figure.axes[1].get_ylabel() == "score"
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, 160), (90, 0))


def test_windows_without_scores_and_beyond_the_frame():
    axes = plotting.plot_windows(blank(), np.array([[-32, 10, 32, 74], [130, 40, 194, 104]]), ax=panel())
    assert len(axes.figure.axes) == 1
    assert axes.collections[0].get_array() is None
    assert (axes.get_xlim(), axes.get_ylim()) == ((-32, 194), (104, 0))
    one = plotting.plot_windows(blank(), [[0, 0, 9, 9]], ax=panel())
    assert one.get_title() == "1 window"
    none = plotting.plot_windows(blank(), Detections.empty(), title="nothing", ax=panel())
    assert none.get_title() == "nothing"
    with pytest.raises(InvalidInputError, match=r"windows must be an \(N, 4\) number array"):
        plotting.plot_windows(blank(), [1, 2, 3, 4])
    with pytest.raises(InvalidInputError, match=r"truth must be \[x1, y1, x2, y2\] with x1 <= x2"):
        plotting.plot_windows(blank(), [], truth=[[5, 0, 1, 1]])


@pytest.mark.parametrize("preset", ["130-windows", "three-scales", "default"])
def test_bands_begin_and_end_where_they_are_searched(preset):
    frame, search = blank(720, 1280), SearchParams.preset(preset)
    figure = plotting.plot_bands(frame, search)
    bands = search.place(frame.shape)
    assert len(figure.axes) == len(bands)
    total = 0
    for axes, band in zip(figure.axes, bands):
        windows = band_windows(band)
        total += len(windows)
        bound, nexts, first = axes.collections
        assert segments(bound).tolist() == [[band.x1, band.y1, band.x2, band.y2]]
        assert segments(first).tolist() == windows[:1].tolist()
        for window in segments(nexts):
            assert (windows == window).all(axis=1).any()
            assert np.abs(window - windows[0]).max() in band.step
        assert f"{len(windows):,} windows" in axes.get_title()
        assert axes.lines[0].get_ydata() == [search.horizon * 720] * 2
    if preset == "130-windows":
        assert total == 114  # what the course's own slide_window lists
    assert texts(figure.legends[0].get_texts())[:2] == ["outer bound", "first window"]
    colors = [lines.get_colors()[0][:3] for lines in figure.axes[0].collections]
    assert colors == [pytest.approx(color) for color in (YELLOW, SKY, VERMILION)]


def test_a_band_with_one_window():
    search = SearchParams(bands=(SearchBand(window=(640, 640), y=(-320, 320)),), horizon=0.5)
    figure = plotting.plot_bands(blank(360, 360), search)
    assert len(figure.axes[0].collections[1].get_segments()) == 1  # to the right only
    with pytest.raises(InvalidInputError, match="image of 160x10 pixels holds no search window"):
        plotting.plot_bands(blank(10))
    with pytest.raises(InvalidInputError, match="search must be a SearchParams, got 'default'"):
        plotting.plot_bands(blank(), "default")


def test_the_fast_search_beside_the_reference():
    reference = np.linspace(-3, 2, 50)
    fast = reference + np.where(np.arange(50) == 7, -3e-6, 1e-6)
    figure = plotting.plot_comparison(fast, reference)
    left, right = figure.axes
    np.testing.assert_allclose(left.collections[0].get_offsets(), np.stack([reference, fast], axis=1))
    assert right.get_title() == "greatest difference 3e-06"
    assert sum(bar.get_height() for bar in right.patches) == 50
    assert plotting.plot_comparison([1.0], [1.0]).axes[1].get_title() == "greatest difference 0"
    with pytest.raises(InvalidInputError, match="fast and reference must be scores of the same windows; got"):
        plotting.plot_comparison([1.0], [1.0, 2.0])
    with pytest.raises(InvalidInputError, match="reference must be a list of finite scores"):
        plotting.plot_comparison([1.0], [np.inf])


def test_speedups_against_the_slowest_or_another():
    times = {"a": 2.0, "b": 0.5, "c": 0.002}
    axes = plotting.plot_speedups(times, ax=panel())
    assert texts(axes.texts) == ["2,000 ms", "500 ms, 4.0x faster", "2 ms, 1,000x faster"]
    assert [bar.get_width() for bar in axes.patches] == [2000, 500, 2]
    assert (axes.get_xscale(), axes.get_xlabel()) == ("log", "time (ms)")
    other = plotting.plot_speedups(times, reference="b", ax=panel())
    assert texts(other.texts) == ["2,000 ms, 4.0x slower", "500 ms", "2 ms, 250x faster"]
    for bad, message in (
        ({}, "seconds must map names to seconds, at least one"),
        ({"a": 0}, r"seconds\['a'\] must be a number, greater than 0"),
        ([1.0], "seconds must map names to seconds"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            plotting.plot_speedups(bad)
    with pytest.raises(InvalidInputError, match="reference must be one of a, b, c; got 'd'"):
        plotting.plot_speedups(times, reference="d")


# Heat


def test_the_heat_map_and_what_it_becomes():
    windows = Detections([[10, 10, 50, 50], [20, 10, 60, 50], [100, 20, 140, 60]], [1.5, 1.0, 3.0])
    params = HeatParams(threshold=1.0, peak_fraction=0.2)
    figure = plotting.plot_heatmap(blank(), windows, params=params)
    first, second, third, bar = figure.axes
    assert segments(first.collections[0]).tolist() == windows.boxes.tolist()
    np.testing.assert_array_equal(second.images[0].get_array(), frame_heat((90, 160), windows, params))
    expected = bounding_boxes((90, 160), windows, params=params)
    assert segments(third.collections[0]).tolist() == expected.boxes.tolist()
    assert third.get_title() == "2 regions above 1"
    assert bar.get_ylabel() == "sum of scores"
    painted = third.images[0].get_array()
    gray = painted[0, 0]
    inside = (painted[30, 40], painted[40, 120])
    assert not (inside[0] == gray).all()
    assert not (inside[0] == inside[1]).all()  # each region in a color of its own
    assert (painted[30, 90] == gray).all()


def test_a_heat_map_of_the_last_frames():
    heat = np.zeros((90, 160), np.float32)
    heat[10:20, 30:60] = 5
    figure = plotting.plot_heatmap(
        blank(), Detections.empty(), params=HeatParams(weighting="count"), heat=heat
    )
    assert segments(figure.axes[2].collections[0]).tolist() == [[30, 10, 60, 20]]
    assert [axes.get_title() for axes in figure.axes[:3]] == [
        "0 windows",
        "heat, peak 5.0",
        "1 region above 2",
    ]
    assert figure.axes[3].get_ylabel() == "windows"
    # Nothing at all.
    assert plotting.plot_heatmap(blank(), Detections.empty()).axes[2].get_title() == "0 regions above 2"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"windows": [[0, 0, 1, 1]]}, "windows must be a Detections, got"),
        ({"heat": np.zeros((5, 5))}, r"heat must be an array of the frame's size \(90, 160\)"),
        ({"params": "hot"}, "params must be a HeatParams, got 'hot'"),
        ({"image": "a.png"}, r"image must be an \(H, W, 3\) uint8 RGB array"),
    ],
)
def test_heat_of_another_kind(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.plot_heatmap(**{"image": blank(), "windows": Detections.empty(), **arguments})


# Tracks and times


def track(number, x, **changes):
    known = {
        "id": number, "box": np.array([x, 40.0, x + 50, 80.0]), "score": 1.0, "state": "confirmed",
        "shown": True, "age": 1.0, "misses": 0, "time_since_update": 0.0, "velocity": (0.0, 0.0),
        "distance_m": 20.0 + x, "distance_std_m": 2.0, "speed_mps": 3.0, "speed_std_mps": 0.5,
    }  # fmt: skip
    return Track(**{**known, **changes})


def result(index, *tracks, time=None, seconds=None):
    return FrameResult(index, time, Detections.empty(), Detections.empty(), tracks, seconds or {})


def test_tracks_over_time():
    results = [
        result(0, track(1, 10.0), track(0, 90.0, shown=False, state="tentative")),
        result(1, track(1, 12.0), track(9, 100.0, distance_m=None, distance_std_m=None)),
        result(2, track(9, 101.0)),
        result(3, track(1, 16.0), track(9, 102.0)),
    ]
    figure = plotting.plot_tracks(results, fps=10)
    assert [axes.get_ylabel().split("(")[-1] for axes in figure.axes] == ["px)", "px)", "m)", "m/s)"]
    assert figure.axes[-1].get_xlabel() == "time (s)"
    assert texts(figure.legends[0].get_texts()) == ["#1", "#9"]
    middle, other = figure.axes[0].lines
    # The line breaks where the track was not there.
    np.testing.assert_allclose(middle.get_ydata(), [35, 37, np.nan, 41])
    np.testing.assert_allclose(middle.get_xdata(), [0, 0.1, 0.2, 0.3])
    assert to_rgb(middle.get_color()) == COLORS[0]
    assert to_rgb(other.get_color()) == COLORS[1]
    assert (middle.get_linestyle(), other.get_linestyle()) == ("-", "--")
    np.testing.assert_allclose(figure.axes[2].lines[1].get_ydata(), [np.nan, 121, 122])
    band = figure.axes[2].collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == (28, 34)  # one standard error; the last point stands alone


def test_tracks_with_times_of_their_own_and_least_length():
    results = [result(0, track(1, 10.0), track(2, 50.0), time=3.0), result(1, track(1, 11.0), time=3.5)]
    figure = plotting.plot_tracks(results, least=2)
    assert len(figure.axes[0].lines) == 1
    assert figure.axes[0].lines[0].get_xdata().tolist() == [3.0, 3.5]


def test_tracks_of_a_file_and_the_truth_of_a_drive():
    drive = render_drive(frames=30, shape=(180, 320), scenario="overtaking", random_state=3)
    rows = [(frame, row) for frame, rows in enumerate(drive.truth) for row in rows if not row.ignore]
    labels = FrameBoxes(
        [frame for frame, _ in rows],
        np.array([row.track for _, row in rows]),
        np.array([row.box for _, row in rows]),
        distance_m=np.array([row.distance_m for _, row in rows]),
    )
    figure = plotting.plot_tracks(labels, truth=drive.truth)
    count = len(set(labels.tracks.tolist()))
    assert len(figure.axes[0].lines) == 2 * count
    found, true = figure.axes[2].lines[0], figure.axes[2].lines[count]
    shown = ~np.isnan(found.get_ydata())
    np.testing.assert_allclose(found.get_ydata()[shown], true.get_ydata())
    assert true.get_color() == "k"
    assert texts(figure.legends[0].get_texts())[-1] == "truth"
    assert not figure.axes[2].collections  # a file tells no errors
    ignored = FrameBoxes([0, 1], [1, 2], [[0, 0, 9, 9]] * 2, ignore=[False, True])
    both = plotting.plot_tracks(labels, truth=ignored)
    assert len(both.axes[0].lines) == count + 1


@pytest.mark.parametrize(
    ("results", "options", "message"),
    [
        ([], {}, "results must hold at least one track to draw; got none"),
        ([result(0, track(1, 1.0, shown=False))], {}, "results must hold at least one track to draw"),
        ([3], {}, r"results must be a FrameResult, got 3 \(int\)"),
        (3, {}, "results must be the FrameResult of each frame, or Labels; got 3"),
        (FrameBoxes(["a"], [1], [[0, 0, 9, 9]]), {}, "results must number its frames, got names such as 'a'"),
        (
            [result(0, track(1, 1.0))],
            {"truth": "t.csv"},
            "truth must be Labels or the truth of a drawn drive",
        ),
        ([result(0, track(1, 1.0))], {"fps": 0}, "fps must be a number, greater than 0"),
    ],
)
def test_tracks_that_cannot_be_drawn(results, options, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.plot_tracks(results, **options)


REPORT = VideoReport(
    frames=100, fps=Fraction(25), shape=(720, 1280, 3), seconds=2.0,
    stages={"encode": 1.0, "decode": 0.5, "search": 0.75}, tracks=1,
)  # fmt: skip


def test_stage_times_of_a_video_and_of_stills():
    stills = [result(index, seconds={"search": 0.01, "track": 0.002 * index}) for index in range(2)]
    axes = plotting.plot_stage_times({"video": REPORT, "stills": stills}, ax=panel())
    # In the order of the work.
    assert legend(axes) == ["decode", "search", "track", "encode"]
    widths = np.array([bar.get_width() for bar in axes.patches]).reshape(4, 2)
    np.testing.assert_allclose(widths, [[5, 0], [7.5, 10], [0, 1], [10, 0]])
    starts = np.array([bar.get_x() for bar in axes.patches]).reshape(4, 2)
    np.testing.assert_allclose(starts, np.cumsum(widths, axis=0) - widths, atol=1e-9)
    assert texts(axes.get_yticklabels()) == ["video", "stills"]
    assert {"  22.5 ms", "  11.0 ms"} <= set(texts(axes.texts))
    assert axes.get_xlabel() == "work (ms a frame)"
    assert texts(plotting.plot_stage_times(REPORT, ax=panel()).get_yticklabels()) == [""]


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ({}, "runs must hold at least one run; got none"),
        ([], "runs must have at least one frame each"),
        ("fast", "runs must be a VideoReport or a list of FrameResult"),
        ({"a": [1]}, "runs must be a VideoReport or a list of FrameResult"),
    ],
)
def test_runs_of_another_kind(runs, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.plot_stage_times(runs)


# Quality


def labelled():
    """Three frames: one vehicle found, one missed, one false alarm, one detection in an ignored region."""
    image = np.random.default_rng(0).integers(0, 256, (120, 200, 3), np.uint8)
    labels = FrameBoxes(
        ["a.png", "a.png", "b.png", "b.png"],
        None,
        [[10, 10, 60, 50], [100, 10, 130, 40], [20, 20, 110, 100], [150, 0, 200, 60]],
        ignore=[False, False, False, True],
    )
    found = FrameBoxes(
        ["a.png", "b.png", "b.png", "c.png"],
        None,
        [[11, 10, 60, 50], [160, 5, 190, 50], [60, 60, 110, 100], [5, 5, 45, 45]],
        scores=[2.0, 3.0, 0.5, 1.0],
    )
    return LabelledFrames("road", dict.fromkeys(("a.png", "b.png", "c.png"), image), labels), found


def test_missed_vehicles_the_largest_first():
    frames, found = labelled()
    scores = evaluate_detections(found, frames.labels)
    axes = plotting.plot_errors(frames, found, ax=panel())
    assert (
        axes.get_title()
        == f"{scores.fn} of {scores.tp + scores.fn} vehicles missed"
        == "2 of 3 vehicles missed"
    )
    assert texts(axes.texts) == ["b\n90x80 px, IoU 0.28", "a\n30x30 px, IoU 0.00"]
    assert len(axes.images) == 2
    assert legend(axes) == ["labelled", "detected"]
    crop = axes.images[1].get_array()
    np.testing.assert_array_equal(crop, frames.frames["a.png"][0:52, 88:142][: crop.shape[0]])


def test_false_alarms_the_surest_first():
    frames, found = labelled()
    axes = plotting.plot_errors(frames, found, kind="false", ax=panel())
    assert axes.get_title() == "2 of 4 detections are no vehicle"
    assert texts(axes.texts) == ["c\nscore 1.00, 40x40 px", "b\nscore 0.50, 50x40 px"]
    reds = [
        lines for lines in axes.collections if tuple(lines.get_colors()[0][:3]) == pytest.approx(VERMILION)
    ]
    assert len(reds) == 2
    one = plotting.plot_errors(frames, found, kind="false", count=1, ax=panel())
    assert len(one.images) == 1


def test_boxes_of_a_crop_lie_where_they_lie_in_the_frame():
    frames, found = labelled()
    axes = plotting.plot_errors(frames, found, kind="false", count=1, ax=panel())
    left, right, bottom, top = axes.images[0].get_extent()
    height, width = axes.images[0].get_array().shape[:2]
    x1, y1, x2, y2 = segments(axes.collections[-1])[0]
    pixel = (right - left) / width
    assert (bottom - top) / height == pytest.approx(pixel)
    # The crop begins at the frame's corner.
    assert np.array([x1 - left, y1 - top, x2 - left, y2 - top]) / pixel == pytest.approx([5, 5, 45, 45])


def test_no_mistakes_at_all(tmp_path):
    write_image(tmp_path / "a.png", blank())
    truth = FrameBoxes(["a.png"], None, [[10, 10, 60, 50]])
    frames = LabelledFrames("road", load_frames(tmp_path), truth)
    perfect = FrameBoxes(["a.png"], None, truth.boxes, scores=[1.0])
    axes = plotting.plot_errors(frames, perfect, ax=panel())
    assert (axes.get_title(), len(axes.images)) == ("0 of 1 vehicles missed", 0)
    assert plotting.plot_errors(frames, perfect, kind="false", ax=panel()).get_title().startswith("0 of 1")
    nothing = FrameBoxes([], None, [], scores=[])
    assert len(plotting.plot_errors(frames, nothing, ax=panel()).images) == 1  # read from the folder


def test_errors_of_another_kind():
    frames, found = labelled()
    with pytest.raises(InvalidInputError, match="kind must be one of 'missed', 'false'; got 'wrong'"):
        plotting.plot_errors(frames, found, kind="wrong")
    with pytest.raises(InvalidInputError, match="frames must be a LabelledFrames, got"):
        plotting.plot_errors([blank()], found)
    with pytest.raises(InvalidInputError, match="predictions must be Labels, got"):
        plotting.plot_errors(frames, Detections.empty())
    with pytest.raises(InvalidInputError, match=r"predictions hold frame 'x.png', which is not among the 3"):
        plotting.plot_errors(frames, found.renamed(lambda name: name.replace("c", "x")))


def test_precision_and_recall():
    frames, found = labelled()
    curve = precision_recall_curve(found, frames.labels)
    axes = plotting.plot_precision_recall({"road": curve, "again": curve}, threshold=0.9, ax=panel())
    lines = {line.get_label(): line for line in axes.lines}
    precision, recall, thresholds = curve
    name = next(label for label in lines if label.startswith("road"))
    np.testing.assert_array_equal(lines[name].get_xydata(), np.stack([recall, precision], axis=1))
    f1 = 2 * precision * recall / (precision + recall)
    assert name == f"road: best F1 {f1.max():.2f} at {thresholds[f1.argmax()]:.2f}"
    used = np.flatnonzero(thresholds > 0.9)[-1]
    squares = [line.get_xydata()[0].tolist() for line in axes.lines if line.get_marker() == "s"]
    assert squares == [[recall[used], precision[used]]] * 2
    assert axes.get_xlabel().startswith("recall")
    alone = plotting.plot_precision_recall(curve, ax=panel())
    assert legend(alone)[0].startswith("best F1")


@pytest.mark.parametrize(
    ("curves", "message"),
    [
        ({}, "curves must hold at least one curve; got none"),
        ({"a": (1, 2)}, r"curves\['a'\] must be \(precision, recall, thresholds\), got"),
        ((np.ones(2), np.ones(3), np.ones(2)), r"curves must be \(precision, recall, thresholds\)"),
        ({"a": (np.ones(0),) * 3}, r"curves\['a'\] must hold detections and labelled vehicles"),
        ((np.ones(1), np.full(1, np.nan), np.ones(1)), "curves must hold detections and labelled vehicles"),
    ],
)
def test_curves_of_another_kind(curves, message):
    with pytest.raises(InvalidInputError, match=message):
        plotting.plot_precision_recall(curves)


def test_quality_by_source_and_detector():
    frames, found = labelled()
    some = evaluate_detections(found, frames.labels)
    best = evaluate_detections(frames.labels, frames.labels)
    axes = plotting.plot_f1({"x": some, "y": best}, ax=panel())
    assert [bar.get_height() for bar in axes.patches] == [some.f1, best.f1]
    assert texts(axes.get_xticklabels()) == ["x", "y"]
    assert axes.get_legend() is None
    nested = plotting.plot_f1(
        {"old": {"x": some}, "new": {"x": best, "y": best}}, metric="recall", ax=panel()
    )
    assert legend(nested) == ["old", "new"]
    heights = np.array([bar.get_height() for bar in nested.patches])
    np.testing.assert_array_equal(heights, [some.recall, np.nan, 1, 1])
    assert nested.get_ylabel() == "recall"
    with pytest.raises(InvalidInputError, match="metric must be one of 'f1', 'precision'"):
        plotting.plot_f1({"x": some}, metric="accuracy")
    with pytest.raises(InvalidInputError, match=r"scores\['x'\] must be a DetectionScores, got 0.5"):
        plotting.plot_f1({"x": 0.5})
    with pytest.raises(InvalidInputError, match="scores must map sources to DetectionScores, got"):
        plotting.plot_f1([some])
    with pytest.raises(InvalidInputError, match="scores must hold at least one source"):
        plotting.plot_f1({"old": {}})


# Tuning


def rows(**columns):
    return ResultTable([dict(zip(columns, values)) for values in zip(*columns.values())])


def test_the_tradeoff_marks_the_front():
    table = rows(configuration=["a", "b", "c"], accuracy=[0.97, 0.96, 0.99], search_ms=[4, 5, 9])
    axes = plotting.plot_tradeoff(table, ax=panel())
    assert axes.lines[0].get_xydata().tolist() == [[4, 0.97], [9, 0.99]]
    assert texts(axes.texts) == ["a", "c"]


def test_what_a_parameter_does():
    table = rows(C=[1e-4, 1e-4, 1.0, None], split=["x"] * 4, accuracy=[0.9, 1.0, 0.8, 0.1])
    axes = plotting.plot_parameter(table, "C", by="split", ax=panel())
    line = axes.lines[0]
    np.testing.assert_allclose(line.get_xydata(), [[1e-4, 0.95], [1.0, 0.8]])
    (bars,) = axes.containers
    several, single = bars[2][0].get_segments()
    assert np.ptp(several[:, 1]) / 2 == pytest.approx(np.std([0.9, 1.0], ddof=1))
    assert not len(single)  # a single run tells no deviation
    assert (axes.get_xscale(), axes.get_xlabel(), axes.get_ylabel()) == ("log", "C", "accuracy")
    assert legend(axes) == ["x"]


def test_a_parameter_of_words_and_one_of_few_numbers():
    table = rows(color_space=["LUV", "YCrCb", "LUV"], orient=[8, 9, 9], frame_f1=[0.5, 0.75, 0.7])
    words = plotting.plot_parameter(table, "color_space", quality="frame_f1", ax=panel())
    assert texts(words.get_xticklabels()) == ["LUV", "YCrCb"]
    np.testing.assert_allclose(words.lines[0].get_xydata(), [[0, 0.6], [1, 0.75]])
    assert words.get_legend() is None
    assert words.get_ylabel() == "frame f1"
    assert plotting.plot_parameter(table, "orient", quality="frame_f1", ax=panel()).get_xscale() == "linear"
    with pytest.raises(InvalidInputError, match="column 'gamma' is none of the table's"):
        plotting.plot_parameter(table, "gamma", quality="frame_f1")
    with pytest.raises(InvalidInputError, match="table has no row with both C and accuracy"):
        plotting.plot_parameter(rows(C=[1.0], accuracy=[None]), "C")


def test_tables_from_json_are_drawn_too():
    table = ResultTable(json.loads('[{"C": 1, "accuracy": 0.5}, {"C": "ALL", "accuracy": 0.6}]'))
    assert texts(plotting.plot_parameter(table, "C", ax=panel()).get_xticklabels()) == ["1", "ALL"]


@pytest.mark.realdata
def test_the_frames_of_the_course(real_data):
    from vehicle_detection.classifier import load_classifier
    from vehicle_detection.images import read_image
    from vehicle_detection.search import find_cars

    image = read_image(real_data / "test_images" / "test1.jpg")
    windows = find_cars(image, load_classifier(), n_jobs=1)
    figure = plotting.plot_heatmap(image, windows)
    assert len(figure.axes[2].collections[0].get_segments()) >= 2
    axes = plotting.plot_windows(image, windows, ax=panel())
    assert len(axes.collections[0].get_array()) == len(windows)


def test_many_lines_stay_apart():
    table = rows(C=[1.0] * 9, seed=list(range(9)), accuracy=[0.9] * 9)
    axes = plotting.plot_parameter(table, "C", by="seed", ax=panel())
    looks = {(str(line[0].get_color()), line[0].get_linestyle()) for line in axes.containers}
    assert len(looks) == 9
