import dataclasses
import math

import pytest

from tests.helpers import drawn
from tools.model_card import write_card
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.training import FoldScore, FrameDataset

SOURCES = [FrameDataset("one", (drawn(range(7), "first"),))]
SCORE = FoldScore(
    name="first",
    source="one",
    frames=7,
    vehicles=13,
    f1=0.8,
    precision=0.7059,
    recall=0.9231,
    mean_iou=0.82,
    false_per_frame=0.7143,
    false_per_empty_frame=math.nan,
    false_per_vehicle_free_frame=0.25,
    threshold=-0.36,
    average_precision=0.9231,
    best_f1=0.96,
    region_f1=0.81,
    region_average_precision=0.93,
    strict_average_precision=0.61,
    recall_occluded=0.5,
    recall_truncated=0.75,
    recall_narrow=math.nan,
    occluded=2,
    truncated=4,
    narrow=0,
    calibration_error=0.05,
)


def test_the_card_lists_the_measurements(small_mixture, tmp_path):
    write_card(tmp_path / "small.md", small_mixture, [SCORE], SOURCES, seed=3, patches=5)
    card = (tmp_path / "small.md").read_text()
    assert card.startswith("# Model card: small\n\nA mixture of 1 linear SVM templates")
    assert "python -m tools.train_default DATA -o small.safetensors --card small.md --seed 3" in card
    assert "Templates, in cells of the vehicle's box: 6x5\n" in card
    assert f"{small_mixture.rescorer.n_weights:,} weights" in card
    row = (
        "| first | 7 | 13 | 0.800 | 0.960 | 0.923 | 0.706 | 0.923 | 0.820 | 0.71 | - | 0.25 | 0.810 | "
        "0.930 | 0.610 | 0.500 | 0.750 | - | 0.050 |"
    )
    assert row in card
    assert "- one: 7 frames, " in card
    assert "- 5 vehicles on the course's patches" in card
    assert "nan" not in card
    assert max(len(line) for line in card.splitlines() if not line.startswith("|")) <= 110


def test_the_card_of_a_model_without_rescorer_and_patches(small_mixture, tmp_path):
    plain = dataclasses.replace(small_mixture, rescorer=None)
    write_card(tmp_path / "m.md", plain, [], SOURCES, seed=0)
    card = (tmp_path / "m.md").read_text()
    assert "Rescoring" not in card
    assert "the course's patches" not in card


def test_the_card_needs_a_folder(small_mixture, tmp_path):
    with pytest.raises(InvalidInputError, match="path needs an existing folder"):
        write_card(tmp_path / "none" / "m.md", small_mixture, [SCORE], SOURCES, seed=0)
