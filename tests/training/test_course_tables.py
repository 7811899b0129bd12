import shutil

from benchmarks import _course_runs, course_tables
from tests.training.trial_cases import SMALL, count_trials
from vehicle_detection import FeatureParams, write_image
from vehicle_detection.training import read_results


def test_the_course_tables_are_written(patch_set, tmp_path, monkeypatch):
    for image, name in zip(patch_set.patches, patch_set.names):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / name, image)
    for archive in ("vehicles", "non-vehicles"):
        shutil.make_archive(str(tmp_path / archive), "zip", tmp_path, archive)
    monkeypatch.setattr(_course_runs, "SEEDS", range(1))
    for name in ("FIRST", "SECOND"):
        monkeypatch.setattr(_course_runs, name, FeatureParams(**SMALL))
    for plan in _course_runs.PLANS.values():
        small = {
            name: FeatureParams(**{**SMALL, "orient": 2 + number})
            for number, name in enumerate(plan.configurations)
        }
        monkeypatch.setitem(vars(plan), "configurations", small)
    out = tmp_path / "docs"
    command = ["--data", str(tmp_path), "--out", str(out)]
    course_tables.main(command)
    page = (out / "results.md").read_text(encoding="utf-8")
    rows = (out / "results" / "rows.jsonl").read_bytes()
    assert page.count("\n## ") == 9
    assert "| random | 96 | 24 |" in page
    assert "## The shipped model" in page
    assert "| (9, 8, 2, All) | " in page
    assert str(tmp_path) not in page
    figures = sorted(path.stem for path in (out / "results").glob("*.png"))
    assert figures == sorted([*_course_runs.PLANS, "bayes_or_svm", "leakage", "prediction_time"])
    for name in figures:
        assert f"![](results/{name}.png)" in page
        assert len(read_results(out / "results" / f"{name}.csv")) > 1
    # A second run measures nothing.
    count_trials(monkeypatch, stop_after=0)
    course_tables.main(command)
    assert (out / "results" / "rows.jsonl").read_bytes() == rows
