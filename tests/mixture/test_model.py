import dataclasses
import json
import re

import numpy as np
import pytest

from tests.helpers import mixture_template, random_mixture
from vehicle_detection._common import FORMAT_VERSION
from vehicle_detection._common.model_file import FORMAT, checksum
from vehicle_detection.classifier import VehicleClassifier, load_classifier
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.mixture import N_CHANNELS, EdgePyramid, MixtureSearch, TemplateMixture, load_model
from vehicle_detection.mixture.boxes import ScoredWindows
from vehicle_detection.params import PyramidParams
from vehicle_detection.synthetic import render_scene

ROAD = render_scene(shape=(360, 640), vehicles=3, random_state=5).image


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"templates": ()}, "templates must hold at least one template; got none"),
        ({"templates": (5,)}, "templates must be a MixtureTemplate, got 5"),
        ({"slope": 0.0}, "slope must be a number, greater than 0"),
        ({"slope": -1.0}, "slope must be a number, greater than 0"),
        ({"offset": np.nan}, "offset must be a number"),
        ({"threshold": np.inf}, "threshold must be a number"),
        ({"vote_weight": np.nan}, "vote_weight must be a number"),
    ],
)
def test_invalid_mixtures_are_rejected(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(random_mixture(), **changes)


def test_the_size_prior_raises_the_margins_of_near_vehicles():
    model = random_mixture()
    pyramid, found = MixtureSearch(model, n_jobs=1).score_windows(ROAD, PyramidParams())
    min_margin = float(np.quantile(found.margins, 0.2))
    boxes, margins, *_ = model.detect_vehicles(pyramid, found, min_margin=min_margin)
    with_prior = dataclasses.replace(model, size_prior_weight=0.1)
    others, raised, *_ = with_prior.detect_vehicles(pyramid, found, min_margin=min_margin)
    before = {tuple(box): margin for box, margin in zip(boxes, margins)}
    common = [row for row, box in enumerate(others) if tuple(box) in before]
    assert len(common) > 3
    heights = others[common, 3] - others[common, 1]
    expected = [before[tuple(others[row])] for row in common] + 0.1 * np.log2(heights / 64).clip(-2, 2)
    np.testing.assert_allclose(raised[common], expected)
    assert (raised >= min_margin).all()
    assert (np.diff(raised) <= 0).all()


def test_many_votes_raise_a_margin():
    model, pyramid = random_mixture(), EdgePyramid(ROAD)
    vehicle, copies = [100.0, 100.0, 200.0, 180.0], 30
    boxes = np.array([[400.0, 100.0, 500.0, 180.0], *[vehicle] * copies])
    windows = ScoredWindows(boxes, np.array([0.5, *[0.4] * copies]), np.zeros(copies + 1, np.intp))
    assert model.detect_vehicles(pyramid, windows, min_margin=0.0)[1].tolist() == [0.5, 0.4]
    with_votes = dataclasses.replace(model, vote_weight=0.1)
    found, margins, *_ = with_votes.detect_vehicles(pyramid, windows, min_margin=0.0)
    assert found.tolist() == [vehicle, boxes[0].tolist()]
    # The vote masses are 30 * 1.5 and 1.6.
    np.testing.assert_allclose(margins, [0.4 + 0.1 * (np.log(46) - 2), 0.5 + 0.1 * (np.log(2.6) - 2)])
    assert len(with_votes.detect_vehicles(pyramid, windows, min_margin=0.5)[0]) == 1
    # The gain is limited to 2 units.
    more = ScoredWindows(np.array([vehicle] * 90), np.full(90, 0.4), np.zeros(90, np.intp))
    np.testing.assert_allclose(with_votes.detect_vehicles(pyramid, more, min_margin=0.0)[1], [0.6])


def test_windows_that_show_the_same_part_of_the_frame_are_one_proposal():
    boxes = np.array([[-90.0, 100, 40, 140], [-20, 100, 40, 140], [300, 100, 360, 140]])
    windows = ScoredWindows(boxes, np.array([0.5, 0.4, 0.3]), np.zeros(3, np.intp))
    found, margins = random_mixture().propose_boxes(EdgePyramid(ROAD), windows, min_margin=0.0)
    assert found.tolist() == [[0, 100, 40, 140], [300, 100, 360, 140]]
    assert margins.tolist() == [0.5, 0.3]


def test_the_summary_lists_the_templates():
    border = mixture_template(5, 6, border=True)
    model = dataclasses.replace(random_mixture(threshold=0.25), templates=(mixture_template(), border))
    title, facts = model.summary()
    assert title == "2 templates, threshold at a probability of 0.56"
    assert facts == {
        "template 1": "box of 7x6 cells",
        "template 2": "box of 4x4 cells at the frame's border",
    }


@pytest.mark.parametrize("candidates", [1, 7, 20])
def test_many_candidates_lower_the_margins(candidates):
    model, pyramid = random_mixture(), EdgePyramid(ROAD)
    corners = np.array([(20 * (number % 10), 40 * (number // 10)) for number in range(candidates)], float)
    boxes, margins = np.hstack([corners, corners + 15]), np.linspace(-0.9, 0.5, candidates)[::-1]
    windows = ScoredWindows(boxes, margins, np.zeros(candidates, np.intp))
    counted = dataclasses.replace(model, count_weight=0.2)
    found, lowered, shift, _ = counted.detect_vehicles(pyramid, windows, min_margin=-2.0)
    np.testing.assert_allclose(found, boxes)
    np.testing.assert_allclose(lowered, margins - 0.2 * np.log((1 + candidates) / 8))
    assert shift == pytest.approx(-0.2 * np.log((1 + candidates) / 8))
    # The count includes the candidates that are not returned.
    best = counted.detect_vehicles(pyramid, windows, min_margin=lowered[0])[1]
    assert best.tolist() == [lowered[0]]


def test_a_saved_model_is_loaded_bit_by_bit(tmp_path):
    path = tmp_path / "model.safetensors"
    options = {"slope": 1.7, "offset": 0.1, "threshold": -0.3, "count_weight": 0.3}
    options |= {"perspective_weight": 0.1, "size_prior_weight": 0.02, "vote_weight": 0.04}
    model = random_mixture(**options, metadata={"a": [1, {"b": None}]})
    templates = *model.templates, mixture_template(5, 6, seed=4, border=True)
    model = dataclasses.replace(model, templates=templates)
    model.save(path)
    loaded = load_model(path)
    assert isinstance(loaded, TemplateMixture)
    for one, other in zip(model.templates, loaded.templates, strict=True):
        assert one.weights.tobytes() == other.weights.tobytes()
        assert (one.bias, one.padding, one.border) == (other.bias, other.padding, other.border)
    assert {name: getattr(loaded, name) for name in options} == options
    assert loaded.metadata == {"a": [1, {"b": None}]}
    first = path.read_bytes()
    loaded.save(path)
    assert path.read_bytes() == first
    expected, found = (MixtureSearch(each, n_jobs=1).find(ROAD).vehicles for each in (model, loaded))
    np.testing.assert_array_equal(expected.boxes, found.boxes)


def test_metadata_can_be_replaced():
    model = random_mixture()
    other = model.with_metadata({"x": 1})
    assert (model.metadata, other.metadata) == ({}, {"x": 1})
    assert other.templates == model.templates


def test_metadata_must_be_json(tmp_path):
    with pytest.raises(InvalidInputError, match="metadata must contain JSON values only"):
        random_mixture(metadata={"when": object()}).save(tmp_path / "m.safetensors")
    assert not list(tmp_path.iterdir())


def write_file(path, tensors=None, params=None, *, params_text=None, **changes):
    """Write a model file as `save` does, with changed content and the matching checksum."""
    from safetensors.numpy import save

    model = random_mixture()
    content = {
        **{f"{index}.weights": template.weights for index, template in enumerate(model.templates)},
        **(tensors or {}),
    }
    content = {name: np.array(tensor) for name, tensor in content.items() if tensor is not None}
    values = {
        "biases": [0.0] * 3,
        "paddings": [[1.0, 1.0]] * 3,
        "borders": [False] * 3,
        "slope": 1.0,
        "offset": 0.0,
        "threshold": 0.0,
        "size_prior_weight": 0.0,
        "vote_weight": 0.0,
        "count_weight": 0.0,
        "perspective_weight": 0.0,
        **(params or {}),
    }
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": "mixture",
        "params": params_text
        or json.dumps({name: value for name, value in values.items() if value is not None}),
        "metadata": "{}",
        **changes,
    }
    header.setdefault("sha256", checksum(header, content))
    path.write_bytes(save(content, metadata=header))
    return path


def test_the_files_of_these_tests_are_valid(tmp_path):
    model = load_model(write_file(tmp_path / "m.safetensors"))
    assert len(model.templates) == 3


@pytest.mark.parametrize(
    ("tensors", "params", "message"),
    [
        (
            {"1.weights": np.full((3, 4, N_CHANNELS), np.nan, np.float32)},
            {},
            "weights must be finite numbers",
        ),
        ({"1.weights": np.zeros((3, 4, 5), np.float32)}, {}, "weights must be finite numbers of shape"),
        (
            {"1.weights": np.full((3, 4, N_CHANNELS), 1e38, np.float32)},
            {},
            "1.weights must be finite numbers of at most 1e[+]12; train again",
        ),
        (
            {"1.weights": np.ones((3, 4, N_CHANNELS), np.bool_)},
            {},
            "1.weights must be floating-point numbers, got bool",
        ),
        ({}, {"biases": [10**400, 0.0, 0.0]}, "int too large"),
        ({}, {"biases": [1e38, 0.0, 0.0]}, "bias must be a number, at least -1e[+]09 and at most"),
        ({}, {"offset": 1e300}, "offset must be a number, at least -1e[+]09"),
        ({"2.weights": None}, {}, "'2.weights'"),
        ({}, {"biases": None}, "'biases'"),
        ({}, {"biases": [0.0]}, "argument"),
        ({}, {"biases": [], "paddings": [], "borders": []}, "at least one template"),
        ({}, {"biases": ["x", 0.0, 0.0]}, "could not convert"),
        ({}, {"paddings": [[1.0], [1.0], [1.0]]}, "index out of range"),
        ({}, {"paddings": [[4.0, 50.0]] * 3}, "padding must be less than half"),
        ({}, {"borders": [True]}, "argument"),
        ({}, {"borders": [1, 0, 0]}, "border must be True or False"),
        ({}, {"slope": 0.0}, "slope must be a number"),
        ({}, {"vote_weight": "much"}, "could not convert"),
        *(({}, {name: None}, f"'{name}'") for name in ("threshold", "borders", "vote_weight")),
    ],
)
def test_inconsistent_files_are_rejected(tmp_path, tensors, params, message):
    path = write_file(tmp_path / "m.safetensors", tensors, params)
    with pytest.raises(ModelFileError, match=rf"model file .* does not fit its own parameters: .*{message}"):
        load_model(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "forest"}, "holds a model of the unknown kind 'forest'; train one"),
        ({"kind": "patches"}, "does not fit its own parameters"),
        ({"format": "other"}, "not a model of this library"),
        ({"format_version": "1"}, f"has format version 1, this release reads {FORMAT_VERSION}; train again"),
        ({"sha256": "0"}, r"was changed after it was written \(checksum differs\)"),
        ({"params_text": "{"}, "has no readable parameters"),
        ({"metadata": "3"}, "has no readable parameters"),
        ({"metadata": "[" * 100_000}, "has no readable parameters"),
        ({"metadata": '{"a":' * 50_000 + "1" + "}" * 50_000}, "has no readable parameters"),
    ],
)
def test_invalid_headers_are_rejected(tmp_path, changes, message):
    path = write_file(tmp_path / "m.safetensors", **changes)
    with pytest.raises(ModelFileError, match=message):
        load_model(path)


def test_damaged_files_are_rejected(tmp_path):
    path = write_file(tmp_path / "m.safetensors")
    data = path.read_bytes()
    for damaged in (b"", data[:7], data[: len(data) // 2], data[:-1], b"x" * 500):
        path.write_bytes(damaged)
        with pytest.raises(ModelFileError, match="is not a complete safetensors file"):
            load_model(path)
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(ModelFileError, match="was changed after it was written"):
        load_model(path)


def test_invalid_paths_are_rejected(tmp_path):
    with pytest.raises(
        ModelFileError, match="does not exist; check the path, or name a shipped model: default"
    ):
        load_model("defualt")
    with pytest.raises(ModelFileError, match="is a folder; choose a file in it"):
        load_model(tmp_path)
    for path in (None, 5):
        with pytest.raises(
            InvalidInputError, match="path must be a model file or one of 'default', 'highway'"
        ):
            load_model(path)


def test_the_shipped_models():
    default, highway = load_model(), load_model("highway")
    assert isinstance(default, TemplateMixture)
    assert isinstance(highway, VehicleClassifier)
    assert default.metadata["metrics"]["left_out"].keys() >= {"india", "camvid", "indonesia", "project_clip"}
    assert set(default.metadata["data"]) == {
        *("camvid", "dawn", "india", "indonesia"),
        *("course", "drawn", "patches"),
    }
    assert highway.metadata == load_classifier().metadata
    with pytest.raises(
        ModelFileError,
        match=re.escape("shipped model 'default' contains a model of kind 'mixture', not 'patches'"),
    ):
        load_classifier("default")


def test_a_missing_shipped_model(tmp_path, monkeypatch):
    monkeypatch.setattr("vehicle_detection._common.model_file.resources.files", lambda package: tmp_path)
    with pytest.raises(ModelFileError, match="shipped model 'highway' is missing; install the package again"):
        load_model("highway")
