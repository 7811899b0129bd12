import numpy as np

from vehicle_detection.tracking import SceneCuts


def test_a_cut_is_a_large_change_of_brightness_anywhere():
    road = np.random.default_rng(0).integers(0, 120, (90, 160, 3), dtype=np.uint8)
    cuts = SceneCuts()
    frames = [road, road, road + np.uint8(30), np.full((180, 320, 3), 230, np.uint8)]
    assert [cuts.update(frame) for frame in (*frames, frames[-1], road)] == [
        False, False, False, True, False, True,
    ]  # fmt: skip
