import dataclasses

import numpy as np
import pytest

from tests.helpers import drawn, write_frame_set
from tests.video.clips import gray_frames, write_clip
from vehicle_detection import LabelledFrames, TrackTable, read_labels, render_drive, write_image, write_labels
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.training import FrameDataset, check_sources, find_sources, load_training_frames


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": ""}, "name must be a non-empty string, got ''"),
        ({"sets": ("road",)}, "sets must be a LabelledFrames, got 'road'"),
    ],
)
def test_invalid_frame_datasets(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        dataclasses.replace(FrameDataset("road", (drawn([0]),)), **changes)


def test_sources_differ_in_name_and_are_enough():
    one, two = (FrameDataset(name, (drawn([0]),)) for name in ("one", "two"))
    assert check_sources([one]) == (one,)
    assert check_sources([one, two]) == (one, two)
    with pytest.raises(InvalidInputError, match="sources must have different names, got 'one' twice"):
        check_sources([one, one])
    for none in (one, []):
        with pytest.raises(InvalidInputError, match="sources must be a list of FrameDataset, one or more"):
            check_sources(none)


def test_find_sources(tmp_path):
    write_frame_set(tmp_path, "town", drawn(range(3)))
    write_frame_set(tmp_path, "coast", drawn(range(2)))
    write_frame_set(tmp_path, "stills", drawn(range(4)), place=".")
    (tmp_path / "labels" / "._town.csv").write_bytes(b"of macOS")
    found = find_sources(tmp_path)
    assert [source.name for source in found] == ["coast", "stills", "town"]
    assert [[len(part) for part in source.sets] for source in found] == [[2], [4], [3]]
    assert len(found[2].sets[0].labels) == len(drawn(range(3)).labels)


def test_labels_of_coco(tmp_path, caplog):
    frames = drawn(range(3))
    write_frame_set(tmp_path, "town", frames)
    table = tmp_path / "labels" / "town.csv"
    labels = read_labels(table)
    table.unlink()
    for shape in (None, frames[0].shape, (9, 16)):
        assert caplog.text == ""
        named = labels.renamed(lambda name: f"town/{name}")
        write_labels(named, tmp_path / "labels" / "town.json", shape=shape)
        (source,) = find_sources(tmp_path)
        assert len(source.sets[0].labels) == len(frames.labels)
    assert "3 of 3 images have another size than it states, such as " in caplog.text
    write_labels(labels, table)
    with pytest.raises(DatasetError, match=r"town\.csv and \S.*town\.json label the same frames"):
        find_sources(tmp_path)


def test_frames_of_a_video_are_sampled_at_the_clip_rate(tmp_path):
    for name in ("labels", "videos"):
        (tmp_path / name).mkdir()
    drive = render_drive(frames=20, shape=(96, 160), fps=10)
    write_labels(drive.labels, tmp_path / "labels" / "drive.csv")
    write_clip(tmp_path / "videos" / "drive.mp4", [scene.image for scene in drive], fps=10)
    (source,) = find_sources(tmp_path, clip_rate=2.0)
    assert (source.name, source.sets[0].keys) == ("drive", (0, 5, 10, 15))
    (source,) = find_sources(tmp_path)
    assert source.sets[0].keys == (0, 3, 6, 9, 12, 15, 18)


def test_invalid_folders(tmp_path):
    with pytest.raises(DatasetError, match="does not exist; pass the folder of the labelled frames"):
        find_sources(tmp_path / "none")
    with pytest.raises(DatasetError, match=r"has no labels/NAME\.csv \(or \.json, .*convert other labels"):
        find_sources(tmp_path)
    write_frame_set(tmp_path, "town", drawn(range(2)))
    labels = tmp_path / "labels" / "town.csv"
    rows = labels.read_text()
    labels.write_text(rows.replace("00", "99"))
    with pytest.raises(InvalidInputError, match=r"town.csv: labels must name the frames, such as "):
        find_sources(tmp_path)
    labels.write_text(rows)
    (tmp_path / "labels" / "other.csv").write_text(rows)
    with pytest.raises(DatasetError, match=r"other.csv has no .*add .*frames/other, .*other or .*other.mp4"):
        find_sources(tmp_path)
    (tmp_path / "frames" / "other").mkdir()
    with pytest.raises((DatasetError, InvalidInputError), match="other"):
        find_sources(tmp_path)


def write_source(root, name, frames, rows):
    """Images of a source, and its labels."""
    (root / "labels").mkdir(exist_ok=True)
    (root / "frames" / name).mkdir(parents=True)
    for number in range(frames):
        write_image(root / "frames" / name / f"{number}.png", np.zeros((90, 160, 3), np.uint8))
    (root / "labels" / f"{name}.csv").write_text("frame,track,x1,y1,x2,y2\n" + "".join(rows))


def frames_of(height, width):
    """A source of one frame with a vehicle and an ignored box."""
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    labels = TrackTable([0, 0], None, [[10, 20, 60, 50], [0, 0, width, 10]], ignore=[False, True])
    return FrameDataset("road", (LabelledFrames("road", [image], labels),)), image


@pytest.mark.parametrize(("height", "width"), [(90, 160), (160, 90)])
def test_the_longer_side_of_frames_is_limited(height, width):
    source, image = frames_of(height, width)
    (frame,) = load_training_frames([source], max_side=80)
    assert frame.image.shape == (height // 2, width // 2, 3)
    assert (frame.boxes.tolist(), frame.ignored.tolist()) == ([[5, 10, 30, 25]], [[0, 0, width / 2, 5]])
    assert frame.image.mean() == pytest.approx(image.mean(), abs=1)
    with pytest.raises(InvalidInputError, match="max_side must be an integer"):
        load_training_frames([source], max_side=0)


@pytest.mark.parametrize(
    ("labelled", "chosen"),
    [
        (range(24), [0, 8, 16]),  # all frames: three per second
        (range(0, 24, 10), [0, 10, 20]),  # some: only these
        (range(5), [0]),  # the beginning: only there
        (range(6, 20, 2), [6, 14]),
    ],
)
def test_frames_of_videos_that_are_labelled_in_part(tmp_path, labelled, chosen):
    (tmp_path / "labels").mkdir()
    (tmp_path / "videos").mkdir()
    write_clip(tmp_path / "videos" / "own.MP4", gray_frames(24), fps=25)
    rows = [f"{number},1,10,10,50,40\n" for number in labelled]
    (tmp_path / "labels" / "own.CSV").write_text("frame,track,x1,y1,x2,y2\n" + "".join(rows))
    (source,) = find_sources(tmp_path)
    assert list(source.sets[0].keys) == chosen


def test_images_whose_labels_have_other_names_are_not_empty_frames(tmp_path, caplog):
    write_source(tmp_path, "road", 3, ["in\\1.png,1,10,10,60,50\n", "2_png.rf.7a.png,1,10,10,60,50\n"])
    (source,) = find_sources(tmp_path)
    assert set(source.sets[0].keys) == set(source.sets[0].labels["frame"].tolist()) == {"1.png"}
    assert "1 of 2 labelled frames have no image in" in caplog.text
    assert "such as '2_png.rf.7a.png'; they are left out" in caplog.text


def test_images_are_unlabelled_if_few_have_labels(tmp_path, caplog):
    write_source(tmp_path, "few", 3, ["1.png,1,10,10,60,50\n"])
    write_source(tmp_path, "empty", 3, [])
    assert [source.sets[0].keys for source in find_sources(tmp_path)] == [
        ("0.png", "1.png", "2.png"),
        ("1.png",),
    ]
    assert "names 1 of 3 images" in caplog.text
