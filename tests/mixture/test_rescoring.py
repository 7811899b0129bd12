import dataclasses
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import SMALL_MIXTURE, drawn
from vehicle_detection._kernels import product
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.mixture import (
    COLORS,
    EDGES,
    BoxRegressor,
    MixtureSearch,
    MixtureTemplate,
    Projection,
    Rescorer,
    TemplateMixture,
    crop_features,
    crop_views,
    load_model,
    mirror_planes,
)
from vehicle_detection.mixture.boxes import nms
from vehicle_detection.mixture.rescoring import RESCORE_MIN
from vehicle_detection.mixture_training import FrameDataset, train_mixture
from vehicle_detection.mixture_training.negatives import Frame, frames_of
from vehicle_detection.mixture_training.rescoring import _boxes, _mirrored, train_rescorer
from vehicle_detection.params import MixtureParams, PyramidParams


def random_verification(seed=0, count=5, **changes):
    rng = np.random.default_rng(seed)
    values = {
        "edges": Projection(rng.normal(0, 0.1, EDGES), rng.normal(0, 0.05, (4, EDGES))),
        "colors": Projection(rng.normal(0, 0.1, COLORS), rng.normal(0, 0.05, (3, COLORS))),
        "vectors": rng.normal(0, 1, (count, 7)),
        "weights": rng.normal(0, 1, count),
        "bias": 0.25,
        "gamma": 0.5,
        "share": 0.4,
    }
    return Rescorer(**(values | changes))


def plain_mixture(**options):
    weights = np.random.default_rng(1).normal(0, 0.05, (8, 9, 28))
    return TemplateMixture((MixtureTemplate(weights, 0.0, (1.0, 1.0)),), BoxRegressor.none(), **options)


def noise(seed, shape=(120, 160, 3)):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


BOXES = np.array([[20.0, 30.0, 80.0, 70.0], [-10.0, 5.0, 30.0, 60.0], [100.5, 40.2, 180.0, 130.0]])


# What is seen of a box.


def test_the_edges_are_those_that_correct_boxes():
    image = noise(0)
    edges, colors = crop_views(image, BOXES)
    np.testing.assert_array_equal(edges, crop_features(image, BOXES)[:, :-4])
    assert colors.shape == (3, COLORS)
    assert edges.dtype == colors.dtype == np.float32
    for part, length in zip(crop_views(image, BOXES[:0]), (EDGES, COLORS)):
        assert part.shape == (0, length)


def test_colors_are_lightness_about_its_mean_and_hue():
    image = np.zeros((120, 120, 3), np.uint8)
    image[:, :60], image[:, 60:] = (200, 40, 40), (40, 40, 200)
    _, (colors,) = crop_views(image, np.array([[20.0, 20.0, 100.0, 100.0]]))
    lightness, a, b = colors.reshape(3, 12, 12)
    assert abs(float(lightness.mean())) < 1e-5
    expected = cv2.cvtColor(np.float32([[[200, 40, 40], [40, 40, 200]]]) / 255, cv2.COLOR_RGB2LAB)[0]
    for column, lab in ((2, expected[0]), (9, expected[1])):
        np.testing.assert_allclose(a[:, column] * 20, lab[1], atol=0.1)
        np.testing.assert_allclose(b[:, column] * 20, lab[2], atol=0.1)
    assert (lightness[:, 2] > lightness[:, 9]).all()


def test_a_darker_frame_has_about_the_same_colors_of_lightness():
    ramp = np.tile(np.linspace(40, 200, 120)[None, :, None], (120, 1, 3))
    box = np.array([[20.0, 20.0, 100.0, 100.0]])
    bright, dark = (
        crop_views((ramp * blend_weight).astype(np.uint8), box)[1][0, :144] for blend_weight in (1.0, 0.6)
    )
    assert np.abs(bright - dark).max() < 0.2
    assert bright.std() > 0.7


def test_mirrored_rows_are_those_of_the_mirrored_image():
    image = noise(3, (96, 96, 3))
    whole = np.array([[16.0, 16.0, 80.0, 80.0]])
    seen = crop_views(image, whole)
    expected = crop_views(np.ascontiguousarray(image[:, ::-1]), whole)
    for found, wanted in zip(_mirrored(seen), expected):
        np.testing.assert_allclose(found, wanted, atol=1e-4)
    planes = mirror_planes(seen[0].reshape(28, 12, 12))
    np.testing.assert_array_equal(_mirrored(seen)[0].reshape(28, 12, 12), planes)


# The opinion.


@given(
    rows=st.integers(0, 7), depth=st.integers(1, 11), columns=st.integers(1, 1100), seed=st.integers(0, 999)
)
def test_products_are_those_of_matrices(rows, depth, columns, seed):
    rng = np.random.default_rng(seed)
    left = rng.normal(0, 1, (rows, depth)).astype(np.float32)
    right = rng.normal(0, 1, (depth, columns)).astype(np.float32)
    found = product(left, right)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, left.astype(np.float64) @ right, atol=1e-4)


def test_few_rows_and_many_give_the_same_products():
    rng = np.random.default_rng(0)
    left = rng.normal(0, 1, (300, 20)).astype(np.float32)
    right = rng.normal(0, 1, (20, 600)).astype(np.float32)
    few = np.concatenate([product(part, right) for part in np.array_split(left, 5)])
    np.testing.assert_allclose(product(left, right), few, atol=1e-4)


@given(seed=st.integers(0, 1000), rows=st.integers(0, 5), count=st.integers(1, 6))
def test_the_decision_is_a_sum_of_kernels(seed, rows, count):
    rescorer = random_verification(seed, count)
    points = np.random.default_rng(seed + 1).normal(0, 1, (rows, 7)).astype(np.float32)
    expected = [
        sum(
            weight * np.exp(-0.5 * ((point - vector) ** 2).sum())
            for vector, weight in zip(rescorer.vectors, rescorer.weights)
        )
        + 0.25
        for point in points.astype(np.float64)
    ]
    np.testing.assert_allclose(rescorer.decision_function(points), expected, atol=1e-4)


def test_both_opinions_have_their_share():
    rescorer, image = random_verification(), noise(1)
    values = np.array([0.5, -0.2, 1.0])
    found = rescorer.decision_function(rescorer.coordinates(*crop_views(image, BOXES)))
    np.testing.assert_allclose(rescorer.apply(image, BOXES, values), 0.6 * values + 0.4 * found)
    assert rescorer.apply(image, BOXES[:0], values[:0]).shape == (0,)


def test_of_two_boxes_on_one_vehicle_the_one_that_both_opinions_like_stays():
    image = noise(2, (200, 300, 3))
    model = plain_mixture(rescorer=random_verification(4))
    search = MixtureSearch(model, n_jobs=1)
    windows = search.score_windows(image, PyramidParams(min_width=24, horizon=None))
    proposals, values = model.propose_boxes(image, windows, min_margin=RESCORE_MIN)
    both = model.rescorer.apply(image, proposals, values)
    rows = nms(proposals, both)
    assert len(rows) < len(proposals)
    boxes, found = model.vehicles(image, windows, least=-9.0)
    np.testing.assert_array_equal(boxes, proposals[rows])
    np.testing.assert_array_equal(found, both[rows])
    middle = float(np.median(found))
    boxes, fewer = model.vehicles(image, windows, least=middle)
    np.testing.assert_array_equal(fewer, found[found >= middle])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edges": Projection(np.zeros(9), np.zeros((4, 9)))}, r"rescorer.edges must take 4032 values"),
        (
            {"colors": Projection(np.zeros(9), np.zeros((3, 9)))},
            r"rescorer.colors must take 432 values",
        ),
        ({"vectors": np.zeros((5, 6))}, r"rescorer.vectors must be finite numbers of shape \(any, 7\)"),
        ({"vectors": np.full((5, 7), 1e6)}, "rescorer.vectors must be numbers below 65,504"),
        ({"weights": np.zeros(4)}, r"rescorer.weights must be finite numbers of shape \(5\)"),
        ({"weights": np.full(5, np.nan)}, "rescorer.weights must be finite numbers"),
        ({"bias": "much"}, "rescorer.bias must be a number"),
        ({"gamma": 0.0}, "rescorer.gamma must be a number"),
        ({"share": 1.5}, "rescorer.share must be a number"),
    ],
)
def test_an_opinion_that_makes_no_sense(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        random_verification(**changes)


def test_a_mixture_wants_a_verification_or_none():
    with pytest.raises(InvalidInputError, match="rescorer must be a Rescorer"):
        plain_mixture(rescorer="yes")


# Files.


def test_a_model_file_keeps_the_opinion(tmp_path):
    model = plain_mixture(rescorer=random_verification(), slope=2.0)
    model.save(tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    for name in ("vectors", "weights", "bias", "gamma", "share"):
        np.testing.assert_array_equal(
            getattr(loaded.rescorer, name), getattr(model.rescorer, name), strict=True
        )
    image = noise(5)
    np.testing.assert_array_equal(
        loaded.rescorer.apply(image, BOXES, np.zeros(3)),
        model.rescorer.apply(image, BOXES, np.zeros(3)),
    )
    plain_mixture().save(tmp_path / "plain.safetensors")
    assert load_model(tmp_path / "plain.safetensors").rescorer is None


def test_a_file_with_half_an_opinion_is_refused(tmp_path, monkeypatch):
    model = plain_mixture(rescorer=random_verification())
    whole = model.rescorer.tensors()
    whole.pop("rescorer.vectors")
    monkeypatch.setattr(Rescorer, "tensors", lambda self: whole)
    model.save(tmp_path / "model.safetensors")
    with pytest.raises(ModelFileError, match=r"model.safetensors does not fit its own parameters.*vectors"):
        load_model(tmp_path / "model.safetensors")


# Training.


def test_training_makes_an_opinion_that_tells_vehicles_from_clutter(small_mixture):
    rescorer = small_mixture.rescorer
    assert rescorer is not None
    assert rescorer.blend_weight == MixtureParams().rescorer
    search, rng = MixtureSearch(small_mixture, n_jobs=1), np.random.default_rng(0)
    right, wrong = [], []
    for frame in frames_of([FrameDataset("others", (drawn(range(12, 18)),))]):
        vehicles, clutter = _boxes(frame, search, SMALL_MIXTURE, rng)
        for boxes, values in (vehicles, right), (clutter, wrong):
            values += rescorer.decision_function(
                rescorer.coordinates(*crop_views(frame.image, boxes))
            ).tolist()
    right, wrong = np.array(right), np.array(wrong)
    assert (right > 0).mean() > 0.9
    assert (wrong < 0).mean() > 0.8


def test_boxes_to_learn_from_are_told_apart_by_the_labels(drawn_source, small_mixture):
    search = MixtureSearch(small_mixture, n_jobs=1)
    for frame in frames_of([drawn_source])[:4]:
        right, wrong = _boxes(frame, search, SMALL_MIXTURE, np.random.default_rng(1))
        assert (iou_matrix(right, frame.boxes).max(axis=1, initial=0) > 0.5).all()
        assert (iou_matrix(wrong, frame.boxes).max(axis=1, initial=0) < 0.45).all()
        wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= SMALL_MIXTURE.min_width]
        np.testing.assert_array_equal(right[: len(wide)], wide)


def test_no_share_is_no_opinion(drawn_source):
    params = dataclasses.replace(SMALL_MIXTURE, rescorer=0.0, rounds=(0.5,))
    assert train_mixture([drawn_source], params, n_jobs=1).rescorer is None


def test_without_anything_to_tell_apart_there_is_no_opinion(small_mixture):
    search = MixtureSearch(small_mixture, n_jobs=1)
    empty = Frame(np.full((200, 356, 3), 90, np.uint8), np.empty((0, 4)), np.empty((0, 4)), 0.0)
    with ThreadPoolExecutor(1) as pool:
        assert train_rescorer([empty], search, SMALL_MIXTURE, np.random.default_rng(0), pool) is None
