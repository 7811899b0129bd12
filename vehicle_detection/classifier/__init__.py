"""The linear SVM of patches: how it is trained, the classifier that comes of it, and how it is loaded."""

from __future__ import annotations

import os

from vehicle_detection._common import ModelData, read_model
from vehicle_detection.classifier.fit import (
    DEFAULT_C,
    check_gamma,
    check_labels,
    fit_features,
    patch_features,
    train_classifier,
)
from vehicle_detection.classifier.linear import KIND, Template, VehicleClassifier
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.params import FeatureParams

__all__ = [
    "CLASSIFIER_REMEDY",
    "DEFAULT_C",
    "KIND",
    "Template",
    "VehicleClassifier",
    "build_classifier",
    "check_gamma",
    "check_labels",
    "fit_features",
    "load_classifier",
    "patch_features",
    "train_classifier",
]

CLASSIFIER_REMEDY = "load_classifier, train_classifier or VehicleClassifier.from_pipeline make one"


def load_classifier(path: str | os.PathLike[str] | None = None) -> VehicleClassifier:
    """Load a classifier of patches: a model file, or the one that the package ships, ``"highway"``.

    Parameters
    ----------
    path
        A ``.safetensors`` file written by `VehicleClassifier.save`; None loads the shipped one.

    Raises
    ------
    ModelFileError
        If the file is missing, cut, edited, of another kind or version, holds NaN, or does not fit its own
        parameters.

    Examples
    --------
    >>> load_classifier().params.color_space
    'LAB'
    """
    return build_classifier(read_model("highway" if path is None else path, KIND))


def build_classifier(model: ModelData) -> VehicleClassifier:
    """Build a classifier from what a model file holds."""
    tensors = model.tensors
    try:
        count = len({key.split(".")[0] for key in tensors})
        templates = tuple(
            Template(
                tensors[f"{index}.mean"],
                tensors[f"{index}.scale"],
                tensors[f"{index}.coef"],
                float(tensors[f"{index}.intercept"].reshape(())),
            )
            for index in range(count)
        )
        return VehicleClassifier(FeatureParams(**model.params), templates, model.metadata)
    except (InvalidInputError, KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f"{model.name} does not fit its own parameters: {error}") from error
