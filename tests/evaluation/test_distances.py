"""Tests of the scores of distances and speeds."""

import json

import numpy as np
import pytest

from tests.cli.commands import run
from vehicle_detection import TrackTable, read_labels
from vehicle_detection.evaluation import evaluate_distances

BOXES = np.array([[10.0, 10, 60, 50], [100, 20, 140, 60], [200, 20, 240, 60]])


def table(distances, **columns):
    count = len(distances)
    return TrackTable([0] * count, list(range(1, count + 1)), BOXES[:count], distance_m=distances, **columns)


def test_errors_by_range_and_cut():
    labels = table([4.0, 15.0, 30.0], truncated=[0.5, 0, 0])
    scores = evaluate_distances(table([5.0, 16.5, np.nan], distance_std_m=[0.5, 2.0, 1.0]), labels).distances
    assert scores["cut, 0-5 m"].error == pytest.approx(0.25)
    assert (scores["cut, 0-5 m"].within_1_std, scores["cut, 0-5 m"].within_2_std) == (0, 1)
    assert scores["10-20 m"].bias == pytest.approx(0.1)
    assert scores["10-20 m"].within_1_std == 1
    assert (scores["20-40 m"].known, scores["20-40 m"].stated) == (1, 0)
    assert sum(row.known for row in scores.values()) == 3


def test_speeds_and_times_to_collision():
    labels = table([20.0, 30.0, 30.0], speed_mps=[-4.0, 2.0, np.nan])
    found = table([20.0, 33.0, 30.0], speed_mps=[-5.0, 2.5, 1.0], speed_std_mps=[2.0, 0.1, 1.0])
    scores = evaluate_distances(found, labels)
    assert (scores.speeds.known, scores.speeds.bias, scores.speeds.error) == (2, -0.25, 0.75)
    assert scores.speeds.within_1_std == 0.5
    # 5 s in truth, 4 s as found; nothing collides with what moves away.
    assert scores.collision_times.known == 1
    assert scores.collision_times.error == pytest.approx(0.2)


def test_boxes_elsewhere_and_without_truth_do_not_count():
    labels = table([np.nan, 20.0])
    found = TrackTable([0, 0], [1, 2], BOXES[[0, 2]], distance_m=[10.0, 20.0])
    scores = evaluate_distances(found, labels)
    assert all(row.known == 0 for row in scores.distances.values())
    assert "no matched box" in scores.summary()


def test_vehicles_beside_the_camera_have_no_relative_error():
    scores = evaluate_distances(table([1.0, 1.0], speed_mps=[-1, 1]), table([0.0, -3.0], speed_mps=[-1, 1]))
    assert all(row.known == 0 for row in (*scores.distances.values(), scores.collision_times))


def test_the_command_reports_them(tmp_path):
    for name, found in (("labels.csv", [20.0, 30.0]), ("tracks.csv", [21.0, 30.0])):
        rows = [f"0,{row + 1},{','.join(map(str, box))},{found[row]}" for row, box in enumerate(BOXES[:2])]
        (tmp_path / name).write_text("\n".join(["frame,track_id,x1,y1,x2,y2,distance_m", *rows]))
    out = tmp_path / "scores.json"
    done = run("evaluate", tmp_path / "tracks.csv", tmp_path / "labels.csv", "--json", out)
    assert "distance, 20-40 m" in done.output
    assert json.loads(out.read_text())["distances"]["distances"]["20-40 m"]["stated"] == 2
    assert np.isfinite(read_labels(tmp_path / "labels.csv")["distance_m"]).all()
