import os
import stat
import threading
from pathlib import Path

import pytest

from vehicle_detection._common import atomic_write, check_target
from vehicle_detection.errors import InvalidInputError


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_check_target_returns_a_path(tmp_path):
    assert check_target(str(tmp_path / "out.csv")) == tmp_path / "out.csv"
    assert check_target("out.csv") == Path("out.csv")


def test_check_target_refuses_a_folder(tmp_path):
    with pytest.raises(InvalidInputError, match=r"path must be a file, got the folder .*; add a file name"):
        check_target(tmp_path, "path")


def test_check_target_refuses_a_missing_folder(tmp_path):
    with pytest.raises(
        InvalidInputError, match=r"target needs an existing folder, .*nowhere is not one; create"
    ):
        check_target(tmp_path / "nowhere" / "out.csv")
    (tmp_path / "file").touch()
    with pytest.raises(InvalidInputError, match="target needs an existing folder"):
        check_target(tmp_path / "file" / "out.csv")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_check_target_refuses_a_read_only_folder(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(InvalidInputError, match="target needs a writable folder"):
            check_target(tmp_path / "out.csv")
    finally:
        tmp_path.chmod(0o700)


def test_check_target_refuses_a_folder_that_the_system_calls_read_only(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK)
    with pytest.raises(InvalidInputError, match=r"target needs a writable folder, .* is read-only; choose"):
        check_target(tmp_path / "out.csv")


def test_the_file_exists_after_the_block(tmp_path):
    target = tmp_path / "out.csv"
    with atomic_write(target) as part:
        assert part.parent == tmp_path
        assert part.suffix == ".csv"
        part.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert names(tmp_path) == ["out.csv"]


@pytest.mark.parametrize("interrupt", [KeyboardInterrupt, SystemExit, OSError, GeneratorExit, MemoryError])
@pytest.mark.parametrize("earlier", [None, "earlier"])
def test_an_interrupt_leaves_no_temporary_file_and_keeps_the_existing_one(tmp_path, interrupt, earlier):
    target = tmp_path / "out.csv"
    if earlier:
        target.write_text(earlier)

    def write():
        with atomic_write(target) as part:
            part.write_text("half")
            raise interrupt

    with pytest.raises(interrupt, match=r"^$"):
        write()
    assert names(tmp_path) == (["out.csv"] if earlier else [])
    assert not earlier or target.read_text() == earlier


def test_a_failed_rename_leaves_no_file(tmp_path, monkeypatch):
    def refuse(self, target):
        raise PermissionError("not yours")

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(PermissionError, match="not yours"), atomic_write(tmp_path / "out.csv") as part:
        part.write_text("whole")
    assert names(tmp_path) == []


@pytest.mark.parametrize("umask", [0o022, 0o077, 0o027])
def test_permissions_equal_those_of_any_new_file(tmp_path, umask):
    before = os.umask(umask)
    try:
        with atomic_write(tmp_path / "out.csv") as part:
            part.touch()
        assert stat.S_IMODE((tmp_path / "out.csv").stat().st_mode) == 0o666 & ~umask
        assert os.umask(umask) == umask
    finally:
        os.umask(before)


def test_a_file_name_of_maximum_length(tmp_path):
    target = tmp_path / f"{'n' * 251}.csv"
    with atomic_write(target) as part:
        part.write_text("whole")
    assert target.read_text() == "whole"


def test_concurrent_writers_of_one_file_do_not_mix(tmp_path):
    target = tmp_path / "out.txt"
    together = threading.Barrier(4)

    def write(text):
        with atomic_write(target) as part, part.open("w") as file:
            together.wait()
            for _ in range(50):
                file.write(text)
            together.wait()

    writers = [threading.Thread(target=write, args=(letter * 100,)) for letter in "abcd"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    text = target.read_text()
    assert len(text) == 5000
    assert len(set(text)) == 1
    assert names(tmp_path) == ["out.txt"]
