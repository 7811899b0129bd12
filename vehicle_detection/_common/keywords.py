"""The right keyword for a wrong one, in the error of a call."""

from __future__ import annotations

import difflib
import functools
import inspect
import re
from collections.abc import Callable
from typing import ParamSpec, TypeVar

Params = ParamSpec("Params")
Result = TypeVar("Result")

_SYNONYMS = {
    "conf": "confidence threshold conf_thres conf_threshold min_conf score_threshold thresh",
    "jobs": "workers n_jobs num_workers threads n_threads",
    "fov": "field_of_view hfov angle",
    "every": "stride vid_stride step skip frame_skip interval",
    "model": "weights net network checkpoint",
    "height_m": "height camera_height lens_height",
    "target": "output out save save_path dest",
    "source": "video path input file filename",
    "progress": "verbose show_progress quiet",
    "annotator": "style draw_params drawing",
}
"""Words of other tools by the keyword that they stand for here."""


def suggest_keywords(function: Callable[Params, Result]) -> Callable[Params, Result]:
    """Let the `TypeError` of a call with an unknown keyword name the right one.

    >>> suggest_keywords(lambda *, jobs=None: jobs)(workers=2)
    Traceback (most recent call last):
    ...
    TypeError: <lambda>() got an unexpected keyword argument 'workers'; did you mean 'jobs'?
    """

    @functools.wraps(function)
    def call(*args: Params.args, **options: Params.kwargs) -> Result:
        try:
            return function(*args, **options)
        except TypeError as error:
            found = re.search(r"unexpected keyword argument '(\w+)'", str(error))
            if found is None or found[1] not in options:
                raise
            known = [name for name in inspect.signature(function).parameters if name != "self"]
            words = {word: name for name in known for word in (name, *_SYNONYMS.get(name, "").split())}
            close = difflib.get_close_matches(found[1], words, n=1)
            hint = f"did you mean {words[close[0]]!r}?" if close else f"the arguments are {', '.join(known)}"
            name = function.__qualname__.removesuffix(".__init__")
            message = f"{name}() got an unexpected keyword argument {found[1]!r}; {hint}"
            raise TypeError(message) from None

    return call
