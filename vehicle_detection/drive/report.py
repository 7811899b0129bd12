"""`ReportWriter`: collects the tracks of a video and writes the report page; pictures that explain boxes."""

from __future__ import annotations

import dataclasses
import os
import urllib.parse
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    UNITS,
    atomic_write,
    check_choice,
    check_integer,
    check_path,
    check_sequence,
    check_suffix,
    check_type,
    hide_credentials,
    is_url,
)
from vehicle_detection.boxes import box_areas
from vehicle_detection.camera import Camera, truncated_edges
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.drawing import blur_boxes, draw_boxes, draw_cell_shares
from vehicle_detection.drive.events import Event, check_events, find_events
from vehicle_detection.drive.history import track_histories
from vehicle_detection.drive.own_speed import own_speeds
from vehicle_detection.drive.report_page import TrackPicture, VideoEmbed, render_page
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import Explanation, explain
from vehicle_detection.tables import TrackTable
from vehicle_detection.tracking import search_interval
from vehicle_detection.video import Source, VideoReport, borrow_source

# Part of an image around a window that a picture shows, as a fraction of its longer side; height of the
# picture in pixels, and color of its box.
_AROUND, _PICTURE_HEIGHT, _BOX_COLOR = 0.2, 180, (240, 228, 66)
# Largest number of tracks that are explained, each of which takes a search of a frame.
_MAX_EXPLAINED = 12


class ReportWriter:
    """Collect the tracks of a video while it is processed, and write a page that shows them.

    The page is one HTML file that loads nothing from elsewhere: the video and charts of its tracks over time
    that seek in it, the times of the run, the settings and the model.

    Parameters
    ----------
    path, video, source
        The page to write (.html or .htm), the annotated video (the target of `process_video`) if one is
        written, and the source video for the title.
    detector, embed_limit
        The :class:`VehicleDetector`, for settings and model; and the number of bytes from which on a video is
        linked instead of embedded: page and video must then be moved together.
    units
        ``"metric"`` (m and km/h) or ``"imperial"`` (ft and mph).

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
        embed_limit: int = 60_000_000,
        units: Literal["metric", "imperial"] = "metric",
    ) -> None:
        check_choice(units, "units", UNITS)
        self._path = check_suffix(path, "path", (".html", ".htm"))
        for name, value in (("video", video), ("source", source)):
            if value is None:
                continue
            if not (name == "source" and isinstance(value, str) and is_url(value)):
                check_path(value, name)  # a URL may have longer parts
            if os.path.realpath(value) == os.path.realpath(self._path):
                raise InvalidInputError(f"path {self._path} is also the {name}; choose another name")
        self._video = None if video is None else Path(video)
        self._source = None if source is None else Path(hide_credentials(os.fspath(source))).name
        self._source_path = None if source is None else str(Path(source))
        self._detector, self._units = detector, units
        self._embed_limit = check_integer(embed_limit, "embed_limit", low=0)
        self.table = TrackTable()  # of the frames that were added

    def __call__(self, result: Any) -> None:
        """Add one frame's result: for ``process_video(..., on_result=...)``."""
        self.table.append(result)

    def finish(
        self,
        report: VideoReport,
        *,
        events: Iterable[Event] | None = None,
        pictures: Sequence[TrackPicture] = (),
    ) -> None:
        """Write the page, completely or not at all.

        Parameters
        ----------
        report, events
            What `process_video` returned, and what `find_events` found in `table`; None: found here.
        pictures
            `TrackPicture` objects to list below the tracks.
        """
        check_type(report, "report", VideoReport, "pass what process_video returned")
        fps = float(report.fps)
        own = getattr(getattr(self._detector, "annotator", None), "own_speed", None)
        speeds = None if own is None else own_speeds(own, self.table, fps=fps)
        if events is None:
            camera = getattr(self._detector, "camera", None)
            camera = camera.for_shape(report.shape) if isinstance(camera, Camera) else None
            events = find_events(self.table, fps=fps, shape=report.shape, camera=camera, own_speed_mps=speeds)
        listed = check_sequence(pictures, "pictures", "TrackPicture")
        for picture in listed:
            check_type(picture, "pictures", TrackPicture, "omit them, or pass TrackPicture objects")
        if self._source_path and self._source:  # without its folder, as in the title
            damage = report.damage.replace(self._source_path, self._source)
            report = dataclasses.replace(report, damage=damage)
        pieces = render_page(
            self.table,
            report,
            events=check_events(events),
            video=self._embed(),
            source=self._source,
            detector=self._detector,
            units=self._units,
            pictures=listed,
            own_speed_mps=speeds,
        )
        with (
            atomic_write(self._path, "path") as part,
            # A file name may hold bytes that are not UTF-8; they become question marks.
            part.open("w", encoding="utf-8", errors="replace", newline="\n") as file,
        ):
            file.writelines(pieces)

    def _embed(self) -> VideoEmbed | None:
        if self._video is None:
            return None
        if not self._video.is_file():
            raise InvalidInputError(
                f"video {self._video} does not exist; call finish after process_video has written it"
            )
        size = self._video.stat().st_size
        # Browsers play the .mov files of `process_video` as MP4.
        mime_type = "video/x-matroska" if self._video.suffix.lower() == ".mkv" else "video/mp4"
        link = _relative_url(self._video, self._path) if size > self._embed_limit else None
        return VideoEmbed(self._video, mime_type, link, size / 1e6)


def _relative_url(video: Path, page: Path) -> str:
    """Return the URL of a video as seen from a page."""
    try:
        relative = os.path.relpath(video.resolve(), page.parent.resolve())
    except ValueError:  # on another drive of Windows
        return video.resolve().as_uri()
    return urllib.parse.quote(os.fsencode(relative.replace(os.sep, "/")))


def explain_tracks(
    detector: VehicleDetector, source: Source, table: TrackTable, *, every: int | None = None
) -> list[TrackPicture]:
    """Explain a box of each of the twelve longest tracks: the largest detected one inside the frame.

    `table` holds the tracks that `detector` found in `source`, which is read again, with the option `every`
    of `process_video`. The pictures are in the order of the tracks' ids.
    """
    known = [track for track in track_histories(table) if np.isfinite(track.boxes).all(axis=1).any()]
    tracks = sorted(known, key=lambda track: -len(track.frames))[:_MAX_EXPLAINED]
    pictures = []
    with borrow_source(source) as opened:
        shape, fps = opened.info.shape[:2], float(opened.info.fps)
        offset = round((table.first_time or 0.0) * fps)
        interval = every or (1 if detector.searches_every_frame else search_interval(fps))
        for track in tracks:
            truncated = truncated_edges(track.boxes, shape).any(axis=1)
            # Predicted boxes have no detection to explain; they are the last choice.
            detected = (track.columns["time_since_update"] == 0) & (track.frames % interval == 0)
            weights = np.where(truncated, 0.01, 1.0) * np.where(detected, 1.0, 1e-9)
            row = int(np.nanargmax(weights * box_areas(track.boxes)))
            frame = int(track.frames[row])
            with opened.read(offset + frame, 1) as frames:
                for _, _, image in frames:
                    explanation = explain(detector, image, track.boxes[row])
                    picture = _draw_explanation(detector, image, explanation)
                    pictures.append(TrackPicture(track.id, frame, picture, explanation.describe()))
    return sorted(pictures, key=lambda picture: picture.track)


def _draw_explanation(
    detector: VehicleDetector, image: NDArray[np.uint8], explanation: Explanation
) -> NDArray[np.uint8]:
    """Draw an explained box twice, side by side: as it is, and with the shares of its cells."""
    if detector.annotator.blur is not None:
        boxes = np.concatenate([detector.detect(image).boxes, explanation.box[None]])
        image = blur_boxes(image, boxes, region=detector.annotator.blur)
    both = np.stack([explanation.window, explanation.box])
    around = _AROUND * (both[:, 2:].max(axis=0) - both[:, :2].min(axis=0)).max()
    low, high = both[:, :2].min(axis=0) - around, both[:, 2:].max(axis=0) + around
    left, top = np.maximum(low, 0).astype(int).tolist()
    right, bottom = np.minimum(high, image.shape[1::-1]).astype(int).tolist()
    plain = np.ascontiguousarray(image[top:bottom, left:right])
    scale = _PICTURE_HEIGHT / len(plain)
    size = max(1, round(scale * plain.shape[1])), _PICTURE_HEIGHT
    plain = np.asarray(cv2.resize(plain, size, interpolation=cv2.INTER_AREA), np.uint8)
    corner = np.array([left, top, left, top])
    shares = draw_cell_shares(plain, (explanation.window - corner) * scale, explanation.cells)
    shares = draw_boxes(shares, [(explanation.box - corner) * scale], color=_BOX_COLOR, thickness=2)
    return np.hstack([plain, shares])
