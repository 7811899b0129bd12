"""The search of a frame with a mixture of templates, over one FHOG pyramid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import (
    Workspace,
    check_type,
    single_threaded_opencv,
)
from vehicle_detection.boxes import Detections
from vehicle_detection.mixture.boxes import MIN_MARGIN, ScoredWindows
from vehicle_detection.mixture.denoise import denoise
from vehicle_detection.mixture.features import (
    COARSE,
    FeatureMap,
    PyramidLevel,
    feature_maps,
    image_pyramid,
    pyramid_levels,
)
from vehicle_detection.mixture.model import TemplateMixture
from vehicle_detection.mixture.template import MixtureTemplate, smallest_box
from vehicle_detection.params import PyramidParams
from vehicle_detection.search import FrameSearch

_MAX_WINDOWS = 2000


class MixtureSearch(FrameSearch):
    """The search of frames with a mixture of templates.

    Vehicles lie inside the frame; windows may extend beyond it. Sensor noise is removed first.
    """

    params_type = PyramidParams

    def __init__(self, model: TemplateMixture, *, n_jobs: int | None = None) -> None:
        check_type(model, "model", TemplateMixture, 'load_model("default") or train_mixture return one')
        super().__init__(n_jobs)
        self.model = model

    def _search(
        self, frame: NDArray[np.uint8], params: PyramidParams, min_vehicle_score: float
    ) -> tuple[Detections, Detections]:
        model = self.model
        with single_threaded_opencv():
            image = denoise(frame)
            found = self.score_windows(image, params)
            boxes, margins = model.detect_vehicles(
                image, found, min_margin=model.margin_of(min_vehicle_score)
            )
        scores = model.scores(found.margins)
        shown = scores >= params.min_score
        return Detections(found.boxes[shown], scores[shown]), Detections(boxes, model.scores(margins))

    def score_windows(self, image: NDArray[np.uint8], params: PyramidParams) -> ScoredWindows:
        """Windows with their templates' margins, best first; weak ones are included because they vote.

        Sensor noise is not removed here.
        """
        min_margin = np.float32(min(MIN_MARGIN, self.model.margin_of(params.min_score)))
        shape = image.shape[:2]
        sizes = params.sizes(*smallest_box(self.model.templates), shape)
        levels = pyramid_levels(sizes, share=params.horizon is None)
        with single_threaded_opencv():
            images = image_pyramid(image)
            parts = self._team.map(
                lambda level: self._search_level(images, level, params, min_margin),
                levels,
                cost=lambda level: level.scale,
            )
        return ScoredWindows.join(parts, shape).best(_MAX_WINDOWS)

    def _search_level(
        self,
        images: list[NDArray[np.uint8]],
        level: PyramidLevel,
        params: PyramidParams,
        min_margin: np.float32,
    ) -> ScoredWindows:
        """Windows of all templates on one resized frame."""
        shape = images[0].shape[:2]
        templates = {
            size: [
                (index, template)
                for index, template in enumerate(self.model.templates)
                if template.box_cells[0] * size >= params.min_width * 0.999
                and template.box_cells[1] * size <= params.max_height * shape[0]
            ]
            for size, _ in level.sizes
        }
        ranges = [
            _row_range(template, size, params, shape)
            for size, used in templates.items()
            for _, template in used
        ]
        rows = min((top for top, _ in ranges), default=0), max((bottom for _, bottom in ranges), default=0)
        if min(rows[1] - rows[0], shape[1]) * level.scale < COARSE:
            return ScoredWindows.empty()
        workspace = self.workspace
        found = [
            _score_template(index, template, feature_map, min_margin, shape[1], workspace)
            for size, feature_map in feature_maps(images, level, rows, workspace)
            for index, template in templates[size]
        ]
        return ScoredWindows.join(found, shape)


def _row_range(
    template: MixtureTemplate, size: float, params: PyramidParams, shape: tuple[int, ...]
) -> tuple[int, int]:
    """Rows of the frame that a template with cells of `size` pixels covers, as a half-open range."""
    width, height = (cells * size for cells in template.box_cells)
    if template.border:
        # A truncated vehicle is wider than its visible part.
        width = max(width, height)
    top, bottom = params.rows(width, height, shape)
    padding = round(template.padding[1] * size)
    return max(0, top - padding), min(shape[0], bottom + padding)


def _score_template(
    index: int,
    template: MixtureTemplate,
    feature_map: FeatureMap,
    min_margin: np.float32,
    width: int,
    workspace: Workspace,
) -> ScoredWindows:
    """Windows of one template above `min_margin` on the feature map of a frame of `width` pixels."""
    if template.border:
        found = [
            template.border_windows(
                feature_map, x, left=left, min_margin=float(min_margin), workspace=workspace
            )
            for left, x in ((True, 0.0), (False, float(width)))
        ]
        boxes, margins = (np.concatenate(part) for part in zip(*found))
    else:
        grid = template.margins(feature_map.channels, workspace)
        rows, columns = (grid > min_margin).nonzero()
        boxes = template.boxes(feature_map, rows, columns)
        margins = grid[rows, columns].astype(np.float64)
    return ScoredWindows(boxes, margins, np.full(len(boxes), index, np.intp))
