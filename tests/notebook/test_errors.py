"""What is malformed is refused, and the message begins with the argument's name."""

import numpy as np
import pytest

from tests.drawing.cases import track
from tests.helpers import random_classifier
from tests.notebook.helpers import SMALL, gray_image
from vehicle_detection import notebook
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.tracking import FrameResult

IMAGE, NONE = gray_image(), Detections.empty()
MODEL = random_classifier(SMALL)
PATCHES = np.zeros((3, 64, 64, 3), np.uint8)
RESULT = FrameResult(0, None, NONE, NONE, ())


@pytest.mark.parametrize(
    ("name", "arguments", "options", "argument"),
    [
        ("plot_channels", [IMAGE, "XYZ"], {}, "color_space"),
        ("plot_channels", [[IMAGE]], {"labels": [1, 0]}, "labels"),
        ("plot_channels", [[]], {}, "images"),
        ("plot_channels", [[IMAGE[..., 0]]], {}, r"images\[0\]"),
        ("plot_channels", [IMAGE], {"points": 0}, "points"),
        (
            "plot_hog",
            [gray_image(30, 30)],
            {"pix_per_cell": [16]},
            "img must have at least the size of a block",
        ),
        ("plot_hog", [IMAGE], {"pix_per_cell": [1]}, "pix_per_cell"),
        ("plot_features", [PATCHES, MODEL], {"rows": [3]}, "rows"),
        ("plot_features", [PATCHES, MODEL], {"rows": []}, "rows"),
        ("plot_features", [PATCHES, MODEL], {"names": ["a", "b"]}, "names"),
        ("plot_features", [PATCHES, MODEL], {"template": 1}, "template"),
        ("plot_features", [PATCHES, "m"], {}, "model must be .* pass load_classifier"),
        ("plot_weights", ["m"], {}, "classifier"),
        ("plot_weights", [MODEL], {"template": 1}, "template"),
        ("plot_windows", [IMAGE, [1, 2, 3, 4]], {}, "windows"),
        ("plot_windows", [IMAGE, []], {"truth": [[5, 0, 1, 1]]}, "truth"),
        ("plot_windows", [IMAGE, []], {"ax": "here"}, "ax"),
        ("plot_bands", [gray_image(10)], {}, "image of 160x10 pixels holds no search window"),
        ("plot_bands", [IMAGE, "default"], {}, "search"),
        ("plot_comparison", [[1.0], [1.0, 2.0]], {}, "fast and reference"),
        ("plot_comparison", [[1.0], [np.inf]], {}, "reference"),
        ("plot_speedups", [{}], {}, "seconds must map names to seconds, at least one"),
        ("plot_speedups", [{"a": 0}], {}, r"seconds\['a'\]"),
        ("plot_speedups", [[1.0]], {}, "seconds"),
        ("plot_speedups", [{"a": 1.0}], {"reference": "d"}, "reference"),
        ("plot_heatmap", [IMAGE, [[0, 0, 1, 1]]], {}, "windows"),
        ("plot_heatmap", [IMAGE, NONE], {"heat": np.zeros((5, 5))}, "heat must be .* add_heat"),
        ("plot_heatmap", [IMAGE, NONE], {"params": "hot"}, "params"),
        ("plot_heatmap", ["a.png", NONE], {}, "image"),
        ("plot_birds_eye", [[]], {}, "results"),
        ("plot_birds_eye", [[track()]], {}, "results must be .* pass what detector.process"),
        ("plot_birds_eye", [RESULT, 3], {}, "camera"),
        ("plot_birds_eye", [RESULT], {"trail_seconds": -1}, "trail_seconds"),
        ("show_images", [[IMAGE]], {"figure": 3}, "figure must be .* pass a Figure"),
    ],
)
def test_a_malformed_argument_is_named(name, arguments, options, argument):
    with pytest.raises(InvalidInputError, match=f"^{argument}"):
        getattr(notebook, name)(*arguments, **options)
