"""The mixture of templates: linear SVMs of several shapes, and their model file.

A car from behind, a car from the side and a bus do not fit one square window. Each template has its own shape
and is a linear SVM over the same FHOG channels, so one pyramid of a frame serves them all. Their windows
become boxes by voting, rescoring with box correction, and non-maximum suppression. Felzenszwalb et al. (PAMI
2010) for the mixture; Ohn-Bar and Trivedi, "Learning to detect vehicles by clustering appearance patterns"
(IEEE T-ITS 2015) for vehicles.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Floats,
    check_choice,
    check_sequence,
    check_type,
    read_model,
    store_number,
    write_model,
)
from vehicle_detection.boxes import Platt, box_areas, clip_boxes
from vehicle_detection.classifier import KIND as PATCH_KIND
from vehicle_detection.classifier import VehicleClassifier, build_classifier
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.mixture.boxes import (
    DUPLICATE_IOU,
    MAX_PROPOSALS,
    ScoredWindows,
    nms,
    vote_boxes,
    whole_vehicles,
)
from vehicle_detection.mixture.features import EdgePyramid
from vehicle_detection.mixture.perspective import perspective_ratios
from vehicle_detection.mixture.rescoring import RESCORE_AGAIN_MIN, RESCORE_MIN, Rescorer
from vehicle_detection.mixture.template import MixtureTemplate
from vehicle_detection.params import PyramidParams

if TYPE_CHECKING:
    from vehicle_detection.mixture.search import MixtureSearch


WINDOW_MARGIN = -0.38
"""Margin of a window whose score is 0; heat with the default thresholds is best with windows from there."""

# Height in pixels of a box, and number of candidates plus one, that leave a margin as it is.
_USUAL_HEIGHT, _USUAL_COUNT = 64.0, 8

# Numbers of a mixture in its model file.
_NUMBERS = (
    "slope",
    "offset",
    "threshold",
    "size_prior_weight",
    "vote_weight",
    "count_weight",
    "perspective_weight",
)

KIND = "mixture"
"""Kind of the model files that hold a mixture of templates."""


class FoundVehicles(NamedTuple):
    """Vehicles of a frame, best first."""

    boxes: Floats  # (N, 4)
    margins: Floats  # (N,)
    shift: float  # what the number of candidates has added to each margin
    perspective: Floats  # (N,) what perspective has added


@dataclass(frozen=True, eq=False, repr=False)
class TemplateMixture:
    """A model of several templates, for vehicles on any road.

    Attributes
    ----------
    templates
        One or more `MixtureTemplate`.
    rescorer
        Second stage that rescores and corrects the boxes that the windows vote for; None: the templates alone
        decide.
    slope, offset
        Platt scaling: ``slope * margin + offset`` is the log-odds that a box contains a vehicle.
    threshold
        Minimum log-odds of a vehicle.
    size_prior_weight
        Margin added per doubling of a box's height above 64 pixels, and subtracted per halving, at most for
        two: small boxes show less and have more places to occur by chance.
    vote_weight
        Margin added per unit of ``log(1 + vote mass) - 2``, at most 2 units: a vehicle is found by many
        windows of similar position and size, clutter by one or two.
    perspective_weight
        Factor of what the other boxes of the frame say about the height of a box, see `perspective_ratios`.
    count_weight
        Margin subtracted per unit of ``log((1 + n) / 8)``, where `n` counts the candidates in the frame: the
        more there are, the more of them are clutter.
    metadata
        Training facts stored in the model file. JSON values only.

    Raises
    ------
    InvalidInputError
        If there is no template, a number is not finite, or a weight is negative.

    Examples
    --------
    >>> mixture = load_model()
    >>> [template.box_cells for template in mixture.templates]
    [(6.0, 8.0), (7.0, 6.0), (10.0, 6.0), (4.0, 7.0), (6.0, 6.0), (9.0, 5.0)]
    """

    search_params_type: ClassVar[type[PyramidParams]] = PyramidParams
    searches_every_frame: ClassVar[bool] = False

    templates: tuple[MixtureTemplate, ...]
    slope: float = 1.0
    offset: float = 0.0
    threshold: float = 0.0
    size_prior_weight: float = 0.0
    vote_weight: float = 0.0
    count_weight: float = 0.0
    perspective_weight: float = 0.0
    rescorer: Rescorer | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        templates = check_sequence(self.templates, "templates", "MixtureTemplate")
        if not templates:
            raise InvalidInputError("templates must hold at least one template; got none")
        for template in templates:
            check_type(template, "templates", MixtureTemplate, "train_mixture creates them")
        if self.rescorer is not None:
            check_type(self.rescorer, "rescorer", Rescorer, "pass None, or train with train_mixture")
        store_number(self, "slope", above=0, high=1e9)
        for name in "offset", "threshold":
            store_number(self, name, low=-1e9, high=1e9)
        for name in "size_prior_weight", "vote_weight", "count_weight", "perspective_weight":
            store_number(self, name, low=0)
        object.__setattr__(self, "templates", templates)

    @property
    def calibration(self) -> Platt:
        """Probability that a box contains a vehicle, by its score: the log-odds above the threshold."""
        return Platt(-1.0, -self.threshold)

    def open_search(
        self, n_jobs: int | None = None, method: Literal["shared", "windows"] = "shared"
    ) -> MixtureSearch:
        """Open a search of frames with this model, with threads and memory kept from frame to frame.

        Parameters
        ----------
        n_jobs
            Threads that share the sizes of a frame; the result does not depend on them.
        method
            ``"shared"``, the only search of this kind of model.

        Returns
        -------
        MixtureSearch
            A thread-safe context manager; its parameters are `PyramidParams`.

        Raises
        ------
        InvalidInputError
            If `method` is ``"windows"``, or `n_jobs` is malformed.
        """
        from vehicle_detection.mixture.search import MixtureSearch

        check_choice(method, "method", ("shared", "windows"))
        if method != "shared":
            raise InvalidInputError(
                f"method must be 'shared' for a mixture of templates, got {method!r}; use the model 'highway'"
            )
        return MixtureSearch(self, n_jobs=n_jobs)

    def __repr__(self) -> str:
        return f"TemplateMixture({self.summary()[0]})"

    def summary(self) -> tuple[str, dict[str, str]]:
        """Describe the model for display: a title, and named facts."""
        facts = {
            f"template {number}": "box of {:g}x{:g} cells".format(*template.box_cells)
            + " at the frame's border" * template.border
            for number, template in enumerate(self.templates, 1)
        }
        if self.rescorer is not None:
            facts["rescoring"] = (
                f"{len(self.rescorer.networks)} networks, {self.rescorer.n_weights:,} weights, blend weight "
                f"{self.rescorer.blend_weight:g}"
            )
        probability = float(Platt(-1.0, 0.0).probability(self.threshold))
        return f"{len(self.templates)} templates, threshold at a probability of {probability:.2g}", facts

    def scores(self, margins: Floats) -> Floats:
        """Convert SVM margins to log-odds above the threshold."""
        return self.slope * margins + self.offset - self.threshold

    def margin_of(self, score: float) -> float:
        """Margin of a score: the inverse of `scores`."""
        return (score + self.threshold - self.offset) / self.slope

    def window_scores(self, margins: Floats) -> Floats:
        """Convert the margins of windows to log-odds above those of `WINDOW_MARGIN`.

        The threshold is that of boxes, whose margins the second stage has changed.
        """
        return self.slope * (margins - WINDOW_MARGIN)

    def window_margin(self, score: float) -> float:
        """Margin of a window's score: the inverse of `window_scores`."""
        return score / self.slope + WINDOW_MARGIN

    def detect_vehicles(
        self, pyramid: EdgePyramid, windows: ScoredWindows, *, min_margin: float
    ) -> FoundVehicles:
        """Find the vehicles that the windows of a frame propose.

        Parameters
        ----------
        pyramid, windows
            As in `propose_boxes`.
        min_margin
            Minimum final margin of a vehicle.

        Returns
        -------
        FoundVehicles
            Boxes and final margins, best first.
        """
        proposals, template_margins = self.propose_boxes(pyramid, windows, min_margin=RESCORE_MIN)
        boxes, margins, _ = self.rescore_boxes(pyramid, proposals, template_margins)
        count = np.count_nonzero(margins >= RESCORE_MIN)
        shift = -self.count_weight * math.log((1 + count) / _USUAL_COUNT)
        perspective = np.zeros(len(boxes))
        if self.perspective_weight:
            ratios = perspective_ratios(boxes, margins + shift, pyramid.shape[0])
            perspective = self.perspective_weight * ratios
        margins = margins + shift + perspective
        whole = whole_vehicles(boxes, margins)
        order = whole[np.argsort(-margins[whole], kind="stable")]
        rows = order[(margins[order] >= min_margin) & (box_areas(boxes[order]) > 0)]
        return FoundVehicles(boxes[rows], margins[rows], shift, perspective[rows])

    def propose_boxes(
        self,
        pyramid: EdgePyramid,
        windows: ScoredWindows,
        *,
        min_margin: float,
        max_boxes: int = MAX_PROPOSALS,
    ) -> tuple[Floats, Floats]:
        """Group the windows of a frame into boxes, before rescoring; several boxes may cover one vehicle.

        Parameters
        ----------
        pyramid, windows
            What `MixtureSearch.score_windows` returns for the frame; the windows are sorted, best first.
        min_margin
            Minimum margin of a box, with the size prior and the votes.
        max_boxes
            Maximum number of boxes.

        Returns
        -------
        boxes, margins : numpy.ndarray
            ``(N, 4)`` float64 boxes ``[x1, y1, x2, y2]`` inside the frame, and their ``(N,)`` float64
            margins, best first.
        """
        # The size prior and the votes add at most 2 units each.
        min_window = min_margin - 2 * self.size_prior_weight - 2 * self.vote_weight
        grouped, vote_mass = vote_boxes(windows, min_margin=min_window, max_boxes=max_boxes)
        margins = grouped.margins + self.vote_weight * np.minimum(np.log1p(vote_mass) - 2, 2)
        boxes = clip_boxes(grouped.boxes, pyramid.shape)
        heights = np.maximum(boxes[:, 3] - boxes[:, 1], 1)
        margins = margins + self.size_prior_weight * np.log2(heights / _USUAL_HEIGHT).clip(-2, 2)
        kept = np.flatnonzero((margins >= min_margin) & (box_areas(boxes) > 0))
        boxes, margins = boxes[kept], margins[kept]
        rows = nms(boxes, margins, iou=DUPLICATE_IOU, cover=np.inf)
        return boxes[rows], margins[rows]

    def rescore_boxes(
        self, pyramid: EdgePyramid, proposals: Floats, margins: Floats
    ) -> tuple[Floats, Floats, NDArray[np.intp]]:
        """Rescore and correct proposed boxes, and keep one for each vehicle.

        The second stage sees a box twice: as proposed, and as corrected, when it fits the vehicle better. The
        two margins are averaged. Correction in steps: Cai and Vasconcelos, "Cascade R-CNN" (CVPR 2018).

        Parameters
        ----------
        pyramid
            As in `propose_boxes`.
        proposals, margins
            What `propose_boxes` returns.

        Returns
        -------
        boxes, margins, rows : numpy.ndarray
            ``(M, 4)`` boxes and ``(M,)`` final margins, best first, and ``(M,)`` intp rows in `proposals`.
        """
        if self.rescorer is None:
            rows = nms(proposals, margins)
            return proposals[rows], margins[rows], rows
        boxes, first = self.rescorer.apply(pyramid, proposals, margins)
        rows = nms(boxes, first)
        boxes, final = boxes[rows], first[rows]
        # Rows are sorted, best first.
        again = slice(np.count_nonzero(final >= RESCORE_AGAIN_MIN))
        boxes[again], second = self.rescorer.apply(pyramid, boxes[again], margins[rows[again]])
        final[again] = (final[again] + second) / 2
        kept = nms(boxes, final)
        return boxes[kept], final[kept], rows[kept]

    def with_metadata(self, metadata: Mapping[str, Any]) -> TemplateMixture:
        """Return the same model with other metadata."""
        check_type(metadata, "metadata", Mapping, "pass a dictionary")
        return replace(self, metadata=dict(metadata))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model as a safetensors file: tensors and JSON, no executable content."""
        tensors: dict[str, NDArray[Any]] = {}
        for index, template in enumerate(self.templates):
            tensors[f"{index}.weights"] = template.weights
        params: dict[str, Any] = {
            "biases": [template.bias for template in self.templates],
            "paddings": [template.padding for template in self.templates],
            "borders": [template.border for template in self.templates],
        } | {name: getattr(self, name) for name in _NUMBERS}
        if self.rescorer is not None:
            tensors |= self.rescorer.tensors()
            params["rescorer"] = self.rescorer.numbers()
        write_model(path, KIND, params, tensors, self.metadata)


def load_model(path: str | os.PathLike[str] = "default") -> TemplateMixture | VehicleClassifier:
    """Load a model of either kind.

    Parameters
    ----------
    path
        ``"default"``, for any road; ``"highway"``, one template, the fastest; or a ``.safetensors`` file.

    Returns
    -------
    TemplateMixture or VehicleClassifier
        A mixture for ``"default"``, a classifier for ``"highway"``; otherwise the kind that the file holds.

    Raises
    ------
    ModelFileError
        If the file is missing, truncated, edited, of another version, or does not fit its own parameters.
    InvalidInputError
        If `path` is neither a path nor a name.

    Examples
    --------
    >>> len(load_model("highway").templates)
    1
    """
    data = read_model(path)
    if data.kind == PATCH_KIND:
        return build_classifier(data)
    if data.kind != KIND:
        raise ModelFileError(f"{data.name} holds a model of the unknown kind {data.kind!r}; train one")
    params, tensors = data.params, data.tensors
    try:
        rows = zip(params["biases"], params["paddings"], params["borders"], strict=True)
        templates = tuple(
            MixtureTemplate(
                tensors[f"{index}.weights"], float(bias), (float(padding[0]), float(padding[1])), border
            )
            for index, (bias, padding, border) in enumerate(rows)
        )
        numbers = {name: float(params[name]) for name in _NUMBERS}
        rescorer = Rescorer.build(tensors, params["rescorer"]) if "rescorer" in params else None
        return TemplateMixture(templates, **numbers, rescorer=rescorer, metadata=data.metadata)
    except (InvalidInputError, KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
        raise ModelFileError(f"{data.name} does not fit its own parameters: {error}") from error
