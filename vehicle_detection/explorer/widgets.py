"""The controls of the explorer, built with ipywidgets."""

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
from vehicle_detection.params import HeatParams, PyramidParams, RegionParams, SearchParams

_JPEG_QUALITY = 88
# Controls that are enabled for one method only.
_METHOD_CONTROLS = {
    "groups": {"min_peak", "min_evidence"},
    "heat": {"threshold", "peak_fraction", "weighting"},
}


@dataclass(frozen=True, eq=False)
class Panel:
    """Controls by name, the image, the line of text above it, and the widget that contains all."""

    controls: dict[str, Any]
    image: Any
    text: Any
    root: Any

    def watch(self, update: Callable[[dict[str, Any]], None]) -> None:
        """Call `update` with the changed values: now with none, and after each change of a control."""
        values = self._values()

        def on_change(_: object = None) -> None:
            nonlocal values
            previous, values = values, self._values()
            for method, names in _METHOD_CONTROLS.items():
                for name in self.controls.keys() & names:
                    self.controls[name].disabled = values["method"] != method
            update({name: value for name, value in values.items() if value != previous[name]})

        for control in self.controls.values():
            control.observe(on_change, names="value")
        on_change()

    def _values(self) -> dict[str, Any]:
        return {name: control.value for name, control in self.controls.items()}

    def show(self, image: NDArray[np.uint8], text: str) -> None:
        """Show an image, ``(H, W, 3)`` uint8 RGB, and a line of text."""
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        self.image.value = data.tobytes()
        self.text.value = html.escape(text)

    def show_error(self, message: str) -> None:
        """Show an error message in place of the text; the image stays."""
        self.text.value = f"<b>{html.escape(message)}</b>"


def build_widgets(
    *,
    names: Sequence[str],
    frame: str,
    views: Sequence[str],
    view: str,
    search_params: SearchParams | PyramidParams,
    bands: Sequence[int],
    methods: Sequence[str],
    method: str,
    heat_params: HeatParams,
    group_params: RegionParams | None,
) -> Panel:
    """Create one control per parameter; None for `group_params` leaves out its controls."""
    try:
        widgets: Any = importlib.import_module("ipywidgets")
    except ImportError:
        raise InvalidInputError(
            "the explorer's sliders need ipywidgets; pip install 'vehicle-detection[notebooks]', or use "
            "its methods without them"
        ) from None
    style = {"description_width": "96px"}
    wide = {"layout": widgets.Layout(width="98%"), "style": style}
    # Buttons as wide as their labels fit in one row.
    fitted = {"layout": widgets.Layout(width="98%"), "style": {**style, "button_width": "auto"}}

    def slider(text: str, value: float, low: float, high: float, step: float) -> Any:
        # A value outside the usual range widens the range, so that the slider does not change it.
        ends = {"min": min(low, value), "max": max(high, value), "step": step}
        return widgets.FloatSlider(value=value, description=text, readout_format=".2f", **ends, **wide)

    def buttons(text: str, options: Sequence[str], value: str) -> Any:
        return widgets.ToggleButtons(options=options, value=value, description=text, **fitted)

    horizon = 0.5 if search_params.horizon is None else search_params.horizon
    controls = {
        "frame": widgets.Dropdown(options=names, value=frame, description="frame", **wide),
        "view": buttons("show", views, view),
        "min_score": slider("min. score", search_params.min_score, -2.0, 4.0, 0.05),
        "horizon": slider("horizon", horizon, 0.2, 0.8, 0.01),
    }
    sizes = [
        (f"{number}: {round(band.window[0])}x{round(band.window[1])}", number)
        for number, band in enumerate(getattr(search_params, "bands", ()))
    ]
    if sizes:
        controls["bands"] = widgets.SelectMultiple(
            options=sizes, value=bands, rows=min(len(sizes), 12), description="windows (px)", **wide
        )
    controls["method"] = buttons("boxes from", methods, method)
    if group_params is not None:
        controls["min_peak"] = slider("min. peak", group_params.min_peak, 0.0, 4.0, 0.05)
        controls["min_evidence"] = slider("min. evidence", group_params.min_evidence, 0.0, 20.0, 0.1)
    controls["threshold"] = slider("min. heat", heat_params.threshold, 0.0, 30.0, 0.25)
    controls["peak_fraction"] = slider("peak fraction", heat_params.peak_fraction, 0.0, 0.95, 0.05)
    controls["weighting"] = buttons("heat is", ("score", "count"), heat_params.weighting)
    image = widgets.Image(format="jpeg", layout=widgets.Layout(width="100%"))
    text = widgets.HTML()
    left = widgets.VBox(list(controls.values()), layout=widgets.Layout(width="35%"))
    right = widgets.VBox([text, image], layout=widgets.Layout(width="65%"))
    return Panel(controls, image, text, widgets.HBox([left, right]))
