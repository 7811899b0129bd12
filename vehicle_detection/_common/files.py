"""Files and folders to write: complete, or not at all."""

from __future__ import annotations

import contextlib
import errno
import glob
import logging
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from vehicle_detection._common import check
from vehicle_detection.errors import InvalidInputError, OutputError, VehicleDetectionError

_LOGGER = logging.getLogger(__name__)

_FULL = (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC))
_DISK_ERRORS = (*_FULL, errno.EROFS, errno.EIO)
# Processes that write one target at the same time, above which their leftovers are not removed.
_MAX_PARTS = 100
_SYSTEM_FOLDERS = ("__macosx", "$recycle.bin", "system volume information", "lost+found")


def check_target(target: str | os.PathLike[str], name: str = "target") -> Path:
    """Return the path of a file to write, after checking that it is no device, and its folder is writable."""
    path = check.path(target, name)
    if path.is_dir():
        raise InvalidInputError(f"{name} must be a file, got the folder {path}; add a file name to it")
    if os.path.exists(path) and not path.is_file():  # it would be replaced by a file
        raise InvalidInputError(f"{name} must be a file, got the device or pipe {path}; choose another name")
    if not path.parent.is_dir():
        raise InvalidInputError(f"{name} needs an existing folder, {path.parent} is not one; create it first")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InvalidInputError(f"{name} needs a writable folder, {path.parent} is read-only; choose another")
    return path


def check_suffix(target: str | os.PathLike[str], name: str, suffixes: Sequence[str]) -> Path:
    """Return the path of a file to write, after checking its suffix and folder."""
    path = check_target(target, name)
    if path.suffix.lower() not in suffixes:
        allowed, example = " or ".join(suffixes), path.stem + suffixes[0]
        raise InvalidInputError(f"{name} must end in {allowed}, got {path.name!r}; write {example!r}")
    return path


def make_folder(path: str | os.PathLike[str], name: str) -> Path:
    """Create a folder and those above it, if they are missing, and return it."""
    folder = check.path(path, name, kind="a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = f"{folder} cannot be created: {error.strerror}"
        raise InvalidInputError(f"{name} must be a folder, {reason}; choose another") from error
    return folder


def write_text(target: str | os.PathLike[str], text: str, name: str = "target") -> None:
    """Write a text as UTF-8 with Unix line ends, as a whole or not at all."""
    with atomic_write(target, name) as part:
        part.write_text(text, encoding="utf-8", newline="\n")


def is_hidden(name: str) -> bool:
    """Whether a file or one of its folders is hidden, or a folder of the system, such as the recycle bin.

    `name` is relative to the folder that is listed, with slashes.
    """
    return any(part.startswith(".") or part.lower() in _SYSTEM_FOLDERS for part in name.split("/"))


def walk_files(
    folder: Path, name: str = "source", *, error: type[VehicleDetectionError] = InvalidInputError
) -> Iterator[Path]:
    """Yield the files of a folder and below that are not hidden, each once, also where links lead to folders.

    A folder that cannot be read is an `error`, not an empty one; `name` is that of the argument.
    """

    def refuse(reason: OSError) -> None:
        text = f"{name} {reason.filename} cannot be listed ({reason.strerror}); change its permissions"
        raise error(text) from reason

    visited = set[str]()
    for parent, folders, files in os.walk(folder, onerror=refuse, followlinks=True):
        place = os.path.realpath(parent)
        folders[:] = [] if place in visited else sorted(each for each in folders if not is_hidden(each))
        if place not in visited:
            yield from (Path(parent, each) for each in files if not is_hidden(each))
        visited.add(place)


@contextlib.contextmanager
def atomic_write(target: str | os.PathLike[str], name: str = "target") -> Iterator[Path]:
    """Yield a temporary path beside `target`, renamed to `target` if the block succeeds.

    After an error or an interrupt, the temporary file is removed and an existing `target` is unchanged. A
    killed process leaves its temporary file, which the next one with the same target overwrites and renames.
    The temporary name has the suffix of `target`, which determines the format that many libraries write. A
    full disk and other errors of the system are an `OutputError`.
    """
    path = check_target(target, name)
    if path.is_symlink() and path.exists():  # the link stays one
        path = path.resolve()
    with contextlib.ExitStack() as stack:
        with _output_errors(path, every=True):
            part = _open_part(path, stack)
        try:
            with _output_errors(path, part):
                yield part
            with _output_errors(path, every=True):
                with contextlib.suppress(OSError):  # some file systems, such as exFAT, refuse it
                    part.chmod(_permissions(path))  # the temporary file is private
                part.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):  # the first error is the one to report
                part.unlink()
            raise


def _permissions(path: Path) -> int:
    """Permissions of an existing file, or else those of any new one."""
    if sys.platform == "win32":  # where only a read-only file differs, which cannot be renamed
        return 0o666
    with contextlib.suppress(OSError):  # it is missing, or a link that leads nowhere
        return stat.S_IMODE(path.stat().st_mode)
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask


@contextlib.contextmanager
def _output_errors(path: Path, part: Path | None = None, *, every: bool = False) -> Iterator[None]:
    """Raise errors of the disk as an `OutputError` that names the output.

    With `every`, these are all errors of the system; otherwise those that concern the temporary file `part`.
    """
    try:
        yield
    except VehicleDetectionError:
        raise
    except OSError as error:
        named = error.filename or str(part), error.filename2
        if not every and (error.errno not in _DISK_ERRORS or str(part) not in named):
            raise
        kept = "; the existing file is unchanged" if path.is_file() else ""
        reason = error.strerror or str(error) or type(error).__name__
        remedy = "free some space" if error.errno in _FULL else "check the folder, or choose another"
        raise OutputError(f"{path} cannot be written ({reason}); {remedy}{kept}") from error


def _open_part(path: Path, stack: contextlib.ExitStack) -> Path:
    """Create the temporary file of a target, locked until `stack` closes where the system has locks.

    The names are numbered: a file that no process has locked is what a killed one has left.
    """
    # The stem is shortened: with additions, it may exceed the limit for file names.
    prefix = f".{path.stem[:32]}."
    if sys.platform != "win32":
        for number in range(_MAX_PARTS):
            part = path.parent / f"{prefix}{number}.part{path.suffix}"
            try:
                handle = open_locked(part)
            except BlockingIOError:
                continue
            if handle is None:
                break
            stack.callback(os.close, handle)
            return part
    handle, temporary = tempfile.mkstemp(prefix=prefix, suffix=f".part{path.suffix}", dir=path.parent)
    os.close(handle)
    return Path(temporary)


def open_locked(part: Path) -> int | None:
    """Open and lock a new or abandoned file, not on Windows; None if the file system has no locks.

    Raises BlockingIOError if another process uses the file, or it is not a file.
    """
    import fcntl

    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    while True:
        try:
            handle = os.open(part, flags, 0o600)
        except OSError as error:
            if not os.path.lexists(part):  # the disk is full, or read-only
                raise
            # A link, a folder, or the file of another user.
            raise BlockingIOError(error.errno, error.strerror) from error
        try:
            status = os.fstat(handle)
            if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:  # a pipe, or also another's file
                raise BlockingIOError(errno.EWOULDBLOCK, "not a file of its own")
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with contextlib.suppress(FileNotFoundError):
                # Another process may have renamed or removed the file before it was locked.
                if os.path.samestat(os.stat(part), status):
                    os.truncate(handle, 0)
                    return handle
        except BlockingIOError:
            os.close(handle)
            raise
        except OSError:  # a file system without locks
            os.close(handle)
            part.unlink(missing_ok=True)
            return None
        os.close(handle)


def private_folder(name: str) -> str:
    """Create a folder for temporary files that only this user can write; empty if that is impossible.

    numba's cache holds pickled objects, so another user must not have created it.
    """
    if not hasattr(os, "getuid"):  # Windows, where the folder of temporary files is private
        return str(Path(tempfile.gettempdir()) / name)
    user = os.getuid()  # containers may have users without a name
    try:
        folder = Path(tempfile.gettempdir()) / f"{name}-{user}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        _LOGGER.warning("%s cannot be created (%s); kernels are kept elsewhere", name, error.strerror)
        return ""
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != user or found.st_mode & 0o022:
        _LOGGER.warning("%s can be written by other users; remove it, kernels are kept elsewhere", folder)
        return ""
    return str(folder)


@contextlib.contextmanager
def temporary_folder(parent: Path, name: str) -> Iterator[Path]:
    """Create a hidden folder in `parent`, removed after the block; also remove those of killed processes."""
    with contextlib.ExitStack() as stack:
        with _output_errors(parent / name, every=True):
            lock = _open_part(parent / name, stack)
            stack.callback(lock.unlink, missing_ok=True)
            for left in parent.glob(f"{glob.escape(lock.name)}.*"):  # no process has locked them
                shutil.rmtree(left, ignore_errors=True)
            folder = Path(tempfile.mkdtemp(prefix=f"{lock.name}.", dir=parent))
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
        with _output_errors(parent / name):
            yield folder
