"""What is malformed is refused, and the message begins with the argument's name."""

import numpy as np
import pandas as pd
import pytest

from tests.helpers import random_classifier
from tests.notebook.helpers import SMALL, gray_image
from vehicle_detection import notebook
from vehicle_detection.boxes import Detections
from vehicle_detection.datasets import PatchSet, Split
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames, evaluate_detections
from vehicle_detection.tables import TrackTable
from vehicle_detection.tracking import FrameResult

IMAGE, NONE = gray_image(), Detections.empty()
MODEL = random_classifier(SMALL)
PATCHES = np.zeros((3, 64, 64, 3), np.uint8)
SET = PatchSet(PATCHES, [1, 1, 0], ["vehicles/a/1.png", "vehicles/a/2.png", "non-vehicles/b/1.png"])
BOXES = TrackTable([0], [1], [[0, 0, 50, 40]], score=[1.0])
FRAMES = LabelledFrames("road", [IMAGE], TrackTable([0], [1], [[0, 0, 50, 40]]))
SCORES = evaluate_detections(BOXES, FRAMES.labels)
TABLE = pd.DataFrame({"accuracy": [0.9], "search_ms": [4.0], "configuration": ["a"]})
RESULT = FrameResult(0, None, NONE, NONE, ())


@pytest.mark.parametrize(
    ("name", "arguments", "options", "argument"),
    [
        ("plot_channels", [IMAGE, "XYZ"], {}, "color_space"),
        ("plot_channels", [[IMAGE]], {"labels": [1, 0]}, "labels"),
        (
            "plot_hog",
            [gray_image(30, 30)],
            {"pix_per_cell": [16]},
            "images.0. must have at least the size",
        ),
        ("plot_features", [PATCHES, MODEL], {"rows": [3]}, "rows"),
        ("plot_features", [PATCHES, MODEL], {"names": ["a", "b"]}, "names"),
        ("plot_features", [PATCHES, "m"], {}, "model must be .* pass load_classifier"),
        ("plot_windows", [IMAGE, [1, 2, 3, 4]], {}, "windows"),
        ("plot_windows", [IMAGE, []], {"truth": [[5, 0, 1, 1]]}, "truth"),
        ("plot_bands", [gray_image(10)], {}, "image of 160x10 pixels holds no search window"),
        ("plot_comparison", [[1.0], [1.0, 2.0]], {}, "fast and reference"),
        ("plot_speedups", [{}], {}, "seconds must map names to seconds, at least one"),
        ("plot_speedups", [{"a": 0}], {}, r"seconds\['a'\]"),
        ("plot_speedups", [{"a": 1.0}], {"reference": "d"}, "reference"),
        ("plot_heatmap", [IMAGE, [[0, 0, 1, 1]]], {}, "windows"),
        ("plot_heatmap", [IMAGE, NONE], {"heat": np.zeros((5, 5))}, "heat must be .* add_heat"),
        ("show_images", [[IMAGE]], {"figure": 3}, "figure must be .* pass a Figure"),
        ("show_images", [IMAGE], {}, "images must be a list of images.* wrap a single one in a list"),
        ("show_images", [[IMAGE / 255]], {}, r"images\[0\] must be .* scale its values 0-1"),
        ("show_images", [[IMAGE], ["a", "b"]], {}, "titles"),
        ("show_images", [[IMAGE]], {"boxes": [[1, 2, 3, 4]]}, r"boxes\[0\]"),
        ("describe_image", ["road.png"], {}, "image must be an array of numbers, .* read_image"),
        ("plot_methods", [[IMAGE], {"count": [NONE, NONE]}], {}, r"methods\['count'\]"),
        ("plot_patches", [PATCHES], {"labels": [1]}, "labels"),
        ("plot_patches", [PATCHES], {"captions": ["a"]}, "captions"),
        ("plot_near_duplicates", [SET, [[0, 3]]], {}, "pairs must be .* of the 3 patches"),
        ("plot_near_duplicates", [SET, [[0, 1]]], {"split": Split(np.array([0, 1]), np.array([2]))}, "pairs"),
        ("plot_errors", [FRAMES, BOXES.renamed(lambda key: key + 5)], {}, "predictions hold frame 5"),
        ("plot_precision_recall", [(np.ones(2), np.ones(3), np.ones(2))], {}, "curves"),
        ("plot_precision_recall", [{"a": (np.ones(0),) * 3}], {}, r"curves\['a'\] must be computed from"),
        ("plot_precision_recall", [(np.ones(1), np.full(1, np.nan), np.ones(1))], {}, "curves"),
        ("plot_f1", [{"x": 0.5}], {}, r"scores\['x'\]"),
        ("plot_f1", [{"old": {}}], {}, "scores"),
        ("plot_scores", [[1.0], [1, 0]], {}, "labels"),
        ("plot_scores", [[1.0, 2.0], [1, -1]], {}, "labels"),
        ("plot_tradeoff", [TABLE], {"quality": "frame_f1"}, "table has no column 'frame_f1'"),
        ("plot_tradeoff", [TABLE[:0]], {}, "table has no row with both accuracy and search_ms"),
        ("plot_parameter", [TABLE, "gamma"], {}, "table has no column 'gamma'"),
        ("plot_parameter", [TABLE[:0], "search_ms"], {}, "table has no row with both search_ms and accuracy"),
        ("plot_tracks", [[]], {}, "results must hold at least one track"),
        ("plot_tracks", [[RESULT]], {}, "results must hold at least one track"),
        ("plot_tracks", [BOXES.renamed(str)], {}, "results must have numbered frames"),
        ("plot_tracks", [BOXES], {"truth": "t.csv"}, "truth must be .* read_labels"),
        ("plot_stage_times", [[]], {}, "runs"),
    ],
)
def test_a_malformed_argument_is_named(name, arguments, options, argument):
    with pytest.raises(InvalidInputError, match=f"^{argument}"):
        getattr(notebook, name)(*arguments, **options)
