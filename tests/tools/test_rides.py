from tools.rides import kept_rides

NAMES = [f"ride{number}.jpg" for number in range(900)]


def test_the_kept_rides_are_two_hundred_after_the_first_and_follow_from_the_names():
    kept = kept_rides(NAMES)
    assert len(set(kept)) == 200
    assert not set(kept) & set(NAMES[:557])
    assert 650 < sum(map(NAMES.index, kept)) / 200 < 800  # spread over the others
    assert kept_rides([name for name in NAMES for _ in range(3)]) == kept_rides(NAMES)
    assert kept_rides([*NAMES[:557], *NAMES[:556:-1]]) == kept_rides(NAMES)
    assert kept_rides(NAMES)[:2] == ["ride605.jpg", "ride875.jpg"]
    assert kept_rides(NAMES[:557]) == []
