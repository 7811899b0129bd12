"""Runs of batches, and checks of what they have written."""

import contextlib
import json
from concurrent.futures import ThreadPoolExecutor

import pytest

from vehicle_detection import probe_video, run_batch
from vehicle_detection.drive.batch_store import open_store
from vehicle_detection.drive.batch_trip import source_id

parquet = pytest.importorskip("pyarrow.parquet")


def run(sources, out, model, **options):
    with ThreadPoolExecutor(1) as executor:
        return run_batch(sources, out, executor, model=model, progress=False, **options)


@contextlib.contextmanager
def unfinished(out, source):
    """Lock a trip, as another run does that works on it: a batch with this trip outlasts the block."""
    pytest.importorskip("fcntl")
    with open_store(out, create=True).lock(source_id(str(source))) as locked:
        assert locked
        yield


def counts(report):
    return report.done, report.failed, report.errors, report.skipped


def files(folder, pattern="*"):
    return {path: path.stat().st_mtime_ns for path in folder.rglob(pattern) if path.is_file()}


def records(out):
    paths = (out / "records").glob("[!.]*.json")  # not those that are being written
    return {path.stem: json.loads(path.read_text()) for path in paths}


def check_whole(out, *, done, failed):
    """Assert that every record is complete, and that there is nothing else."""
    found = records(out)
    by_status = {status: [key for key, each in found.items() if each["status"] == status] for status in
                 ("done", "failed", "error")}  # fmt: skip
    assert {status: len(keys) for status, keys in by_status.items()} == {
        "done": done, "failed": failed, "error": 0
    }  # fmt: skip
    expected = {out / path for each in found.values() for path in each.get("outputs", {}).values()}
    expected |= {out / "records" / f"{key}.json" for key in found}
    assert set(files(out)) == expected
    for key in by_status["done"]:
        table = parquet.read_table(out / found[key]["outputs"]["tracks"], partitioning=None)
        assert table.num_rows == found[key]["rows"] > 0
        assert set(table["trip"].to_pylist()) == {key}
        if "video" in found[key]["outputs"]:
            assert probe_video(out / found[key]["outputs"]["video"]).frames == found[key]["frames"]
    return found
