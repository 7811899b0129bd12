import pytest

from vehicle_detection.annotator import (
    LABEL_FIELDS,
    DrawParams,
)
from vehicle_detection.errors import InvalidInputError


def test_labels_become_a_tuple():
    assert DrawParams(labels=["id", "std"]).labels == ("id", "std")
    assert DrawParams(labels="id").labels == ("id",)
    assert DrawParams(labels=()).labels == ()
    assert DrawParams(labels=LABEL_FIELDS).labels == LABEL_FIELDS


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"labels": ("name",)}, "labels must be one of 'id', 'score'"),
        ({"labels": 3}, "labels must be a list of fields, got 3; pass some of"),
        ({"line_width": 0}, "line_width must be an integer from 1 to 1000; got 0"),
        ({"color_by": "speed"}, "color_by must be one of 'id', 'distance'; got 'speed'"),
        ({"panel": "left"}, "panel must be one of 'none', 'corner', 'side'; got 'left'"),
    ],
)
def test_rejects_unknown_values(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        DrawParams(**changes)
