"""The controls of the explorer, built with ipywidgets."""

from __future__ import annotations

import html
import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection.errors import InvalidInputError

_JPEG_QUALITY = 88
# Label, minimum, maximum and step of each slider.
_SLIDERS = {
    "min_score": ("min. score", -2.0, 4.0, 0.05),
    "horizon": ("horizon", 0.2, 0.8, 0.01),
    "min_peak": ("min. peak", 0.0, 4.0, 0.05),
    "min_evidence": ("min. evidence", 0.0, 20.0, 0.1),
    "threshold": ("min. heat", 0.0, 30.0, 0.25),
    "peak_fraction": ("peak fraction", 0.0, 0.95, 0.05),
}
_LABELS = {
    "view": "show",
    "box": "explain box",
    "bands": "windows (px)",
    "method": "boxes from",
    "weighting": "heat is",
}

METHOD_CONTROLS = {
    "groups": ("min_peak", "min_evidence"),
    "heat": ("threshold", "peak_fraction", "weighting"),
}
"""Controls that are enabled for one method only."""


@dataclass(frozen=True, eq=False)
class Panel:
    """Controls by name, the image, the line of text above it, and the widget that contains all."""

    controls: dict[str, Any]
    image: Any
    text: Any
    root: Any

    def watch(self, update: Callable[[dict[str, Any]], None]) -> None:
        """Call `update` with the changed values: now with none, and after each change of a control."""

        def on_change(changes: dict[str, Any]) -> None:
            for method, names in METHOD_CONTROLS.items():
                for name in self.controls.keys() & names:
                    self.controls[name].disabled = self.controls["method"].value != method
            update(changes)

        for name, control in self.controls.items():
            control.observe(lambda change, name=name: on_change({name: change["new"]}), names="value")
        on_change({})

    def on_click(self, action: Callable[[float, float], None]) -> None:
        """Call `action` with the pixel of the image that is clicked; nothing happens without ipyevents."""
        try:
            events: Any = importlib.import_module("ipyevents")
        except ImportError:
            return
        event = events.Event(source=self.image, watched_events=["click"])
        event.on_dom_event(lambda click: action(float(click["dataX"]), float(click["dataY"])))

    def show(self, image: NDArray[np.uint8], text: str) -> None:
        """Show an image, ``(H, W, 3)`` uint8 RGB, and a line of text."""
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        self.image.value = data.tobytes()
        self.text.value = html.escape(text)

    def show_error(self, message: str) -> None:
        """Show an error message in place of the text; the image stays."""
        self.text.value = f"<b>{html.escape(message)}</b>"


def build_widgets(values: Mapping[str, Any], options: Mapping[str, Sequence[Any]]) -> Panel:
    """Create a control for each value: a slider, or a choice of the options of the same name."""
    try:
        widgets: Any = importlib.import_module("ipywidgets")
    except ImportError:
        raise InvalidInputError(
            "the explorer's sliders need ipywidgets; pip install ipywidgets, or use its methods without them"
        ) from None
    controls = {}
    for name, value in values.items():
        style = {"description_width": "96px"}
        common = {"value": value, "layout": widgets.Layout(width="98%"), "style": style}
        if name in _SLIDERS:
            label, low, high, step = _SLIDERS[name]
            # A value outside the usual range widens the range, so that the slider does not change it.
            ends = {"min": min(low, value), "max": max(high, value), "step": step}
            control = widgets.FloatSlider(description=label, readout_format=".2f", **ends, **common)
        elif name == "box":
            control = widgets.BoundedIntText(description=_LABELS[name], min=0, max=999, **common)
        else:
            common |= {"description": _LABELS.get(name, name), "options": options[name]}
            if name == "frame":
                control = widgets.Dropdown(**common)
            elif name == "bands":
                control = widgets.SelectMultiple(rows=min(len(options[name]), 12), **common)
            else:
                # Buttons as wide as their labels fit in one row.
                style["button_width"] = "auto"
                control = widgets.ToggleButtons(**common)
        controls[name] = control
    image = widgets.Image(format="jpeg", layout=widgets.Layout(width="100%"))
    text = widgets.HTML()
    left = widgets.VBox(list(controls.values()), layout=widgets.Layout(width="35%"))
    right = widgets.VBox([text, image], layout=widgets.Layout(width="65%"))
    return Panel(controls, image, text, widgets.HBox([left, right]))
