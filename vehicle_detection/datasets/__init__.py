"""Training patches and frames: reading, download, splits and near duplicates."""

from vehicle_detection.datasets.archives import fetch_patches, is_image
from vehicle_detection.datasets.frames import FrameSet, load_frames
from vehicle_detection.datasets.patches import PatchSet, load_patches, load_training_patches
from vehicle_detection.datasets.splits import (
    SEEDED_SPLITS,
    SPLIT_NAMES,
    Split,
    find_near_duplicates,
    make_split,
    make_thumbnails,
    split_groups,
    split_leakage,
    split_random,
    split_sequences,
    split_sources,
)

__all__ = [
    "SEEDED_SPLITS",
    "SPLIT_NAMES",
    "FrameSet",
    "PatchSet",
    "Split",
    "fetch_patches",
    "find_near_duplicates",
    "is_image",
    "load_frames",
    "load_patches",
    "load_training_patches",
    "make_split",
    "make_thumbnails",
    "split_groups",
    "split_leakage",
    "split_random",
    "split_sequences",
    "split_sources",
]
