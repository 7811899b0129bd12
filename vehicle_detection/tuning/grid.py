"""Configurations by name: read, spelled out of a grid, and checked one by one."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehicle_detection._common import describe
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import FeatureParams
from vehicle_detection.tuning.results import number_or_text
from vehicle_detection.tuning.trials import FEATURE_FIELDS, TRAINING_FIELDS, Recipe

Configuration = FeatureParams | Mapping[str, Any] | str
"""Features, a mapping from fields of `FeatureParams`, C, mirror and vehicle_weight, or a preset's name."""

_FIELDS = (*FEATURE_FIELDS, *TRAINING_FIELDS)

_MOST_COMBINATIONS = 100_000

_WORDS: dict[str, Any] = {"true": True, "yes": True, "false": False, "no": False}


@dataclass(frozen=True)
class Candidate:
    """A named configuration: its recipe, or why it is impossible."""

    name: str
    options: Mapping[str, Any]
    recipe: Recipe | None
    fault: str | None = None


def read_configurations(
    configurations: Mapping[str, Configuration] | Sequence[Configuration], *, defaults: Mapping[str, Any]
) -> list[Candidate]:
    """Check each configuration; `defaults` are the training options that it does not name."""
    given: object = configurations
    if isinstance(given, Mapping):
        pairs: list[tuple[str | None, Any]] = list(given.items())
    elif isinstance(given, Iterable) and not isinstance(given, (str, bytes)):
        pairs = [(None, each) for each in given]
    else:
        pairs = []
    if not pairs:
        raise InvalidInputError(
            "configurations must be a mapping from names to FeatureParams, or a list of them, at least one; "
            f"got {describe(given)}"
        )
    return [_read(name, each, defaults) for name, each in pairs]


def expand_grid(grid: Mapping[str, Iterable[Any]]) -> list[dict[str, Any]]:
    """List all combinations of a grid's values, the last name varying fastest.

    Parameters
    ----------
    grid
        Lists of values by name: fields of `FeatureParams`, ``C``, ``mirror`` and ``vehicle_weight``.

    Raises
    ------
    InvalidInputError
        If a name is no option, or a list is none, is empty, or makes more than 100,000 combinations.

    Examples
    --------
    >>> expand_grid({"orient": [8, 9], "C": [1e-4]})
    [{'orient': 8, 'C': 0.0001}, {'orient': 9, 'C': 0.0001}]
    """
    given: object = grid
    if not isinstance(given, Mapping) or not given:
        raise InvalidInputError(
            f"grid must map names of {', '.join(_FIELDS)} to lists of values; got {describe(given)}"
        )
    _check_names(grid, "grid")
    lists = {}
    for name, values in grid.items():
        if isinstance(values, (str, bytes)) or not isinstance(values, Iterable):
            raise InvalidInputError(f"grid[{name!r}] must be a list of values; got {describe(values)}")
        lists[name] = [value.item() if isinstance(value, np.generic) else value for value in values]
        if not lists[name]:
            raise InvalidInputError(f"grid[{name!r}] must hold at least one value; got none")
    count = math.prod(map(len, lists.values()))
    if count > _MOST_COMBINATIONS:
        raise InvalidInputError(f"grid must span at most {_MOST_COMBINATIONS} combinations; got {count}")
    return [dict(zip(lists, values)) for values in itertools.product(*lists.values())]


def parse_grid(text: str) -> dict[str, list[Any]]:
    """Read a grid as it is typed: ``"orient=8,9 color_space=YCrCb,LAB"``.

    Raises
    ------
    InvalidInputError
        If a part is no ``name=value,value``, or a name is none or comes twice.

    Examples
    --------
    >>> parse_grid("orient=8,9 hog_channel=ALL,0 C=1e-4")
    {'orient': [8, 9], 'hog_channel': ['ALL', 0], 'C': [0.0001]}
    """
    grid: dict[str, list[Any]] = {}
    for part in text.split():
        name, sign, values = part.partition("=")
        if not sign or not name or not all(values.split(",")):
            raise InvalidInputError(
                f"grid must be like 'orient=8,9 color_space=YCrCb,LAB', values parted by commas without a "
                f"space; got {part!r}"
            )
        if name in grid:
            raise InvalidInputError(f"grid names {name} twice; put its values into one list")
        grid[name] = [_parse_value(value) for value in values.split(",")]
    if not grid:
        raise InvalidInputError("grid is empty; name at least one option, such as 'orient=8,9'")
    _check_names(grid, "grid")
    return grid


def _parse_value(text: str) -> Any:
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    return number_or_text(text)


def _check_names(options: Mapping[str, Any], name: str) -> None:
    unknown = [key for key in options if key not in _FIELDS]
    if unknown:
        raise InvalidInputError(f"{name} knows no {unknown[0]!r}; the options are {', '.join(_FIELDS)}")


def _read(name: str | None, configuration: object, defaults: Mapping[str, Any]) -> Candidate:
    if isinstance(configuration, Recipe):
        options: dict[str, Any] = {**dataclasses.asdict(configuration.params)}
        options |= {field: getattr(configuration, field) for field in TRAINING_FIELDS}
    elif isinstance(configuration, FeatureParams):
        options = dataclasses.asdict(configuration)
    elif isinstance(configuration, str):
        options = dataclasses.asdict(FeatureParams.preset(configuration))
    elif isinstance(configuration, Mapping):
        options = dict(configuration)
        _check_names(options, "a configuration")
    else:
        raise InvalidInputError(
            "a configuration must be FeatureParams, a mapping of options or a preset's name; "
            f"got {describe(configuration)}"
        )
    features = {key: value for key, value in options.items() if key in FEATURE_FIELDS}
    training = {key: options.get(key, defaults[key]) for key in TRAINING_FIELDS}
    try:
        recipe = Recipe(params=FeatureParams(**features), **training)
    except InvalidInputError as error:
        return Candidate(name or _spell(options), {**options, **training}, None, str(error))
    return Candidate(name or describe_params(recipe.params), options, recipe)


def describe_params(params: FeatureParams) -> str:
    """Name features by their preset, else by what differs from the defaults."""
    values = dataclasses.asdict(params)
    for preset in FeatureParams.PRESETS:
        if FeatureParams.preset(preset) == params:
            return preset
    plain = dataclasses.asdict(FeatureParams())
    return _spell({key: value for key, value in values.items() if value != plain[key]})


def _spell(options: Mapping[str, Any]) -> str:
    return " ".join(f"{key}={value}" for key, value in options.items() if key in FEATURE_FIELDS) or "default"
