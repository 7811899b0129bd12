from dataclasses import replace

from tools.soak import Sample, judge, soak

STEADY = Sample(frames=10, memory_mb=500.0, frames_per_second=50.0, tracks=3, mean_distance_m=30.0)


def test_a_short_run_has_a_sample_for_each_tenth():
    samples = list(soak("highway", frames=20, length=10, shape=(180, 320)))
    assert [sample.frames for sample in samples] == list(range(2, 21, 2))
    assert min(sample.frames_per_second for sample in samples) > 0
    assert samples[-1].memory_mb < samples[0].memory_mb + 20


def test_growth_slowdown_and_drift_are_named():
    changes = {
        "memory grew from 500 to 600 MB": {"memory_mb": 600.0},
        "speed fell from 50 to 30 frames/s": {"frames_per_second": 30.0},
        "the number of tracks is not bounded": {"tracks": 100},
        "distances drifted from 30.0 to 50.0 m": {"mean_distance_m": 50.0},
    }
    for problem, change in changes.items():
        assert judge([STEADY, *[replace(STEADY, **change)] * 9]) == [problem]
