import dataclasses

import numpy as np
import pytest

from tests.helpers import SMALL_MIXTURE
from vehicle_detection.errors import InvalidInputError


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shapes": ()}, "shapes must be a tuple of at least one entry; got"),
        ({"shapes": (6, 5)}, r"shapes must be pairs \(columns, rows\) of cells, such as .*; got 6"),
        ({"shapes": ((6, 1),)}, "shapes must be a number, at least 2"),
        (
            {"mirrored": (True, False)},
            r"mirrored must be True or False for each of 1 shapes; got \(True, False\)",
        ),
        ({"mirrored": (1,)}, "mirrored must be True or False"),
        ({"border_shapes": None}, "border_shapes must be a tuple; got None"),
        ({"border_shapes": (4, 7)}, r"border_shapes must be pairs \(columns, rows\)"),
        ({"border_shapes": ((1, 7),)}, "border_shapes must be a number, at least 2"),
        (
            {"simulated_borders": (0.5, 1.5)},
            "simulated_borders must be a number, greater than 0 and at most 1",
        ),
        ({"border_bias": np.nan}, "border_bias must be a number"),
        ({"size_prior_weight": "much"}, "size_prior_weight must be a number"),
        ({"vote_weight": -0.1}, "vote_weight must be a number, at least 0"),
        ({"padding": -1}, "padding must be a number"),
        ({"C": 0}, "C must be a number, greater than 0"),
        ({"border_C": 0}, "border_C must be a number, greater than 0"),
        ({"border_copies": 0}, "border_copies must be an integer from 1"),
        ({"blend_weight": 1.5}, "blend_weight must be a number, at least 0 and at most 1"),
        ({"positive_weight": 0}, "positive_weight must be a number, greater than 0"),
        ({"min_width": 2}, "min_width must be a number, at least 8"),
        ({"aspect_tolerance": -0.1}, "aspect_tolerance must be a number"),
        ({"copies": 0}, "copies must be an integer from 1"),
        ({"jitter_scale": 0.5}, "jitter_scale must be a number"),
        ({"relit_copies": -1}, "relit_copies must be an integer from 0"),
        ({"mining_schedule": ()}, "mining_schedule must be a tuple of at least one entry"),
        ({"mining_schedule": (0.5, 1.5)}, "mining_schedule must be a number, greater than 0 and at most 1"),
        ({"max_per_frame": 0}, "max_per_frame must be an integer"),
        ({"max_negatives": 2.5}, "max_negatives must be an integer"),
        ({"search": None}, "search must be a PyramidParams, got None"),
    ],
)
def test_invalid_mixture_params(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(SMALL_MIXTURE, **changes)
