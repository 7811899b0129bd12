import numpy as np
import pytest

from tests.datasets.cases import patch_image
from vehicle_detection import DatasetError, load_frames, write_image


def test_frames_are_read_on_access(tmp_path):
    for number in (10, 9):
        write_image(tmp_path / f"frame{number}.png", patch_image(number))
    (tmp_path / "frame11.jpg").write_bytes(b"damaged")
    (tmp_path / "notes.txt").write_text("no frame")
    (tmp_path / "folder.png").mkdir()
    frames = load_frames(tmp_path)
    assert frames.names == ("frame9.png", "frame10.png", "frame11.jpg")
    assert len(frames) == 3
    assert "3 frames" in repr(frames)
    np.testing.assert_array_equal(frames[1], patch_image(10))
    with pytest.raises(DatasetError, match=r"frame11.jpg .*cannot be decoded; replace or remove it"):
        frames[-1]
    with pytest.raises(IndexError):
        frames[3]
    (tmp_path / "frame11.jpg").unlink()
    assert [name for name, image in load_frames(tmp_path)] == ["frame9.png", "frame10.png"]


def test_missing_and_empty_folders(tmp_path):
    with pytest.raises(DatasetError, match=r"folder .*nowhere does not exist or .*a folder; check the path"):
        load_frames(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=r"folder .* holds no PNG or JPEG frames; pass the folder"):
        load_frames(tmp_path)


@pytest.mark.realdata
def test_the_real_frames_are_listed(real_data):
    frames = load_frames(real_data / "frames" / "camvid")
    assert len(frames) == 163
    assert frames[0].shape == (360, 480, 3)
