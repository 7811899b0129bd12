import math
import re
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas
import pytest

from vehicle_detection import Detections, InvalidInputError, PatchSet
from vehicle_detection._common import check, describe

IMAGE = np.zeros((4, 6, 3), np.uint8)
PATCH = np.zeros((64, 64, 3), np.uint8)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (np.zeros((2, 3), np.float32), "an array of shape (2, 3) and dtype float32"),
        ("road", "'road'"),
        (None, "None"),
        (7, "7"),
        (0.5, "0.5"),
        ((1, 2), "(1, 2) (tuple)"),
        (range(3), "range(0, 3) (range)"),
    ],
)
def test_describe(value, text):
    assert describe(value) == text


@pytest.mark.parametrize("value", ["x" * 500, list(range(500)), [np.zeros((3, 3))], "two\nlines"])
def test_describe_stays_short_and_on_one_line(value):
    assert len(describe(value)) < 100
    assert "\n" not in describe(value)


def test_values_that_python_refuses_to_print():
    nested = []
    for _ in range(10**5):
        nested = [nested]
    assert describe(10**5000) == "a value too long to print (int)"
    assert describe(nested) == "a value too long to print (list)"
    with pytest.raises(InvalidInputError, match="must be an integer at least 1; got a value too long"):
        check.integer(10**5000, "n", low=1)


def test_a_long_name_is_shortened():
    with pytest.raises(InvalidInputError, match=r"got 'a{76}\.\.\. with more than 255 bytes"):
        check.path(Path("a" * 300))


def test_arrays_that_fit_are_returned():
    boxes = np.array([[0, 1, 2, 3], [5, 5, 5, 5]], np.int16)
    batch = np.stack([PATCH, PATCH + 1])
    assert check.image(IMAGE) is IMAGE
    assert check.boxes(boxes) is boxes
    assert check.boxes([[0.5, 1, 2, 3]]).dtype == np.float64
    assert check.patches(batch, 64) is batch
    assert check.patches(PatchSet(batch, [0, 1], ["a/b/c.png"] * 2), 64) is batch


@pytest.mark.parametrize(
    ("image", "remedy"),
    [
        ("road.png", "read files with vehicle_detection.read_image"),
        ([[1, 2, 3]], "pass one image after the other"), (iter([IMAGE]), "pass a list of images"),
        (SimpleNamespace(convert=None), r"numpy\.asarray\(image\.convert\('RGB'\)\)"),
        (memoryview(IMAGE), "read files with vehicle_detection.read_image"),
        (np.zeros((3, 4, 6), np.uint8), r"image\.transpose\(1, 2, 0\)"),
        (np.full((4, 6, 3), -1.0), "map its values to 0-255; they are -1 to -1"),
        (None, "read files with vehicle_detection.read_image"), (IMAGE[..., 0], "COLOR_GRAY2RGB"),
        (IMAGE[..., :1], "COLOR_GRAY2RGB"), (np.zeros((4, 6, 4), np.uint8), "drop the alpha channel"),
        (np.zeros((2, 4, 6, 3), np.uint8), "pass one image"),
        (np.zeros((4, 6, 2), np.uint8), "three color channels"),
        (np.zeros(3, np.uint8), "three color channels"),
        (np.zeros((0, 6, 3), np.uint8), "the image is empty"),
        (np.zeros((4, 0, 3), np.uint8), "the image is empty"), (IMAGE / 255, r"\(image \* 255\)"),
        (IMAGE.astype(np.float32), r"\(image \* 255\)"),
        (IMAGE + 255.0, r"convert its values 0-255 with image.round\(\).astype\(numpy.uint8\)"),
        (IMAGE.astype(np.uint16), "image // 257"), (IMAGE.astype(np.int64), "0-255"),
        (IMAGE.astype(bool), "0-255"),
    ],
)  # fmt: skip
def test_check_image_explains_the_conversion(image, remedy):
    with pytest.raises(InvalidInputError, match=rf"^frame must be an \(H, W, 3\) uint8 RGB array.*{remedy}"):
        check.image(image, "frame")


def test_check_patches_stacks_a_list():
    batch = np.stack([PATCH, PATCH + 1])
    np.testing.assert_array_equal(check.patches([PATCH, PATCH + 1], 64), batch)
    assert check.patches([], 64).shape == (0, 64, 64, 3)
    assert check.patches(np.empty((0, 32, 32, 3), np.uint8), 32).dtype == np.uint8


@pytest.mark.parametrize(
    ("patches", "message"),
    [
        (PATCH, r"patches must be an \(N, 64, 64, 3\) uint8 RGB array .*got an array of shape \(64, 64, 3\)"),
        (PATCH, r"pass a single patch as patches\[None\]"),
        (np.zeros((2, 32, 32, 3), np.uint8), r"\(N, 64, 64, 3\) .*resize each image with cv2.resize"),
        (np.zeros((72, 128, 3), np.uint8), "resize each image with cv2.resize"),
        (np.zeros((2, 64, 64, 3)), r"scale its values 0-1 with \(patches \* 255\)"),
        (np.zeros((0, 64, 64, 3)), r"scale its values 0-1 with \(patches \* 255\)"),
        (np.full((2, 64, 64, 3), 9.0), r"convert its values 0-255 with patches.round\(\)"),
        (np.zeros((2, 64, 64, 3), int), r"patches.astype\(numpy.uint8\) once"),
        (np.zeros((2, 6156), np.float32), "vehicle_detection.load_patches"),
        ("vehicles.zip", "vehicle_detection.load_patches"),
        ([PATCH, IMAGE], r"patches\[1\] must be 64x64 pixels, .*cv2.resize"),
        ([PATCH, PATCH[..., 0]], r"patches\[1\] must be an \(H, W, 3\)"),
    ],
)
def test_check_patches_refuses(patches, message):
    with pytest.raises(InvalidInputError, match=message):
        check.patches(patches, 64)


@pytest.mark.parametrize("empty", [[], np.empty((0, 4)), np.empty(0), (), np.empty((0, 4), np.int64)])
def test_check_boxes_accepts_no_boxes(empty):
    assert check.boxes(empty).shape == (0, 4)


def test_check_boxes_accepts_corner_pairs_and_detections():
    boxes = [[1, 2, 3, 4], [0, 0, 5, 6]]
    np.testing.assert_array_equal(check.boxes([((1, 2), (3, 4)), ((5, 6), (0, 0))]), boxes)
    np.testing.assert_array_equal(check.boxes(Detections(boxes, [1, 2])), boxes)


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        ([0, 1, 2, 3], "wrap a single box in a list"), ([[0, 1, 2]], r"an \(N, 4\) number array"),
        ([[[0, 1, 2, 3]]], r"an \(N, 4\) number array"),
        ([["a", "b", "c", "d"]], r"an \(N, 4\) number array"),
        ([[True, True, True, True]], r"an \(N, 4\) number array"),
        ([[0, 0, 1, 1], [0, 0, 1]], "numbers of equal lengths"),
        ((SimpleNamespace(box=[0, 0, 1, 1]),), r"pass \[track.box for track in tracks\]"),
        (pandas.DataFrame([[0, 0, 1, 1]], dtype="Int64"), r"convert .* with table.astype\(float\)"),
        (None, r"an \(N, 4\) number array"), ([[0, 0, math.nan, 1]], "must be finite"),
        ([[0, 0, math.inf, 1]], "must be finite"),
        ([[0, 0, 1, 1], [10, 10, 5, 20]], r"\[1\] must be .*, got \[10, 10, 5, 20\] .* x \+ width"),
        (np.array([[10, 10, 5, 20]], np.uint8), r"\[0\] must be"),
    ],
)  # fmt: skip
def test_check_boxes_refuses(boxes, message):
    with pytest.raises(InvalidInputError, match=f"^windows.*{message}"):
        check.boxes(boxes, "windows")


def test_the_reason_why_an_array_cannot_be_converted_is_kept():
    class Tensor:
        def __array__(self, *_, **__):
            raise TypeError("Use Tensor.cpu() first.")

    for function in (check.array, check.boxes):
        with pytest.raises(InvalidInputError, match=r"^x must .*Tensor.*; Use Tensor.cpu\(\)") as caught:
            function(Tensor(), "x")
        assert isinstance(caught.value.__cause__, TypeError)


def test_check_type():
    check.instance(True, "n", int, "count them")
    with pytest.raises(InvalidInputError, match=r"^n must be a int, got 'a'; count them$"):
        check.instance("a", "n", int, "count them")


@pytest.mark.parametrize("value", [0, 1, 0.5, np.float32(0.5), np.int64(1), Fraction(1, 4), 1e-300])
def test_check_number_accepts_numbers_in_range(value):
    number = check.number(value, "fraction", low=0, high=1)
    assert type(number) is float
    assert number == value


def test_check_bool():
    assert check.boolean(np.bool_(True), "mirror") is True
    for value in (1, "yes", None, np.int64(1)):
        with pytest.raises(InvalidInputError, match="mirror must be True or False; got"):
            check.boolean(value, "mirror")


@pytest.mark.parametrize("value", [-0.01, 1.01, math.nan, math.inf, -math.inf, "0.5", None, True, [0.5], 1j])
def test_check_number_refuses(value):
    expected = re.escape(f"fraction must be a number, at least 0 and at most 1; got {describe(value)}")
    with pytest.raises(InvalidInputError, match=expected):
        check.number(value, "fraction", low=0, high=1)


@pytest.mark.parametrize(
    ("value", "bounds", "expected"),
    [
        (0, {"above": 0}, "greater than 0; got 0"),
        (math.inf, {}, "finite; got inf"),
        (math.nan, {}, "finite; got nan"),
        (Decimal(30), {}, r"finite; got Decimal\('30'\) \(Decimal\)"),
    ],
)
def test_check_number_describes_the_bounds(value, bounds, expected):
    with pytest.raises(InvalidInputError, match=f"fps must be a number, {expected}$"):
        check.number(value, "fps", **bounds)


def test_check_integer():
    for value in (1, 5, np.int8(3), np.uint64(4)):
        assert type(check.integer(value, "n", low=1, high=5)) is int
    assert check.integer(10**12, "n", low=1) == 10**12
    for value in (0, 6, 2.0, "2", True, None, math.nan):
        with pytest.raises(InvalidInputError, match="n must be an integer from 1 to 5; got"):
            check.integer(value, "n", low=1, high=5)
    with pytest.raises(InvalidInputError, match=r"n must be an integer at least 1; got -3$"):
        check.integer(-3, "n", low=1)


@pytest.mark.parametrize("value", ["c", None, ["a"], {}, np.zeros(3), np.array(["a", "b"])])
@pytest.mark.parametrize("choices", [("a", "b"), {"a": 1, "b": 2}])
def test_check_choice_lists_the_choices(value, choices):
    check.choice("a", "mode", choices)
    with pytest.raises(InvalidInputError, match=r"mode must be one of 'a', 'b'; got"):
        check.choice(value, "mode", choices)
