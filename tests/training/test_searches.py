import pytest

from vehicle_detection import InvalidInputError, LabelledFrames, load_classifier, render_scene
from vehicle_detection.scenes import truth_table
from vehicle_detection.training import compare_searches


@pytest.fixture(scope="module")
def frames():
    scenes = [render_scene(shape=(540, 960), random_state=seed) for seed in range(3)]
    labels = truth_table({row: scene.truth for row, scene in enumerate(scenes)})
    return LabelledFrames("scenes", [scene.image for scene in scenes], labels)


def test_the_best_search_comes_first(frames):
    scales, thresholds = [(1.0, 1.5), (0.8,)], (0, 2, 8, 200)
    table = compare_searches(load_classifier(), frames, scales=scales, overlaps=[0.75], thresholds=thresholds)
    assert len(table) == 8
    assert table["f1"].is_monotonic_decreasing
    assert table["f1"].iloc[0] > 0
    assert set(table["scales"]) == set(scales)
    assert (table["recall"][table["threshold"] == 200] == 0).all()
    assert (table["search_ms"] > 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scales": 1.0}, "scales must be a sequence"),
        ({"scales": [(0,)]}, "scales must be a number"),
        ({"overlaps": [1.0]}, "overlaps must be a number"),
        ({"thresholds": [-1]}, "thresholds must be a number"),
        ({"thresholds": []}, "must hold a value each"),
        ({"classifier": None}, "classifier must be"),
        ({"frames": []}, "frames must be"),
    ],
)
def test_bad_input_is_refused(frames, options, message):
    with pytest.raises(InvalidInputError, match=message):
        compare_searches(**{"classifier": load_classifier(), "frames": frames, **options})
