import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection.drive.report_charts import format_time


@given(st.floats(0, 1e5))
def test_times_carry_when_they_are_rounded(seconds):
    text = format_time(seconds)
    *hours, minutes, rest = text.split(":")
    assert float(rest) < 60
    total = sum(int(part) * unit for part, unit in zip([*hours[:1], minutes][::-1], (60, 3600)))
    assert total + float(rest) == pytest.approx(seconds, abs=0.051)
