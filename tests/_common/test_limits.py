"""Files that are endless, too large or no files."""

import os
import tracemalloc
import zipfile

import pytest

from vehicle_detection import load_model, load_patches, read_camera, read_labels
from vehicle_detection._common import Limit, check, read_regular_file
from vehicle_detection.errors import DatasetError, InvalidInputError, ModelFileError

READERS = [
    (load_model, ModelFileError, "VEHICLE_DETECTION_MAX_MODEL_BYTES"),
    (read_labels, DatasetError, "VEHICLE_DETECTION_MAX_TEXT_BYTES"),
    (read_camera, InvalidInputError, "VEHICLE_DETECTION_MAX_TEXT_BYTES"),
    (lambda path: load_patches(path, label=1), DatasetError, None),
]


@pytest.fixture
def pipe(tmp_path):
    path = tmp_path / "pipe.csv"
    os.mkfifo(path)
    return path


@pytest.mark.parametrize(("read", "error", "variable"), READERS)
def test_devices_and_pipes_are_refused_at_once(read, error, variable, pipe):
    for path in ("/dev/zero", pipe):
        with pytest.raises(error, match="is a device or a pipe, which may never end; copy it to a file"):
            read(path)


def test_a_device_in_a_folder_of_patches_is_refused(tmp_path):
    (tmp_path / "endless.png").symlink_to("/dev/zero")
    with pytest.raises(DatasetError, match=r"endless.png of .+ is a device or a pipe, which may never end"):
        load_patches(tmp_path, label=1)


@pytest.mark.parametrize(("read", "error", "variable"), READERS[:3])
def test_files_larger_than_the_limit_are_refused(read, error, variable, tmp_path, monkeypatch):
    path = tmp_path / "large.csv"
    path.write_bytes(b"frame\n" * 100)
    monkeypatch.setenv(variable, "599")
    with pytest.raises(error, match=rf"large.csv is larger than 599 bytes; .*, set {variable}"):
        read(path)


def test_a_file_that_grows_while_it_is_read(tmp_path, monkeypatch):
    path = tmp_path / "log.csv"
    path.write_bytes(b"1234")
    tracemalloc.start()
    try:
        assert read_regular_file(path, "log", Limit.TEXT_BYTES) == b"1234"
        assert tracemalloc.get_traced_memory()[1] < 1_000_000  # not the limit of 1 GB
    finally:
        tracemalloc.stop()
    monkeypatch.setenv(Limit.TEXT_BYTES.variable, "8")
    open_file = type(path).open

    def grow(self, mode):
        with open_file(self, "ab") as file:
            file.write(b"12345")
        return open_file(self, mode)

    monkeypatch.setattr(type(path), "open", grow)
    with pytest.raises(InvalidInputError, match="log is larger than 8 bytes"):
        read_regular_file(path, "log", Limit.TEXT_BYTES)


def test_a_member_larger_than_the_limit_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "vehicles.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("vehicles/bomb.png", bytes(10_000_000))
    assert path.stat().st_size < 20_000
    monkeypatch.setenv(Limit.IMAGE_BYTES.variable, "1000000")
    with pytest.raises(DatasetError, match=r"bomb.png .* cannot be read \(larger than 1,000,000 bytes; set"):
        load_patches(path)


@pytest.mark.parametrize(
    "name", ["a" * 5000, "a/" * 2500, "b" * 300 + "/c", "\ud800.csv", "a\0b.csv", b"bytes.csv"]
)
@pytest.mark.parametrize("read", [load_model, read_labels, lambda path: load_patches(path, label=1)])
def test_impossible_file_names(name, read):
    with pytest.raises(InvalidInputError, match=r"must be .*(4096 bytes|255 bytes|character|got b)"):
        read(name)


def test_unusual_file_names_are_possible(tmp_path):
    for name in ("é" * 127, "name with\nline break", os.fsdecode(b"\xff\xfe")):
        assert check.path(tmp_path / name) == tmp_path / name


@pytest.mark.parametrize(("read", "error", "variable"), READERS)
def test_loops_of_symbolic_links(read, error, variable, tmp_path):
    loop = tmp_path / "loop.zip"
    loop.symlink_to(loop)
    with pytest.raises(error, match=r"does not exist|Too many levels of symbolic links"):
        read(loop)


def test_a_limit_of_thousands_of_digits(monkeypatch):
    monkeypatch.setenv(Limit.PIXELS.variable, "9" * 5000)
    with pytest.raises(InvalidInputError, match="must be a number of pixels"):
        Limit.PIXELS.current()
