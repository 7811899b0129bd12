"""Training parameters of the mixture of templates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vehicle_detection._common import (
    check_number,
    check_type,
    describe,
    store_integer,
    store_number,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params.search import PyramidParams


@dataclass(frozen=True, kw_only=True)
class MixtureParams:
    """Parameters of `train_mixture`: templates, training samples, SVM, and mining of hard negatives.

    Attributes
    ----------
    shapes, padding
        Size of the vehicle's box in cells, ``(columns, rows)``, for each template, and cells of context.
    mirrored
        For each template, whether it shows one side of a vehicle: its samples are aligned to the same side,
        and the mirrored template is searched too.
    border_shapes
        Size in cells of the visible part of a vehicle that the left or right border of the frame truncates,
        for each border template; () trains none.
    simulated_borders
        Fractions of the frame width at which the frame is assumed to end, for more negatives of the border
        templates than the actual borders give.
    border_bias
        Added to the bias of the border templates. Negative: less of a vehicle is visible there, so a larger
        margin is required.
    C, border_C
        Inverse regularization strength, as in ``LinearSVC``, of the templates and of the border templates.
    positive_weight
        Total weight of all positives of a template; each negative weighs 1.
    size_prior_weight, vote_weight, count_weight, perspective_weight, blend_weight
        As in `TemplateMixture` and `Rescorer`; with a `blend_weight` of 0 no rescorer is
        trained.
    min_width
        Width in pixels of the narrowest box to train on.
    aspect_tolerance
        A box trains every template whose log aspect ratio differs by less than this, and the closest one.
    copies, jitter_scale
        Copies of each box; all but the first are shifted randomly by up to `jitter_scale` of their sides.
    border_copies, relit_copies
        Copies of each box that a border truncates, which are few; and additional copies of each box from
        frames with random exposure and contrast.
    mining_schedule
        Fraction of the frames that each mining round searches. Mining stops early when a round over all
        frames adds less than 1% new negatives.
    max_per_frame, max_negatives
        Maximum number of negatives per frame, template and round, and of those kept per template, which have
        the highest margins.
    search
        Window sizes at which negatives are searched.

    Raises
    ------
    InvalidInputError
        If a value is out of range, or `mirrored` and `shapes` differ in length.

    Examples
    --------
    >>> MixtureParams(shapes=((8, 6),), mirrored=(True,), mining_schedule=(1.0,)).padding
    1.0
    """

    shapes: tuple[tuple[float, float], ...] = ((6, 8), (7, 6), (10, 6))
    mirrored: tuple[bool, ...] = (False, False, False)
    padding: float = 1.0
    border_shapes: tuple[tuple[float, float], ...] = ((4, 7), (6, 6), (9, 5))
    simulated_borders: tuple[float, ...] = (0.3, 0.5, 0.7)
    border_bias: float = -0.3
    C: float = 2e-3
    border_C: float = 4e-3  # noqa: N815 - as C
    positive_weight: float = 1500.0
    size_prior_weight: float = 0.1
    vote_weight: float = 0.1
    count_weight: float = 0.22
    perspective_weight: float = 0.2
    blend_weight: float = 0.1
    min_width: float = 28.0
    aspect_tolerance: float = 0.2
    copies: int = 2
    jitter_scale: float = 0.03
    border_copies: int = 8
    relit_copies: int = 1
    mining_schedule: tuple[float, ...] = (0.15, 0.3, 0.6, 1.0)
    max_per_frame: int = 30
    max_negatives: int = 12_000
    search: PyramidParams = PyramidParams(min_width=24.0, horizon=None)  # noqa: RUF009 - frozen

    def __post_init__(self) -> None:
        shapes, mirrored = _check_shapes(self.shapes, "shapes"), entries(self.mirrored, "mirrored")
        border_shapes = _check_shapes(self.border_shapes, "border_shapes", min_count=0)
        borders = entries(self.simulated_borders, "simulated_borders", min_count=0)
        schedule = entries(self.mining_schedule, "mining_schedule")
        if len(mirrored) != len(shapes) or not all(isinstance(each, (bool, np.bool_)) for each in mirrored):
            raise InvalidInputError(
                f"mirrored must be True or False for each of {len(shapes)} shapes; got {describe(mirrored)}"
            )
        for name, fractions in ("simulated_borders", borders), ("mining_schedule", schedule):
            for fraction in fractions:
                check_number(fraction, name, above=0, high=1)
        store_number(self, "padding", low=0, high=8)
        store_number(self, "border_bias")
        for name in "C", "border_C":
            store_number(self, name, above=0, high=1e6)
        store_number(self, "positive_weight", above=0, high=1e9)
        for name in "size_prior_weight", "vote_weight", "count_weight", "perspective_weight":
            store_number(self, name, low=0)
        store_number(self, "blend_weight", low=0, high=1)
        store_number(self, "min_width", low=8, high=10_000)
        store_number(self, "aspect_tolerance", low=0, high=10)
        for name in "copies", "border_copies":
            store_integer(self, name, low=1, high=100)
        store_number(self, "jitter_scale", low=0, high=0.25)
        store_integer(self, "relit_copies", low=0, high=100)
        for name in "max_per_frame", "max_negatives":
            store_integer(self, name, low=1)
        check_type(self.search, "search", PyramidParams, "it sets the window sizes for negatives")
        tuples = {"shapes": shapes, "border_shapes": border_shapes, "mirrored": tuple(map(bool, mirrored))}
        for name, values in (tuples | {"simulated_borders": borders, "mining_schedule": schedule}).items():
            object.__setattr__(self, name, values)


def entries(values: object, name: str, *, min_count: int = 1) -> tuple[Any, ...]:
    """Return the values of a tuple or list with at least `min_count` entries."""
    if not isinstance(values, (tuple, list)) or len(values) < min_count:
        count = " of at least one entry" if min_count else ""
        raise InvalidInputError(f"{name} must be a tuple{count}; got {describe(values)}")
    return tuple(values)


def _check_shapes(values: object, name: str, *, min_count: int = 1) -> tuple[tuple[float, float], ...]:
    shapes = entries(values, name, min_count=min_count)
    for shape in shapes:
        if not isinstance(shape, (tuple, list)) or len(shape) != 2:
            raise InvalidInputError(
                f"{name} must be pairs (columns, rows) of cells, such as ((7, 6),); got {describe(shape)}"
            )
        for cells in shape:
            check_number(cells, name, low=2, high=64)
    return tuple((columns, rows) for columns, rows in shapes)
