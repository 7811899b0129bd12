import json

import numpy as np
import pytest

from tests.helpers import drawn, write_frame_set
from tools import measure_model
from tools.measure_model import choose_sources, measure
from vehicle_detection import DatasetError, LabelledFrames, TrackTable, detector_from
from vehicle_detection.training import FrameDataset

VEHICLE = [10, 10, 60, 50]


@pytest.fixture
def data(tmp_path):
    for name, seeds in (("bdd", range(3)), ("dawn", [3])):
        write_frame_set(tmp_path / "data", name, drawn(seeds))
    return tmp_path / "data"


def model_of(confidence):
    return detector_from(lambda image: ([VEHICLE], [confidence])).model


def gray(name, levels):
    """Frames of these gray levels, with the same vehicle in each."""
    images = [np.full((60, 160, 3), level, np.uint8) for level in levels]
    labels = TrackTable(list(range(len(levels))), None, [VEHICLE] * len(levels))
    return FrameDataset(name, (LabelledFrames(name, images, labels),))


def test_sources_in_the_given_order_and_their_rides(data):
    assert [source.name for source in choose_sources(data, ["dawn", "bdd"])] == ["dawn", "bdd"]
    names = choose_sources(data, ["bdd"])[0].sets[0].keys
    road, fog = choose_sources(data, ["bdd", "dawn"], names[1:])
    assert road.sets[0].keys == names[1:]
    assert len(fog.sets[0]) == 1
    with pytest.raises(DatasetError, match=r"lacks labels/india\.csv"):
        choose_sources(data, ["bdd", "india"])
    with pytest.raises(DatasetError, match=r"bdd has no frame 'none\.jpg'"):
        choose_sources(data, ["bdd"], [*names, "none.jpg"])


def test_a_model_is_scored_at_its_own_threshold_and_by_light():
    sources = [gray("bdd", [20, 50, 100, 110]), gray("dawn", [20])]
    rows = measure(model_of(0.9), sources)
    assert [(row["name"], row["frames"]) for row in rows] == [
        ("bdd", 4), ("bdd day", 2), ("bdd dusk", 1), ("bdd night", 1), ("dawn", 1),
    ]  # fmt: skip
    assert {row["f1"] for row in rows} == {1.0}
    assert rows[0]["calibration_error"] == pytest.approx(0.1, abs=1e-3)
    # Below the threshold, but found.
    (row,) = measure(model_of(0.3), sources[1:])
    assert (row["f1"], row["best_f1"], row["average_precision"]) == (0.0, 1.0, 1.0)


def test_the_command_writes_the_values(data, tmp_path, capsys):
    rides = tmp_path / "rides.txt"
    name = choose_sources(data, ["bdd"])[0].sets[0].keys[0]
    rides.write_text(f"{name}\n")
    words = [data, "--model", "default", "--sources", "bdd,dawn", "--rides", rides, "--jobs", 1]
    measure_model.main([*map(str, words), "-o", str(tmp_path / "out.json")])
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["model"] == "default"
    found = {row["name"]: row["frames"] for row in written["sets"]}
    assert (found["bdd"], found["dawn"]) == (1, 1)
    assert capsys.readouterr().out.startswith("| set | frames | vehicles | F1 |")
