import dataclasses

import imageio_ffmpeg
import pytest

from tests.helpers import drawn, write_frame_set
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.mixture_training import find_sources
from vehicle_detection.synthetic import render_drive


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": ""}, "name must be a non-empty string, got ''"),
        ({"name": 5}, "name must be a non-empty string"),
        ({"sets": ()}, "sets must be a tuple of at least one entry"),
        ({"sets": None}, "sets must be a tuple of at least one entry; got None"),
        ({"sets": ("road",)}, "sets must be a LabelledFrames, got 'road'"),
        ({"min_labelled_width": -1}, "min_labelled_width must be a number, at least 0"),
    ],
)
def test_invalid_frame_datasets(drawn_source, changes, message):
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(drawn_source, **changes)


def test_find_sources(tmp_path):
    write_frame_set(tmp_path, "town", drawn(range(3)))
    write_frame_set(tmp_path, "coast", drawn(range(2)))
    write_frame_set(tmp_path, "stills", drawn(range(4)), place=".")
    found = find_sources(tmp_path, min_labelled_widths={"coast": 60.0, "unknown": 30.0})
    assert [source.name for source in found] == ["coast", "stills", "town"]
    assert [[len(part) for part in source.sets] for source in found] == [[2], [4], [3]]
    assert [source.min_labelled_width for source in found] == [60.0, 0.0, 0.0]
    assert len(found[2].sets[0].labels) == len(drawn(range(3)).labels)


def test_frames_of_a_video_are_sampled_at_the_clip_rate(tmp_path):
    for name in ("labels", "videos"):
        (tmp_path / name).mkdir()
    drive = render_drive(frames=20, shape=(96, 160), fps=10)
    drive.write_labels(tmp_path / "labels" / "drive.csv")
    writer = imageio_ffmpeg.write_frames(
        str(tmp_path / "videos" / "drive.mp4"), (160, 96), fps=10, macro_block_size=1
    )
    writer.send(None)
    for scene in drive:
        writer.send(scene.image.tobytes())
    writer.close()
    (source,) = find_sources(tmp_path, clip_rate=2.0)
    assert (source.name, source.sets[0].keys) == ("drive", (0, 5, 10, 15))
    (source,) = find_sources(tmp_path)
    assert source.sets[0].keys == (0, 3, 6, 9, 12, 15, 18)


def test_invalid_folders(tmp_path):
    with pytest.raises(DatasetError, match="does not exist; pass the folder of the labelled frames"):
        find_sources(tmp_path / "none")
    with pytest.raises(DatasetError, match=r"has no labels/NAME\.csv; pass the folder"):
        find_sources(tmp_path)
    write_frame_set(tmp_path, "town", drawn(range(2)))
    labels = tmp_path / "labels" / "town.csv"
    rows = labels.read_text()
    labels.write_text(rows.replace("00", "99"))
    with pytest.raises(InvalidInputError, match=r"town.csv: labels must name the frames, such as "):
        find_sources(tmp_path)
    labels.write_text(rows)
    (tmp_path / "labels" / "other.csv").write_text(rows)
    with pytest.raises(
        DatasetError, match=r"other.csv has no frames: add .*frames/other, .*other or .*other.mp4"
    ):
        find_sources(tmp_path)
    (tmp_path / "frames" / "other").mkdir()
    with pytest.raises((DatasetError, InvalidInputError), match="other"):
        find_sources(tmp_path)
