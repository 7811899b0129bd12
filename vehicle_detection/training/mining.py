"""Hard negative mining: false positive windows of labelled frames become training patches."""

from __future__ import annotations

import contextlib
import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check
from vehicle_detection.boxes import intersection_matrix, non_max_suppression
from vehicle_detection.datasets import PatchSet
from vehicle_detection.evaluation import Frames, LabelledFrames, keyed_frames
from vehicle_detection.features import PATCH_SIZE
from vehicle_detection.search import SearchParams
from vehicle_detection.svm import CLASSIFIER_REMEDY, VehicleClassifier
from vehicle_detection.tables import TrackTable


def mine_negatives(
    frames: Frames,
    labels: TrackTable,
    classifier: VehicleClassifier,
    *,
    search_params: SearchParams | None = None,
    min_score: float = 0.0,
    max_overlap: float = 0.5,
    max_per_frame: int | None = None,
    source: str = "mined",
    jobs: int | None = None,
) -> PatchSet:
    """Cut the false positive windows of labelled frames out as training patches.

    A window is a false positive if it touches no labelled box, whether that box is scored or ignored. Every
    vehicle in the frames must therefore be labelled, at least coarsely. Do not evaluate on mined frames. The
    detector is then trained again with its false positives (Dalal and Triggs, CVPR 2005, section 4).

    Returns non-vehicles, 64x64 pixels, frame by frame, highest score first, with the names
    ``non-vehicles/<source>/<frame>_<x1>_<y1>_<side>.png``; may be empty. `PatchSet.concatenate` appends them
    to the training patches.

    Parameters
    ----------
    frames, labels
        As in `LabelledFrames`.
    classifier, jobs
        The model whose false positives are collected, and the threads of its search.
    search_params, min_score
        Where and at which sizes to search, by default ``SearchParams.preset()``; windows above the score are
        collected, and a value below 0 includes near misses.
    max_overlap, max_per_frame
        Of windows that overlap by more than this IoU only the best is kept; 1 keeps all. Of each frame only
        this number of patches with the highest scores is kept; None keeps all.
    source
        Source folder in the names of the patches.

    Examples
    --------
    >>> from vehicle_detection import load_classifier
    >>> road = np.full((360, 640, 3), 90, np.uint8)
    >>> len(mine_negatives([road], TrackTable(frame_keys=[0]), load_classifier()))
    0
    """
    check.instance(source, "source", str, "pass a name for the patches' source folder")
    labelled = LabelledFrames(source, keyed_frames(frames), labels)
    overlap = check.number(max_overlap, "max_overlap", low=0, high=1)
    limit = None if max_per_frame is None else check.integer(max_per_frame, "max_per_frame", low=1)
    check.instance(classifier, "classifier", VehicleClassifier, CLASSIFIER_REMEDY)
    given = SearchParams.preset() if search_params is None else search_params
    check.instance(given, "search_params", SearchParams, "omit it for the default")
    params = dataclasses.replace(given, min_score=check.number(min_score, "min_score"))
    patches: list[NDArray[np.uint8]] = []
    names: list[str] = []
    with contextlib.closing(classifier.open_search(jobs)) as search:
        for key, image in labelled:
            windows = search.find(image, params).windows
            labelled_boxes = labelled.labels.frame(key).boxes
            touching = intersection_matrix(windows.boxes.astype(np.float64), labelled_boxes) > 0
            windows = windows[np.flatnonzero(~touching.any(axis=1))]
            kept = windows[non_max_suppression(windows.boxes, windows.scores, threshold=overlap)]
            for box in np.rint(kept.boxes[:limit]).astype(np.int64):
                patches.append(_cut_patch(image, box))
                x1, y1, x2, _ = box.tolist()
                stem = str(key).replace("/", "_")
                names.append(f"non-vehicles/{source}/{stem}_{x1}_{y1}_{x2 - x1}.png")
    stacked = np.stack(patches) if patches else np.empty((0, PATCH_SIZE, PATCH_SIZE, 3), np.uint8)
    return PatchSet(stacked, np.zeros(len(stacked), np.bool_), tuple(names))


def _cut_patch(image: NDArray[np.uint8], box: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Cut a box out and resize it to a patch; pixels outside the frame repeat its border."""
    height, width = image.shape[:2]
    rows = np.clip(np.arange(box[1], box[3]), 0, height - 1)
    columns = np.clip(np.arange(box[0], box[2]), 0, width - 1)
    return np.asarray(cv2.resize(image[np.ix_(rows, columns)], (PATCH_SIZE, PATCH_SIZE)), np.uint8)
