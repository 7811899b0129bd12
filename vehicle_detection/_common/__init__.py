"""Helpers for all packages: argument checks, files, threads, progress bars, model files, augmentation."""

from vehicle_detection._common.augment import blur_patches, degrade_patches, mirror_patches, relight
from vehicle_detection._common.checks import (
    check_boxes,
    check_channel,
    check_choice,
    check_image,
    check_integer,
    check_number,
    check_patches,
    check_type,
    describe,
    finite_array,
)
from vehicle_detection._common.files import atomic_write, check_target, write_parquet
from vehicle_detection._common.model_file import FORMAT_VERSION, ModelData, read_model, write_model
from vehicle_detection._common.progress import progress_bar
from vehicle_detection._common.threads import (
    JOBS_VARIABLE,
    ThreadTeam,
    available_cores,
    resolve_jobs,
    single_threaded_opencv,
)
from vehicle_detection._common.workspace import NEW_ARRAYS, Workspace

__all__ = [
    "FORMAT_VERSION",
    "JOBS_VARIABLE",
    "NEW_ARRAYS",
    "ModelData",
    "ThreadTeam",
    "Workspace",
    "atomic_write",
    "available_cores",
    "blur_patches",
    "check_boxes",
    "check_channel",
    "check_choice",
    "check_image",
    "check_integer",
    "check_number",
    "check_patches",
    "check_target",
    "check_type",
    "degrade_patches",
    "describe",
    "finite_array",
    "mirror_patches",
    "progress_bar",
    "read_model",
    "relight",
    "resolve_jobs",
    "single_threaded_opencv",
    "write_model",
    "write_parquet",
]
