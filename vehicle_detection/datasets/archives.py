"""Where patches come from: course archives fetched and verified, folders and zips listed and decoded."""

from __future__ import annotations

import contextlib
import logging
import lzma
import math
import os
import re
import struct
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import atomic_write, check_integer, describe
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.images import decode_image

_log = logging.getLogger(__name__)

COURSE_URL = "https://s3.amazonaws.com/udacity-sdc/Vehicle_Tracking/"
"""Web folder of ``vehicles.zip`` and ``non-vehicles.zip``."""

ARCHIVES: dict[str, dict[str, int]] = {
    "vehicles.zip": {
        "vehicles/GTI_Far": 834,
        "vehicles/GTI_Left": 909,
        "vehicles/GTI_MiddleClose": 419,
        "vehicles/GTI_Right": 664,
        "vehicles/KITTI_extracted": 5966,
    },
    "non-vehicles.zip": {"non-vehicles/Extras": 5068, "non-vehicles/GTI": 3900},
}
"""Patches in each folder of each archive. Copies differ in their bytes, so no hash of the file is pinned."""

CLASS_FOLDERS = {"vehicles": True, "cars": True, "nonvehicles": False, "notcars": False}
"""Folder names, without hyphens and underscores, that say what their patches show."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

STALE_SECONDS = 3600.0
"""A partial download untouched for so long belongs to a process that was killed."""

# What zipfile raises on a damaged archive, depending on which byte is wrong; RuntimeError if it is encrypted.
_ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    RuntimeError,
    ValueError,
    OSError,
)


def natural_key(name: str) -> tuple[list[object], str]:
    """Sort key that puts ``image2`` before ``image10``."""
    parts = re.split(r"([0-9]+)", name)
    # Digits compare by length, then as text: numbers of any length, whatever their leading zeros.
    numbers = [(len(digits.lstrip("0")), digits.lstrip("0")) for digits in parts[1::2]]
    return [item for pair in zip(parts[::2], [*numbers, (0, "")]) for item in pair], name


def parent_folder(name: str) -> str:
    """Everything of a patch's name before the file's own."""
    return name.rpartition("/")[0]


def is_litter(name: str) -> bool:
    """Whether a member or file is no data: hidden, or left behind by macOS."""
    return any(part == "__MACOSX" or part.startswith(".") for part in name.split("/"))


def is_image(name: str) -> bool:
    """Whether a file's name is one of a PNG or JPEG that counts."""
    return name.lower().endswith(IMAGE_SUFFIXES) and not is_litter(name)


def open_archive(path: Path, shown: str | None = None) -> zipfile.ZipFile:
    """Open a zip for reading; a DatasetError says what the file is, if not a whole zip."""
    shown = shown or str(path)
    try:
        return zipfile.ZipFile(path)
    except _ZIP_ERRORS as error:
        try:
            with path.open("rb") as file:
                head = file.read(512).lstrip()
        except OSError as unreadable:
            raise DatasetError(
                f"{shown} cannot be read: {unreadable.strerror}; check the path and its permissions"
            ) from unreadable
        if head.startswith(b"PK"):
            reason = "is a zip that is cut short or damaged; fetch it again"
        elif head.startswith(b"<"):
            reason = "is a web page, not a zip (a login or proxy page?); open the address in a browser"
        else:
            reason = "is not a zip; pass a folder of patches or a whole .zip file"
        raise DatasetError(f"{shown} {reason}") from error


@dataclass(frozen=True)
class Listing:
    """The images of one folder or zip in natural order: their names, and what each is read by."""

    path: Path
    is_zip: bool
    names: tuple[str, ...]
    members: tuple[str, ...]

    @contextlib.contextmanager
    def reader(self) -> Iterator[Callable[[str], bytes]]:
        """Yield a function from member to bytes; each thread opens its own."""
        if self.is_zip:
            with open_archive(self.path) as archive:
                yield archive.read
        else:
            yield lambda member: (self.path / member).read_bytes()


def list_patches(source: str | os.PathLike[str], name: str) -> Listing:
    """List the images under a folder or in a zip; `name` is the argument that `source` came in by."""
    if not isinstance(source, (str, os.PathLike)):
        raise InvalidInputError(f"{name} must be the path of a folder or zip, got {describe(source)}")
    path = Path(source)
    if not path.exists():
        raise DatasetError(f"{name} {path} does not exist; check the path or use fetch_patches")
    is_zip = not path.is_dir()
    found = _list_zip(path) if is_zip else _list_folder(path)
    if not found:
        zips = [] if is_zip else sorted(file.name for file in path.glob("*.zip"))
        remedy = f"pass a zip of it ({', '.join(zips)})" if zips else "use fetch_patches for the course's"
        raise DatasetError(f"{name} {path} holds no PNG or JPEG patches; {remedy}")
    names = tuple(sorted(found, key=natural_key))
    return Listing(path, is_zip, names, tuple(found[each] for each in names))


def _list_folder(folder: Path) -> dict[str, str]:
    """Names of all images under `folder`, from its own name downwards, to paths relative to it."""

    def stop(error: OSError) -> None:
        raise DatasetError(f"{error.filename} cannot be read: {error.strerror}; check its permissions")

    own = Path(os.path.abspath(folder)).name
    found = {}
    for parent, _, files in os.walk(folder, onerror=stop):
        for file in files:
            member = (Path(parent) / file).relative_to(folder).as_posix()
            if is_image(member):
                found[f"{own}/{member}"] = member
    return found


def _list_zip(path: Path) -> dict[str, str]:
    """Names of all images in a zip, as they would be once it is unpacked, to its members."""
    with open_archive(path) as archive:
        members = {member.replace("\\", "/").removeprefix("./"): member for member in archive.namelist()}
    found = {name: member for name, member in members.items() if is_image(name)}
    # Without one folder at its top, a zip unpacks into a folder of its own name.
    single = len({name.partition("/")[0] for name in found}) == 1 and all("/" in name for name in found)
    return found if single else {f"{path.stem}/{name}": member for name, member in found.items()}


def infer_labels(listing: Listing) -> NDArray[np.bool_]:
    """Label patches by the innermost folder, or else the zip's name, that tells the class."""
    known: dict[str, bool] = {}
    for folder in dict.fromkeys(map(parent_folder, listing.names)):
        parts = [listing.path.stem, *folder.split("/")] if listing.is_zip else folder.split("/")
        classes = [CLASS_FOLDERS.get(re.sub("[-_ ]", "", part.lower())) for part in parts]
        told = [each for each in classes if each is not None]
        if not told:
            raise InvalidInputError(
                f"label must be 1 or 0 for {listing.path}, as no folder in {folder!r} is named vehicles or "
                "non-vehicles; pass label=1 for vehicles, 0 for others"
            )
        known[folder] = told[-1]
    return np.array([known[parent_folder(name)] for name in listing.names])


def decode_listings(
    listings: Sequence[Listing], *, size: int, n_jobs: int | None, progress: bool
) -> NDArray[np.uint8]:
    """Decode all images into one ``(N, size, size, 3)`` array, in the order of the listings."""
    check_integer(size, "size", low=1, high=4096)
    jobs = check_integer(n_jobs, "n_jobs", low=1) if n_jobs is not None else min(os.cpu_count() or 1, 8)
    total = sum(len(listing.names) for listing in listings)
    patches = np.empty((total, size, size, 3), np.uint8)
    with contextlib.ExitStack() as stack:
        tick: Callable[[], object] = int
        if progress:
            from tqdm import tqdm

            tick = stack.enter_context(tqdm(total=total, unit="patch")).update
        # Threads suffice, as OpenCV releases the GIL; a span of rows each, as opening a zip takes time.
        pool = stack.enter_context(ThreadPoolExecutor(jobs))
        waiting, start = [], 0
        for listing in listings:
            count = len(listing.names)
            out = patches[start : start + count]
            step = math.ceil(count / jobs)
            for first in range(0, count, step):
                rows = range(first, min(first + step, count))
                waiting.append(pool.submit(_decode_rows, listing, rows, out, tick))
            start += count
        for done in waiting:
            done.result()
    return patches


def _decode_rows(listing: Listing, rows: range, out: NDArray[np.uint8], tick: Callable[[], object]) -> None:
    """Decode the images of `rows` into the same rows of `out`."""
    side = out.shape[1]
    with listing.reader() as read:
        for row in rows:
            where = f"{listing.names[row]} of {listing.path}"
            try:
                image = decode_image(read(listing.members[row]), where)
            except InvalidInputError as error:
                raise DatasetError(f"{error}; replace or remove it") from error
            except _ZIP_ERRORS as error:
                raise DatasetError(f"{where} cannot be read ({error}); fetch or unpack it again") from error
            if image.shape != out.shape[1:]:
                height, width = image.shape[:2]
                raise DatasetError(
                    f"{where} is {width}x{height} pixels, expected {side}x{side}; "
                    f"resize it with cv2.resize(image, ({side}, {side}))"
                )
            out[row] = image
            tick()


def verify_archive(path: Path, folders: dict[str, int], *, shown: str) -> None:
    """Raise DatasetError unless the zip holds the PNGs of `folders`, in number, undamaged, and nothing else.

    Directories and macOS litter do not count.
    """
    other = "pass the url of a folder that holds the course's archives"
    with open_archive(path, shown) as archive:
        found: Counter[str] = Counter()
        for name in sorted({member.replace("\\", "/") for member in archive.namelist()}):
            # Nothing is unpacked here: this protects whoever unpacks the file later.
            if name.startswith("/") or name[1:2] == ":" or ".." in name.split("/"):
                raise DatasetError(f"{shown} holds the unsafe member {name!r}; {other}")
            if is_litter(name) or name.endswith("/"):
                continue
            folder = parent_folder(name)
            if folder not in folders or not name.endswith(".png"):
                raise DatasetError(f"{shown} holds {name!r}, which is no patch of the course; {other}")
            found[folder] += 1
        for folder, expected in folders.items():
            if found[folder] != expected:
                raise DatasetError(
                    f"{shown} holds {found[folder]} patches in {folder}, expected {expected}; {other}"
                )
        try:
            damaged = archive.testzip()
        except _ZIP_ERRORS as error:
            raise DatasetError(f"{shown} is damaged ({error}); fetch it again") from error
        if damaged is not None:
            raise DatasetError(f"{shown} is damaged at {damaged!r}; fetch it again")


def fetch_patches(
    to: str | os.PathLike[str] | None = None, *, url: str = COURSE_URL, progress: bool = True
) -> tuple[Path, Path]:
    """Download the course's training patches, once: ``vehicles.zip`` and ``non-vehicles.zip`` (110 MB).

    Each archive is verified by the names, number and checksums of its members (8,792 vehicles and 8,968
    non-vehicles) and appears whole or not at all: whatever goes wrong, an earlier file stays as it was and
    calling again starts over. An archive that is there and verifies is not downloaded again. The patches come
    from the GTI vehicle image database and from KITTI (CC BY-NC-SA 3.0, non-commercial).

    Parameters
    ----------
    to
        Folder for the two files, created where missing; None is the user's cache folder.
    url
        Web folder (``http://`` or ``https://``) that holds the two files.
    progress
        Show a progress bar on standard error.

    Returns
    -------
    tuple of pathlib.Path
        The vehicles and the non-vehicles, as `load_training_patches` takes them.

    Raises
    ------
    DatasetError
        If the server cannot be reached or has no such file, the connection is cut, or what came is not the
        archive.
    InvalidInputError
        If `url` is no web address, or `to` cannot be written to.

    Examples
    --------
    >>> fetch_patches(url="s3://bucket")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.InvalidInputError: url must start with http:// or https://; got 's3://bucket'
    """
    if not url.startswith(("http://", "https://")):
        raise InvalidInputError(f"url must start with http:// or https://; got {url!r}")
    if to is None:
        import pooch

        to = pooch.os_cache("vehicle_detection")
    vehicles, non_vehicles = (
        _fetch(Path(to) / name, f"{url.rstrip('/')}/{name}", folders, progress)
        for name, folders in ARCHIVES.items()
    )
    return vehicles, non_vehicles


def _fetch(target: Path, address: str, folders: dict[str, int], progress: bool) -> Path:
    """Return `target` once it holds the verified archive, downloading it if need be."""
    if target.is_file():
        try:
            verify_archive(target, folders, shown=str(target))
        except DatasetError as error:
            _log.warning("downloading again, as the file in place does not verify: %s", error)
        else:
            return target
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"to must be a folder, {target.parent} cannot be made: {error.strerror}; choose another"
        ) from error
    _remove_stale_parts(target)
    with atomic_write(target, "to") as part:
        _log.info("downloading %s", address)
        _download(address, part, progress)
        verify_archive(part, folders, shown=address)
    return target


def _remove_stale_parts(target: Path) -> None:
    """Remove what killed downloads of `target` left behind; a running one keeps its part fresh."""
    for part in target.parent.glob(f".{target.stem}.*{target.suffix}"):
        with contextlib.suppress(OSError):
            if time.time() - part.stat().st_mtime > STALE_SECONDS:
                part.unlink()


def _download(address: str, part: Path, progress: bool) -> None:
    """Download `address` into the file `part`; every failure is a DatasetError with its remedy."""
    import pooch
    import requests

    answers: list[requests.Response] = []

    def keep(response: requests.Response, **_: object) -> None:
        answers.append(response)

    # The downloader itself: pooch.retrieve would log the hash of a file that has none to compare.
    download = pooch.HTTPDownloader(progressbar=progress, chunk_size=1 << 16, hooks={"response": keep})
    try:
        download(address, str(part), None)
    except requests.HTTPError as error:
        answer = error.response.status_code if error.response is not None else "an error"
        raise DatasetError(
            f"{address} answers {answer}; pass the url of a folder that holds {' and '.join(ARCHIVES)}"
        ) from error
    except requests.exceptions.ChunkedEncodingError as error:
        raise DatasetError(f"{address} was cut off on the way; call again to start over") from error
    except (requests.ConnectionError, requests.Timeout) as error:
        raise DatasetError(
            f"{address} cannot be reached ({type(error).__name__}); check the network and call again, "
            "or download the file in a browser and pass its path to load_training_patches"
        ) from error
    except requests.RequestException as error:
        raise DatasetError(f"{address} cannot be downloaded ({type(error).__name__}); check url") from error
    except OSError as error:
        raise DatasetError(
            f"{address} cannot be stored in {part.parent}: {error.strerror}; free some space or choose "
            "another folder with to="
        ) from error
    finally:
        # Pooch leaves the connection open when it raises.
        for response in answers:
            response.close()
