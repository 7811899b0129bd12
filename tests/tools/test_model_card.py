import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch, the extra [train]")

from tests.helpers import drawn
from tools.model_card import calibration_rows, write_card
from vehicle_detection import LabelledFrames, NetworkModel, TrackTable
from vehicle_detection.network import InputFormat, OutputFormat
from vehicle_detection.training import FoldDetections, FrameDataset

SOURCES = [FrameDataset("us_side", (drawn(range(3), "us_side"),)), FrameDataset("own", (drawn([4]),))]
MODEL = NetworkModel(
    graph=b"\0" * 1_900_000,
    name="small",
    input_format=InputFormat(None, "uint8", False),
    output_format=OutputFormat("columns", 1),
    slope=2.0,
    threshold=0.5,
    metadata={"training": {"steps": 40, "batch": 64, "size": "640x384", "random_state": 3}},
)
BOXES = [[100, 80, 200, 180], [170, 60, 260, 150], [300, 100, 330, 125], [0, 90, 60, 170], [340, 20, 400, 60]]


def fold(source, shown, scores, gray=90):
    """Detections of the boxes `shown` in one frame, and of one that is false."""
    labels = TrackTable(
        [0] * 5,
        np.arange(5),
        BOXES,
        truncated=np.array([0, 0, 0, 0.4, 0]),
        ignore=np.array([0, 0, 0, 0, 1], np.bool_),
    )
    boxes = [*(BOXES[row] for row in shown), [10, 10, 40, 30]]
    found = TrackTable([0] * len(boxes), None, boxes, score=np.array(scores, float))
    images = {0: np.full((200, 400, 3), gray, np.uint8)}
    return FoldDetections(source, LabelledFrames(source, images, labels), found)


def test_probabilities_are_fitted_to_the_other_sources():
    folds = [fold(name, [0, 1, 2, 3], [2.0, 1.5, 1.0, -0.5, -1.5]) for name in ("one", "two")]
    rows = calibration_rows(folds)
    assert sum(count for count, _, _ in rows) <= 10
    assert rows[-1][2] == 1.0
    assert [probability for _, probability, _ in rows] == sorted(probability for _, probability, _ in rows)
    assert calibration_rows([]) == []


def test_the_card_lists_the_measurements(tmp_path):
    folds = [fold("us_side", [0, 1, 3], [1.0, 0.5, 0.1, -1.5]), fold("bdd", [0], [1.0, -1.5], gray=20)]
    write_card(tmp_path / "small.md", MODEL, folds, SOURCES, seed=3, trained_on="a GPU, 5 minutes")
    card = (tmp_path / "small.md").read_text()
    assert card.startswith("# Model card: small\n\nA small network that detects vehicles")
    assert "python -m tools.train_default DATA -o small.onnx --card small.md --seed 3\n" in card
    assert "- Training: 40 steps of 64 samples of 640x384 px, seed 3\n" in card
    assert "- Hardware and time: a GPU, 5 minutes\n" in card
    assert "- Threshold: a confidence of 0.62\n" in card
    # The threshold is 0.25 in the log-odds of the network: two of four vehicles, no false box.
    assert "| us_side | 1 | 4 | 0.667 | 1.000 | 0.500 | " in card
    assert "| bdd night | 1 | 4 | " in card
    assert "- us_side, 3 frames, " in card
    assert "nan" not in card
    assert max(len(line) for line in card.splitlines() if not line.startswith("|")) <= 110
