"""Call every public function with bad values of every argument: only the library's errors may come back.

The functions are found by introspection: those of `vehicle_detection`, `vehicle_detection.course` and
`vehicle_detection.notebook` and the public ones of other subpackages, with the constructors and methods of
their classes. A new one is covered as
soon as `_Valid` knows valid values for its arguments. ``python -m tools.bad_input`` tries one value of each
kind for each argument, also of the commands' options; ``--every`` tries all values. The tests try a few
kinds for each argument. `tools.bad_input_page` writes the outcomes as a page of the documentation.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import inspect
import itertools
import pkgutil
import re
import signal
import sys
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any, Literal

import numpy as np

import vehicle_detection as vd
from vehicle_detection.boxes import Platt
from vehicle_detection.errors import InvalidInputError, VehicleDetectionError
from vehicle_detection.training import to_pipeline
from vehicle_detection.video import VideoReport

from .site_pages import SUBPACKAGE_NAMES

MAX_SECONDS = 60
"""Time limit of one call, which may have to compile kernels."""

NOT_CALLED = {
    "course.set_lesson_defaults": "changes later calls; tests/test_course_versions.py",
    "course.detect_versions": "takes a module; tests/test_course_versions.py",
    "open_dask": "starts a cluster",
    "write_video": "takes what track returned; tests/video/test_writing.py",
    "fetch_patches": "downloads; its arguments are tested in tests/datasets/test_archives.py",
    "Detections.to_supervision": "needs the package supervision; tests/test_boxes.py",
}
"""Public functions that are not called, and why."""

RESULTS = {
    "BatchReport", "BatchStatus", "DetectionScores", "DistanceScores", "Event", "Explanation", "FrameResult",
    "FrameSet", "FrameSource", "HorizonEstimate", "ImageDetections",
    "NetworkModel", "SearchResult", "Track", "TrackScores",
    "TrackRun", "TrainingReport", "Trip", "VehicleCounts", "VideoInfo", "VideoReport",
}  # fmt: skip
"""Classes whose instances the library makes, and whose constructors therefore check nothing."""


def bad_values(folder: Path) -> dict[str, tuple[Any, ...]]:
    """Return bad values of every kind. Some of them are valid for some arguments."""
    # A link: a function that replaced the device itself would do harm.
    zero = folder / "zero"
    if not zero.is_symlink():
        zero.symlink_to("/dev/zero")
        for suffix in (".csv", ".png", ".mp4", ".json"):
            zero.with_suffix(suffix).symlink_to("/dev/zero")
    full, image = np.full((2, 4), np.nan), np.zeros((5, 5, 3), np.uint8)
    return {
        "`None`": (None,),
        "negative number": (-1, 0, np.int8(-5), -0.5),
        "huge integer": (10**400, -(10**400), 2**63),
        "NaN, infinity": (float("nan"), float("inf"), 1e308, np.float32("nan")),
        "empty": ("", (), {}, [], np.zeros((0, 4))),
        "text": ("x", ["x", "y"], "frame,x1\n0,1"),
        "wrong type": (object(), print, True, b"x", {"a": 1}, {1, 2}, 1j, 1.5, range(3),
                       np.datetime64("now")),
        "ragged list": ([1, [2, 3]], [[1, 2], [3]], [None], [(0, 0, 1, 1), "x"], [[10**400, 0, 1, 1]]),
        "wrong number of items": ((1,), (1, 2, 3, 4, 5), (10**400, 10**400), np.array(3)),
        "wrong shape": (np.zeros((2, 3)), np.zeros((2, 2, 3)), image[..., 0], image[None], np.zeros((2, 4))),
        "wrong dtype": (np.array(["x"]), np.array([object()]), np.zeros((70, 70, 3), np.int64),
                        np.zeros((5, 5, 3)), np.zeros((64, 64, 4), np.uint8)),
        "invalid boxes": (full, np.array([[5, 5, 1, 1]]), [(1e308, 0, 1e308, 1)]),
        "tiny image": (image, image[:0], np.zeros((1, 1, 3), np.uint8)),
        "impossible name": ("\ud800", "a" * 5000, "a\0b", "b" * 300 + ".csv"),
        "missing file": (Path("missing"), "missing/missing.mp4", folder / "missing.csv"),
        "folder": (folder, str(folder)),
        "device": (zero, *(zero.with_suffix(suffix) for suffix in (".csv", ".png", ".mp4", ".json"))),
    }  # fmt: skip


def public_callables() -> dict[str, Callable[..., Any]]:
    """Return the public functions, the constructors of public classes and their methods, by name."""
    found: dict[str, Callable[..., Any]] = {}
    modules = {"course.": vd.course.__all__, "notebook.": vd.notebook.__all__}
    listed = [("", name, value) for name, value in package_names().items()]
    listed += [
        (prefix, name, getattr(getattr(vd, prefix[:-1]), name))
        for prefix in modules
        for name in modules[prefix]
    ]
    for prefix, name, value in listed:
        if inspect.ismodule(value) or (inspect.isclass(value) and issubclass(value, Exception)):
            continue
        if not value.__module__.startswith(vd.__name__):  # of another library, as in `vd.course`
            continue
        if prefix and value is getattr(vd, name, None):  # public in the package, too
            continue
        if prefix + name not in RESULTS:
            found[prefix + name] = value
        if inspect.isclass(value):
            found.update((f"{prefix}{name}.{each}", method) for each, method in _methods(value))
    called = {name: value for name, value in found.items() if name not in NOT_CALLED}
    return {name: value for name, value in called.items() if _parameters(value)}


@functools.cache
def package_names() -> dict[str, Any]:
    """Return the public names of the package and of its subpackages without a page of their own."""
    places = {
        name: f"{module}.{name}" for module, names in SUBPACKAGE_NAMES.items() for name in names.split()
    }
    places |= {name: name for name in vd.__all__}
    return {name: pkgutil.resolve_name(f"vehicle_detection.{place}") for name, place in places.items()}


def _methods(kind: type) -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield the public methods that a class of this library defines, and that have arguments."""
    for name, member in inspect.getmembers(kind):
        if name.startswith("_") or not inspect.isroutine(member):
            continue
        public_bases = [base for base in kind.__mro__[1:] if base.__name__ in package_names()]
        inherited = name not in vars(kind) and any(hasattr(base, name) for base in public_bases)
        own = str(getattr(member, "__module__", "")).startswith("vehicle_detection")
        if own and not inherited and _parameters(member):
            yield name, member


def _parameters(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the arguments of a function, without ``self`` and those of any number."""
    many = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    parameters = inspect.signature(function).parameters.values()
    return [each for each in parameters if each.name != "self" and each.kind not in many]


INTERNAL = {
    "Detector.reduction", "Event.text", "FeatureParams.spatial_planes", "FrameResult.unsearched",
    "FrameSource.audio",
    "FrameSource.read", "HeatParams.for_search", "NetworkModel.feeds", "NetworkModel.input_size_for",
    "NetworkModel.name_classes", "NetworkModel.network_probability", "NetworkModel.scores",
    "NetworkModel.with_confidence",
    "RegionParams.with_peak", "SearchBand.place", "SceneCuts.sample_size", "SearchParams.place",
    "SearchResult.enlarged", "TrackTable.select", "VehicleDetector.reduction",
}  # fmt: skip
"""Methods that only the library calls, with its own results."""


@dataclass(frozen=True)
class Target:
    """A public function, and valid values of its arguments."""

    name: str
    call: Callable[..., Any]
    arguments: Mapping[str, Any]


def targets(folder: Path) -> dict[str, Target]:
    """Return the public functions with valid arguments.

    Raises
    ------
    LookupError
        If a valid value of an argument is not known.
    """
    valid = _Valid(folder)
    found: dict[str, Target] = {}
    missing: list[str] = []
    for name, function in public_callables().items():
        if name in INTERNAL:
            continue
        owner, _, method = name.removeprefix("course.").removeprefix("notebook.").rpartition(".")
        call = (
            function if not owner or inspect.ismethod(function) else getattr(valid.instances[owner], method)
        )
        known = valid.by_name | valid.by_function.get(name.partition(".")[0] + ".", {})
        known |= valid.by_function.get(name, {})
        arguments = dict(valid.by_function.get(name, {}))
        for each in _parameters(call):
            if each.default is not each.empty:
                arguments.setdefault(each.name, each.default)
            elif each.name in known:
                arguments[each.name] = known[each.name]
            else:
                missing.append(f"{each.name} of {name}")
        found[name] = Target(name, call, arguments)
    if missing:
        raise LookupError(f"add valid values to {__name__} for {', '.join(missing)}")
    return found


class _Valid:
    """Valid values of arguments, by the argument's name or by the function's and the argument's."""

    def __init__(self, folder: Path) -> None:
        import moviepy

        from vehicle_detection.cli.demo import draw_clip
        from vehicle_detection.training import write_results

        scene = vd.render_scene(shape=(180, 320), vehicles=1, random_state=0)
        image = scene.image
        boxes, scores = np.array([[1, 2, 30, 40], [5, 6, 50, 60]]), np.array([1.0, 0.5])
        windows = vd.Detections(boxes, scores)
        heat = np.zeros((180, 320), np.float32)
        patches, labels = vd.render_patches(20)
        names = tuple(f"{'ab'[number // 2 % 2]}/{number}.png" for number in range(20))
        patch_set = vd.PatchSet(patches, labels, names)
        params = vd.FeatureParams(hog_channel=0, spatial_feat=False, hist_feat=False, orient=4)
        classifier = vd.train_classifier(patches, labels, params=params)
        truth = vd.TrackTable([0, 1], np.array([1, 1]), boxes)
        predicted = vd.TrackTable([0, 1], np.array([1, 1]), boxes, score=scores)
        frames = vd.LabelledFrames("a", {0: image, 1: image}, truth)
        camera = vd.Camera(focal_px=500.0, horizon_px=40.0)
        band = vd.SearchBand(window=(64, 64), y=(0.0, 256.0))
        search = vd.SearchParams(bands=(band,))
        detector = vd.VehicleDetector(classifier, jobs=1)
        result = detector.process(image)
        tracker, log, own_speed = vd.Tracker(), vd.TrackTable(), vd.drive.OwnSpeed.constant(25.0)
        report = VideoReport(
            frames=1, fps=Fraction(25), shape=image.shape, seconds=1.0, stages={"search": 1.0}, tracks=0
        )
        clip = folder / "valid.mp4"
        draw_clip(vd.render_drive(frames=3, shape=(64, 96)), clip, folder / "valid.csv")
        vd.write_image(folder / "valid.png", image)
        vd.write_camera(camera, folder / "camera.json", (180, 320))
        (folder / "speed.csv").write_text("time_s,speed_kmh\n0,90\n1,91\n")
        (folder / "patches").mkdir()
        vd.write_image(folder / "patches" / "vehicle.png", patches[0])
        _, scaler, svc = (step for _, step in to_pipeline(classifier).steps)
        moving = moviepy.VideoClip(lambda time: image, duration=0.1)
        theirs = SimpleNamespace(xyxy=boxes, confidence=scores, class_id=None)
        quick = vd.training.TrialOptions(time_search=False, jobs=1)
        table = _table()
        write_results(table, folder / "results.csv")
        lesson_only = {"spatial_feat": False, "hist_feat": False, "hog_channel": 0, "color_space": "YCrCb"}
        lesson = {"img": image, "svc": svc, "X_scaler": scaler, "clf": svc, "scaler": scaler,
                  "orient": 4, "pix_per_cell": 8, "cell_per_block": 2,
                  "spatial_size": (16, 16), "hist_bins": 16, "windows": [((0, 0), (64, 64))], "ystart": 0,
                  "ystop": 96, "scale": 1.0}  # fmt: skip
        self.instances: dict[str, Any] = {
            "Annotator": vd.Annotator(), "Box": vd.course.Box(), "Camera": camera, "Detections": windows,
            "Detector": detector.detector, "Explorer": vd.Explorer([image], classifier),
            "ImageDetections": detector.detect(image),
            "TrackTable": predicted, "FunctionParams": vd.FunctionParams(), "HeatHistory": vd.HeatHistory(),
            "FrameSource": vd.open_source(clip), "HeatmapDetector": vd.HeatmapDetector(classifier),
            "NetworkModel": vd.load_model("default"), "NetworkParams": vd.NetworkParams(),
            "OwnSpeed": own_speed, "PatchFeatures": vd.training.PatchFeatures(jobs=1), "PatchSet": patch_set,
            "Platt": Platt(-1.0, 0.0),
            "ReportWriter": vd.ReportWriter(folder / "writer.html"),
            "SearchParams": search,
            "RegionParams": vd.RegionParams(), "SceneCuts": vd.tracking.SceneCuts(), "Tracker": tracker,
            "VehicleClassifier": classifier, "VehicleDetector": detector,
        }  # fmt: skip
        self.by_name: dict[str, Any] = {
            "image": image, "img": image, "frame": image, "patches": patches, "labels": labels,
            "boxes": boxes, "scores": scores, "windows": windows, "detections": windows, "shape": (180, 320),
            "camera": camera, "patch_set": patch_set, "classifier": classifier, "predictions": predicted,
            "heatmap": heat, "heat": heat, "tracks": [], "fps": 25.0, "folder": folder / "patches",
            "detector": detector, "threshold": 0.5, "box": boxes[0], "explanation": None, "table": table,
            "source": patches, "params": params, "result": result, "results": [result], "n": 2,
            "random_state": 0, "path": folder / "out.csv", "log": log, "events": [], "video": clip,
            "focal_px": 500.0, "horizon_px": 40.0, "first": boxes, "second": boxes, "bboxes": boxes,
            "X": patches, "y": labels, "metadata": {}, "horizon": 0.5, "images": [image],
            "time": 0.0, "name": "a", "bbox_list": boxes, "files": [clip], "model": classifier,
            "key": 0, "sets": [patch_set], "frames": [image], "clip": moving,
            "before": result, "after": None, "times": [], "thumbnail": np.zeros((9, 16), np.float32),
            "report": report, "on_result": None, "view": "heat", "rename": int,
            "templates": classifier.templates, "fast": scores, "reference": scores,
            "seconds": {"a": 1.0, "b": 2.0},
            "pairs": np.array([[0, 1]]),
            "parameter": "orient", "methods": {"a": [windows]}, "curves": (scores, scores, scores),
            "runs": {"a": [result]}, "out": folder / "out", "target": folder / "out.mp4",
            "pipeline": to_pipeline(classifier), "lateral_px": 10.0, "index": 0, "imgs": [image],
            "split": vd.datasets.Split(np.arange(10), np.arange(10, 20)), "number": 1, "speed": own_speed,
            "speed_mps": 25.0,
        }  # fmt: skip
        self.by_function: dict[str, dict[str, Any]] = {
            "course.": lesson,
            "LabelledFrames": {"frames": [image, image], "labels": truth},
            "LabelledFrames.from_video": {"path": clip, "labels": truth},
            "ImageDetections.save": {"path": folder / "found.png"},
            "TrackTable": {"frame": [0, 1], "track_id": np.array([1, 1]), "boxes": boxes},
            "TrackTable.from_detections": {"detections": {0: windows}},
            "TrackTable.from_pandas": {"table": predicted.to_pandas()},
            "Detections.from_supervision": {"detections": theirs},
            "FrameDataset": {"sets": (frames,)},
            "Platt": {"a": -1.0, "b": 0.0},
            "Platt.score": {"probability": 0.5},
            "OwnSpeed": {"seconds": [0.0, 2.0], "speeds_mps": [10.0, 14.0]},
            "OwnSpeed.at": {"seconds": [0.0, 1.0]},
            "PatchSet": {"names": names},
            "SearchBand": {"window": (64, 64), "y": (0.0, 256.0)},
            "SearchParams": {"bands": (band,)},
            "Explorer": {"frames": [image], "model": classifier},
            "Explorer.box_at": {"x": 1.0, "y": 1.0},
            "Explorer.set_frame": {"frame": 0},
            "Tracker": {"fps": 25.0},
            "Split": {"train": np.arange(3), "test": np.arange(3, 5)},
            "HeatmapDetector": {"clf": classifier},
            "ReportWriter": {"path": folder / "out.html"},
            "VehicleDetector": {"model": classifier},
            "FeatureParams.preset": {"name": "lab-8460"},
            "SearchParams.preset": {"name": "default"},
            "PatchFeatures.fit": {"y": labels},
            "VehicleClassifier": {"params": params},
            "VehicleClassifier.from_pipeline": {"params": params},
            "VehicleClassifier.save": {"path": folder / "out.safetensors"},
            "NetworkModel.save": {"path": folder / "out.onnx"},
            "Detector.fit": {"found": detector.search(image)},
            "VehicleDetector.track": {"found": detector.search(image)},
            "batch_status": {"out": folder},
            "bounding_boxes": {"params": None},
            "bin_spatial": {"img": image, "size": 16},
            "calibrate_scores": {"labels": [1, 0]},
            "calibration_error": {"probabilities": [0.2, 0.5], "labels": [0, 1], "bins": 5},
            "compare_configurations": {"configurations": {"a": params}, "options": quick},
            "compare_searches": {"frames": frames, "scales": [(1.0,)], "overlaps": [0.5], "thresholds": [1]},
            "detector_from": {"function": lambda image: (boxes, scores)},
            "course.Box.add": {"box": ((0, 0), (9, 9))},
            "course.adjust_bbox": {"bbox": ((0, 0), (9, 9)), "previous": ((1, 0), (10, 9))},
            "course.find_car_windows": lesson_only,
            "course.find_cars": lesson_only,
            "course.search_windows": {**lesson_only, "color_space": "RGB", "orient": 4},
            "course.bounding_boxes": {"windows": boxes},
            "course.show_images": {"titles": ["a"]},
            "course.process_image": {"method": 2},
            "estimate_horizon": {"boxes": [[40 * n, 60, 30 + 40 * n + n, 90 + n] for n in range(1, 7)]},
            "evaluate_detections": {"labels": truth},
            "evaluate_distances": {"labels": truth},
            "evaluate_tracks": {"labels": truth},
            "color_hist": {"img": image},
            "count_vehicles": {"table": predicted},
            "draw_labeled_bboxes": {"img": image, "labels": (heat.astype(np.int32), 0)},
            "get_hog_features": {"img": image[..., 0], "orient": 4, "pix_per_cell": 8, "cell_per_block": 2},
            "extract_features": {"jobs": 1},
            "find_cars": {"params": search, "jobs": 1},
            "find_events": {"table": predicted},
            "find_vehicles": {"params": None},
            "load_classifier": {"path": "highway"},
            "load_patches": {"source": folder / "patches", "label": 1, "jobs": 1},
            "load_training_patches": {"vehicles": folder / "patches", "non_vehicles": folder / "patches"},
            "mine_negatives": {"labels": truth, "search_params": search, "jobs": 1},
            "open_source": {"source": clip},
            "precision_recall_curve": {"labels": truth},
            "probe_video": {"path": clip},
            "process_video": {"source": clip, "progress": False, "jobs": 1},
            "read_camera": {"path": folder / "camera.json"},
            "read_frames": {"source": clip},
            "read_image": {"path": folder / "valid.png"},
            "read_labels": {"path": folder / "valid.csv"},
            "read_own_speed": {"path": folder / "speed.csv"},
            "read_results": {"path": folder / "results.csv"},
            "render_drive": {"frames": 2, "shape": (64, 96)},
            "render_scene": {"shape": (64, 64), "vehicles": 1},
            "run_batch": {
                "sources": [clip],
                "executor": ThreadPoolExecutor(1),
                "model": "highway",
                "progress": False,
                "tracks_only": True,
                "dry_run": True,
            },
            "search_windows": {"windows": boxes, "jobs": 1},
            "single_img_features": {"image": patches[0]},
            "split_random": {"patches_or_labels": labels},
            "split_sources": {"train": ("a",), "test": ("b",)},
            "track": {"source": clip, "detector": detector},
            "train_and_evaluate": {"params": params, "seeds": 1, "jobs": 1},
            "train_classifier": {"labels": labels, "params": params, "jobs": 1},
            "write_camera": {"path": folder / "out.json"},
            "write_image": {"path": folder / "out.png"},
            "write_labels": {"labels": truth},
            "write_subtitles": {"table": predicted, "path": folder / "out.srt"},
            "write_tracks": {"results": predicted},
            "notebook.plot_errors": {"frames": frames},
            "notebook.plot_explanation": {"explanation": vd.explain(detector, image, boxes[0])},
            "notebook.plot_tracks": {"results": predicted},
            "notebook.plot_weights": {"classifier": vd.load_classifier("highway")},
        }


def _table() -> Any:
    """Return a small table of tuning results."""
    import pandas as pd

    return pd.DataFrame({"orient": [4, 9], "accuracy": [0.9, 0.95], "search_ms": [1.0, 2.0],
                         "configuration": ["a", "b"]})  # fmt: skip


_OTHER_NAMES = {
    "clf": "classifier|model file|path", "cost": "column", "X_scaler": "scaler", "svc": "classifier",
    "by": "column",
    "frames": "frame", "label": "column", "n_frames": "frames", "parameter": "column", "path": "file|folder",
    "quality": "column", "configurations": "configuration|preset", "image": "path|frame",
    "frame": "img|image", "patches": "image file|rows", "windows": "boxes|bbox_list", "X": "source",
    "name": "preset", "detector": "model", "imgs": "image file", "hist_feat": "features",
    "hog_feat": "features", "spatial_feat": "features",
    "vehicles": "png|csv", "non_vehicles": "png|json", "source": "png|csv", "images": "folder",
    "bbox_list": "boxes", "patches_or_labels": "vehicles",
}  # fmt: skip
"""What the error of a bad argument may name instead."""


def _names(argument: str, text: str, error: BaseException) -> bool:
    """Whether an error names the argument; those of other arguments come first in some functions."""
    names = f"{argument}|{_OTHER_NAMES.get(argument, argument)}"
    return bool(re.search(rf"\b({names})\b", str(error))) or text.startswith(_ALSO_OTHER_ERRORS)


_ALSO_OTHER_ERRORS = (
    "TrackTable.append(", "bin_spatial(size", "draw_labeled_bboxes(img",
    "notebook.plot_tracks(min_frames",
)  # fmt: skip
"""Calls whose error may be that of another argument, which the bad one contradicts."""

_KEEPS_FILES = "tune --cache "
"""Start of the texts of calls whose files stay after an error: what is cached saves time the next time."""


@dataclass
class Outcome:
    """What happened to the values of one kind in one function."""

    refused: int = 0
    accepted: int = 0
    problems: list[str] = field(default_factory=list)

    def add(self, text: str, error: BaseException | None, written: set[str]) -> None:
        """Add a call, such as ``"f(x=None)"``, its error and the files that it wrote."""
        if error is None:
            self.accepted += 1
        elif isinstance(error, VehicleDetectionError):
            self.refused += 1
            if written and not text.startswith(_KEEPS_FILES):
                self.problems.append(f"{text}: failed, but left {sorted(written)}")
            argument = re.match(r"[\w.]+\((\w+)=", text)
            if argument and not _names(argument[1], text, error):
                self.problems.append(f"{text}: does not name the argument: {error}"[:200])
        else:
            self.problems.append(f"{text}: {' '.join(f'{type(error).__name__}: {error}'.split())[:150]}")


Effort = Literal["few", "one", "every"]
"""For each argument: one value of a few kinds (the tests) or of each kind, or every value."""

FEW_OF_FUNCTIONS, FEW_OF_COMMANDS = 3, 1
"""Numbers of kinds for each argument of a function, and for each option of a command, in the tests."""


def cases(
    functions: Mapping[str, Target], values: Mapping[str, tuple[Any, ...]], effort: Effort
) -> Iterator[Case]:
    """Yield the functions with bad values of their arguments."""
    count = FEW_OF_FUNCTIONS if effort == "few" else len(values)
    for name, target in functions.items():
        for argument, kind in _pairs(name, target.arguments, values, count):
            choices = values[kind]
            one = choices[_number(name, argument, kind) // len(values) % len(choices)]
            for value in choices if effort == "every" else (one,):
                text = f"{name}({argument}={' '.join(repr(value).split())[:60]})"
                yield name, kind, text, partial(target.call, **{**target.arguments, argument: value})


def _pairs(
    name: str, arguments: Iterable[str], kinds: Iterable[str], count: int
) -> Iterator[tuple[str, str]]:
    """Yield each argument of a function with some of the kinds, which are the same in every run."""
    listed = list(kinds)
    for argument in arguments:
        chosen = sorted(listed, key=lambda kind: _number(name, argument, kind))[:count]
        yield from ((argument, kind) for kind in listed if kind in chosen)


def _number(*words: str) -> int:
    """Return a number that depends on the words, but not on the run, as that of `hash` does."""
    return zlib.crc32(" ".join(words).encode())


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the main thread after some seconds, where the system has alarms."""
    if not hasattr(signal, "setitimer"):
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"no result after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


Case = tuple[str, str, str, Callable[[], Any]]
"""Function or command, kind of the value, description of the call, and the call."""


def run(
    effort: Effort, *, functions: Iterable[str] = (), commands: bool = True
) -> tuple[dict[str, dict[str, Outcome]], list[str]]:
    """Call the functions and commands; return the outcomes by name and kind, and all problems.

    Problems are errors of other classes, calls without an end, files written although the call failed, and
    files outside the folder of the valid files.
    """
    outcomes: dict[str, dict[str, Outcome]] = {}
    with tempfile.TemporaryDirectory(prefix="bad_input.") as outer, contextlib.chdir(outer):
        folder = Path(outer) / "in"
        folder.mkdir()
        values, found = bad_values(folder), targets(folder)
        chosen = {name: found[name] for name in functions or found}
        tried: Iterator[Case] = cases(chosen, values, effort)
        if commands:
            tried = itertools.chain(tried, command_cases(folder, effort))
        before = _files(outer)
        for name, kind, text, call in tried:
            outcome = outcomes.setdefault(name, {}).setdefault(kind, Outcome())
            error = call_quietly(call)
            written = _files(outer) - before
            outcome.add(text, error, written)
            for path in sorted(written, reverse=True):
                remove = Path(outer, path)
                remove.rmdir() if remove.is_dir() else remove.unlink()
    return outcomes, [text for row in outcomes.values() for each in row.values() for text in each.problems]


def call_quietly(call: Callable[[], Any]) -> BaseException | None:
    """Call without warnings and open figures, and return the error if there is one."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings(), time_limit(MAX_SECONDS):
            warnings.simplefilter("ignore")
            result = call()
            if inspect.isgenerator(result):
                result.close()
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return error
    finally:
        if "matplotlib.pyplot" in sys.modules:
            sys.modules["matplotlib.pyplot"].close("all")
    return None


def _files(folder: str) -> set[str]:
    return {str(path.relative_to(folder)) for path in Path(folder).rglob("*")}


COMMANDS = {
    "demo": ("-o", "demo", "--frames", "1"),
    "detect": ("in/valid.png", "-o", "out", "--model", "highway"),
    "video": ("in/valid.mp4", "-o", "out.mp4", "--model", "highway", "-q"),
    "evaluate": ("in/valid.csv", "in/valid.csv"),
    "batch": ("missing.mp4", "-o", "out", "--model", "highway", "-q"),
    "train": ("--vehicles", "in/patches", "--non-vehicles", "in/patches", "-o", "out.safetensors"),
    "train-frames": ("in/patches", "-o", "out.onnx"),
    "tune": (
        "--vehicles",
        "in/patches",
        "--non-vehicles",
        "in/patches",
        "--grid",
        "orient=4",
        "-o",
        "out.csv",
    ),
    "info": (),
}
"""Arguments of the commands. The slow ones fail after all options were checked."""

COMMANDS_NOT_CALLED = {"fetch": "downloads"}
"""Commands that are not called, and why."""


def command_options() -> dict[str, list[str | None]]:
    """Return the options of each command that take a value; None stands for its positional arguments."""
    import typer

    from vehicle_detection.cli.app import app

    group: Any = typer.main.get_command(app)
    return {
        name: [
            None if each.param_type_name == "argument" else each.opts[-1]
            for each in command.params
            if not getattr(each, "is_flag", False) and each.name != "help"
        ]
        for name, command in group.commands.items()
        if name not in COMMANDS_NOT_CALLED
    }


def command_cases(folder: Path, effort: Effort) -> Iterator[Case]:
    """Yield the commands with bad values of their options and arguments, one of each kind."""
    values = {
        "negative number": "-1", "huge integer": "9" * 400, "NaN, infinity": "nan", "empty": "", "text": "x",
        "impossible name": "a" * 5000, "missing file": "missing/missing.mp4", "folder": str(folder),
        "device": str(folder / "zero.csv"), "wrong type": "\udc80.csv",
    }  # fmt: skip
    count = FEW_OF_COMMANDS if effort == "few" else len(values)
    for name, options in command_options().items():
        for option, kind in _pairs(name, [option or "" for option in options], values, count):
            value = values[kind]
            words = [*COMMANDS[name], option, value] if option else [value, *COMMANDS[name][1:]]
            yield (f"`{name}`", kind, f"{name} {option} {value[:60]!r}", partial(_run_command, name, words))


def _run_command(name: str, words: list[str]) -> None:
    """Run a command in this process; an error that it reports in one line counts as one of the library's."""
    from typer.testing import CliRunner

    from vehicle_detection.cli.app import app

    result = CliRunner().invoke(app, [name, *words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    if "Traceback" in result.output:
        raise AssertionError("the output holds a traceback")
    if result.exit_code in (1, 2):
        raise InvalidInputError(result.output[-200:])
    if result.exit_code not in (0, 3):  # 3: what can be read was processed
        raise AssertionError(f"exit code {result.exit_code}")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--functions", nargs="+", default=(), help="functions to call; default: all")
    parser.add_argument("--every", action="store_true", help="try every value; default: one of a kind")
    options = parser.parse_args()
    effort: Effort = "every" if options.every else "one"
    outcomes, problems = run(effort, functions=options.functions, commands=not options.functions)
    for problem in problems:
        print(problem)
    cells = [each for row in outcomes.values() for each in row.values()]
    print(f"{sum(each.refused for each in cells)} refused, {sum(each.accepted for each in cells)} accepted")
    sys.exit(bool(problems))


if __name__ == "__main__":
    main()
