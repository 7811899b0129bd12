"""Hard negatives: windows of labelled frames that a classifier takes for vehicles and that are none."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_integer, check_number
from vehicle_detection.boxes import Detections, intersection_matrix, non_max_suppression
from vehicle_detection.classifier import VehicleClassifier
from vehicle_detection.datasets import PatchSet
from vehicle_detection.evaluation import (
    FrameBoxes,
    Frames,
    check_frame_boxes,
    iterate_frames,
    keyed_frames,
    keys_of,
)
from vehicle_detection.params import PATCH_SIZE, SearchParams
from vehicle_detection.search import BandSearch


def mine_negatives(
    frames: Frames,
    labels: FrameBoxes,
    classifier: VehicleClassifier,
    *,
    search: SearchParams | None = None,
    min_score: float = 0.0,
    max_overlap: float = 0.5,
    per_frame: int | None = None,
    source: str = "mined",
    n_jobs: int | None = None,
) -> PatchSet:
    """Cut out the false windows of labelled frames, as patches to train on.

    A window is false if it touches no labelled box, whether that is scored or to be ignored. So every
    vehicle in the frames must be labelled, at least coarsely. Do not mine frames that are scored
    afterwards.

    Parameters
    ----------
    frames
        Images by key, a list of images that go by their numbers, or the frames of `load_frames`.
    labels
        True boxes of these frames; a frame without any counts as empty.
    classifier
        The model whose mistakes are wanted.
    search
        Where and at which sizes to search; the default is ``SearchParams.preset("default")``.
    min_score
        Windows that score above this are mistakes; below 0, near mistakes are taken, too.
    max_overlap
        Of false windows that overlap by more than this (IoU), the best scored one is taken; 1 takes all.
    per_frame
        At most so many of a frame, the best scored ones; None takes all.
    source
        Name of the patches' source.
    n_jobs
        Threads of the search.

    Returns
    -------
    PatchSet
        Non-vehicles, 64x64, frame by frame, best score first, each named
        ``non-vehicles/<source>/<frame>_<x1>_<y1>_<side>.png``; join it to the training patches with
        ``PatchSet.concatenate``. It is empty if the classifier makes no mistake.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or the labels know none of the frames.

    Notes
    -----
    Dalal and Triggs (CVPR 2005), section 4: the detector is trained again with its own false positives.

    Examples
    --------
    >>> from vehicle_detection import load_classifier
    >>> road = np.full((360, 640, 3), 90, np.uint8)
    >>> mine_negatives([road], Labels([], None, [], frame_keys=[0]), load_classifier())
    PatchSet(0 patches of 64x64 pixels, 0 of them vehicles)
    """
    images = keyed_frames(frames)
    known = check_frame_boxes(keys_of(images), labels)
    least = check_number(min_score, "min_score")
    overlap = check_number(max_overlap, "max_overlap", low=0, high=1)
    most = None if per_frame is None else check_integer(per_frame, "per_frame", low=1)
    wanted = dataclasses.replace(search or SearchParams.preset(), min_score=least)
    patches: list[NDArray[np.uint8]] = []
    names: list[str] = []
    with BandSearch(classifier, n_jobs=n_jobs) as bands:
        for key, image in iterate_frames(images):
            windows = _false_windows(bands.find_windows(image, wanted), known.boxes[known.rows(key)])
            kept = windows[non_max_suppression(windows.boxes, windows.scores, threshold=overlap)]
            for box in np.rint(kept.boxes[:most]).astype(np.int64):
                patches.append(cut_patch(image, box))
                left, top, right, _ = box.tolist()
                stem = str(key).replace("/", "_")
                names.append(f"non-vehicles/{source}/{stem}_{left}_{top}_{right - left}.png")
    stacked = np.stack(patches) if patches else np.empty((0, PATCH_SIZE, PATCH_SIZE, 3), np.uint8)
    return PatchSet(stacked, np.zeros(len(stacked), np.bool_), tuple(names))


def _false_windows(windows: Detections, boxes: NDArray[np.float64]) -> Detections:
    """Drop the windows that touch a box."""
    touched = intersection_matrix(windows.boxes.astype(np.float64), boxes) > 0
    return windows[np.flatnonzero(~touched.any(axis=1))]


def cut_patch(image: NDArray[np.uint8], box: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Cut a box out and resize it to a patch; beyond the frame its outermost pixels go on."""
    height, width = image.shape[:2]
    rows = np.clip(np.arange(box[1], box[3]), 0, height - 1)
    columns = np.clip(np.arange(box[0], box[2]), 0, width - 1)
    return np.asarray(cv2.resize(image[np.ix_(rows, columns)], (PATCH_SIZE, PATCH_SIZE)), np.uint8)
