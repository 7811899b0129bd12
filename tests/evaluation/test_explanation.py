"""Explanations of scores: shares of cells and other terms."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.network.graphs import constant_network, spot_network
from vehicle_detection import (
    Annotator,
    FeatureParams,
    NetworkParams,
    VehicleDetector,
    explain,
    render_scene,
    write_image,
)
from vehicle_detection.drive import explain_tracks
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation.explanation import Explanation, patch_cell_shares
from vehicle_detection.features import part_slices
from vehicle_detection.function_model import FunctionModel
from vehicle_detection.scenes import SceneVehicle
from vehicle_detection.tables import TrackTable

CARS = [SceneVehicle(distance_m=14.0, kind="sedan"), SceneVehicle(distance_m=9.0, lateral_m=4.2, kind="suv")]
SCENE = render_scene(shape=(360, 640), vehicles=CARS, lane=1, random_state=1)

NO_MODEL = FunctionModel(function=lambda image: ([], []), score="probability")


@pytest.fixture(scope="module")
def detector():
    with VehicleDetector() as found:
        yield found


def test_each_found_vehicle_is_explained(detector):
    found = detector.detect(SCENE.image)
    assert len(found) == 2
    for box, score in zip(found.boxes, found.scores):
        explanation = explain(detector, SCENE.image, box)
        assert explanation.found
        assert (explanation.box == box).all()
        assert explanation.margin == pytest.approx(score) == explanation.score
        assert list(explanation.terms) == ["cells", "rest"]
        assert explanation.terms["cells"] == pytest.approx(explanation.cells.sum())
        assert explanation.cells.shape == (6, 6)
        assert explanation.cells.max() > 0
        assert f"score {score:.2f}: margin {score:.2f}" in str(explanation)
        assert explanation.describe().startswith("A vehicle is found here: the ")


def test_a_box_without_a_vehicle_is_explained_too(detector):
    explanation = explain(detector, SCENE.image, [60, 230, 130, 290])
    assert not explanation.found
    assert explanation.score is None
    assert explanation.margin < 0
    assert str(explanation).startswith("not found: margin -")
    assert explanation.describe().startswith("No vehicle is found here")


@pytest.mark.parametrize(
    ("cells", "text"),
    [
        (np.pad(np.ones((2, 2)), 2), "the center speaks for it"),
        (np.pad(-np.ones((2, 2)), ((4, 0), (0, 4))), "the lower left speaks against it"),
        (np.pad([[2.0, -1.0]], ((2, 0), (0, 1))), "the lower middle speaks against it"),
        (np.zeros((6, 6)), "no part stands out"),
    ],
)
def test_words_name_the_parts_that_matter(cells, text):
    box = np.array([0.0, 0, 60, 60])
    assert Explanation(box, True, box, np.asarray(cells, float), {}, 1.0).describe().endswith(f"{text}.")


@pytest.fixture(scope="module")
def spots(tmp_path_factory):
    """A detector of spots that are brighter than the gray of the network's padding."""
    path = tmp_path_factory.mktemp("spots") / "spots.onnx"
    path.write_bytes(spot_network())
    with VehicleDetector(path, search_params=NetworkParams(input_size=640)) as found:
        yield found


@pytest.mark.parametrize("shape", [(352, 640), (704, 1280), (700, 400)])
def test_the_cells_of_a_network_lie_where_it_looks(spots, shape):
    # The network looks at 32x32 pixels of its input, and says that they are the middle of a box of 64x64.
    scale = max(shape) / 640
    image = np.full((*shape, 3), 115, np.uint8)
    x, y, side = (round(each * scale) for each in (160, 192, 32))
    image[y : y + side, x : x + side] = 255
    (box,) = spots.detect(image).boxes
    np.testing.assert_allclose(box, np.array([144, 176, 208, 240]) * scale, atol=3 * scale)
    explanation = explain(spots, image, box)
    middle = explanation.cells[1:5, 1:5].sum()
    assert middle > 3
    assert np.abs(explanation.cells).sum() == pytest.approx(middle, abs=0.01)


def test_a_network_of_a_fixed_size_is_explained(tmp_path):
    boxes = np.zeros((1, 5, 189), np.float32)
    boxes[0, :, 7] = [48, 48, 24, 24, 0.9]
    (tmp_path / "fixed.onnx").write_bytes(constant_network({"output0": boxes}))
    with VehicleDetector(tmp_path / "fixed.onnx") as detector:
        explanation = explain(detector, SCENE.image, detector.detect(SCENE.image).boxes[0])
    assert explanation.found
    assert not explanation.cells.any()  # its boxes do not depend on the image


@pytest.mark.parametrize(
    "params",
    [
        FeatureParams(),
        FeatureParams.preset("lab-9432"),
        FeatureParams.preset("luv-2384"),
        FeatureParams(pix_per_cell=16, spatial_size=8, spatial_order="interleaved", cell_per_block=1),
        FeatureParams(hog_feat=False, spatial_size=12),
        FeatureParams(spatial_feat=False, hist_feat=False, pix_per_cell=7),
    ],
)
def test_shares_of_a_patch_are_exact(params):
    shares = np.random.default_rng(0).normal(size=params.length)
    cells = patch_cell_shares(shares, params)
    histogram = part_slices(params).get("color histogram", slice(0))
    assert cells.shape == (params.cells, params.cells)
    assert cells.sum() == pytest.approx(shares.sum() - shares[histogram].sum())


def test_terms_of_a_classifier_are_its_score():
    with VehicleDetector("highway") as detector:
        explanation = explain(detector, SCENE.image, SCENE.boxes[0])
        assert explanation.found
        x1, y1, x2, y2 = np.rint(explanation.window).astype(int)
        patch = cv2.resize(SCENE.image[y1:y2, x1:x2], (64, 64))
        score = detector.model.decision_function(patch[None])[0]
        assert explanation.margin == pytest.approx(score) == explanation.score
        assert list(explanation.terms) == ["cells", "bias", "color histogram"]
        nothing = explain(detector, SCENE.image, [0, 0, 60, 60])
        assert (nothing.found, nothing.score) == (False, None)


@pytest.mark.parametrize(("seconds", "frame"), [((0.0, 0.04), 0), ((0.04, 0.08), 1)])
def test_a_detected_box_of_a_track_is_explained(detector, tmp_path, seconds, frame):
    # Without any detected box, the largest predicted one.
    table, box = TrackTable(), detector.detect(SCENE.image).boxes[0]
    for index, since in enumerate(seconds):
        write_image(tmp_path / f"{index}.png", SCENE.image)
        larger = box + index * np.array([-1, -1, 1, 1])
        table.append(index, index / 25, [SimpleNamespace(id=1, box=larger, time_since_update=since)])
    (picture,) = explain_tracks(detector, tmp_path, table)
    assert (picture.track, picture.frame) == (1, frame)
    assert picture.text.startswith("A vehicle is found here")
    assert "not found" not in picture.text


def test_a_picture_of_a_blurred_video_blurs_tracks_that_are_not_detected(detector, tmp_path):
    write_image(tmp_path / "0.png", SCENE.image)
    box, pictures = detector.detect(SCENE.image).boxes[0], []
    blurring = VehicleDetector(detector.detector, annotator=Annotator(blur="vehicles"))
    for boxes in [box], [box, box + 30]:
        table = TrackTable()
        table.append(0, 0.0, [SimpleNamespace(id=row, box=each) for row, each in enumerate(boxes, 1)])
        pictures.append(explain_tracks(blurring, tmp_path, table)[0].image)
    assert (pictures[0] != pictures[1]).any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"box": [1, 2, 3]}, "box must be an"),
        ({"box": [10, 10, 10, 20]}, r"box must be \[x1, y1, x2, y2\], 1 pixel or larger"),
        ({"box": [30, 20, 10, 40]}, "box.* must be .* with x1 <= x2"),
        ({"box": [700, 0, 760, 60]}, "box must lie in the image of 640x360 pixels"),
        ({"detector": VehicleDetector(NO_MODEL)}, "detector must have a network or a classifier of"),
    ],
)
def test_bad_arguments_are_refused(detector, changes, message):
    with pytest.raises(InvalidInputError, match=message):
        explain(**{"detector": detector, "image": SCENE.image, "box": [0, 0, 9, 9]} | changes)
