"""Several linear templates for vehicles of any shape: the model, its search and its file.

A car from behind, a car from the side and a bus do not fit one square window. Each template has a shape of
its own and is a linear SVM over the same feature maps (`_feature_maps`), so that one pyramid of a frame
serves them all; what they find together becomes boxes by suppression, voting and a linear correction.
Felzenszwalb et al. (PAMI 2010) for the mixture and the box prediction; Ohn-Bar and Trivedi, "Learning to
detect vehicles by clustering appearance patterns" (IEEE T-ITS 2015) for vehicles.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Buffers,
    Take,
    ThreadTeam,
    check_image,
    check_number,
    check_type,
    read_model,
    single_threaded_opencv,
    write_model,
)
from vehicle_detection.boxes import Detections
from vehicle_detection.classifier import KIND as PATCH_KIND
from vehicle_detection.classifier import VehicleClassifier, build_classifier
from vehicle_detection.errors import InvalidInputError, ModelFileError
from vehicle_detection.mixture.boxes import WEAKEST, BoxRegressor, ScoredWindows, nms, vote_boxes
from vehicle_detection.mixture.denoise import without_noise
from vehicle_detection.mixture.features import (
    COARSE,
    FeatureMap,
    Level,
    image_pyramid,
    level_maps,
    pyramid_levels,
)
from vehicle_detection.mixture.rescoring import RESCORE_MIN, Rescorer
from vehicle_detection.mixture.template import MixtureTemplate, smallest_box
from vehicle_detection.params import PyramidParams

KIND = "mixture"
"""Kind of the model files that hold a mixture of templates."""

_MOST_WINDOWS = 2000


@dataclass(frozen=True, eq=False)
class TemplateMixture:
    """A model of several templates, for vehicles on any road.

    Attributes
    ----------
    templates
        One or more `MixtureTemplate`.
    box_regressor
        Corrects the boxes.
    rescorer
        Gives boxes a second opinion; None leaves their value to the templates.
    slope, offset
        Turn a vehicle's value into log-odds that it is a vehicle: ``slope * value + offset``.
    threshold
        Least log-odds of a vehicle.
    size_prior_weight
        Added to a vehicle's value for every doubling of its box's height from a quarter of the frame's on,
        and taken off for every halving: there are more places for what is small.
    vote_weight
        Added to a vehicle's value for every factor e in how many windows, and how good ones, agree on it: a
        vehicle is found by many of similar place and size, clutter by one or two. Few windows take as much
        off.
    metadata
        What the model file tells about itself. JSON values only.

    Raises
    ------
    InvalidInputError
        If there is no template, a number is not finite, or a gain is negative.

    Examples
    --------
    >>> mixture = load_model()
    >>> [template.box_cells for template in mixture.templates]
    [(6.0, 8.0), (7.0, 6.0), (10.0, 6.0), (4.0, 7.0), (6.0, 6.0), (9.0, 5.0)]
    """

    templates: tuple[MixtureTemplate, ...]
    box_regressor: BoxRegressor
    slope: float = 1.0
    offset: float = 0.0
    threshold: float = 0.0
    size_prior_weight: float = 0.0
    vote_weight: float = 0.0
    rescorer: Rescorer | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        templates = tuple(self.templates)
        if not templates:
            raise InvalidInputError("templates must hold at least one template; got none")
        for template in templates:
            check_type(template, "templates", MixtureTemplate, "train_mixture makes them")
        check_type(self.box_regressor, "box_regressor", BoxRegressor, "train_mixture makes one")
        if self.rescorer is not None:
            check_type(self.rescorer, "rescorer", Rescorer, "train_mixture makes one, or None")
        check_number(self.slope, "slope", above=0, high=1e9)
        check_number(self.offset, "offset")
        check_number(self.threshold, "threshold")
        check_number(self.size_prior_weight, "size_prior_weight", low=0)
        check_number(self.vote_weight, "vote_weight", low=0)
        object.__setattr__(self, "templates", templates)

    def scores(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Turn values into log-odds above the threshold."""
        return self.slope * values + self.offset - self.threshold

    def value(self, score: float) -> float:
        """Value that has a score."""
        return (score + self.threshold - self.offset) / self.slope

    def vehicles(
        self, image: NDArray[np.uint8], found: ScoredWindows, *, least: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Boxes and values, `least` or more, of the vehicles to which windows of a frame lead, best first."""
        # What the second opinion will say of a box is not known before.
        boxes, values = self.proposals(image, found, least=least if self.rescorer is None else RESCORE_MIN)
        if self.rescorer is not None:
            values = self.rescorer.apply(image, boxes, values)
        rows = nms(boxes, values)
        rows = rows[values[rows] >= least]
        return boxes[rows], values[rows]

    def proposals(
        self, image: NDArray[np.uint8], found: ScoredWindows, *, least: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Corrected boxes, and values by the templates of `least` or more; several may be on one vehicle."""
        # At most the frame's height, which is two doublings, is gained; of support two steps count as well.
        least_alone = least - 2 * self.size_prior_weight - 2 * self.vote_weight
        grouped, vote_mass = vote_boxes(found, least=least_alone)
        values = grouped.scores + self.vote_weight * np.minimum(np.log1p(vote_mass) - 2, 2)
        # A look makes a box 1.6 times as high at most, which is 0.68 doublings.
        slack = 0.68 * self.box_regressor.n_iterations * self.size_prior_weight
        most = values + self._gain_of_height(grouped.boxes, image) + slack
        grouped = replace(grouped, scores=values)[most >= least]
        boxes, values = self.box_regressor.apply(image, grouped)
        values = values + self._gain_of_height(boxes, image)
        kept = values >= least
        return boxes[kept], values[kept]

    def _gain_of_height(self, boxes: NDArray[np.float64], image: NDArray[np.uint8]) -> NDArray[np.float64]:
        return np.asarray(self.size_prior_weight * np.log2(4 * (boxes[:, 3] - boxes[:, 1]) / image.shape[0]))

    def with_metadata(self, metadata: Mapping[str, Any]) -> TemplateMixture:
        """Return the same model with other facts in its file."""
        return replace(self, metadata=dict(metadata))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model as a safetensors file: tensors and JSON, nothing that runs when loaded."""
        tensors: dict[str, NDArray[Any]] = {
            "box_regressor.weights": self.box_regressor.weights,
            "box_regressor.bias": self.box_regressor.bias,
        }
        for index, template in enumerate(self.templates):
            tensors[f"{index}.weights"] = template.weights
        params: dict[str, Any] = {
            "biases": [template.bias for template in self.templates],
            "paddings": [template.margin for template in self.templates],
            "borders": [template.border for template in self.templates],
            "slope": self.slope,
            "offset": self.offset,
            "threshold": self.threshold,
            "size_prior_weight": self.size_prior_weight,
            "vote_weight": self.vote_weight,
            "n_iterations": self.box_regressor.n_iterations,
        }
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

    Raises
    ------
    ModelFileError
        If the file is missing, cut, edited, of another version, or does not fit its own parameters.
    InvalidInputError
        If `path` is neither a path nor a name.

    Examples
    --------
    >>> len(load_model("highway").templates)
    1
    """
    model = read_model(path)
    if model.kind == PATCH_KIND:
        return build_classifier(model)
    if model.kind != KIND:
        raise ModelFileError(f"{model.name} holds a model of the unknown kind {model.kind!r}; train one")
    params, tensors = model.params, model.tensors
    try:
        borders = params.get("borders", [False] * len(params["biases"]))
        rows = zip(params["biases"], params["paddings"], borders, strict=True)
        templates = tuple(
            MixtureTemplate(
                tensors[f"{index}.weights"], float(bias), (float(margin[0]), float(margin[1])), border
            )
            for index, (bias, margin, border) in enumerate(rows)
        )
        n_iterations = params.get("n_iterations", 1)
        box_regressor = BoxRegressor(
            tensors["box_regressor.weights"], tensors["box_regressor.bias"], n_iterations
        )
        numbers = {name: float(params[name]) for name in ("slope", "offset", "threshold")}
        numbers |= {name: float(params.get(name, 0.0)) for name in ("size_prior_weight", "vote_weight")}
        second = Rescorer.build(tensors, params["rescorer"]) if "rescorer" in params else None
        return TemplateMixture(templates, box_regressor, **numbers, rescorer=second, metadata=model.metadata)
    except (InvalidInputError, KeyError, IndexError, TypeError, ValueError) as error:
        raise ModelFileError(f"{model.name} does not fit its own parameters: {error}") from error


@dataclass(frozen=True, eq=False)
class MixtureFind:
    """What the search with several templates finds in a frame.

    Attributes
    ----------
    windows
        Windows above the search's least score, best first, with log-odds above the model's threshold, as far
        as their templates can tell.
    vehicles
        Boxes of the vehicles, with scores above the least one that was asked for.
    """

    windows: Detections
    vehicles: Detections


class MixtureSearch:
    """The search with its threads and buffers kept from frame to frame; any thread may use it.

    Parameters
    ----------
    mixture
        The model.
    n_jobs
        Threads that share the sizes of a frame; the result does not depend on them.

    Raises
    ------
    InvalidInputError
        If the model is no mixture.

    Examples
    --------
    >>> search = MixtureSearch(load_model(), n_jobs=1)
    >>> len(search.find(np.full((360, 640, 3), 90, np.uint8)).vehicles)
    0
    """

    def __init__(self, mixture: TemplateMixture, *, n_jobs: int | None = None) -> None:
        check_type(mixture, "mixture", TemplateMixture, 'load_model("default") or train_mixture make one')
        self.mixture = mixture
        self._crew = ThreadTeam(n_jobs, name="search")
        self._local = threading.local()

    def close(self) -> None:
        """End the threads."""
        self._crew.close()

    def find(
        self, image: NDArray[np.uint8], params: PyramidParams | None = None, *, least: float = 0.0
    ) -> MixtureFind:
        """Find the vehicles of a frame.

        Parameters
        ----------
        image
            ``(H, W, 3)`` uint8 RGB.
        params
            Sizes and places of the windows; by default those of any dash-cam.
        least
            Least score of a vehicle, in log-odds above the model's threshold.

        Returns
        -------
        MixtureFind
            Boxes in pixels of the frame. Those of the vehicles lie inside it; those of windows may overhang.

        Raises
        ------
        InvalidInputError
            If an argument is malformed. An image that is smaller than a template holds no vehicle.
        """
        params = params if params is not None else PyramidParams()
        check_number(least, "least")
        check_image(image)
        with single_threaded_opencv():
            image = without_noise(image)
        found = self.candidates(image, params)
        mixture = self.mixture
        scores = mixture.scores(found.scores)
        evidence = scores >= params.min_score
        with single_threaded_opencv():
            boxes, values = mixture.vehicles(image, found, least=mixture.value(least))
        return MixtureFind(
            Detections(found.boxes[evidence], scores[evidence]), Detections(boxes, mixture.scores(values))
        )

    def candidates(self, image: NDArray[np.uint8], params: PyramidParams) -> ScoredWindows:
        """Windows with their templates' values, the best ones first, weak ones too: they vote for boxes.

        The image is taken as it is, noise and all.
        """
        check_image(image)
        check_type(params, "params", PyramidParams, "a mixture of templates is searched for on a pyramid")
        least = np.float32(min(WEAKEST, self.mixture.value(params.min_score)))
        shape = image.shape[:2]
        sizes = params.sizes(*smallest_box(self.mixture.templates), shape)
        levels = pyramid_levels(sizes, share=params.horizon is None)
        with single_threaded_opencv():
            images = image_pyramid(image)
            parts = self._crew.map(
                lambda level: self._level(images, level, params, least),
                levels,
                cost=lambda level: level.shrink,
            )
        return ScoredWindows.join(parts, shape).best(_MOST_WINDOWS)

    def _level(
        self, images: list[NDArray[np.uint8]], level: Level, params: PyramidParams, least: np.float32
    ) -> ScoredWindows:
        """Windows of all templates on one resized frame."""
        shape = images[0].shape[:2]
        templates = {
            pixels: [
                (index, template)
                for index, template in enumerate(self.mixture.templates)
                if template.box_cells[0] * pixels >= params.min_width * 0.999
                and template.box_cells[1] * pixels <= params.max_height * shape[0]
            ]
            for pixels, _ in level.sizes
        }
        reach = [
            self._rows(template, pixels, params, shape)
            for pixels, those in templates.items()
            for _, template in those
        ]
        rows = min((top for top, _ in reach), default=0), max((bottom for _, bottom in reach), default=0)
        if min(rows[1] - rows[0], shape[1]) * level.shrink < COARSE:
            return ScoredWindows.empty()
        buffers = self._local.__dict__.setdefault("buffers", Buffers())
        found = [
            self._hits(index, template, features, least, shape[1], buffers.take)
            for pixels, features in level_maps(images, level, rows, buffers.take)
            for index, template in templates[pixels]
        ]
        return ScoredWindows.join(found, shape)

    @staticmethod
    def _rows(
        template: MixtureTemplate, pixels: float, params: PyramidParams, shape: tuple[int, ...]
    ) -> tuple[int, int]:
        width, height = (cells * pixels for cells in template.box_cells)
        if template.border:
            # What is cut is wider than what is seen of it.
            width = max(width, height)
        top, bottom = params.rows(width, height, shape)
        margin = round(template.margin[1] * pixels)
        return max(0, top - margin), min(shape[0], bottom + margin)

    @staticmethod
    def _hits(
        index: int,
        template: MixtureTemplate,
        level: FeatureMap,
        least: np.float32,
        width: int,
        take: Take,
    ) -> ScoredWindows:
        if template.border:
            found = [
                template.border_windows(level, end, left=left, least=float(least), take=take)
                for left, end in ((True, 0.0), (False, float(width)))
            ]
            boxes, values = (np.concatenate(part) for part in zip(*found))
        else:
            scores = template.scores(level.planes, take)
            rows, columns = (scores > least).nonzero()
            boxes, values = template.boxes(level, rows, columns), scores[rows, columns].astype(np.float64)
        return ScoredWindows(boxes, values, np.full(len(boxes), index, np.intp))
