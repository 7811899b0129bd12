"""`track`: an iterator of results."""

import contextlib
import gc
import itertools

import numpy as np
import pytest

from tests.helpers import random_network
from tests.video.clips import ffmpeg
from vehicle_detection import VehicleDetector, open_tracks, process_video, render_drive, track, write_video
from vehicle_detection.cli.demo import draw_clip
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.video import open_source, read_frames


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stream")
    drive = render_drive(frames=12, shape=(180, 320), scenario="overtaking")
    draw_clip(drive, folder / "clip.mp4", folder / "labels.csv")
    return folder / "clip.mp4"


@pytest.fixture(scope="module")
def detector():
    with VehicleDetector(random_network(), jobs=1) as detector:
        yield detector


def boxes(results):
    return [
        (result.index, result.time, [(track.id, track.box.tolist()) for track in result.tracks])
        for result in results
    ]


def test_the_frames_are_those_of_process_video(clip, detector, tmp_path):
    expected = []
    with open_tracks(tmp_path / "expected.csv") as write:
        process_video(clip, None, detector, on_result=lambda each: (expected.append(each), write(each)))
    assert any(result.tracks for result in expected)
    found = []
    with open_tracks(tmp_path / "found.csv") as write:
        for result in track(clip, detector, frames=True):
            write(result)
            found.append(result)
    assert boxes(found) == boxes(expected) == boxes(track(clip, detector))
    assert (tmp_path / "found.csv").read_bytes() == (tmp_path / "expected.csv").read_bytes()
    assert [result.searched for result in found] == [True, False] * 6
    assert len(found[0].detections) == len(expected[0].detections)
    with read_frames(clip) as frames:
        for (_, time, frame), result in zip(frames, found, strict=True):
            assert result.time == time
            np.testing.assert_array_equal(result.frame, frame)


def test_identities_carry_over_from_segment_to_segment(clip, detector, tmp_path):
    whole, card = tmp_path / "whole.mp4", tmp_path / "card"
    card.mkdir()
    ffmpeg("-i", clip, "-g", 4, "-bf", 0, "-video_track_timescale", 12800, whole)
    split = ["-f", "segment", "-segment_time", "0.16", "-reset_timestamps", 1]
    ffmpeg("-i", whole, "-c", "copy", *split, card / "GRMN%04d.mp4")
    assert len(list(card.iterdir())) == 3
    expected = boxes(track(whole, detector))
    assert any(tracks for _, _, tracks in expected)
    assert boxes(track(sorted(card.iterdir()), detector)) == expected


def test_a_frame_rate_with_false_cuts_gives_a_warning(detector, caplog):
    for fps in (5, 4):
        next(track(open_source("test_images", fps=fps), detector))
    (message,) = caplog.messages
    assert " has 4 frames/s: " in message


@pytest.mark.parametrize("end", ["close", "delete", "break", "error", "unused"])
def test_closing_it_early_leaves_no_process(clip, detector, end):
    results = track(clip, detector, frames=True)
    if end != "unused":
        # The clip is so short that it may be decoded when the first of the delayed results comes.
        assert next(results).index == 0
    if end == "close":
        results.close()
    elif end == "break":
        for _ in results:
            break
    elif end == "error":
        with contextlib.suppress(ZeroDivisionError):
            for result in results:
                result.index / 0
    del results
    gc.collect()


def test_options_and_ranges(clip):
    with VehicleDetector(random_network(), jobs=1) as detector:
        times = [result.time for result in track(clip, detector, start=0.1, end=0.3, every=1)]
    with read_frames(clip, start=0.1, end=0.3) as frames:
        assert times == [time for _, time, _ in frames]


def test_a_source_that_is_opened_already(clip, detector):
    with open_source(clip) as source:
        assert len(list(itertools.islice(track(source, detector), 3))) == 3
        assert len(list(track(source, detector))) == 12


def test_a_detector_may_be_a_model(clip):
    assert [result.frame for result in track(clip, "highway", end=0.08)] == [None, None]


def test_what_cannot_be_written(clip, detector, tmp_path):
    for results in (iter([]), track(clip, detector)):
        with pytest.raises(InvalidInputError, match=r"results must .*; pass .*frames=True"):
            write_video(results, tmp_path / "out.mp4", detector.annotator)
    with pytest.raises(InvalidInputError, match=r"annotator must have .*; pass an Annotator"):
        write_video(track(clip, detector, frames=True), tmp_path / "out.mp4", None)
