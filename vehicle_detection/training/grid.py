"""Configurations: read from presets and mappings, expanded from a grid, and checked one by one."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehicle_detection._common import describe, is_listing
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import FeatureParams
from vehicle_detection.training.classifier import TrainingOptions
from vehicle_detection.training.results import number_or_text

FEATURE_FIELDS = tuple(field.name for field in dataclasses.fields(FeatureParams))
TRAINING_FIELDS = ("C", "mirror", "positive_weight")
_FIELDS = (*FEATURE_FIELDS, *TRAINING_FIELDS)

_MAX_COMBINATIONS = 100_000

_BOOLEANS = {"true": True, "yes": True, "false": False, "no": False}


@dataclass(frozen=True)
class TrialConfig:
    """Features and training options of one classifier."""

    params: FeatureParams
    training: TrainingOptions

    def to_columns(self) -> dict[str, Any]:
        """Return the columns of a result row that describe the configuration."""
        training = {name: getattr(self.training, name) for name in TRAINING_FIELDS}
        return {**dataclasses.asdict(self.params), "n_features": self.params.length, **training}


Configuration = FeatureParams | Mapping[str, Any] | str
"""`FeatureParams`, a preset's name, or a mapping of fields of `FeatureParams` and of training options."""


@dataclass(frozen=True)
class Candidate:
    """A named configuration; `config` is None where it is impossible, and `error` then says why."""

    name: str
    options: Mapping[str, Any]
    config: TrialConfig | None
    error: str | None = None


def read_configurations(
    configurations: Mapping[str, Configuration] | Sequence[Configuration], *, defaults: Mapping[str, Any]
) -> list[Candidate]:
    """Check each configuration; `defaults` holds the training options that it does not set."""
    given: object = configurations
    if isinstance(given, Mapping):
        pairs: list[tuple[str | None, Any]] = list(given.items())
    else:
        pairs = [(None, each) for each in given] if is_listing(given) else []
    if not pairs:
        raise InvalidInputError(
            "configurations must be a mapping from names to FeatureParams or a list of them, with at least "
            f"one entry; got {describe(given)}"
        )
    return [_read(name, each, defaults) for name, each in pairs]


def _read(name: str | None, configuration: object, defaults: Mapping[str, Any]) -> Candidate:
    if isinstance(configuration, FeatureParams):
        options = dataclasses.asdict(configuration)
    elif isinstance(configuration, str):
        options = dataclasses.asdict(FeatureParams.preset(configuration))
    elif isinstance(configuration, Mapping):
        options = dict(configuration)
        _check_names(options, "configuration")
    else:
        raise InvalidInputError(
            "a configuration must be FeatureParams, a mapping of options or a preset's name; "
            f"got {describe(configuration)}"
        )
    features = {key: value for key, value in options.items() if key in FEATURE_FIELDS}
    training = {key: options.get(key, defaults[key]) for key in TRAINING_FIELDS}
    try:
        config = TrialConfig(FeatureParams(**features), TrainingOptions(**training))
    except InvalidInputError as error:
        return Candidate(name or _join_options(options), {**options, **training}, None, str(error))
    return Candidate(name or describe_params(config.params), options, config)


def expand_grid(grid: Mapping[str, Iterable[Any]]) -> list[dict[str, Any]]:
    """List all combinations of a grid's values; the last name varies fastest.

    >>> expand_grid({"orient": [8, 9], "C": [1e-4]})
    [{'orient': 8, 'C': 0.0001}, {'orient': 9, 'C': 0.0001}]
    """
    given: object = grid
    if not isinstance(given, Mapping) or not given:
        raise InvalidInputError(
            f"grid must map option names ({', '.join(_FIELDS)}) to lists of values; got {describe(given)}"
        )
    _check_names(grid, "grid")
    lists = {}
    for name, values in grid.items():
        if not is_listing(values):
            raise InvalidInputError(f"grid[{name!r}] must be a list of values; got {describe(values)}")
        plain = [value.item() if isinstance(value, np.generic) else value for value in values]
        # Each value once; unlike in a set, True and 1 are two values.
        lists[name] = list({(type(value), repr(value)): value for value in plain}.values())
        if not lists[name]:
            raise InvalidInputError(f"grid[{name!r}] must hold at least one value; got none")
    count = math.prod(map(len, lists.values()))
    if count > _MAX_COMBINATIONS:
        raise InvalidInputError(f"grid must have at most {_MAX_COMBINATIONS} combinations; got {count}")
    return [dict(zip(lists, values)) for values in itertools.product(*lists.values())]


def parse_grid(text: str) -> dict[str, list[Any]]:
    """Parse a grid from the command line.

    >>> parse_grid("orient=8,9 hog_channel=ALL,0 C=1e-4")
    {'orient': [8, 9], 'hog_channel': ['ALL', 0], 'C': [0.0001]}
    """
    grid: dict[str, list[Any]] = {}
    for part in text.split():
        name, sign, values = part.partition("=")
        if not sign or not name or not all(values.split(",")):
            raise InvalidInputError(
                "grid must look like 'orient=8,9 color_space=YCrCb,LAB', with commas and no spaces between "
                f"values; got {part!r}"
            )
        if name in grid:
            raise InvalidInputError(f"grid names {name} twice; put all its values into one list")
        grid[name] = [_BOOLEANS.get(each.lower(), number_or_text(each)) for each in values.split(",")]
    if not grid:
        raise InvalidInputError("grid is empty; name at least one option, such as 'orient=8,9'")
    _check_names(grid, "grid")
    return grid


def _check_names(options: Mapping[str, Any], name: str) -> None:
    unknown = [key for key in options if key not in _FIELDS]
    if unknown:
        raise InvalidInputError(f"{name} has the unknown option {unknown[0]!r}; use {', '.join(_FIELDS)}")


def describe_params(params: FeatureParams) -> str:
    """Name features by their preset, or else by the fields that differ from the defaults."""
    for preset in FeatureParams.PRESETS:
        if FeatureParams.preset(preset) == params:
            return preset
    defaults, values = dataclasses.asdict(FeatureParams()), dataclasses.asdict(params)
    return _join_options({key: value for key, value in values.items() if value != defaults[key]})


def _join_options(options: Mapping[str, Any]) -> str:
    return " ".join(f"{key}={value}" for key, value in options.items() if key in FEATURE_FIELDS) or "default"
