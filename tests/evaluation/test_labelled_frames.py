import numpy as np
import pytest

from tests.video.clips import write_clip
from vehicle_detection import InvalidInputError, LabelledFrames, TrackTable, render_drive

LABELS = TrackTable([0, 1, 1], None, [[10, 10, 60, 50], [20, 10, 70, 50], [100, 0, 150, 40]], frame_keys=[2])
IMAGES = [np.full((60, 160, 3), value, np.uint8) for value in (10, 20)]


def test_labelled_frames_have_a_repr_and_iterate():
    frames = LabelledFrames("road", IMAGES, LABELS)
    assert repr(frames) == "LabelledFrames('road', 2 frames, 3 boxes)"
    assert (len(frames), frames.keys) == (2, (0, 1))
    assert [image[0, 0, 0] for _, image in frames] == [10, 20]
    one = LabelledFrames("one", {1: IMAGES[1]}, LABELS)
    assert set(one.labels["frame"].tolist()) == {1}


def test_labelled_frames_of_a_video(tmp_path):
    drive = render_drive(frames=7, shape=(96, 160))
    path = write_clip(tmp_path / "drive.mp4", [scene.image for scene in drive])
    taken = LabelledFrames.from_video(path, LABELS, every=3, horizon=0.5)
    assert (taken.name, taken.keys, taken.horizon) == ("drive", (0, 3, 6), 0.5)
    assert set(taken.labels["frame"].tolist()) == {0}
    with pytest.raises(InvalidInputError, match="every must be an integer at least 1"):
        LabelledFrames.from_video(path, LABELS, every=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("", IMAGES, LABELS), "name must be a non-empty string, got ''"),
        (("a", [], LABELS), "frames must hold at least one image"),
        (("a", IMAGES, LABELS.renamed(lambda key: key + 10)), "labels must name the frames, such as "),
    ],
)
def test_invalid_labelled_frames(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        LabelledFrames(*arguments)
