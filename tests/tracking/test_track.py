import math

import pytest

from vehicle_detection.tracking import TrackParams
from vehicle_detection.tracking.track import TrackState

PARAMS = TrackParams()
DT = 0.04


def confirmed(**options):
    return TrackState(score=2.0, id=1, **options)


def test_the_stage_of_a_track():
    assert TrackState(score=1.0).state == TrackState(score=1.0, misses=3).state == "tentative"
    assert (confirmed().state, confirmed(misses=1).state) == ("confirmed", "coasting")


def test_a_detection_advances_the_score_and_ends_a_gap():
    state = confirmed(misses=2, all_misses=2, time_since_update=0.08, unexplained_gap=0.04, hidden_gap=0.04)
    state.covered_budget, state.hidden, state.lost = 0.0, True, True
    state.update_score(5.0, DT, PARAMS)
    decay = math.exp(-DT / PARAMS.score_time_constant)
    assert state.score == pytest.approx(decay * 2.0 + (1 - decay) * 5.0)
    assert (state.hits, state.misses, state.all_misses) == (2, 0, 2)
    assert (state.age, state.time_since_update, state.unexplained_gap, state.hidden_gap) == (DT, 0, 0, 0)
    assert (state.hidden, state.lost) == (False, False)
    assert state.covered_budget == PARAMS.show_covered


def test_a_frame_without_a_detection_counts_as_score_zero():
    state = confirmed(age=1.0)
    state.update_score(None, DT, PARAMS)
    assert state.score == pytest.approx(2.0 * math.exp(-DT / PARAMS.score_time_constant))
    assert (state.hits, state.misses, state.all_misses) == (1, 1, 1)
    assert (state.age, state.time_since_update) == (1.0 + DT, DT)


def test_the_time_without_detections_grows_with_detections_up_to_a_limit():
    state = confirmed()
    for _ in range(3):
        state.update_score(1.0, DT, PARAMS)
    assert state.coast_budget == pytest.approx(min(3 * DT, PARAMS.show_coast))
    for _ in range(1000):
        state.update_score(1.0, DT, PARAMS)
    assert state.coast_budget == PARAMS.show_coast
    tentative = TrackState(score=1.0)
    tentative.update_score(1.0, DT, PARAMS)
    assert tentative.coast_budget == 0.0


def test_gaps_are_counted_by_their_reason():
    state = confirmed(coast_budget=0.3, covered_budget=0.4)
    state.mark_missed(DT, hidden=True, covered=False, lost=True)
    assert (state.hidden, state.lost) == (True, True)
    state.mark_missed(DT, hidden=True, covered=True, lost=False)
    assert (state.hidden_gap, state.covered_budget, state.coast_budget) == (2 * DT, 0.4 - DT, 0.3)
    state.mark_missed(DT, hidden=False, covered=True, lost=False)
    assert (state.unexplained_gap, state.coast_budget, state.covered_budget) == (DT, 0.3 - DT, 0.4 - DT)
    assert state.hidden_gap == 2 * DT


def test_a_missed_track_is_shown_while_its_budget_lasts():
    assert not TrackState(score=1.0).shown
    assert confirmed().shown
    assert not confirmed(lost=True).shown
    assert confirmed(misses=1, coast_budget=0.0).shown
    assert not confirmed(misses=1, coast_budget=-0.01).shown


def test_a_hidden_track_is_shown_for_as_long_as_it_was_detected():
    options = {"misses": 1, "hidden": True, "coast_budget": -1.0}
    assert confirmed(**options, age=1.0, time_since_update=0.5).shown
    assert not confirmed(**options, age=1.0, time_since_update=0.51).shown
    assert not confirmed(**options, age=1.0, time_since_update=0.5, covered_budget=-0.01).shown


def test_the_conditions_of_confirmation():
    options = {"hits": 5, "all_misses": 5 - PARAMS.confirm_hits, "age": PARAMS.confirm_seconds}
    assert TrackState(score=PARAMS.confirm_score, **options).can_confirm(PARAMS)
    assert not TrackState(score=PARAMS.confirm_score - 0.01, **options).can_confirm(PARAMS)
    assert not TrackState(score=9.0, **{**options, "hits": 4}).can_confirm(PARAMS)
    young = {**options, "age": PARAMS.confirm_seconds - 0.01}
    assert not TrackState(score=9.0, **young).can_confirm(PARAMS)
    assert not TrackState(score=9.0, **options, misses=1).can_confirm(PARAMS)
    assert not TrackState(score=9.0, **options, id=1).can_confirm(PARAMS)
    assert TrackState(score=-1.0, confirm_at_birth=True).can_confirm(PARAMS)
    assert not TrackState(score=-1.0, confirm_at_birth=True, misses=1).can_confirm(PARAMS)


def test_the_end_of_a_track():
    later = 0.01
    assert not confirmed(unexplained_gap=PARAMS.max_coast, hidden_gap=PARAMS.max_hidden).is_expired(PARAMS)
    assert confirmed(unexplained_gap=PARAMS.max_coast + later).is_expired(PARAMS)
    assert confirmed(hidden_gap=PARAMS.max_hidden + later).is_expired(PARAMS)
    assert not confirmed(time_since_update=99.0).is_expired(PARAMS)
    assert not TrackState(score=1.0, time_since_update=PARAMS.tentative_coast).is_expired(PARAMS)
    assert TrackState(score=1.0, time_since_update=PARAMS.tentative_coast + later).is_expired(PARAMS)
