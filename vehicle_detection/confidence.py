"""Confidence of boxes: the threshold that a calibrated probability implies."""

from __future__ import annotations

import dataclasses

from vehicle_detection._common import check_number
from vehicle_detection.boxes import logit
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.function_model import FunctionModel
from vehicle_detection.heatmap import HeatParams
from vehicle_detection.network import NetworkModel
from vehicle_detection.regions import RegionParams
from vehicle_detection.svm import VehicleClassifier

Model = VehicleClassifier | NetworkModel | FunctionModel

# Probabilities beyond these have no useful threshold.
_MIN_CONF, _MAX_CONF = 0.001, 0.999


def with_confidence(
    model: Model, regions: RegionParams | HeatParams | None, conf: float
) -> tuple[Model, RegionParams | HeatParams | None]:
    """Return model and region parameters that find the boxes with a confidence of at least `conf`.

    Raises
    ------
    InvalidInputError
        If `conf` is not a probability, or the boxes have none: those of a heat map and of functions whose
        scores have a scale of their own.
    """
    limit = min(max(check_number(conf, "conf", low=0, high=1), _MIN_CONF), _MAX_CONF)
    if isinstance(regions, HeatParams):
        raise InvalidInputError(
            f"conf must be None with a heat map, whose heat is no probability; got {conf:g}; set the "
            "threshold of HeatParams"
        )
    if isinstance(model, VehicleClassifier):
        params = regions or RegionParams()
        peak = max(model.calibration.score(limit), 0.0)
        # Weak groups of windows have less evidence in proportion.
        evidence = params.min_evidence * min(peak / max(params.min_peak, 1e-9), 1.0)
        return model, dataclasses.replace(params, min_peak=peak, min_evidence=evidence)
    if isinstance(model, NetworkModel):
        return dataclasses.replace(model, threshold=logit(limit)), regions
    if isinstance(model.score, tuple):
        raise InvalidInputError(
            f"conf must be None for scores on a scale of their own, got {conf:g}; change the lower end of "
            "score=(low, high), or return probabilities"
        )
    threshold = limit if model.score == "probability" else logit(limit)
    return dataclasses.replace(model, threshold=threshold), regions
