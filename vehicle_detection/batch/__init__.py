"""Many trips: planned, processed by worker processes or a cluster, and recorded so that a run can resume."""

from vehicle_detection.batch.cluster import open_dask
from vehicle_detection.batch.records import BatchStatus, batch_status, batch_summary, with_source
from vehicle_detection.batch.run import BatchReport, run_batch

__all__ = [
    "BatchReport",
    "BatchStatus",
    "batch_status",
    "batch_summary",
    "open_dask",
    "run_batch",
    "with_source",
]
