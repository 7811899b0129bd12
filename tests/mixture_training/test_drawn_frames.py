from types import SimpleNamespace

import numpy as np
import pytest

from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture_training import drawn_source
from vehicle_detection.mixture_training.drawn_frames import _closest_truncation


def test_the_closest_frame_with_a_truncated_vehicle():
    def moment(truncated, ignore):
        return SimpleNamespace(truth=[SimpleNamespace(truncated=truncated, ignore=ignore)])

    drive = [moment(0.0, False)] * 40
    assert _closest_truncation(drive, 17) == 17
    drive[2], drive[32], drive[22], drive[16] = (
        moment(0.5, False),
        moment(0.3, False),
        moment(0.9, True),
        moment(0.5, False),
    )
    # Ignored vehicles do not count, and only every fifth frame is searched.
    assert _closest_truncation(drive, 17) == 2
    drive[12] = moment(0.21, False)
    assert _closest_truncation(drive, 17) == 12


def test_drawn_frames_follow_from_the_seed():
    one, same, other = (drawn_source(drives=2, frames=2, random_state=seed) for seed in (0, 0, 1))
    assert (one.name, [len(part) for part in one.sets]) == ("drawn", [2, 2])
    for part, again, different in zip(one.sets, same.sets, other.sets):
        for (key, image), (_, twin), (_, stranger) in zip(part, again, different):
            assert image.shape == (720, 1280, 3)
            np.testing.assert_array_equal(image, twin)
            assert (image != stranger).any()
            assert len(part.labels.rows(key)) > 0
    with pytest.raises(InvalidInputError, match="drives must be an integer at least 1; got 0"):
        drawn_source(drives=0)
    with pytest.raises(InvalidInputError, match="frames must be"):
        drawn_source(frames=500)
