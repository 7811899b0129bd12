import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import mixture_template
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.mixture import (
    N_COLOR_FEATURES,
    N_EDGE_FEATURES,
    BoxRegressor,
    MixtureSearch,
    Projection,
    Rescorer,
    TemplateMixture,
    load_model,
    rescoring_features,
)
from vehicle_detection.mixture.boxes import nms
from vehicle_detection.mixture.rescoring import RESCORE_MIN
from vehicle_detection.params import PyramidParams

BOXES = np.array([[20.0, 30.0, 80.0, 70.0], [-10.0, 5.0, 30.0, 60.0], [100.5, 40.2, 180.0, 130.0]])


def random_rescorer(seed=0, count=5, **changes):
    rng = np.random.default_rng(seed)
    values = {
        "edges": Projection(rng.normal(0, 0.1, N_EDGE_FEATURES), rng.normal(0, 0.05, (4, N_EDGE_FEATURES))),
        "colors": Projection(
            rng.normal(0, 0.1, N_COLOR_FEATURES), rng.normal(0, 0.05, (3, N_COLOR_FEATURES))
        ),
        "vectors": rng.normal(0, 1, (count, 7)),
        "weights": rng.normal(0, 1, count),
        "bias": 0.25,
        "gamma": 0.5,
        "blend_weight": 0.4,
    }
    return Rescorer(**(values | changes))


def one_template_mixture(**options):
    return TemplateMixture((mixture_template(seed=1),), BoxRegressor.none(), **options)


def noise(seed, shape=(120, 160, 3)):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


@given(seed=st.integers(0, 1000), rows=st.integers(0, 5), count=st.integers(1, 6))
def test_the_decision_function_is_a_sum_of_kernels(seed, rows, count):
    rescorer = random_rescorer(seed, count)
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


def test_rescoring_blends_margins_and_decision_margins():
    rescorer, image = random_rescorer(), noise(1)
    margins = np.array([0.5, -0.2, 1.0])
    decisions = rescorer.decision_function(rescorer.project(*rescoring_features(image, BOXES)))
    np.testing.assert_allclose(rescorer.apply(image, BOXES, margins), 0.6 * margins + 0.4 * decisions)
    assert rescorer.apply(image, BOXES[:0], margins[:0]).shape == (0,)


def test_nms_uses_the_rescored_margins():
    image = noise(2, (200, 300, 3))
    model = one_template_mixture(rescorer=random_rescorer(4))
    search = MixtureSearch(model, n_jobs=1)
    windows = search.score_windows(image, PyramidParams(min_width=24, horizon=None))
    proposals, margins = model.propose_boxes(image, windows, min_margin=RESCORE_MIN)
    rescored = model.rescorer.apply(image, proposals, margins)
    rows = nms(proposals, rescored)
    assert len(rows) < len(proposals)
    boxes, found = model.detect_vehicles(image, windows, min_margin=-9.0)
    np.testing.assert_array_equal(boxes, proposals[rows])
    np.testing.assert_array_equal(found, rescored[rows])
    middle = float(np.median(found))
    boxes, fewer = model.detect_vehicles(image, windows, min_margin=middle)
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
        ({"blend_weight": 1.5}, "rescorer.blend_weight must be a number"),
    ],
)
def test_invalid_rescorers_are_rejected(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        random_rescorer(**changes)


def test_a_mixture_takes_a_rescorer_or_none():
    with pytest.raises(InvalidInputError, match="rescorer must be a Rescorer"):
        one_template_mixture(rescorer="yes")


def test_a_model_file_preserves_the_rescorer(tmp_path):
    model = one_template_mixture(rescorer=random_rescorer(), slope=2.0)
    model.save(tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    for name in ("vectors", "weights", "bias", "gamma", "blend_weight"):
        np.testing.assert_array_equal(
            getattr(loaded.rescorer, name), getattr(model.rescorer, name), strict=True
        )
    image = noise(5)
    np.testing.assert_array_equal(
        loaded.rescorer.apply(image, BOXES, np.zeros(3)),
        model.rescorer.apply(image, BOXES, np.zeros(3)),
    )
    one_template_mixture().save(tmp_path / "plain.safetensors")
    assert load_model(tmp_path / "plain.safetensors").rescorer is None


def test_a_file_with_an_incomplete_rescorer_is_rejected(tmp_path, monkeypatch):
    model = one_template_mixture(rescorer=random_rescorer())
    tensors = model.rescorer.tensors()
    tensors.pop("rescorer.vectors")
    monkeypatch.setattr(Rescorer, "tensors", lambda self: tensors)
    model.save(tmp_path / "model.safetensors")
    with pytest.raises(ModelFileError, match=r"model.safetensors does not fit its own parameters.*vectors"):
        load_model(tmp_path / "model.safetensors")
