"""Feature extraction of the course's patches on one core, compared with scikit-image."""

from __future__ import annotations

import numpy as np

from benchmarks._material import Context, patches
from benchmarks._report import Row, at_most
from benchmarks._timing import seconds_of
from vehicle_detection import FeatureParams, extract_features, single_img_features

COUNT = 17_760
SAMPLE = 300
TOLERANCE = 1e-4


def run(context: Context) -> list[Row]:
    """Extract the features of all patches, and of a sample by the reference functions."""
    found, material = patches()
    # Rendered patches are repeated to the same number; their content does not change the time.
    images = np.resize(found.patches, (COUNT, *found.patches.shape[1:]))
    params = FeatureParams.preset("ycrcb-6156")
    sample = images[:: COUNT // SAMPLE][:SAMPLE]
    fast = extract_features(sample, params, jobs=1)
    reference = np.empty(fast.shape)

    def by_reference() -> None:
        for index, patch in enumerate(sample):
            reference[index] = single_img_features(patch, params)

    seconds = seconds_of(lambda: extract_features(images, params, jobs=1))
    slow = seconds_of(by_reference) * COUNT / SAMPLE
    return [
        Row(
            f"features of {COUNT:,} patches, {params.length} long, one core",
            seconds,
            unit="s",
            target=at_most(3),
            material=material,
        ),
        Row(f"scikit-image, extrapolated from {SAMPLE} patches", slow, unit="s"),
        Row("faster than scikit-image", slow / seconds, unit="x"),
        Row(
            "maximum difference of a feature, relative to its size or 1",
            float((np.abs(fast - reference) / np.maximum(1, np.abs(reference))).max()),
            target=at_most(TOLERANCE),
        ),
    ]
