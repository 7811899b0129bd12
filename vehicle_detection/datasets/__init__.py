"""Training patches: read, downloaded, split without leakage, and searched for near duplicates."""

from vehicle_detection.datasets.archives import fetch_patches
from vehicle_detection.datasets.near_duplicates import find_near_duplicates, make_thumbnails
from vehicle_detection.datasets.patches import (
    FrameSet,
    PatchSet,
    load_frames,
    load_patches,
    load_training_patches,
)
from vehicle_detection.datasets.splits import (
    Split,
    split_groups,
    split_leakage,
    split_random,
    split_sequences,
    split_sources,
)

__all__ = [
    "FrameSet",
    "PatchSet",
    "Split",
    "fetch_patches",
    "find_near_duplicates",
    "load_frames",
    "load_patches",
    "load_training_patches",
    "make_thumbnails",
    "split_groups",
    "split_leakage",
    "split_random",
    "split_sequences",
    "split_sources",
]
