"""Sources of patches: download and verify the course's archives, list and decode folders and zip files."""

from __future__ import annotations

import contextlib
import logging
import lzma
import os
import re
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Limit,
    atomic_write,
    check,
    check_regular_file,
    is_hidden,
    make_folder,
    natural_key,
    progress_bar,
    read_regular_file,
    resolve_jobs,
    walk_files,
)
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.images import IMAGE_SUFFIXES, decode_image

_LOGGER = logging.getLogger(__name__)

COURSE_URL = "https://s3.amazonaws.com/udacity-sdc/Vehicle_Tracking/"
# Number of patches in each folder. Mirrors repack the archives, so there is no hash of the whole file.
ARCHIVES: dict[str, dict[str, int]] = {
    "vehicles.zip": {
        "vehicles/GTI_Far": 834, "vehicles/GTI_Left": 909, "vehicles/GTI_MiddleClose": 419,
        "vehicles/GTI_Right": 664, "vehicles/KITTI_extracted": 5966,
    },
    "non-vehicles.zip": {"non-vehicles/Extras": 5068, "non-vehicles/GTI": 3900},
}  # fmt: skip
# Labels by folder name, without hyphens and underscores.
CLASS_FOLDERS = {"vehicles": True, "cars": True, "nonvehicles": False, "notcars": False}
# Maximum size of all unpacked members together; the course's have 60 MB each.
_MAX_ARCHIVE_BYTES = 1_000_000_000
# Errors of zipfile on a damaged archive; RuntimeError if it is encrypted.
_ZIP_ERRORS = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, RuntimeError, ValueError, OSError,
)  # fmt: skip


def parent_folder(name: str) -> str:
    """Folder part of a patch's name."""
    return name.rpartition("/")[0]


def is_image(name: str) -> bool:
    """Whether a file name is that of an image that is not hidden."""
    return name.lower().endswith(IMAGE_SUFFIXES) and not is_hidden(name)


def open_archive(path: Path, shown: str | None = None) -> zipfile.ZipFile:
    """Open a zip for reading, or raise a DatasetError that says what the file is instead."""
    check_regular_file(path, shown or str(path), error=DatasetError)
    try:
        return zipfile.ZipFile(path)
    except _ZIP_ERRORS as error:
        reason = "is not a zip; pass a folder of patches or a .zip file"
        try:
            with path.open("rb") as file:
                head = file.read(512).lstrip()
        except OSError as unreadable:
            reason = f"cannot be read: {unreadable.strerror}; check the path and its permissions"
        else:
            if head.startswith(b"PK"):
                reason = "is a damaged or incomplete zip; download it again"
            elif head.startswith(b"<"):
                reason = "is a web page, not a zip (perhaps a login page); open the address in a browser"
        raise DatasetError(f"{shown or path} {reason}") from error


@dataclass(frozen=True)
class Listing:
    """Images of a folder or zip file in natural order."""

    path: Path
    names: tuple[str, ...]  # Names of the patches.
    members: tuple[str, ...]  # Members of the zip, or paths relative to the folder.

    @contextlib.contextmanager
    def reader(self) -> Iterator[Callable[[str], bytes]]:
        """Yield a function that reads a member's bytes. It is not thread-safe: open one per thread."""
        if self.path.is_dir():
            yield lambda member: read_regular_file(
                self.path / member, f"{member} of {self.path}", Limit.IMAGE_BYTES, error=DatasetError
            )
            return
        limit = Limit.IMAGE_BYTES.current()
        with open_archive(self.path) as archive:

            def read(member: str) -> bytes:
                with archive.open(member) as file:
                    data = file.read(limit + 1)  # whatever size the archive states
                if len(data) > limit:
                    name = Limit.IMAGE_BYTES.variable
                    raise ValueError(f"larger than {limit:,} bytes; set {name} if it is meant to be")
                return data

            yield read


def list_patches(source: str | os.PathLike[str], name: str) -> Listing:
    """List the images in a folder or zip; `name` is the argument's name in error messages."""
    path = check.path(source, name, kind="the path of a folder or zip")
    if not path.exists():
        raise DatasetError(f"{name} {path} does not exist; check the path, or download the course's patches")
    found = _list_folder(path) if path.is_dir() else _list_zip(path)
    if not found:
        zips = sorted(file.name for file in path.glob("*.zip"))
        remedy = f"pass one of its zip files ({', '.join(zips)})" if zips else "download the course's patches"
        raise DatasetError(f"{name} {path} holds no PNG or JPEG patches; {remedy}")
    names = tuple(sorted(found, key=natural_key))
    return Listing(path, names, tuple(found[each] for each in names))


def _list_folder(folder: Path) -> dict[str, str]:
    """Map names of images, which start with the folder's name, to paths relative to the folder."""
    paths = walk_files(folder, "folder", error=DatasetError)
    members = [path.relative_to(folder).as_posix() for path in paths]
    folder_name = Path(os.path.abspath(folder)).name
    return {f"{folder_name}/{member}": member for member in members if is_image(member)}


def _list_zip(path: Path) -> dict[str, str]:
    """Map names of images, as they are after unpacking, to members of the zip."""
    with open_archive(path) as archive:
        members = {member.replace("\\", "/").removeprefix("./"): member for member in archive.namelist()}
    found = {name: member for name, member in members.items() if is_image(name)}
    # Unless all members are in one folder, a zip is unpacked into a folder with its own name.
    single = len({name.partition("/")[0] for name in found}) == 1 and all("/" in name for name in found)
    return found if single else {f"{path.stem}/{name}": member for name, member in found.items()}


def folder_labels(listing: Listing) -> dict[str, bool | None]:
    """Label of each folder by the innermost folder name, or else the zip's name, that stands for a class."""
    found: dict[str, bool | None] = {}
    for folder in dict.fromkeys(map(parent_folder, listing.names)):
        parts = folder.split("/") if listing.path.is_dir() else [listing.path.stem, *folder.split("/")]
        classes = [CLASS_FOLDERS.get(re.sub("[-_ ]", "", part.lower())) for part in parts]
        found[folder] = next((label for label in reversed(classes) if label is not None), None)
    return found


def infer_labels(listing: Listing) -> NDArray[np.bool_]:
    """Label patches by `folder_labels`, which must know each folder."""
    known = folder_labels(listing)
    for folder, label in known.items():
        if label is None:
            raise InvalidInputError(
                f"label must be 1 or 0 for {listing.path}, because no folder in {folder!r} is named vehicles "
                "or non-vehicles; pass label=1 for vehicles, 0 for non-vehicles"
            )
    return np.array([known[parent_folder(name)] for name in listing.names], np.bool_)


def decode_listings(
    listings: Sequence[Listing], *, size: int, jobs: int | None, progress: bool
) -> NDArray[np.uint8]:
    """Decode all images into one ``(N, size, size, 3)`` array, in the order of the listings."""
    check.integer(size, "size", low=1, high=4096)
    jobs = resolve_jobs(jobs) if jobs is not None else min(resolve_jobs(None), 8)
    total = sum(len(listing.names) for listing in listings)
    patches = np.empty((total, size, size, 3), np.uint8)
    # OpenCV releases the GIL, so threads suffice. Each decodes a range of rows, as opening a zip takes time.
    with progress_bar(progress, total, unit="patch") as bar, ThreadPoolExecutor(jobs) as pool:
        outs = np.split(patches, np.cumsum([len(each.names) for each in listings])[:-1])
        futures = [
            pool.submit(_decode_rows, listing, rows.tolist(), out, bar.update)
            for listing, out in zip(listings, outs)
            for rows in np.array_split(np.arange(len(out)), jobs)
        ]
        for future in futures:
            future.result()
    return patches


def _decode_rows(
    listing: Listing, rows: list[int], out: NDArray[np.uint8], update: Callable[[], object]
) -> None:
    """Decode the images of `rows` into the same rows of `out`; call `update` after each."""
    with listing.reader() as read:
        for row in rows:
            where = f"{listing.names[row]} of {listing.path}"
            try:
                image = decode_image(read(listing.members[row]), where)
            except InvalidInputError as error:
                raise DatasetError(f"{error}; replace or remove it") from error
            except _ZIP_ERRORS as error:
                raise DatasetError(
                    f"{where} cannot be read ({error}); download or unpack it again"
                ) from error
            if image.shape != out.shape[1:]:
                height, width = image.shape[:2]
                expected = f"{out.shape[1]}x{out.shape[1]}"
                raise DatasetError(
                    f"{where} is {width}x{height} pixels, expected {expected}; resize it to {expected} pixels"
                )
            out[row] = image
            update()


def verify_archive(path: Path, counts: dict[str, int], *, shown: str) -> None:
    """Raise a DatasetError unless the zip holds exactly the number of PNGs per folder, all undamaged."""
    remedy = "pass the url of a folder with the course's archives"
    with open_archive(path, shown) as archive:
        size = sum(member.file_size for member in archive.infolist())
        if size > _MAX_ARCHIVE_BYTES:
            raise DatasetError(f"{shown} holds {size:,} bytes, more than the course's patches; {remedy}")
        found: Counter[str] = Counter()
        for name in sorted({member.replace("\\", "/") for member in archive.namelist()}):
            folder = parent_folder(name)
            if (is_hidden(name) and ".." not in name) or name.endswith("/"):
                continue
            if folder not in counts or not name.endswith(".png"):
                raise DatasetError(f"{shown} holds {name!r}, which is not a patch of the course; {remedy}")
            found[folder] += 1
        for folder, expected in counts.items():
            if found[folder] != expected:
                raise DatasetError(
                    f"{shown} holds {found[folder]} patches in {folder}, expected {expected}; {remedy}"
                )
        try:
            damaged = archive.testzip()
        except _ZIP_ERRORS as error:
            raise DatasetError(f"{shown} is damaged ({error}); download it again") from error
        if damaged is not None:
            raise DatasetError(f"{shown} is damaged at {damaged!r}; download it again")


def fetch_patches(
    folder: str | os.PathLike[str] | None = None, *, url: str = COURSE_URL, progress: bool = True
) -> tuple[Path, Path]:
    """Download the course's training patches: ``vehicles.zip`` and ``non-vehicles.zip`` (110 MB).

    Each archive is verified by the names, number and checksums of its members (8,792 vehicles and 8,968
    non-vehicles) and written atomically; one that verifies already is not downloaded again. The patches come
    from the GTI vehicle image database and KITTI (CC BY-NC-SA 3.0, non-commercial).

    Returns paths of the vehicles and the non-vehicles, the arguments of `load_training_patches`.

    Parameters
    ----------
    folder, url
        Folder for the two files, created if missing, None for the user's cache folder; and the base URL
        (``http://`` or ``https://``) that they are at.
    progress
        Show a progress bar on standard error.

    Examples
    --------
    >>> fetch_patches(url="s3://bucket")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: url must start with http:// or https://; got 's3://bucket'
    """
    if not url.startswith(("http://", "https://")):
        raise InvalidInputError(f"url must start with http:// or https://; got {url!r}")
    if folder is None:
        import pooch

        folder = pooch.os_cache("vehicle_detection")
    vehicles, non_vehicles = (
        _fetch(Path(folder) / name, f"{url.rstrip('/')}/{name}", counts, progress)
        for name, counts in ARCHIVES.items()
    )
    return vehicles, non_vehicles


def _fetch(target: Path, address: str, counts: dict[str, int], progress: bool) -> Path:
    """Download the archive to `target` unless that is verified already; return `target`."""
    if target.is_file():
        try:
            verify_archive(target, counts, shown=str(target))
            return target
        except DatasetError as error:
            _LOGGER.warning("the existing file is not the archive, downloading it again: %s", error)
    make_folder(target.parent, "folder")
    with atomic_write(target) as part:
        _LOGGER.info("downloading %s", address)
        _download(address, part, progress)
        verify_archive(part, counts, shown=address)
    return target


def _download(address: str, part: Path, progress: bool) -> None:
    """Download `address` into the file `part`; a failure of the network raises a DatasetError."""
    import pooch
    import requests

    responses: list[requests.Response] = []
    hooks = {"response": lambda response, **_: responses.append(response)}
    # Not pooch.retrieve, which asks to pin the hash of the file.
    download = pooch.HTTPDownloader(progressbar=progress, chunk_size=1 << 16, hooks=hooks)
    try:
        download(address, str(part), None)
    except requests.HTTPError as error:
        status = getattr(error.response, "status_code", "an error")
        raise DatasetError(
            f"{address} returns {status}; pass the url of a folder with {' and '.join(ARCHIVES)}"
        ) from error
    except requests.RequestException as error:
        raise DatasetError(
            f"{address} cannot be downloaded completely ({type(error).__name__}); check the network and url "
            f"and call again, or put the file from a browser into {part.parent}"
        ) from error
    finally:
        # pooch leaves the connection open when it raises.
        for response in responses:
            response.close()
