"""Material that the tests of the commands share."""

import pytest

from tests.cli.commands import write_patches
from vehicle_detection import render_drive, write_image
from vehicle_detection.cli.demo import draw_clip


@pytest.fixture(scope="session")
def material(tmp_path_factory):
    """Return a folder with a clip and its labels, a picture, patches and damaged copies."""
    folder = tmp_path_factory.mktemp("material")
    drive = render_drive(frames=10, shape=(270, 480), scenario="overtaking")
    draw_clip(drive, folder / "clip.mp4", folder / "labels.csv")
    write_image(folder / "road.png", drive[6].image)
    write_patches(folder, 40)
    for name in ("clip.mp4", "road.png"):
        data = (folder / name).read_bytes()
        (folder / f"cut_{name}").write_bytes(data[: len(data) // 2])
    for name in ("text.mp4", "text.png", "text.safetensors"):
        (folder / name).write_text("not what the name says")
    (folder / "empty").mkdir()
    return folder


@pytest.fixture
def picture(material):
    return material / "road.png"


@pytest.fixture
def clip(material):
    return material / "clip.mp4"
