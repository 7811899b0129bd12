"""Training parameters of the mixture of templates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vehicle_detection._common import (
    check_integer,
    check_number,
    check_type,
    describe,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params.search import PyramidParams


@dataclass(frozen=True, kw_only=True)
class MixtureParams:
    """How a mixture is trained.

    Attributes
    ----------
    shapes
        Columns and rows of cells that the boxes of each template fill.
    facing
        Which of them show one side of a vehicle: their vehicles are turned to face the same way, and the
        mirrored template is searched for too.
    border_shapes
        Columns and rows of cells that the visible part of a vehicle fills which the left or right border of
        the frame cuts, for each template of such parts; () for none.
    cuts
        Shares of a frame's width at which it is taken to end, at the right and at the left: windows that end
        there are negatives of the templates at the border, beside those at the border itself.
    border_bias
        Added to the values of the templates at the border: less of a vehicle is seen there, so that it must
        be the clearer.
    size_prior_weight, vote_weight
        As in `TemplateMixture`.
    n_iterations
        How often a box is corrected at most, as in `BoxRegressor`.
    rescorer
        Share that the second opinion has in a vehicle's value, as in `Rescorer`; 0 for none.
    margin
        Cells of context on every side.
    C, border_C
        Inverse strength of the regularisation, as in ``LinearSVC``, of the templates of whole vehicles and of
        those at the border.
    vehicles
        Weight of all vehicles of a template together; a negative weighs 1.
    min_width
        Width in pixels of the narrowest box that is trained on.
    near
        A box trains every template whose logarithmic aspect ratio is this near, and the nearest.
    jitter
        Copies of each box, of which all but the first are moved by up to ``jitter_scale`` of its sides.
    border_jitter
        The same for each vehicle that a border cuts: they are few, and seen from another side than those that
        are cut on purpose.
    exposures
        Further copies of each box of a whole vehicle, each in a frame of another exposure and contrast.
    rounds
        Shares of the frames that the rounds of mining look at; one of all frames that brings under 1% new
        negatives is the last.
    per_frame
        Negatives that a round takes from a frame for each template, at most.
    max_negatives
        Negatives that are kept for each template; the easiest go.
    search
        Sizes at which negatives are looked for.

    Raises
    ------
    InvalidInputError
        If a value is out of range, or `facing` is not as long as `shapes`.

    Examples
    --------
    >>> MixtureParams(shapes=((8, 6),), facing=(True,), rounds=(1.0,)).margin
    1.0
    """

    shapes: tuple[tuple[float, float], ...] = ((6, 8), (7, 6), (10, 6))
    facing: tuple[bool, ...] = (False, False, False)
    border_shapes: tuple[tuple[float, float], ...] = ((4, 7), (6, 6), (9, 5))
    cuts: tuple[float, ...] = (0.3, 0.5, 0.7)
    border_bias: float = -0.3
    size_prior_weight: float = 0.03
    vote_weight: float = 0.1
    n_iterations: int = 2
    rescorer: float = 0.4
    margin: float = 1.0
    C: float = 2e-3
    border_C: float = 4e-3  # noqa: N815 - as C
    vehicles: float = 1500.0
    min_width: float = 28.0
    near: float = 0.2
    jitter: int = 2
    border_jitter: int = 8
    jitter_scale: float = 0.03
    exposures: int = 1
    rounds: tuple[float, ...] = (0.15, 0.3, 0.6, 1.0)
    per_frame: int = 30
    max_negatives: int = 12_000
    search: PyramidParams = PyramidParams(min_width=24.0, horizon=None)  # noqa: RUF009 - frozen

    def __post_init__(self) -> None:
        shapes, facing = _shapes(self.shapes, "shapes"), entries(self.facing, "facing")
        border_shapes = _shapes(self.border_shapes, "border_shapes", least=0)
        cuts = entries(self.cuts, "cuts", least=0)
        for share in cuts:
            check_number(share, "cuts", above=0, high=1)
        if len(facing) != len(shapes) or not all(isinstance(each, (bool, np.bool_)) for each in facing):
            raise InvalidInputError(
                f"facing must be True or False for each of {len(shapes)} shapes; got {describe(facing)}"
            )
        check_number(self.border_bias, "border_bias")
        check_number(self.size_prior_weight, "size_prior_weight", low=0)
        check_number(self.vote_weight, "vote_weight", low=0)
        check_integer(self.n_iterations, "n_iterations", low=1, high=10)
        check_number(self.rescorer, "rescorer", low=0, high=1)
        check_number(self.margin, "margin", low=0, high=8)
        check_number(self.C, "C", above=0, high=1e6)
        check_number(self.border_C, "border_C", above=0, high=1e6)
        check_number(self.vehicles, "vehicles", above=0, high=1e9)
        check_number(self.min_width, "min_width", low=8, high=10_000)
        check_number(self.near, "near", low=0, high=10)
        check_integer(self.jitter, "jitter", low=1, high=100)
        check_integer(self.border_jitter, "border_jitter", low=1, high=100)
        check_number(self.jitter_scale, "shake", low=0, high=0.25)
        check_integer(self.exposures, "exposures", low=0, high=100)
        rounds = entries(self.rounds, "rounds")
        for share in rounds:
            check_number(share, "rounds", above=0, high=1)
        check_integer(self.per_frame, "per_frame", low=1)
        check_integer(self.max_negatives, "max_negatives", low=1)
        check_type(self.search, "search", PyramidParams, "it tells where negatives are looked for")
        held = {"shapes": shapes, "border_shapes": border_shapes, "facing": facing, "cuts": cuts}
        for name, values in (held | {"rounds": rounds}).items():
            object.__setattr__(self, name, values)


def entries(values: object, name: str, *, least: int = 1) -> tuple[Any, ...]:
    """Return the values of a tuple or list of `least` or more."""
    if not isinstance(values, (tuple, list)) or len(values) < least:
        count = " of at least one entry" if least else ""
        raise InvalidInputError(f"{name} must be a tuple{count}; got {describe(values)}")
    return tuple(values)


def _shapes(values: object, name: str, *, least: int = 1) -> tuple[tuple[float, float], ...]:
    shapes = entries(values, name, least=least)
    for shape in shapes:
        if not isinstance(shape, (tuple, list)) or len(shape) != 2:
            raise InvalidInputError(
                f"{name} must be (columns, rows) of cells each, such as ((7, 6),); got {describe(shape)}"
            )
        for cells in shape:
            check_number(cells, name, low=2, high=64)
    return tuple((columns, rows) for columns, rows in shapes)
