"""How a classifier is trained: the copies of the patches, their features, and the fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import vehicle_detection
from vehicle_detection._common import (
    blur_patches,
    check_integer,
    check_number,
    check_patches,
    degrade_patches,
    describe,
    mirror_patches,
)
from vehicle_detection._kernels import fit_svm
from vehicle_detection.classifier.linear import Template, VehicleClassifier
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import extract_features
from vehicle_detection.params import PATCH_SIZE, FeatureParams

DEFAULT_C = 1e-4


def train_classifier(
    patches: NDArray[np.uint8],
    labels: ArrayLike,
    *,
    params: FeatureParams | None = None,
    C: float = DEFAULT_C,
    mirror: bool = True,
    gamma: float = 0.0,
    degraded: float = 0.0,
    random_state: int = 0,
    n_jobs: int | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> VehicleClassifier:
    """Fit a scaler and a linear SVM on patches.

    Parameters
    ----------
    patches
        ``(N, 64, 64, 3)`` uint8 RGB: the training part only; nothing else is seen.
    labels
        ``(N,)``, 1 (or True) for a vehicle, 0 for anything else.
    params
        Features; the default is ``FeatureParams()``.
    C
        Inverse strength of the regularisation. Small values generalise better to other sequences.
    mirror
        Add each patch mirrored left to right.
    gamma
        Give the mirrored patches another brightness: exponents between ``exp(-gamma)`` and ``exp(gamma)``.
    degraded
        Weight of two more copies of each patch, in [0, 1]: one coarse, as from further away, and one coarse,
        pale and compressed, as of another camera. It helps most on other cameras; 0 leaves them out.
    random_state
        Seed of the solver.
    n_jobs
        Threads of the feature extraction.
    metadata
        Facts to keep in the model file.

    Returns
    -------
    VehicleClassifier
        With one template. The same input and seed give the same model.

    Raises
    ------
    InvalidInputError
        If a patch is malformed, the labels do not fit or hold one class only.
    """
    params = params or FeatureParams()
    images = check_patches(patches, PATCH_SIZE)
    targets = check_labels(labels, len(images))
    check_number(C, "C", above=0, high=1e12)
    check_gamma(gamma, mirror)
    check_number(degraded, "degraded", low=0, high=1)
    check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    features = patch_features(images, params, mirror=mirror, gamma=gamma, degraded=degraded, n_jobs=n_jobs)
    return fit_features(
        features,
        targets,
        params=params,
        C=C,
        mirror=mirror,
        gamma=gamma,
        degraded=degraded,
        random_state=random_state,
        metadata=metadata,
    )


def patch_features(
    images: NDArray[np.uint8],
    params: FeatureParams,
    *,
    mirror: bool,
    gamma: float = 0.0,
    degraded: float = 0.0,
    n_jobs: int | None = None,
) -> NDArray[np.float32]:
    """Features of all patches and below them, as asked for, of all mirrored, coarse and degraded ones."""
    makers: list[Callable[[], NDArray[np.uint8]]] = [lambda: images]
    if mirror:
        makers.append(lambda: mirror_patches(images, gamma=gamma))
    if degraded:
        makers.append(lambda: blur_patches(images, mirror=mirror))
        makers.append(lambda: degrade_patches(images, mirror=mirror))
    if len(makers) == 1:
        return extract_features(images, params, n_jobs=n_jobs)
    count = len(images)
    features = np.empty((len(makers) * count, params.length), np.float32)
    for copy, make in enumerate(makers):
        features[copy * count : (copy + 1) * count] = extract_features(make(), params, n_jobs=n_jobs)
    return features


def copy_weights(mirror: bool, degraded: float) -> tuple[float, ...]:
    """Weights of the copies of each patch that are trained on, in the order of `patch_features`."""
    return (1.0, *(1.0,) * mirror, *(degraded, degraded) * (degraded > 0))


def fit_features(
    features: NDArray[np.float32],
    labels: NDArray[np.int64],
    *,
    params: FeatureParams,
    C: float,
    mirror: bool,
    gamma: float = 0.0,
    degraded: float = 0.0,
    random_state: int,
    rows: NDArray[np.intp] | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> VehicleClassifier:
    """Fit a scaler and a linear SVM on features that `patch_features` computed; the caller checks.

    Parameters
    ----------
    features
        ``(copies * N, params.length)`` float32; not changed, and not copied.
    labels
        ``(N,)`` zeros and ones of the patches, both present.
    rows
        Patches to train on, with all their copies; all if None.
    params, C, mirror, gamma, degraded, random_state, metadata
        As in `train_classifier`; `mirror` and `degraded` tell which copies the features are of.
    """
    weights = copy_weights(mirror, degraded)
    count = len(labels)
    chosen = np.arange(count) if rows is None else rows
    fitted = fit_svm(
        features,
        np.tile(labels, len(weights)),
        C * np.repeat(weights, count),
        rows=np.concatenate([chosen + copy * count for copy in range(len(weights))]),
        gains=params.gains,
        random_state=random_state,
    )
    vehicles = int(labels[chosen].sum())
    facts = {
        "training": {
            "C": C,
            "mirror": mirror,
            "gamma": gamma,
            "degraded": degraded,
            "random_state": random_state,
            "vehicles": vehicles,
            "non_vehicles": len(chosen) - vehicles,
        },
        "versions": {"vehicle_detection": vehicle_detection.__version__, **_library_versions()},
        **(metadata or {}),
    }
    return VehicleClassifier(params, (Template(*fitted),), facts)


def _library_versions() -> dict[str, str]:
    from importlib.metadata import version

    return {name: version(name) for name in ("numba", "numpy", "opencv-python-headless")}


def check_labels(labels: ArrayLike, count: int) -> NDArray[np.int64]:
    """Return `labels` as `count` zeros and ones with both classes present."""
    array = np.asarray(labels)
    if array.shape != (count,) or array.dtype.kind not in "biuf":
        raise InvalidInputError(
            f"labels must be one number for each of {count} patches; got {describe(array)}"
        )
    if not np.isin(array, (0, 1)).all():
        raise InvalidInputError(f"labels must be 0 or 1; got {np.unique(array)[:5].tolist()}")
    if count == 0 or array.min() == array.max():
        raise InvalidInputError("labels must hold both classes: vehicles (1) and non-vehicles (0)")
    return array.astype(np.int64)


def check_gamma(gamma: object, mirror: bool) -> float:
    """Return `gamma` if it is one that patches with or without mirrored ones can have."""
    number = check_number(gamma, "gamma", low=0, high=2)
    if number and not mirror:
        raise InvalidInputError(
            f"gamma must be 0 without mirrored patches, whose brightness it changes; got {number:g}"
        )
    return number
