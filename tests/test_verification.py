import dataclasses
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection._kernels import product
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.mixture import (
    COLOURS,
    EDGES,
    MixtureSearch,
    MixtureTemplate,
    Projection,
    Refinement,
    TemplateMixture,
    Verification,
    crop_features,
    crop_views,
    load_model,
    mirror_planes,
)
from vehicle_detection.mixture.boxes import resolve
from vehicle_detection.mixture.rescoring import LEAST_VALUE
from vehicle_detection.mixture_training import FrameSource, MixtureParams, train_mixture
from vehicle_detection.mixture_training.negatives import Frame, frames_of
from vehicle_detection.mixture_training.rescoring import _boxes, _mirrored, train_verification
from vehicle_detection.params import PyramidParams

from .test_mixture_training import SMALL, drawn
from .test_mixture_training import source as source
from .test_mixture_training import trained as trained


def random_verification(seed=0, count=5, **changes):
    rng = np.random.default_rng(seed)
    values = {
        "edges": Projection(rng.normal(0, 0.1, EDGES), rng.normal(0, 0.05, (4, EDGES))),
        "colours": Projection(rng.normal(0, 0.1, COLOURS), rng.normal(0, 0.05, (3, COLOURS))),
        "vectors": rng.normal(0, 1, (count, 7)),
        "weights": rng.normal(0, 1, count),
        "bias": 0.25,
        "gamma": 0.5,
        "share": 0.4,
    }
    return Verification(**(values | changes))


def plain_mixture(**options):
    weights = np.random.default_rng(1).normal(0, 0.05, (8, 9, 28))
    return TemplateMixture((MixtureTemplate(weights, 0.0, (1.0, 1.0)),), Refinement.none(), **options)


def noise(seed, shape=(120, 160, 3)):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


BOXES = np.array([[20.0, 30.0, 80.0, 70.0], [-10.0, 5.0, 30.0, 60.0], [100.5, 40.2, 180.0, 130.0]])


# What is seen of a box.


def test_the_edges_are_those_that_correct_boxes():
    image = noise(0)
    edges, colours = crop_views(image, BOXES)
    np.testing.assert_array_equal(edges, crop_features(image, BOXES)[:, :-4])
    assert colours.shape == (3, COLOURS)
    assert edges.dtype == colours.dtype == np.float32
    for part, length in zip(crop_views(image, BOXES[:0]), (EDGES, COLOURS)):
        assert part.shape == (0, length)


def test_colours_are_lightness_about_its_mean_and_hue():
    image = np.zeros((120, 120, 3), np.uint8)
    image[:, :60], image[:, 60:] = (200, 40, 40), (40, 40, 200)
    _, (colours,) = crop_views(image, np.array([[20.0, 20.0, 100.0, 100.0]]))
    lightness, a, b = colours.reshape(3, 12, 12)
    assert abs(float(lightness.mean())) < 1e-5
    expected = cv2.cvtColor(np.float32([[[200, 40, 40], [40, 40, 200]]]) / 255, cv2.COLOR_RGB2LAB)[0]
    for column, lab in ((2, expected[0]), (9, expected[1])):
        np.testing.assert_allclose(a[:, column] * 20, lab[1], atol=0.1)
        np.testing.assert_allclose(b[:, column] * 20, lab[2], atol=0.1)
    assert (lightness[:, 2] > lightness[:, 9]).all()


def test_a_darker_frame_has_about_the_same_colours_of_lightness():
    ramp = np.tile(np.linspace(40, 200, 120)[None, :, None], (120, 1, 3))
    box = np.array([[20.0, 20.0, 100.0, 100.0]])
    bright, dark = (crop_views((ramp * share).astype(np.uint8), box)[1][0, :144] for share in (1.0, 0.6))
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
    verification = random_verification(seed, count)
    points = np.random.default_rng(seed + 1).normal(0, 1, (rows, 7)).astype(np.float32)
    expected = [
        sum(
            weight * np.exp(-0.5 * ((point - vector) ** 2).sum())
            for vector, weight in zip(verification.vectors, verification.weights)
        )
        + 0.25
        for point in points.astype(np.float64)
    ]
    np.testing.assert_allclose(verification.decide(points), expected, atol=1e-4)


def test_both_opinions_have_their_share():
    verification, image = random_verification(), noise(1)
    values = np.array([0.5, -0.2, 1.0])
    found = verification.decide(verification.coordinates(*crop_views(image, BOXES)))
    np.testing.assert_allclose(verification.apply(image, BOXES, values), 0.6 * values + 0.4 * found)
    assert verification.apply(image, BOXES[:0], values[:0]).shape == (0,)


def test_of_two_boxes_on_one_vehicle_the_one_that_both_opinions_like_stays():
    image = noise(2, (200, 300, 3))
    model = plain_mixture(verification=random_verification(4))
    search = MixtureSearch(model, n_jobs=1)
    windows = search.candidates(image, PyramidParams(least_width=24, horizon=None))
    proposals, values = model.proposals(image, windows, least=LEAST_VALUE)
    both = model.verification.apply(image, proposals, values)
    rows = resolve(proposals, both)
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
        ({"edges": Projection(np.zeros(9), np.zeros((4, 9)))}, r"verification.edges must take 4032 values"),
        (
            {"colours": Projection(np.zeros(9), np.zeros((3, 9)))},
            r"verification.colours must take 432 values",
        ),
        ({"vectors": np.zeros((5, 6))}, r"verification.vectors must be finite numbers of shape \(any, 7\)"),
        ({"vectors": np.full((5, 7), 1e6)}, "verification.vectors must be numbers below 65,504"),
        ({"weights": np.zeros(4)}, r"verification.weights must be finite numbers of shape \(5\)"),
        ({"weights": np.full(5, np.nan)}, "verification.weights must be finite numbers"),
        ({"bias": "much"}, "verification.bias must be a number"),
        ({"gamma": 0.0}, "verification.gamma must be a number"),
        ({"share": 1.5}, "verification.share must be a number"),
    ],
)
def test_an_opinion_that_makes_no_sense(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        random_verification(**changes)


def test_a_mixture_wants_a_verification_or_none():
    with pytest.raises(InvalidInputError, match="verification must be a Verification"):
        plain_mixture(verification="yes")


# Files.


def test_a_model_file_keeps_the_opinion(tmp_path):
    model = plain_mixture(verification=random_verification(), slope=2.0)
    model.save(tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    for name in ("vectors", "weights", "bias", "gamma", "share"):
        np.testing.assert_array_equal(
            getattr(loaded.verification, name), getattr(model.verification, name), strict=True
        )
    image = noise(5)
    np.testing.assert_array_equal(
        loaded.verification.apply(image, BOXES, np.zeros(3)),
        model.verification.apply(image, BOXES, np.zeros(3)),
    )
    plain_mixture().save(tmp_path / "plain.safetensors")
    assert load_model(tmp_path / "plain.safetensors").verification is None


def test_a_file_with_half_an_opinion_is_refused(tmp_path, monkeypatch):
    model = plain_mixture(verification=random_verification())
    whole = model.verification.tensors()
    whole.pop("verification.vectors")
    monkeypatch.setattr(Verification, "tensors", lambda self: whole)
    model.save(tmp_path / "model.safetensors")
    with pytest.raises(ModelFileError, match=r"model.safetensors does not fit its own parameters.*vectors"):
        load_model(tmp_path / "model.safetensors")


# Training.


def test_training_makes_an_opinion_that_tells_vehicles_from_clutter(trained):
    verification = trained.verification
    assert verification is not None
    assert verification.share == MixtureParams().verification
    search, rng = MixtureSearch(trained, n_jobs=1), np.random.default_rng(0)
    right, wrong = [], []
    for frame in frames_of([FrameSource("others", (drawn(range(12, 18)),))]):
        vehicles, clutter = _boxes(frame, search, SMALL, rng)
        for boxes, values in (vehicles, right), (clutter, wrong):
            values += verification.decide(verification.coordinates(*crop_views(frame.image, boxes))).tolist()
    right, wrong = np.array(right), np.array(wrong)
    assert (right > 0).mean() > 0.9
    assert (wrong < 0).mean() > 0.8


def test_boxes_to_learn_from_are_told_apart_by_the_labels(source, trained):
    search = MixtureSearch(trained, n_jobs=1)
    for frame in frames_of([source])[:4]:
        right, wrong = _boxes(frame, search, SMALL, np.random.default_rng(1))
        assert (iou_matrix(right, frame.boxes).max(axis=1, initial=0) > 0.5).all()
        assert (iou_matrix(wrong, frame.boxes).max(axis=1, initial=0) < 0.45).all()
        wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= SMALL.least_width]
        np.testing.assert_array_equal(right[: len(wide)], wide)


def test_no_share_is_no_opinion(source):
    params = dataclasses.replace(SMALL, verification=0.0, rounds=(0.5,))
    assert train_mixture([source], params, n_jobs=1).verification is None


def test_without_anything_to_tell_apart_there_is_no_opinion(trained):
    search = MixtureSearch(trained, n_jobs=1)
    empty = Frame(np.full((200, 356, 3), 90, np.uint8), np.empty((0, 4)), np.empty((0, 4)), 0.0)
    with ThreadPoolExecutor(1) as pool:
        assert train_verification([empty], search, SMALL, np.random.default_rng(0), pool) is None
