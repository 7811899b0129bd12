"""One page that shows what a run over a video found: the video, its tracks over time, settings and model."""

from __future__ import annotations

import base64
import os
import urllib.parse
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

from vehicle_detection._common import atomic_write, check_integer, check_target, check_type, describe
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.report.history import TrackLog
from vehicle_detection.report.page import Film, page
from vehicle_detection.video import VideoReport

EMBED_LIMIT = 60_000_000
"""A video of more bytes stands beside the page instead of in it."""

_KINDS = {".mkv": "video/x-matroska"}  # .mov that we write plays as .mp4 does
_CHUNK = 3 << 18  # a multiple of 3: base64 of the pieces is that of the whole


class ReportWriter:
    """Collect the tracks of a video while it is processed, and write a page that shows them.

    The page is one HTML file that loads nothing from elsewhere: the video with its tracks over time, which
    lead to their places in it, the run's times and settings, and the model. A few numbers for each track and
    frame are kept, and no frame.

    Parameters
    ----------
    path
        The page to write: .html or .htm.
    video
        The annotated video, the target of `process_video`; None where none is written.
    source
        The video it was made of, for the title.
    detector
        The :class:`VehicleDetector`, for settings and model; None leaves them out.
    embed_limit
        A video of more bytes than this is not put into the page, but linked: it must stay where it is, as
        seen from the page.

    Raises
    ------
    InvalidInputError
        If the page's name ends in something else, its folder is missing or read-only, or it is the video or
        the source itself.

    Examples
    --------
    >>> write = ReportWriter("report.html", video="found.mp4", source="drive.mp4")
    >>> report = process_video("drive.mp4", "found.mp4", detector, on_result=write)  # doctest: +SKIP
    >>> write.finish(report)  # doctest: +SKIP
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        video: str | os.PathLike[str] | None = None,
        source: str | os.PathLike[str] | None = None,
        detector: Any = None,
        embed_limit: int = EMBED_LIMIT,
    ) -> None:
        for name, value in (("path", path), ("video", video), ("source", source)):
            if value is None and name != "path":
                continue
            if not isinstance(value, (str, os.PathLike)):
                raise InvalidInputError(f"{name} must be a file name, got {describe(value)}; pass a name")
        self._path = Path(path)
        if self._path.suffix.lower() not in (".html", ".htm"):
            raise InvalidInputError(
                f"path must end in .html, got {self._path.name!r}; write {self._path.stem + '.html'!r}"
            )
        check_target(self._path, "path")
        for name, value in (("video", video), ("source", source)):
            if value is not None and Path(value).resolve() == self._path.resolve():
                raise InvalidInputError(f"path {self._path} is the {name} as well; choose another name")
        self._video = None if video is None else Path(video)
        self._source = None if source is None else Path(source).name
        self._detector = detector
        self._limit = check_integer(embed_limit, "embed_limit", low=0)
        self._log = TrackLog()

    def __call__(self, result: Any) -> None:
        """Take one frame's result: for ``process_video(..., on_result=...)``."""
        self.write(result.index, result.time, result.tracks)

    def write(self, frame_index: int, time: float | None, tracks: Iterable[Any]) -> None:
        """Take the tracks of the next frame, of which those that are shown count.

        Parameters
        ----------
        frame_index
            Number of the frame, from 0 without a gap.
        time
            Its time in the source in seconds, None where it is not known.
        tracks
            What `Tracker.update` returned for it.

        Raises
        ------
        InvalidInputError
            If the frame is not the next one, or `tracks` holds something else.
        """
        self._log.add(frame_index, time, tracks)

    def finish(self, report: VideoReport) -> None:
        """Write the page, which appears whole or not at all, once the video is there.

        Parameters
        ----------
        report
            What `process_video` returned.

        Raises
        ------
        InvalidInputError
            If `report` is something else, or the video is missing.
        """
        check_type(report, "report", VideoReport, "pass what process_video returned")
        film = self._film()
        before, after = page(self._log, report, film=film, source=self._source, detector=self._detector)
        with (
            atomic_write(self._path, "path") as part,
            part.open("w", encoding="utf-8", newline="\n") as file,
        ):
            file.write(before)
            if film is not None and film.link is None and self._video is not None:
                _put_base64(self._video, file)
            file.write(after)

    def _film(self) -> Film | None:
        if self._video is None:
            return None
        if not self._video.is_file():
            raise InvalidInputError(
                f"video {self._video} does not exist; call finish after process_video has written it"
            )
        size = self._video.stat().st_size
        kind = _KINDS.get(self._video.suffix.lower(), "video/mp4")
        link = _address(self._video, self._path) if size > self._limit else None
        return Film(kind, link, self._video.name, size / 1e6)


def _put_base64(path: Path, file: IO[str]) -> None:
    with path.open("rb") as video:
        while chunk := video.read(_CHUNK):
            file.write(base64.b64encode(chunk).decode("ascii"))


def _address(video: Path, page_path: Path) -> str:
    """Return the address of a video as seen from a page."""
    try:
        relative = os.path.relpath(video.resolve(), page_path.parent.resolve())
    except ValueError:  # another drive of Windows
        return video.resolve().as_uri()
    return urllib.parse.quote(os.fsencode(relative.replace(os.sep, "/")))
