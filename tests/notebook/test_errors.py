"""What is malformed is refused, and the message begins with the argument's name."""

import numpy as np
import pandas as pd
import pytest

from tests.helpers import random_classifier
from tests.notebook.helpers import SMALL, gray_image
from vehicle_detection import Detections, FrameResult, InvalidInputError, LabelledFrames, TrackTable, notebook

IMAGE, NONE = gray_image(), Detections.empty()
MODEL = random_classifier(SMALL)
PATCHES = np.zeros((3, 64, 64, 3), np.uint8)
BOXES = TrackTable([0], [1], [[0, 0, 50, 40]], score=[1.0])
FRAMES = LabelledFrames("road", [IMAGE], TrackTable([0], [1], [[0, 0, 50, 40]]))
TABLE = pd.DataFrame({"accuracy": [0.9], "search_ms": [4.0], "configuration": ["a"]})
RESULT = FrameResult(0, None, NONE, NONE, ())


@pytest.mark.parametrize(
    ("name", "arguments", "options", "argument"),
    [
        ("plot_hog", [gray_image(30, 30)], {"pix_per_cell": [16]}, "images.0. must have 32x32 pixels"),
        ("show_images", [[IMAGE]], {"boxes": [[1, 2, 3, 4]]}, r"boxes\[0\]"),
        ("plot_errors", [FRAMES, BOXES.renamed(lambda key: key + 5)], {}, "predictions hold frame 5"),
        ("plot_precision_recall", [(np.ones(2), np.ones(3), np.ones(2))], {}, "curves"),
        ("plot_precision_recall", [{"a": (np.ones(0),) * 3}], {}, r"curves\['a'\] must be computed from"),
        ("plot_precision_recall", [(np.ones(1), np.full(1, np.nan), np.ones(1))], {}, "curves"),
        ("plot_tradeoff", [TABLE], {"quality": "frame_f1"}, "table has no column 'frame_f1'"),
        ("plot_tradeoff", [TABLE[:0]], {}, "table has no row with both accuracy and search_ms"),
        ("plot_tracks", [[]], {}, "results must hold at least one track"),
        ("plot_tracks", [[RESULT]], {}, "results must hold at least one track"),
        ("plot_tracks", [BOXES.renamed(str)], {}, "results must have numbered frames"),
    ],
)
def test_a_malformed_argument_is_named(name, arguments, options, argument):
    with pytest.raises(InvalidInputError, match=f"^{argument}"):
        getattr(notebook, name)(*arguments, **options)
