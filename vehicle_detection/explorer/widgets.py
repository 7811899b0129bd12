"""The controls of the explorer, laid out with ipywidgets; what they do is the explorer's."""

from __future__ import annotations

import html
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import HeatParams, RegionParams, SearchParams

_JPEG_QUALITY = 88
# Controls that matter for one kind of boxes alone.
_ONLY = {"fitted": ("min_peak", "min_evidence"), "heat": ("threshold", "peak_fraction", "weighting")}


@dataclass(frozen=True, eq=False)
class Panel:
    """Controls by name, the picture, the line above it, and the widget that holds them all."""

    controls: dict[str, Any]
    picture: Any
    line: Any
    whole: Any

    def values(self) -> dict[str, Any]:
        """Return what the controls say."""
        return {name: control.value for name, control in self.controls.items()}

    def watch(self, act: Callable[[], None]) -> None:
        """Act now, and whenever a control changes."""

        def changed(_: object = None) -> None:
            for kind, names in _ONLY.items():
                for name in names:
                    self.controls[name].disabled = self.controls["kind"].value != kind
            act()

        for control in self.controls.values():
            control.observe(changed, names="value")
        changed()

    def show(self, image: NDArray[np.uint8], text: str) -> None:
        """Show a picture, ``(H, W, 3)`` uint8 RGB, and a line."""
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        self.picture.value = data.tobytes()
        self.line.value = html.escape(text)

    def tell(self, text: str) -> None:
        """Say what is wrong, in place of the line; the picture stays."""
        self.line.value = f"<b>{html.escape(text)}</b>"


def lay_out(
    *,
    names: Sequence[str],
    frame: str,
    views: Sequence[str],
    view: str,
    search: SearchParams,
    bands: Sequence[int],
    kind: str,
    heat: HeatParams,
    fit: RegionParams,
) -> Panel:
    """Make one control for each parameter, set to its value.

    Raises
    ------
    InvalidInputError
        If ipywidgets is not installed.
    """
    try:
        widgets: Any = importlib.import_module("ipywidgets")
    except ImportError:
        raise InvalidInputError(
            "the explorer's sliders need ipywidgets; pip install 'vehicle-detection[notebooks]', or use "
            "its methods without them"
        ) from None
    style = {"description_width": "96px"}
    wide = {"layout": widgets.Layout(width="98%"), "style": style}
    # Buttons as wide as their words stand in one line.
    snug = {"layout": widgets.Layout(width="98%"), "style": {**style, "button_width": "auto"}}

    def slider(text: str, value: float, low: float, high: float, step: float) -> Any:
        # A value beyond the usual range widens it: the slider must not change what it shows.
        ends = {"min": min(low, value), "max": max(high, value), "step": step}
        return widgets.FloatSlider(value=value, description=text, readout_format=".2f", **ends, **wide)

    def choice(text: str, options: Sequence[str], value: str) -> Any:
        return widgets.ToggleButtons(options=options, value=value, description=text, **snug)

    sizes = [
        (f"{number}: {round(band.window[0])}x{round(band.window[1])}", number)
        for number, band in enumerate(search.bands)
    ]
    controls = {
        "frame": widgets.Dropdown(options=names, value=frame, description="frame", **wide),
        "view": choice("show", views, view),
        "min_score": slider("score above", search.min_score, -2.0, 4.0, 0.05),
        "horizon": slider("horizon", search.horizon, 0.2, 0.8, 0.01),
        "bands": widgets.SelectMultiple(
            options=sizes, value=bands, rows=min(len(sizes), 12), description="windows (px)", **wide
        ),
        "kind": choice("boxes", tuple(_ONLY), kind),
        "min_peak": slider("least peak", fit.min_peak, 0.0, 4.0, 0.05),
        "min_evidence": slider("least evidence", fit.min_evidence, 0.0, 20.0, 0.1),
        "threshold": slider("heat above", heat.threshold, 0.0, 30.0, 0.25),
        "peak_fraction": slider("share of peak", heat.peak_fraction, 0.0, 0.95, 0.05),
        "weighting": choice("a window adds", ("score", "count"), heat.weighting),
    }
    picture = widgets.Image(format="jpeg", layout=widgets.Layout(width="100%"))
    line = widgets.HTML()
    left = widgets.VBox(list(controls.values()), layout=widgets.Layout(width="35%"))
    right = widgets.VBox([line, picture], layout=widgets.Layout(width="65%"))
    return Panel(controls, picture, line, widgets.HBox([left, right]))
