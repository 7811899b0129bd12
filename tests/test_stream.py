"""`track`: results as a generator and as a list."""

import contextlib
import gc
import itertools

import numpy as np
import pytest

from tests.helpers import random_network
from tests.video.clips import child_processes, ffmpeg, running_threads
from vehicle_detection import FrameResult, TrackWriter, VehicleDetector, notebook, process_video, track
from vehicle_detection.cli.demo import draw_clip
from vehicle_detection.errors import InvalidInputError, VideoError
from vehicle_detection.scenes import render_drive
from vehicle_detection.video import open_source, read_frames


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stream")
    drive = render_drive(frames=12, shape=(180, 320), scenario="overtaking")
    draw_clip(drive, folder / "clip.mp4", folder / "labels.csv")
    return folder / "clip.mp4"


@pytest.fixture(scope="module")
def detector():
    with VehicleDetector(random_network(), n_jobs=1, every=2) as detector:
        yield detector


def boxes(results):
    return [
        (result.index, result.time, [(track.id, track.box.tolist()) for track in result.tracks])
        for result in results
    ]


def test_the_frames_are_those_of_process_video(clip, detector, tmp_path):
    expected = []
    with TrackWriter(tmp_path / "expected.csv") as write:
        process_video(clip, None, detector, on_result=lambda each: (expected.append(each), write(each)))
    assert any(result.tracks for result in expected)
    found = []
    with TrackWriter(tmp_path / "found.csv") as write:
        for result in track(clip, detector, stream=True):
            write(result)
            found.append(result)
    assert boxes(found) == boxes(expected) == boxes(track(clip, detector))
    assert (tmp_path / "found.csv").read_bytes() == (tmp_path / "expected.csv").read_bytes()
    assert [result.searched for result in found] == [True, False] * 6
    assert all(result.shown == result.result.shown for result in found)
    assert len(found[0].detections) == len(expected[0].detections)
    with read_frames(clip) as frames:
        for (_, time, frame), result in zip(frames, found, strict=True):
            assert result.time == time
            np.testing.assert_array_equal(result.frame, frame)
            np.testing.assert_array_equal(result.picture, detector.annotate(frame, result.result))
    assert found[0].picture is found[0].picture


def test_the_number_of_threads_changes_nothing(clip, detector):
    expected = boxes(track(clip, detector, workers=1))
    assert any(tracks for _, _, tracks in expected)
    for workers in (2, 3, 7):
        assert boxes(track(clip, detector, workers=workers)) == expected


def test_identities_carry_over_from_segment_to_segment(clip, detector, tmp_path):
    whole, card = tmp_path / "whole.mp4", tmp_path / "card"
    card.mkdir()
    ffmpeg("-i", clip, "-g", 4, "-bf", 0, "-video_track_timescale", 12800, whole)
    split = ["-f", "segment", "-segment_time", "0.16", "-reset_timestamps", 1]
    ffmpeg("-i", whole, "-c", "copy", *split, card / "GRMN%04d.mp4")
    assert len(list(card.iterdir())) == 3
    expected = boxes(track(whole, detector))
    assert any(tracks for _, _, tracks in expected)
    assert boxes(track(card, detector)) == expected


@pytest.mark.parametrize("end", ["close", "delete", "break", "error", "unused"])
def test_closing_it_early_leaves_no_process(clip, detector, end):
    before = child_processes()
    results = track(clip, detector, stream=True)
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
    assert child_processes() == before
    assert not running_threads()


def test_options_and_ranges(clip):
    times = [result.time for result in track(clip, random_network(), start=0.1, end=0.3, every=1)]
    with read_frames(clip, start=0.1, end=0.3) as frames:
        assert times == [time for _, time, _ in frames]


def test_a_source_that_is_opened_already(clip, detector):
    with open_source(clip) as source:
        assert len(list(itertools.islice(track(source, detector, stream=True), 3))) == 3
        assert len(track(source, detector)) == 12


def test_bad_arguments(clip, detector, tmp_path):
    with pytest.raises(InvalidInputError, match=r"model is a detector, .* got every in addition"):
        track(clip, detector, every=2)
    with pytest.raises(InvalidInputError, match="show must be True or False; got 'yes'"):
        track(clip, detector, show="yes")
    with pytest.raises(InvalidInputError, match=r"source missing\.mp4 does not exist"):
        track("missing.mp4", random_network(), stream=True)
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(VideoError, match="is a text file, not a video"):
        track(tmp_path / "text.mp4", detector, stream=True)


def test_functions_of_results_take_tracked_frames(clip, detector):
    found = list(track(clip, detector, stream=True, end=0.2))
    notebook.plot_tracks(found)
    notebook.plot_birds_eye(found)
    notebook.plot_stage_times(found)
    np.testing.assert_array_equal(detector.annotate(found[1].frame, found[1]), found[1].picture)
    assert [each.index for each in detector.backfill(found)] == [each.index for each in found]
    assert found[0].windows is found[0].result.windows
    assert type(found[0].result) is FrameResult
