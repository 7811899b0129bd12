"""The versions of the lesson: what published ones differ in, as defaults and found by calling a module."""

from __future__ import annotations

import contextlib
import functools
import inspect
import itertools
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ParamSpec, TypeVar
from unittest import mock

import cv2
import numpy as np

from vehicle_detection._common import check, describe, warn
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import SPATIAL_ORDERS

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

FORMULAS = ("old", "new")
READERS = ("mpimg", "cv2")
CHANNEL_ORDERS = ("RGB", "BGR")
RETURNS = ("picture", "boxes", "both")
# Names of options in earlier quizzes and in published versions.
_ALIASES = {"cspace": "color_space", "orient_bins": "orient", "hog_channels": "hog_channel"}
_COLOR_OPTIONS = {"spatial_size", "hist_bins", "hist_range"}
_HOG_OPTIONS = {"orient", "pix_per_cell", "cell_per_block", "hog_channel"}
_SWITCHES = {"spatial_feat", "hist_feat", "hog_feat"}


def check_range(limits: Any, name: str) -> tuple[float, float] | None:
    """Return the range of a histogram; None stands for the range of the values."""
    if limits is None:
        return None
    if check.array(limits, name).shape != (2,):
        raise InvalidInputError(f"{name} must be (low, high) or None; got {describe(limits)}")
    low = check.number(limits[0], name)
    return low, check.number(limits[1], name, above=low)


def check_switch(value: Any, name: str) -> bool:
    """Return a switch as a bool; the lesson's code also passes 0 and 1."""
    check.flags(**{name: value})
    return bool(value)


# Check and initial value of each option of `set_lesson_defaults`.
_OPTIONS: dict[str, tuple[Callable[[Any, str], Any], Any]] = {
    "transform_sqrt": (check_switch, False),
    "formula": (functools.partial(check.choice, choices=FORMULAS), "old"),
    "imread": (functools.partial(check.choice, choices=READERS), "mpimg"),
    "channel_order": (functools.partial(check.choice, choices=CHANNEL_ORDERS), "RGB"),
    "hist_range": (check_range, (0, 256)),
    "spatial_order": (functools.partial(check.choice, choices=SPATIAL_ORDERS), "interleaved"),
    "find_cars_returns": (functools.partial(check.choice, choices=RETURNS), "picture"),
    "find_cars_formula": (functools.partial(check.choice, choices=FORMULAS), "old"),
    "cells_per_step": (lambda value, name: check.integer(value, name, low=1), 2),
    "divide_by": (lambda value, name: check.number(value, name, above=0), 255),
}
lesson_defaults = {name: value for name, (_, value) in _OPTIONS.items()}


def set_lesson_defaults(**options: Any) -> None:
    """Set the defaults in which published versions of ``lesson_functions.py`` differ.

    They hold for later calls in this process that do not pass the option; a `HeatmapDetector` keeps those of
    its construction. `detect_versions` finds them.

    Parameters
    ----------
    transform_sqrt : bool
        Of all functions that compute HOG, initially False. True if your own file calls scikit-image's ``hog``
        with ``transform_sqrt=True``, as most published ones do.
    formula, find_cars_formula : {"old", "new"}
        Of `slide_window` and of `find_cars`, initially ``"old"``. ``"new"`` if your own ``slide_window``
        computes ``nx_buffer``, and if your own ``find_cars`` adds 1 to ``nxsteps``.
    imread, channel_order : {"mpimg", "cv2"}, {"RGB", "BGR"}
        How `extract_features` reads files: ``"mpimg"`` PNG files as 0-1, initially; ``"cv2"`` all as 0-255;
        ``"BGR"`` with blue first, as ``cv2.imread`` returns them, if your code does not convert them.
    hist_range : tuple or None
        Of all histograms, initially ``(0, 256)``. None for the range of the values of each channel.
    spatial_order : {"interleaved", "channels"}
        Of all spatial bins, initially ``"interleaved"``.
    find_cars_returns : {"picture", "boxes", "both"}
        What `find_cars` returns, initially the picture; ``"both"`` is a pair of the picture and the boxes.
    divide_by, cells_per_step
        Of `find_cars`, initially 255 and 2.

    Examples
    --------
    >>> import numpy as np
    >>> from vehicle_detection.course import slide_window
    >>> image = np.zeros((64, 128, 3), np.uint8)
    >>> set_lesson_defaults(formula="new")
    >>> len(slide_window(image, xy_overlap=(0.5, 0)))
    3
    >>> set_lesson_defaults(formula="old")
    """
    for name in options:
        check.choice(name, "a name of an option", tuple(_OPTIONS))
    lesson_defaults.update({name: _OPTIONS[name][0](value, name) for name, value in options.items()})


def lesson_function(**renamed: str) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Let options of a function that a call does not pass have the defaults of `set_lesson_defaults`.

    `renamed` are the names of these defaults, where they differ from those of the options. The function also
    accepts the names that options have in published versions.
    """

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        names = list(inspect.signature(function).parameters)

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Result:
            if "spatial_feat" in names and "ystart" not in names:
                _read_earlier_quiz(args, kwargs)
            for alias in _ALIASES.keys() & kwargs.keys():
                name = _ALIASES[alias]
                if name in kwargs:
                    raise InvalidInputError(f"{name} and {alias} are the same option; pass one of them")
                kwargs[name] = kwargs.pop(alias)
            for name in names[len(args) :]:
                default = renamed.get(name, name)
                if default in lesson_defaults:
                    kwargs.setdefault(name, lesson_defaults[default])
            return function(*args, **kwargs)

        return call

    return decorate


def _read_earlier_quiz(args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    """Select the features of two quizzes, whose ``extract_features`` has ``cspace=``.

    One computes HOG alone, the other colors alone: without the switches, the options say which. The order of
    the HOG quiz, with a number as spatial_size and a channel as pix_per_cell, is an error.
    """
    is_number = [isinstance(value, (int, np.integer)) for value in args]
    if len(args) > 5 and is_number[2] and (isinstance(args[5], str) or (is_number[5] and args[5] <= 3)):
        names = ("cspace", "orient", "pix_per_cell", "cell_per_block", "hog_channel")
        named = ", ".join(f"{name}={value!r}" for name, value in zip(names, args[1:]))
        raise InvalidInputError(
            "the arguments after color_space must be spatial_size, hist_bins, orient, pix_per_cell, ...; "
            f"got those of the HOG quiz in its order. Pass them by name: {named}"
        )
    if "cspace" in kwargs and _SWITCHES.isdisjoint(kwargs):
        color, hog = (not options.isdisjoint(kwargs) for options in (_COLOR_OPTIONS, _HOG_OPTIONS))
        if color != hog:
            kwargs.update(spatial_feat=color, hist_feat=color, hog_feat=hog)


def detect_versions(lesson: Any) -> dict[str, Any]:
    """Find out which version of the lesson a module was written with, by calling its functions.

    Returns the arguments of `set_lesson_defaults` that can be told. A warning names each function that fails
    or that equals no version, because its author has changed it: go on using that one.

    Parameters
    ----------
    lesson
        Your own module of lesson functions, as imported, or ``sys.modules["__main__"]`` for a notebook. Its
        functions are called with a small random image; their results are compared with the versions of
        `vehicle_detection.course.reference`.

    Examples
    --------
    >>> from vehicle_detection.course import reference
    >>> versions = detect_versions(reference)
    >>> versions["imread"], versions["formula"], versions["find_cars_returns"]
    ('mpimg', 'old', 'picture')
    """
    from vehicle_detection.course import reference

    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, (arguments, options, versions) in _probes(Path(folder, "probe.png")).items():
            function = getattr(lesson, name, None)
            if not callable(function):
                continue
            try:
                with _hog_of_2017(function):
                    returned, kind = _call(name, function, arguments, options)
            except Exception as error:
                problem = f"fails: {type(error).__name__}: {error}"
            else:
                found |= kind
                if name in ("extract_features", "find_cars"):
                    options = {each: found[each] for each in _FEATURE_VERSIONS if each in found}
                problem = "equals no version of the lesson"
                for values in itertools.product(*versions.values()):
                    version = dict(zip(versions, values))
                    renamed = {_KEYWORDS.get((name, key), key): value for key, value in version.items()}
                    expected, _ = _call(name, getattr(reference, name), arguments, options | renamed)
                    if _are_equal(returned, expected):
                        found |= version
                        problem = ""
                        break
            if problem:
                warn(f"your {name} {problem}; go on using it, and do not import that of the library")
    return found


# Defaults that change features, and the option of the reference of a default, where it has another name.
_FEATURE_VERSIONS = ("transform_sqrt", "spatial_order", "hist_range")
_KEYWORDS = {
    ("bin_spatial", "spatial_order"): "order",
    ("color_hist", "hist_range"): "bins_range",
    ("find_cars", "find_cars_formula"): "formula",
}


def _probes(file: Path) -> dict[str, tuple[Any, dict[str, Any], dict[str, Any]]]:
    """Arguments and options of a call of each function, and the values of the defaults that it shows."""
    noise = np.random.default_rng(0).integers(60, 180, (25, 30, 3), np.uint8)
    image = np.asarray(cv2.resize(noise, (240, 200), interpolation=cv2.INTER_CUBIC))
    patch = image[:64, :64]
    cv2.imwrite(str(file), patch)
    channel, region = patch[:, :, 1], ([None, None], [8, None], (64, 64), (0.75, 0.6))
    whole = {"vis": False, "feature_vec": True}
    bands = {"divide_by": (255, 1), "cells_per_step": (2, 1, 3), "find_cars_formula": FORMULAS}
    files = {"imread": READERS, "channel_order": CHANNEL_ORDERS}
    return {
        "get_hog_features": ((channel, 9, 8, 2), whole, {"transform_sqrt": (False, True)}),
        "slide_window": ((image, *region), {}, {"formula": FORMULAS}),
        "bin_spatial": ((patch,), {"size": (16, 16)}, {"spatial_order": SPATIAL_ORDERS}),
        "color_hist": ((patch,), {"nbins": 16}, {"hist_range": ((0, 256), None, (0, 1))}),
        "extract_features": (([str(file)], "YCrCb", (16, 16), 16, 9, 8, 2, "ALL"), {}, files),
        "find_cars": ((image, 16, 200, 1.5, 9, 8, 2, (16, 16), 16), {}, bands),
    }


def _call(name: str, function: Any, arguments: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Return the result of a function; of `find_cars`, the features of all windows and what it returns."""
    if name != "find_cars":
        return function(*arguments, **options), {}
    recorder = _Recorder()
    returned = function(*arguments[:4], recorder, recorder, *arguments[4:], **options)
    parts = [isinstance(part, np.ndarray) for part in returned] if isinstance(returned, tuple) else []
    kind = "picture" if isinstance(returned, np.ndarray) else "both" if any(parts) else "boxes"
    return recorder.rows, {"find_cars_returns": kind}


class _Recorder:
    """A scaler and a classifier that keep the features of all windows, each of which is a vehicle."""

    def __init__(self) -> None:
        self.rows: list[Any] = []

    def transform(self, features: Any) -> Any:
        self.rows += list(np.array(features, np.float64))
        return features

    def predict(self, features: Any) -> Any:
        return np.ones(len(features))

    decision_function = predict


@contextlib.contextmanager
def _hog_of_2017(function: Any) -> Iterator[None]:
    """Let a function call scikit-image's ``hog`` by the argument ``visualise`` of its earlier versions."""
    names = getattr(function, "__globals__", {})
    hog = names.get("hog")

    def call(*args: Any, visualise: bool = False, **options: Any) -> Any:
        assert hog is not None
        return hog(*args, **{"visualize": visualise, **options})

    with mock.patch.dict(names, {"hog": call} if callable(hog) else {}):
        yield


def _are_equal(found: Any, expected: Any) -> bool:
    try:
        return bool(np.shape(found) == np.shape(expected) and np.allclose(found, expected, 1e-4, 1e-4))
    except (TypeError, ValueError):  # of another kind, such as a list of arrays
        return False
