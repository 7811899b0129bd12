import math

import motmetrics
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.evaluation.cases import CAR, boxes_of, moved, trials
from vehicle_detection import InvalidInputError, TrackTable, evaluate_tracks, iou_matrix


def clip(tracks, *, step=4.0, offset=(0.0,)):
    """One vehicle a frame further right in every frame, followed by `tracks`; None where it is missed."""
    labels = boxes_of(*((frame, 1, moved(step * frame)) for frame in range(len(tracks))))
    rows = [
        (frame, track, moved(step * frame + offset[frame % len(offset)]))
        for frame, track in enumerate(tracks)
        if track is not None
    ]
    return (boxes_of(*rows) if rows else TrackTable([], [], [])), labels


@pytest.mark.parametrize(
    ("tracks", "switches", "fragmentations", "mota", "idf1"),
    [
        ([5, 5, 5, 5], 0, 0, 1, 1),
        ([5, 5, 6, 6], 1, 0, 3 / 4, 1 / 2),
        ([5, 6, 5, 5], 2, 0, 2 / 4, 3 / 4),
        ([5, None, 5, 5], 0, 1, 3 / 4, 6 / 7),
        ([5, None, 6, None], 1, 1, 1 / 4, 2 / 6),
        ([None, 5, 5, None], 0, 0, 2 / 4, 4 / 6),
        ([None, None, None, None], 0, 0, 0, 0),
    ],
)
def test_switches_and_fragmentations_by_hand(tracks, switches, fragmentations, mota, idf1):
    scores = evaluate_tracks(*clip(tracks))
    assert (scores.id_switches, scores.fragmentations) == (switches, fragmentations)
    assert scores.mota == pytest.approx(mota)
    assert scores.idf1 == pytest.approx(idf1)
    assert scores.vehicles == 1
    assert scores.tracks == len({*tracks} - {None})


def test_jitter_by_hand():
    # Errors of 0, 2, 0: each step changes the left and right edge by 2, top and bottom not at all.
    assert evaluate_tracks(*clip([5, 5, 5], offset=(0, 2, 0))).jitter == 1
    assert evaluate_tracks(*clip([5, 5, 5], offset=(3,))).jitter == 0
    # Another track on the same vehicle jumps all the same; a gap is no pair of frames.
    assert evaluate_tracks(*clip([5, 6], offset=(0, 2))).jitter == 1
    assert math.isnan(evaluate_tracks(*clip([5, None, 5], offset=(0, 0, 2))).jitter)


def test_consecutive_frames_differ_by_the_smallest_step():
    found, labels = clip([5, 5, 5, 5], offset=(0, 2))
    every_tenth = [side.renamed(lambda key: key * 10) for side in (found, labels)]
    assert evaluate_tracks(*every_tenth).jitter == 1
    gap = [side.renamed(lambda key: key + 90 * (key > 1)) for side in (found, labels)]
    assert evaluate_tracks(*gap).jitter == 1
    assert evaluate_tracks(gap[0], gap[1][:0]).longest_false_positive_run == 2
    names = [side.renamed(lambda key: f"{3 * key}.png") for side in (found, labels)]
    assert evaluate_tracks(*names).jitter == 1
    # Names given in another order follow each other in that order: errors of 0, 0, 2, 2.
    assert evaluate_tracks(*names, frames=["0.png", "6.png", "3.png", "9.png"]).jitter == pytest.approx(1 / 3)


@pytest.mark.parametrize(
    ("frames", "longest"), [([], 0), ([3], 1), ([0, 1, 2], 3), ([0, 1, 3, 4, 5, 7], 3), ([0, 2, 4], 1)]
)
def test_longest_false_positive_run_by_hand(frames, longest):
    _, labels = clip([None] * 8)
    false = boxes_of(*((f, 9, moved(700)) for f in frames)) if frames else TrackTable([], [], [])
    assert evaluate_tracks(false, labels).longest_false_positive_run == longest


def test_boxes_without_tracks_are_rejected():
    labels, loose = boxes_of((0, 1, CAR)), boxes_of((0, -1, CAR))
    with pytest.raises(InvalidInputError, match=r"predictions must .*track for every box, row 0 in frame 0"):
        evaluate_tracks(loose, labels)
    with pytest.raises(InvalidInputError, match="labels must have a track"):
        evaluate_tracks(labels, loose)


@st.composite
def crowds(draw):
    """Vehicles that cross and hide each other, under tracks that go over from one to the other."""
    length = draw(st.integers(2, 8))
    sides = []
    for spread in (80, 30):
        rows = [
            (frame, track, moved(draw(st.integers(0, spread))))
            for frame in range(length)
            for track in range(3)
            if draw(st.integers(0, 5))
        ]
        sides.append(boxes_of(*rows, frame_keys=range(length)) if rows else TrackTable([], [], []))
    return sides[1], sides[0]


@given(trial=trials() | crowds())
@settings(max_examples=20)
def test_track_scores_equal_those_of_motmetrics(trial):
    found, labels = trial
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for key in labels.frame_keys:
        truth, here = labels.frame(key), found.frame(key)
        overlap = iou_matrix(truth.boxes, here.boxes)
        distance = np.where(overlap >= 0.5, 1 - overlap, np.nan)
        accumulator.update(truth["track_id"], here["track_id"], distance)
    names = ("mota", "idf1", "num_switches", "num_fragmentations", "num_misses", "num_false_positives")
    row = motmetrics.metrics.create().compute(accumulator, metrics=list(names), name="clip").iloc[0]
    scores = evaluate_tracks(found, labels)
    assert scores.mota == pytest.approx(row["mota"], nan_ok=True)
    assert scores.idf1 == pytest.approx(row["idf1"], nan_ok=True)
    assert (scores.id_switches, scores.fragmentations) == (row["num_switches"], row["num_fragmentations"])
    assert (scores.fn, scores.fp) == (row["num_misses"], row["num_false_positives"])


def random_clip(seed, frames, cars):
    """Vehicles that cross each other, and noisy tracks that break off, are missing, or are false."""
    rng = np.random.default_rng(seed)
    sides = [[], []]
    starts, speeds, sizes = rng.uniform(0, 1000, (cars, 2)), rng.normal(0, 3, (cars, 2)), (90, 60)
    for frame in range(frames):
        corners = starts + frame * speeds % 300
        for car, corner in enumerate(corners):
            sides[0].append((frame, car, (*corner, *(corner + sizes))))
            if rng.random() < 0.85:
                noisy = corner + rng.normal(0, 9, 2)
                sides[1].append((frame, car + 100 * (frame // 80), (*noisy, *(noisy + sizes))))
        false = rng.uniform(0, 900, 2)
        sides[1].append((frame, 10_000 + frame // 20, (*false, *(false + sizes))))
    return boxes_of(*sides[1]), boxes_of(*sides[0])


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((0, 40, 3), [0.457914644547, 0.397990153682, 0.52692598926, 0.760298645282]),
        ((1, 200, 8), [0.320385852512, 0.492026463188, 0.209032618238, 0.766242905537]),
        ((2, 100, 20), [0.449067961274, 0.527963869918, 0.382111555145, 0.764329127214]),
        ((3, 60, 6), [0.516364488366, 0.477750686932, 0.558288370279, 0.766597507178]),
        ((4, 150, 12), [0.385341688993, 0.513874046093, 0.28930974888, 0.766112835158]),
    ],
)
def test_hota_of_longer_clips_equals_that_of_trackeval(arguments, expected):
    # HOTA, DetA, AssA and LocA by TrackEval 1.3.0, which is no dependency of the tests: it needs OpenCV's
    # build with windows, which does not load on a server.
    found, labels = random_clip(*arguments)
    scores = evaluate_tracks(found, labels)
    np.testing.assert_allclose([scores.hota, scores.deta, scores.assa, scores.loca], expected, atol=1e-9)


def test_hota_by_hand():
    # Perfect boxes under two tracks of 2 frames each: every match shares 2 of its 4 frames.
    scores = evaluate_tracks(*clip([5, 5, 6, 6]))
    assert (scores.deta, scores.assa, scores.loca) == (1, 0.5, 1)
    assert scores.hota == pytest.approx(math.sqrt(0.5))
    assert "HOTA" in scores.summary()
    missed = evaluate_tracks(*clip([None, None]))
    assert (missed.hota, missed.deta, missed.assa, missed.loca) == (0, 0, 0, 1)  # as in TrackEval
    assert math.isnan(evaluate_tracks(TrackTable([], [], []), TrackTable([], [], [])).hota)


def test_tracks_with_ignored_boxes_as_regions():
    labels = boxes_of((0, 1, moved(500)), (0, 2, (0, 0, 300, 90)), ignore=np.array([False, True]))
    found = boxes_of((0, 7, CAR), (0, 8, moved(500)))
    plain, lenient = (evaluate_tracks(found, labels, ignored_as_regions=each) for each in (False, True))
    assert (plain.tp, plain.fp, plain.ignored, plain.idf1) == (1, 1, 0, 2 / 3)
    assert (lenient.tp, lenient.fp, lenient.ignored, lenient.idf1, lenient.hota) == (1, 0, 1, 1, 1)
