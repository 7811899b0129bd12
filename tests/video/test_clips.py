"""Annotating clips of moviepy: times, rewinding, and its methods and effects."""

import numpy as np
import pytest
from moviepy import (
    AudioClip,
    ColorClip,
    ImageClip,
    ImageSequenceClip,
    VideoClip,
    VideoFileClip,
    concatenate_videoclips,
    vfx,
)

from tests.helpers import find_red
from tests.video.clips import write_clip
from vehicle_detection import Annotator, DrawParams, InvalidInputError, detector_from, render_drive
from vehicle_detection.video import annotate_clip, probe_video

SHAPE = (120, 200)


def frame_with(left):
    frame = np.full((*SHAPE, 3), 90, np.uint8)
    frame[50:80, left : left + 40] = (240, 15, 15)
    return frame


def clip_of(count=20, fps=25, start=20):
    return ImageSequenceClip([frame_with(start + 2 * step) for step in range(count)], fps=fps)


def pictures(clip):
    return [frame.copy() for frame in clip.iter_frames()]


def assert_same(first, second):
    assert len(first) == len(second)
    for one, other in zip(first, second):
        np.testing.assert_array_equal(one, other)


class Recorder:
    """An annotated clip of a detector of red boxes, and its results."""

    def __init__(self, clip, **options):
        self.results = []
        self.clip = annotate_clip(clip, detector_from(find_red), on_result=self.results.append, **options)

    @property
    def times(self):
        return [result.time for result in self.results]


@pytest.fixture
def expected():
    """The 20 frames of `clip_of`, annotated one after the other with their times."""
    detector = detector_from(find_red)
    return [
        detector.annotate(frame, detector.process(frame, step / 25))
        for step, frame in enumerate(pictures(clip_of()))
    ]


def test_frames_are_processed_once_with_their_times(expected):
    recorder = Recorder(clip_of())
    assert recorder.times == [0]  # moviepy reads the first frame to know its size
    for _ in range(2):  # a second rendering equals the first
        assert_same(pictures(recorder.clip), expected)
        assert [track.id for track in recorder.results[-1].shown] == [1]
    assert recorder.times == 2 * [step / 25 for step in range(20)]
    assert [result.index for result in recorder.results] == 2 * list(range(20))


def test_a_frame_that_is_read_twice_is_processed_once(expected):
    recorder = Recorder(clip_of())
    for step, picture in enumerate(expected):
        for time in (step / 25, step / 25, step / 25 + 0.019):
            frame = recorder.clip.get_frame(time)
            np.testing.assert_array_equal(frame, picture)
            frame[:] = 0  # the caller may draw on it
    assert len(recorder.results) == 20


def test_going_back_starts_anew(expected):
    recorder = Recorder(clip_of())
    for time in (0.2, 0.5, 0.3):
        recorder.clip.get_frame(time)
    assert [result.index for result in recorder.results] == [0, 1, 2, 0]
    assert_same(pictures(recorder.clip), expected)


def test_clips_and_the_detector_have_tracks_of_their_own(expected):
    detector = detector_from(find_red)
    for step in range(8):
        result = detector.process(frame_with(150 - step), step / 25)
    seen = [[], []]
    first, second = (annotate_clip(clip_of(), detector, on_result=results.append) for results in seen)
    for step, picture in enumerate(expected):  # alternately
        np.testing.assert_array_equal(first.get_frame(step / 25), picture)
        np.testing.assert_array_equal(second.get_frame(step / 25), picture)
    assert {track.id for results in seen for result in results for track in result.shown} == {1}
    following = detector.process(frame_with(141), 8 / 25)
    assert following.index == 8
    assert [track.id for track in following.shown] == [track.id for track in result.shown] == [1]


def test_duration_frame_rate_and_audio_are_kept(tmp_path):
    sound = AudioClip(lambda t: np.sin(2765 * t), duration=0.8, fps=44100)
    clip = clip_of().with_audio(sound)
    annotated = annotate_clip(clip, detector_from(find_red))
    assert (annotated.duration, annotated.fps, annotated.size) == (clip.duration, 25, clip.size)
    assert annotated.audio.duration == 0.8
    target = tmp_path / "out.mp4"
    annotated.write_videofile(str(target), preset="ultrafast", logger=None, temp_audiofile_path=str(tmp_path))
    info = probe_video(target)
    assert (info.frames, float(info.fps), info.has_audio) == (20, 25, True)
    assert_same(pictures(clip), pictures(clip_of()))  # the clip itself is unchanged


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # moviepy leaves pipes open
def test_a_video_file_is_annotated(tmp_path):
    path = write_clip(tmp_path / "clip.mp4", [frame_with(20 + 2 * step) for step in range(20)], fps=25)
    with VideoFileClip(str(path)) as clip:
        recorder = Recorder(clip.subclipped(0.2, 0.6))
        assert len(pictures(recorder.clip)) == 10
        # Times start at the beginning of the part.
        assert recorder.times == [step / 25 for step in range(10)]


def test_a_part_of_an_annotated_clip(expected):
    recorder = Recorder(clip_of())
    part = recorder.clip.subclipped(0.2, 0.6)
    recorder.results.clear()
    assert len(pictures(part)) == 10
    assert recorder.times == [step / 25 for step in range(6, 15)]  # 0.2 s was read when the part was made
    assert_same(pictures(Recorder(clip_of()).clip.subclipped(0, 0.4)), expected[:10])


def test_effects_after_annotating_change_the_picture_only(expected):
    annotated = Recorder(clip_of()).clip
    cropped = annotated.cropped(x1=20, y1=10, x2=180, y2=110)
    assert_same(pictures(cropped), [picture[10:110, 20:180] for picture in expected])
    assert pictures(annotated.resized(0.5))[0].shape == (60, 100, 3)
    mirrored = annotated.with_effects([vfx.MirrorX()])
    assert_same(pictures(mirrored), [picture[:, ::-1] for picture in expected])


def test_effects_before_annotating_change_what_is_detected():
    recorder = Recorder(clip_of().cropped(x1=10, y1=20, x2=190, y2=120).resized(2.0))
    pictures(recorder.clip)
    box = recorder.results[-1].detections.boxes[0]
    np.testing.assert_allclose(box, 2 * np.array([48, 30, 88, 60]), atol=2)


@pytest.mark.parametrize("factor", [0.25, 0.5, 1, 2])
def test_another_speed_after_annotating_keeps_times_of_the_clip(factor, expected):
    recorder = Recorder(clip_of())
    changed = recorder.clip.with_speed_scaled(factor)
    assert len(pictures(changed)) == round(20 / factor)
    assert recorder.times == [step / 25 for step in range(0, 20, max(1, round(factor)))]
    assert [track.id for track in recorder.results[-1].shown] == [1]
    if factor < 1:  # slow motion repeats pictures
        assert_same(pictures(changed)[:: round(1 / factor)], expected)


@pytest.mark.parametrize("method", ["chain", "compose"])
def test_clips_are_concatenated(method, expected):
    detector, seen = detector_from(find_red), [[], []]
    parts = [annotate_clip(clip_of(), detector, on_result=results.append) for results in seen]
    joined = pictures(concatenate_videoclips(parts, method=method))
    assert len(joined) == 40
    # At 0.8 s moviepy rounds in favor of the first clip and repeats its last frame.
    assert_same(joined[:20] + joined[21:], expected + expected[1:])
    assert [[track.id for track in results[-1].shown] for results in seen] == [[1], [1]]
    # The other way round, and two parts of one annotated clip.
    whole = Recorder(concatenate_videoclips([clip_of(), clip_of()], method=method))
    assert len(pictures(whole.clip)) == 40
    one = Recorder(clip_of()).clip
    both = concatenate_videoclips([one.subclipped(0, 0.4), one.subclipped(0.4, 0.8)], method=method)
    assert_same(pictures(both), expected)


def test_clips_without_a_frame_rate():
    moving = VideoClip(lambda t: frame_with(20 + round(50 * t)), duration=0.8)
    recorder = Recorder(moving)
    for step in range(16):
        recorder.clip.get_frame(step / 20)
    assert recorder.times == [step / 20 for step in range(16)]
    still = Recorder(ImageClip(frame_with(20), duration=1))
    for step in range(10):
        still.clip.get_frame(step / 10)
    assert [track.id for track in still.results[-1].shown] == [1]


def test_speeds_are_right_for_every_frame_rate():
    for fps in (25, 50):
        drive = render_drive(frames=2 * fps, fps=fps, shape=(360, 640), scenario="overtaking", random_state=3)
        truth = [[row for row in rows if not row.ignore] for rows in drive.truth]
        found = iter([np.array([row.box for row in rows]).reshape(-1, 4) for rows in truth])
        detector = detector_from(
            lambda image, found=found: ((box := next(found)), [0.95] * len(box)), camera=drive[0].camera
        )
        clip = ImageSequenceClip([np.zeros((360, 640, 3), np.uint8)] * len(drive), fps=fps)
        results = []
        pictures(annotate_clip(clip, detector, on_result=results.append))
        shown = [track for result in results[-fps // 2 :] for track in result.shown]
        estimate = np.median([track.speed_mps for track in shown if track.speed_mps is not None])
        # A wrong frame rate would double or halve it.
        true = np.median([row.speed_mps for rows in truth for row in rows])
        assert estimate == pytest.approx(true, rel=0.2)


def test_an_image_transform_counts_the_first_frame_once_and_warns_of_speeds():
    detector = detector_from(find_red)
    transformed = clip_of(50, fps=50).image_transform(detector)
    with pytest.warns(UserWarning, match="speeds assume 25 frames per second.*annotate_clip") as caught:
        frames = pictures(transformed)
    assert len(caught) == 1
    assert len(frames) == 50
    assert detector.process(frame_with(120)).index == 50
    known = detector_from(find_red)
    known.reset(fps=50)
    pictures(clip_of(50, fps=50).image_transform(known))  # no warning


@pytest.mark.parametrize(
    "clip", [None, "drive.mp4", np.zeros((2, 2)), AudioClip(lambda t: 0 * t, duration=1)]
)
def test_what_is_no_clip_is_refused(clip):
    with pytest.raises(InvalidInputError, match=r"clip must be a video clip of moviepy .*process_video"):
        annotate_clip(clip, detector_from(find_red))
    with pytest.raises(InvalidInputError, match="on_result must be a function"):
        annotate_clip(clip_of(1), detector_from(find_red), on_result=5)


@pytest.mark.parametrize("annotator", [Annotator(DrawParams(panel="side")), Annotator(diagnostics=True)])
def test_the_size_of_the_clip_is_that_of_its_pictures(annotator):
    clip = annotate_clip(clip_of(3), detector_from(find_red, annotator=annotator))
    height, width, _ = annotator.output_shape((*SHAPE, 3))
    assert (width > SHAPE[1]) == (not annotator.diagnostics)
    assert tuple(clip.size) == (width, height)
    assert {frame.shape for frame in pictures(clip)} == {(height, width, 3)}


def test_frames_of_effects_that_are_no_bytes(expected):
    """Fading and rotating give fractions of gray levels, and single colors 64-bit integers."""
    faded = clip_of().with_effects([vfx.FadeIn(0.2)])
    assert faded.get_frame(0.1).dtype == np.float64
    assert len(pictures(Recorder(faded).clip)) == 20
    title = ColorClip((200, 120), (9, 9, 9), duration=0.2).with_fps(25)
    assert len(pictures(Recorder(concatenate_videoclips([title, clip_of()])).clip)) == 25
