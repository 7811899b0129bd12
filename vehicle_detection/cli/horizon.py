"""The horizon on the command line: its option, its estimate, and a warning if it hides all vehicles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import vehicle_detection as vd
from vehicle_detection.cli.output import print_error, print_line
from vehicle_detection.errors import InvalidInputError

if TYPE_CHECKING:
    from vehicle_detection.video import FrameSource

# Boxes of a vehicle in a second that are used to check a stated horizon, and the difference that is accepted.
_BOXES_PER_SECOND, _CONTRADICTION = 2, 0.05


def search_everywhere(model: Any, conf: float | None) -> vd.Detector:
    """Open a detector that searches all rows, whatever the horizon."""
    params = model.search_params_type.default()
    # Networks and functions search all rows anyway.
    everywhere = params.everywhere() if hasattr(params, "everywhere") else None
    return vd.Detector(model, conf=conf, search_params=everywhere)


def is_limited(detector: vd.Detector) -> bool:
    """Whether the detector searches rows near the horizon only."""
    params: Any = detector.search_params
    return hasattr(params, "everywhere") and params != params.everywhere()


def warn_of_horizon(given: str, found: vd.tracking.HorizonEstimate | None) -> None:
    """Warn that no vehicle was found, and print what a search of all rows found; `given` set the horizon."""
    rest = "; leave it out if there are some (a search of all rows found too few vehicles to estimate it)"
    if found is not None:
        rest = (
            f", but a search of all rows found {found.n_boxes} boxes, whose horizon is "
            f"{found.horizon:.2f}; use --horizon {found.horizon:.2f}"
        )
    print_error(f"warning: no vehicle was found with {given}{rest}")


def warn_of_contradiction(
    stated: float, table: vd.TrackTable, shape: tuple[int, ...], *, fps: float, height_m: float | None
) -> None:
    """Warn if the sizes of the tracked vehicles contradict the stated horizon."""
    frames = table["frame"].astype(int)
    boxes = table.boxes[frames % max(round(fps / _BOXES_PER_SECOND), 1) == 0]
    try:
        found = vd.tracking.estimate_horizon(boxes, shape, height_m=height_m)
    except InvalidInputError:  # too few vehicles
        return
    if abs(stated - found.horizon) > _CONTRADICTION + 3 * found.horizon_std:
        print_error(
            f"warning: the sizes of the vehicles suggest a horizon of {found.horizon:.2f} (standard error "
            f"{found.horizon_std:.2f}) instead of {stated:.3g}, with which their distances are wrong; "
            "correct it, or leave it out"
        )


def with_found_horizon(
    camera: vd.Camera,
    source: FrameSource,
    model: Any,
    *,
    conf: float | None,
    quiet: bool,
    **known: float | None,
) -> vd.Camera:
    """Return the camera with the horizon that the vehicles of a video show, and its error; print both.

    The camera's height and the time range are `known`, or None.
    """
    from vehicle_detection.video import estimate_video_horizon

    with search_everywhere(model, conf) as detector:
        found = estimate_video_horizon(source, detector, **known)
    if found is None and not quiet:
        print_error(
            "warning: --horizon auto: too few vehicles to estimate the horizon; searching near the middle"
        )
    elif found is not None and not quiet:
        print_line(
            f"horizon {found.horizon:.3f} (standard error {found.horizon_std:.3f}, {found.n_boxes} boxes)"
        )
    if found is None:
        return camera
    # A model that searches rows near the horizon only has to trust the estimate.
    is_band = hasattr(model.search_params_type.default(), "horizon")
    return camera.with_horizon(found.horizon, min(found.horizon_std, 0.02 if is_band else 1.0))
