"""What `detect` returns for an image: detections that know their image."""

from __future__ import annotations

import importlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import Floats, check, in_notebook
from vehicle_detection.boxes import Detections
from vehicle_detection.camera import Camera
from vehicle_detection.drawing import draw_detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.images import image_array, write_image
from vehicle_detection.tracking import Tracker, measure_distances


@dataclass(frozen=True, eq=False, repr=False)
class ImageDetections(Detections):
    """The vehicles of an image, with methods that draw them into it.

    Attributes
    ----------
    source
        The image that `detect` was given: an array, which is not copied; a file, which is read again when the
        picture is needed; or its content.
    distances_m, distance_stds_m
        ``(N,)`` distances and their standard errors in meters, as of `distances`, NaN where unknown; None
        unless the detector has a camera with a known lens.

    Examples
    --------
    >>> from vehicle_detection import detect
    >>> found = detect("test_images/road1.jpg", "highway")
    >>> len(found), found.path.name, found.plot().shape
    (2, 'road1.jpg', (720, 1280, 3))
    """

    source: Any = field(default=None, metadata={"column": False})
    distances_m: Floats | None = None
    distance_stds_m: Floats | None = None

    @property
    def path(self) -> Path | None:
        """Path of the image's file; None for an array, a URL or bytes."""
        known = isinstance(self.source, (str, os.PathLike)) and "://" not in str(self.source)
        return Path(self.source) if known else None

    @property
    def image(self) -> NDArray[np.uint8]:
        """The image, ``(H, W, 3)`` uint8 RGB."""
        return image_array(self.source)

    def distances(self, camera: Camera) -> Floats:
        """Distances along the road and their standard errors in meters, ``(2, N)``; NaN where unknown.

        Where the `camera` does not know its horizon, it is estimated from the vehicles of the image: with few
        of them, the error is large. A vehicle of which only the side is visible needs the horizon.
        """
        return image_distances(self, self.image.shape, camera)

    def plot(self, **options: Any) -> NDArray[np.uint8]:
        """Return the image with its vehicles; the options are those of `draw_detections`."""
        return draw_detections(self.image, self, **options)

    def save(self, path: str | os.PathLike[str], **options: Any) -> None:
        """Write the picture of `plot` to a file, in the format of its suffix, such as ``.jpg``."""
        write_image(path, self.plot(**options))

    def show(self, **options: Any) -> None:
        """Show the picture of `plot`: in the notebook, or in the system's viewer of pictures."""
        from PIL import Image, ImageShow

        picture = Image.fromarray(self.plot(**options))
        if in_notebook():
            importlib.import_module("IPython.display").display(picture)
        elif not ImageShow.show(picture, "vehicles"):
            raise InvalidInputError("show needs a viewer of pictures, and found none; use save(path)")


def image_distances(found: Detections, shape: tuple[int, ...], camera: Camera) -> Floats:
    """Distances and standard errors of the vehicles of one image, as `ImageDetections.distances`."""
    check.instance(camera, "camera", Camera, "pass Camera.dashcam(fov=90)")
    # The horizon of a fisheye lens cannot be estimated.
    if not camera.horizon_is_known and not camera.fisheye:
        tracker = Tracker(camera=camera, fps=1)
        tracker.update(found, shape)
        camera = tracker.camera
    return measure_distances(found.boxes, shape, camera)
