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
    "output target": "save save_path save_dir out output_dir output_file target dest project name o",
    "model": "weights net network checkpoint m",
    "conf": "confidence conf_thres conf_threshold threshold score_threshold min_conf min_score thresh",
    "jobs": "workers threads n_jobs n_threads num_workers processes nproc cpus j",
    "fov": "field_of_view hfov angle",
    "every": "stride vid_stride skip step frame_skip interval frame_interval",
    "device": "gpu cuda accelerator",
    "camera_height height_m": "height mount_height cam_height camera_height lens_height",
    "camera": "lens calibration calib intrinsics",
    "tracks boxes": "csv save_txt json results mot export save_csv",
    "show": "view display view_img imshow gui window preview",
    "units": "mph imperial miles metric unit",
    "no_audio": "no_sound mute an",
    "own_speed": "speed ego_speed",
    "gpx": "gps nmea",
    "labels": "label text hide_labels hide_conf no_labels",
    "line_width": "thickness line_thickness linewidth",
    "start": "begin from ss since",
    "end": "to until stop duration t",
    "quiet": "silent no_progress",
    "progress": "verbose show_progress quiet",
    "blur": "anonymize privacy hide_plates",
    "classes": "class filter_classes class_ids",
    "source": "src input images image video file filename path i",
    "annotator": "style draw_params drawing",
}
"""Words of other tools by the arguments and options that they stand for here."""


def synonyms(name: str) -> list[str]:
    """Words of other tools for an argument or an option."""
    return [word for names, words in _SYNONYMS.items() if name in names.split() for word in words.split()]


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
            words = {word: name for name in known for word in (name, *synonyms(name))}
            close = difflib.get_close_matches(found[1], words, n=1)
            hint = f"did you mean {words[close[0]]!r}?" if close else f"the arguments are {', '.join(known)}"
            name = function.__qualname__.removesuffix(".__init__")
            message = f"{name}() got an unexpected keyword argument {found[1]!r}; {hint}"
            raise TypeError(message) from None

    return call
