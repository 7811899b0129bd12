import errno
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.helpers import FULL_DISK, failing
from vehicle_detection._common import atomic_write, check_target, temporary_folder
from vehicle_detection.errors import InvalidInputError, OutputError


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (".", r"must be a file, got the folder .*; add a file name"),
        ("nowhere/out.csv", r"needs an existing folder, .*nowhere is not one; create"),
        ("file/out.csv", "needs an existing folder"),
        ("pipe", "must be a file, got the device or pipe"),
        ("null", "must be a file, got the device or pipe"),
    ],
)
def test_targets_that_are_no_files(tmp_path, name, message):
    assert check_target(str(tmp_path / "out.csv")) == tmp_path / "out.csv"
    (tmp_path / "file").touch()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "null").symlink_to(os.devnull)  # the device itself would be lost if the check failed
    with pytest.raises(InvalidInputError, match=f"^path {message}"):
        check_target(tmp_path / name, "path")


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
    monkeypatch.setattr(Path, "replace", failing(PermissionError("not yours")))
    message = r"out.csv cannot be written \(not yours\); check the folder, or choose another"
    with pytest.raises(OutputError, match=message), atomic_write(tmp_path / "out.csv") as part:
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


@pytest.mark.parametrize("earlier", [None, "earlier"])
def test_a_full_disk_names_the_output(tmp_path, earlier):
    target = tmp_path / "out.csv"
    if earlier:
        target.write_text(earlier)
    kept = "; the existing file is unchanged" if earlier else ""
    message = rf"out.csv cannot be written \(No space left on device\); free some space{kept}$"
    with pytest.raises(OutputError, match=message), atomic_write(target):
        FULL_DISK()
    assert names(tmp_path) == (["out.csv"] if earlier else [])


def test_no_space_for_a_new_file(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "open", FULL_DISK)
    monkeypatch.setattr(os, "mkdir", FULL_DISK)
    with pytest.raises(OutputError, match=r"out.csv cannot be written"), atomic_write(tmp_path / "out.csv"):
        pass
    with pytest.raises(OutputError, match="demo cannot be written"), temporary_folder(tmp_path, "demo"):
        pass


def test_errors_of_other_files_are_not_those_of_the_output(tmp_path):
    with pytest.raises(FileNotFoundError, match="other"), atomic_write(tmp_path / "out.csv"):
        (tmp_path / "other").read_text()


def test_a_folder_that_vanishes_and_a_target_that_becomes_one(tmp_path):
    folder = tmp_path / "gone"
    folder.mkdir()
    failed = pytest.raises(OutputError, match=r"out.csv cannot be written")
    with failed, atomic_write(folder / "out.csv") as part:
        part.unlink()
        folder.rmdir()
    failed = pytest.raises(OutputError, match=r"out.csv cannot be written")
    with failed, atomic_write(tmp_path / "out.csv"):
        (tmp_path / "out.csv").mkdir()
    assert names(tmp_path) == ["out.csv"]


KILLED = """
import os, sys
from pathlib import Path
from vehicle_detection._common import atomic_write, temporary_folder
with atomic_write(sys.argv[1]) as part, temporary_folder(Path(sys.argv[1]).parent, "demo") as folder:
    part.write_text("half")
    (folder / "clip.mp4").write_text("half")
    print(part.name, folder.name, flush=True)
    sys.stdin.read()
"""


def test_the_next_run_removes_what_a_killed_one_has_left(tmp_path):
    target = tmp_path / "out.csv"
    command = [sys.executable, "-c", KILLED, str(target)]
    (tmp_path / ".out.backup.csv").write_text("of the user")
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        part, folder = process.stdout.readline().split()
        # A running process keeps its files, and a second run on its target works.
        with atomic_write(target) as other, temporary_folder(tmp_path, "demo"):
            other.write_text("second")
            assert (tmp_path / part).read_text() == "half"
            assert (tmp_path / folder / "clip.mp4").exists()
        process.kill()
    assert {".out.backup.csv", "out.csv", part, folder} <= set(names(tmp_path))
    with atomic_write(target) as third, temporary_folder(tmp_path, "demo"):
        assert third.read_text() == ""
        third.write_text("third")
    assert target.read_text() == "third"
    assert names(tmp_path) == [".out.backup.csv", "out.csv"]


def test_a_link_with_the_name_of_a_temporary_file_is_not_followed(tmp_path):
    (tmp_path / "victim").write_text("whole")
    (tmp_path / ".out.0.part.csv").symlink_to("victim")
    with atomic_write(tmp_path / "out.csv") as part:
        part.write_text("new")
    assert (tmp_path / "victim").read_text() == "whole"
    assert (tmp_path / "out.csv").read_text() == "new"


def test_a_file_system_without_locks_and_permissions(tmp_path, monkeypatch):
    refuse = failing(PermissionError(errno.EPERM, "Operation not permitted"))
    monkeypatch.setattr("fcntl.flock", refuse)
    monkeypatch.setattr(Path, "chmod", refuse)
    with atomic_write(tmp_path / "out.csv") as part, temporary_folder(tmp_path, "demo") as folder:
        part.write_text("new")
        assert folder.is_dir()
    assert (tmp_path / "out.csv").read_text() == "new"
    assert names(tmp_path) == ["out.csv"]


@pytest.mark.skipif(sys.platform == "win32", reason="no modes and links")
def test_links_and_permissions_of_a_target_stay(tmp_path):
    real, link = tmp_path / "real.csv", tmp_path / "link.csv"
    real.write_text("old")
    real.chmod(0o600)
    link.symlink_to(real)
    with atomic_write(link) as part:
        part.write_text("new")
    assert link.is_symlink()
    assert (real.read_text(), stat.S_IMODE(real.stat().st_mode)) == ("new", 0o600)
    assert names(tmp_path) == ["link.csv", "real.csv"]
