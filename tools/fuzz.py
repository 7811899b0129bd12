"""Feed random and damaged input to the library: only its own errors may come back.

``python -m tools.fuzz --seconds 600`` is a long run; the tests run a small, fixed part. Kind, seed and number
reproduce an input: ``python -m tools.fuzz --kinds images --seed 3 --first 17 --count 1``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import random
import resource
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import vehicle_detection as vd
from vehicle_detection._common import write_model
from vehicle_detection.errors import VehicleDetectionError

MAX_MEMORY_GB = 4.0
"""Limit of the process's memory in a long run."""

SHORT = {"arguments": 2000, "images": 300, "labels": 300, "models": 150, "archives": 60, "videos": 12}
"""Number of inputs of each kind in the tests."""

Case = tuple[str, Callable[[], object]]
"""Description of an input, and the call that reads it."""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Ignore warnings, of which numpy gives many for odd numbers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Return damaged bytes: flipped bits, other bytes, parts that are cut out, repeated or cut off."""
    result = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 10))):
        if not result:
            break
        place, length = rng.randrange(len(result)), rng.choice((1, 2, 4, 8, 64))
        match rng.randrange(6):
            case 0:
                result[place] ^= 1 << rng.randrange(8)
            case 1:
                result[place] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
            case 2:
                result[place : place + length] = rng.choice((b"\0", b"\xff", b"[", b"9")) * length
            case 3:
                del result[place : place + length]
            case 4:
                result[place:place] = result[place : place + length]
            case _:
                del result[place : None if rng.random() < 0.2 else place + 1]
    return bytes(result)


def image_cases(folder: Path, rng: random.Random) -> Iterator[Case]:
    """Damaged image files of every format."""
    import cv2

    picture = vd.render_scene(shape=(64, 64), vehicles=1, random_state=0).image
    formats = (".png", ".jpg", ".bmp", ".tiff", ".webp", ".gif", ".ppm", ".jp2")
    suffixes = [suffix for suffix in formats if cv2.haveImageWriter("a" + suffix)]
    samples = [cv2.imencode(suffix, picture)[1].tobytes() for suffix in suffixes]
    samples.append(cv2.imencode(".png", picture.astype(np.uint16) * 257)[1].tobytes())
    samples.append(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes())
    file = folder / "image.png"
    while True:
        file.write_bytes(mutate(rng.choice(samples), rng))
        yield "image", partial(vd.read_image, file)


LABELS = {
    "a.csv": "frame,track,x1,y1,x2,y2,occluded,truncated,ignore\n0,1,10,20,30,40,0,0.0,0\n"
    "1,1,11,20,31,40,1,0.5,1\n",
    "b.csv": "frame,track_id,x1,y1,x2,y2,score\n0,1,10,20,30,40,1.5\n1,,11,20,31,40,0.5\n",
    "c.jsonl": '{"frame": 0, "track_id": 1, "x1": 1, "y1": 2, "x2": 3, "y2": 4, "score": 0.5}\n' * 2,
    "d.txt": "1,1,10,20,30,40,1,-1,-1,-1\n2,1,11,20,30,40,1,-1,-1,-1\n",
    "e.txt": "Car 0.0 0 -10 10 20 30 40 -1 -1 -1 -1000 -1000 -1000 -10\n",
    "f.json": '{"images": [{"id": 1, "file_name": "a.png"}], "categories": [{"id": 1, "name": "car"}], '
    '"annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [1, 2, 3, 4], "iscrowd": 0}]}',
}
"""Small label files of every format."""


def label_cases(folder: Path, rng: random.Random) -> Iterator[Case]:
    """Damaged label files, with other values in their fields."""
    values = [
        "1e999",
        "-1",
        "9" * 400,
        "nan",
        "true",
        "null",
        '"',
        "[" * 2000,
        "{}",
        "\0",
        "\ud7ff",
        "1e308",
        ",",
    ]
    while True:
        name, text = rng.choice(list(LABELS.items()))
        if rng.random() < 0.5:
            words = text.replace(",", " , ").split(" ")
            words[rng.randrange(len(words))] = rng.choice(values)
            data = " ".join(words).encode()
        else:
            data = mutate(text.encode(), rng)
        (folder / name).write_bytes(data)
        yield name, partial(vd.read_labels, folder / name, shape=rng.choice((None, (720, 1280))))


def model_cases(folder: Path, rng: random.Random) -> Iterator[Case]:
    """Damaged model files, and intact ones with other values."""
    patches, labels = vd.render_patches(20)
    small = vd.FeatureParams(hog_channel=0, spatial_feat=False, hist_feat=False, orient=4)
    classifier = vd.train_classifier(patches, labels, params=small)
    whole, file = folder / "whole.safetensors", folder / "model.safetensors"
    classifier.save(whole)
    data = whole.read_bytes()
    length = 8 + int.from_bytes(data[:8], "little")
    odd: list[Any] = [1e38, -1e38, np.nan, np.inf, 10**400, True, None, "x", [], {}, [[[]]], -1, 0, 1e-300]
    types = [np.float16, np.float32, np.float64, np.int32, np.bool_, np.uint8]
    while True:
        if rng.random() < 0.5:
            # The header decides about everything else.
            head = mutate(data[:length], rng) if rng.random() < 0.7 else data[:length]
            file.write_bytes(head + (data[length:] if head != data[:length] else mutate(data[length:], rng)))
        else:
            template = classifier.templates[0]
            tensors = {f"0.{name}": np.array(value, ndmin=1) for name, value in vars(template).items()}
            params: dict[str, Any] = {
                "hog_channel": 0,
                "spatial_feat": False,
                "hist_feat": False,
                "orient": 4,
            }
            name = rng.choice(list(tensors))
            match rng.randrange(4):
                case 0:
                    tensors[name] = np.full_like(
                        tensors[name], rng.choice((1e38, np.nan, np.inf, 0, -1, 1e300))
                    )
                case 1:
                    with _quiet():
                        tensors[name] = tensors[name].astype(rng.choice(types))
                case 2:
                    tensors[name] = tensors[name][: rng.randrange(len(tensors[name]) + 1)]
                case _:
                    params[rng.choice((*params, "spatial_size", "other"))] = rng.choice(odd)
            write_model(
                file, rng.choice(("patches", "patches", "mixture")), params, tensors, {"a": rng.choice(odd)}
            )
        yield "model", partial(_use_model, file)


def _use_model(file: Path) -> None:
    """Load a model and score patches with it."""
    model = vd.load_model(file)
    if isinstance(model, vd.VehicleClassifier):
        scores = model.decision_function(np.zeros((2, 64, 64, 3), np.uint8))
        if not np.isfinite(scores).all():
            raise AssertionError(f"a loaded model gives the scores {scores.tolist()}")


def archive_cases(folder: Path, rng: random.Random) -> Iterator[Case]:
    """Damaged zip archives of patches, and intact ones with unusual members."""
    import cv2

    patch = cv2.imencode(".png", np.zeros((64, 64, 3), np.uint8))[1].tobytes()
    names = [
        "vehicles/1.png",
        "../../out.png",
        "/etc/x.png",
        "vehicles/1.png",
        "a" * 300 + ".png",
        "\\..\\b.png",
    ]
    file = folder / "vehicles.zip"
    while True:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive, _quiet():
            archive.writestr("vehicles/0.png", patch)
            for name in rng.sample(names, rng.randrange(3)):
                archive.writestr(name, rng.choice((patch, b"", bytes(100_000))))
        file.write_bytes(mutate(buffer.getvalue(), rng) if rng.random() < 0.8 else buffer.getvalue())
        yield "archive", partial(vd.load_patches, file, label=1, n_jobs=1)


def video_cases(folder: Path, rng: random.Random) -> Iterator[Case]:
    """Damaged videos of several containers."""
    from vehicle_detection.cli.demo import draw_clip

    whole = folder / "whole.mp4"
    draw_clip(vd.render_drive(frames=10, shape=(96, 128)), whole, folder / "labels.csv")
    data = whole.read_bytes()
    start = data.index(b"moov")
    file = folder / "video.mp4"
    while True:
        if rng.random() < 0.5:  # the index, which is small and decides about everything
            file.write_bytes(data[:start] + mutate(data[start:], rng))
        elif rng.random() < 0.5:
            file.write_bytes(data[: rng.randrange(len(data))])
        else:
            file.write_bytes(mutate(data, rng))
        yield "video", partial(_read_video, file)


def _read_video(file: Path) -> None:
    """Read all frames; a video of ten frames of which most are missing must be reported."""
    with vd.read_frames(file) as frames:
        count = sum(1 for _ in frames)
    if count < frames.info.frames - 2 and not frames.damage and not frames.info.has_audio:
        raise AssertionError(f"{count} of {frames.info.frames} frames without a word")


VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 3, 10**400, -(10**400), 2**63, 1.5, float("nan"), float("inf"), 1e308, 1j, "", "x",
    "\ud800", "a" * 5000, "a\0b", b"x", [], [1, [2, 3]], [[1, 2], [3]], [None], ["x", "y"], (), (1,),
    (1, 2, 3, 4, 5), (10**400, 10**400), {}, {"a": 1}, {1, 2}, object(), print, range(3), np.array(3),
    np.zeros((0, 4)),
    np.zeros((2, 3)), np.zeros((2, 4)), np.full((2, 4), np.nan), np.array([[5, 5, 1, 1]]), np.array(["x"]),
    np.array([object()]), np.zeros((5, 5, 3)), np.zeros((5, 5), np.uint8), np.zeros((5, 5, 3), np.uint8),
    np.zeros((70, 70, 3), np.int64), np.zeros((64, 64, 4), np.uint8), np.zeros((2, 64, 64, 3), np.uint8),
    [[10**400, 0, 1, 1]], [(0, 0, 1, 1), "x"], Path("missing"), np.float32(2), np.int8(-5),
    np.datetime64("now"),
)  # fmt: skip
"""Values of every kind for any argument."""


def argument_cases(folder: Path, rng: random.Random) -> Iterator[Case]:
    """Every argument of public functions and classes with every value, all others being valid."""
    for name, (function, base) in _functions(folder).items():
        for argument, (number, value) in itertools.product(base, enumerate(VALUES)):
            shown = repr(value)[:60]
            yield (
                f"{name}({argument}=VALUES[{number}]={shown})",
                partial(function, **{**base, argument: value}),
            )


def _functions(folder: Path) -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    """Public functions with valid arguments."""
    image = vd.render_scene(shape=(96, 128), vehicles=1, random_state=0).image
    boxes, scores = np.array([[1, 2, 30, 40], [5, 6, 50, 60]]), np.array([1.0, 0.5])
    heat = np.zeros((96, 128), np.float32)
    patches, labels = vd.render_patches(20)
    small = vd.FeatureParams(hog_channel=0, spatial_feat=False, hist_feat=False, orient=4)
    classifier = vd.train_classifier(patches, labels, params=small)
    frame_boxes = vd.FrameBoxes([0, 1], np.array([1, 1]), boxes)
    predicted = vd.FrameBoxes([0, 1], np.array([1, 1]), boxes, scores=scores)
    camera = vd.Camera(focal_px=500.0, horizon_px=40.0)
    windows = vd.Detections(boxes, scores)
    rows = [(0, 1, 10, 20, 30, 40, 1.5)]
    patch_set = vd.PatchSet(patches, labels, tuple(f"a/{n}.png" for n in range(20)))
    detector = vd.VehicleDetector(classifier)
    tracker = vd.Tracker()
    band = {"window": (64, 64), "y": (0.0, 256.0), "x": (0.0, 1.0), "overlap": (0.5, 0.5)}

    def options(kind: Any, **given: Any) -> dict[str, Any]:
        import inspect

        defaults = inspect.signature(kind).parameters.items()
        return {k: p.default for k, p in defaults if p.default is not p.empty} | given

    return {
        "Camera": (vd.Camera, options(vd.Camera, focal_px=500.0, horizon_px=40.0)),
        "Detections": (vd.Detections, {"boxes": boxes, "scores": scores}),
        "FeatureParams": (vd.FeatureParams, options(vd.FeatureParams)),
        "HeatParams": (vd.HeatParams, options(vd.HeatParams)),
        "RegionParams": (vd.RegionParams, options(vd.RegionParams)),
        "PyramidParams": (vd.PyramidParams, options(vd.PyramidParams)),
        "FunctionParams": (vd.FunctionParams, options(vd.FunctionParams)),
        "TrackParams": (vd.TrackParams, options(vd.TrackParams)),
        "MixtureParams": (vd.MixtureParams, options(vd.MixtureParams)),
        "SearchBand": (vd.SearchBand, band),
        "SearchParams": (vd.SearchParams, options(vd.SearchParams, bands=(vd.SearchBand(**band),))),
        "HeatHistory": (vd.HeatHistory, {"frames": 3}),
        "Tracker": (vd.Tracker, {"params": None, "fps": 25.0, "camera": None}),
        "Tracker.update": (tracker.update, {"detections": windows, "shape": (96, 128), "time": None,
                                             "frames": 1}),
        "FrameBoxes": (vd.FrameBoxes, {"frames": [0, 1], "tracks": np.array([1, 1]), "boxes": boxes,
                                       "scores": scores, "ignore": None}),
        "PatchSet": (vd.PatchSet, {"patches": patches, "labels": labels, "names": patch_set.names}),
        "VehicleDetector": (vd.VehicleDetector, options(vd.VehicleDetector, model=classifier)),
        "VehicleDetector.detect": (detector.detect, {"image": image}),
        "VehicleClassifier.predict": (classifier.predict, {"X": patches}),
        "VehicleClassifier.score": (classifier.score, {"X": patches, "y": labels}),
        "LabelledFrames": (vd.LabelledFrames, {"name": "a", "frames": [image, image], "labels": frame_boxes,
                                               "horizon": None}),
        "TrackWriter": (vd.TrackWriter, {"path": folder / "t.csv", "format": None}),
        "ReportWriter": (vd.ReportWriter, options(vd.ReportWriter, path=folder / "r.html")),
        "add_heat": (lambda **given: vd.add_heat(heat.copy(), **given), {"boxes": boxes, "scores": scores}),
        "apply_threshold": (vd.apply_threshold, {"heatmap": heat, "threshold": 1.0}),
        "bin_spatial": (vd.bin_spatial, {"img": image, "size": 16, "order": "channels"}),
        "bounding_boxes": (vd.bounding_boxes, {"shape": (96, 128), "windows": windows, "params": None}),
        "calibrate_scores": (vd.calibrate_scores, {"scores": scores, "labels": [1, 0], "prior": True}),
        "calibration_error": (vd.calibration_error, {"probabilities": [0.2, 0.5], "labels": [0, 1],
                                                     "bins": 5}),
        "clip_boxes": (vd.clip_boxes, {"boxes": boxes, "shape": (96, 128)}),
        "color_hist": (vd.color_hist, {"img": image, "nbins": 32}),
        "convert_color": (vd.convert_color, {"image": image, "color_space": "LAB"}),
        "draw_boxes": (vd.draw_boxes, {"image": image, "boxes": boxes, "color": (0, 0, 255), "thickness": 2}),
        "draw_labeled_bboxes": (vd.draw_labeled_bboxes, {"image": image,
                                                         "labels": (heat.astype(np.int32), 0)}),
        "draw_tracks": (vd.draw_tracks, {"image": image, "tracks": [], "labels": ("id",),
                                         "line_width": None, "color_by": "id"}),
        "estimate_horizon": (vd.estimate_horizon, {"boxes": boxes, "shape": (96, 128)}),
        "evaluate_detections": (vd.evaluate_detections, {"predictions": predicted, "labels": frame_boxes,
                                                         "iou": 0.5, "frames": None}),
        "evaluate_tracks": (vd.evaluate_tracks, {"predictions": predicted, "labels": frame_boxes, "iou": 0.5,
                                                 "frames": None}),
        "extract_features": (vd.extract_features, {"source": patches, "params": small, "n_jobs": 1}),
        "find_cars": (vd.find_cars, {"image": image, "classifier": classifier, "params": None, "n_jobs": 1}),
        "find_near_duplicates": (vd.find_near_duplicates, {"patches": patches, "threshold": 0.9}),
        "find_vehicles": (vd.find_vehicles, {"windows": windows, "camera": camera, "shape": (96, 128)}),
        "get_hog_features": (vd.get_hog_features, {"img": image[..., 0], "orient": 9, "pix_per_cell": 8,
                                                   "cell_per_block": 2, "transform_sqrt": False}),
        "hog_image": (vd.hog_image, {"img": image[..., 0], "orient": 9, "pix_per_cell": 8}),
        "iou_matrix": (vd.iou_matrix, {"first": boxes, "second": boxes}),
        "label_boxes": (vd.label_boxes, {"heatmap": heat, "threshold": 0.0, "peak_fraction": 0.0}),
        "load_classifier": (vd.load_classifier, {"path": "highway"}),
        "load_frames": (vd.load_frames, {"folder": folder}),
        "load_model": (vd.load_model, {"path": "highway"}),
        "load_patches": (vd.load_patches, {"source": folder, "label": 1, "size": 64, "n_jobs": 1}),
        "non_max_suppression": (vd.non_max_suppression, {"boxes": boxes, "scores": scores, "threshold": 0.5}),
        "precision_recall_curve": (vd.precision_recall_curve, {"predictions": predicted,
                                                               "labels": frame_boxes, "iou": 0.5}),
        "probe_video": (vd.probe_video, {"path": folder / "missing.mp4"}),
        "process_video": (vd.process_video, {"source": folder / "missing.mp4", "target": folder / "o.mp4",
                                             "detector": detector, "start": None, "end": None}),
        "read_frames": (vd.read_frames, {"source": folder / "missing.mp4", "start": None, "end": None}),
        "read_image": (vd.read_image, {"path": folder / "missing.png"}),
        "read_labels": (vd.read_labels, {"path": folder / "missing.csv", "format": None, "classes": None,
                                         "shape": None, "truth": None}),
        "read_results": (vd.read_results, {"path": folder / "missing.csv"}),
        "render_patches": (vd.render_patches, {"n": 2, "random_state": 0}),
        "render_scene": (vd.render_scene, {"shape": (64, 64), "vehicles": 1, "horizon": 0.5, "light": "day",
                                           "rain": 0.0, "jpeg_quality": None, "random_state": 0}),
        "search_windows": (vd.search_windows, {"image": image, "windows": boxes, "classifier": classifier,
                                               "border": "window", "min_score": 0.0, "n_jobs": 1}),
        "single_img_features": (vd.single_img_features, {"image": patches[0], "params": small}),
        "slide_window": (vd.slide_window, {"image": image, "x_start_stop": (None, None),
                                           "y_start_stop": (None, None), "xy_window": (64, 64),
                                           "xy_overlap": (0.5, 0.5)}),
        "split_random": (vd.split_random, {"patches_or_labels": labels, "test_size": 0.2, "random_state": 0}),
        "split_sequences": (vd.split_sequences, {"patch_set": patch_set, "test_size": 0.2}),
        "split_groups": (vd.split_groups, {"patch_set": patch_set, "test_size": 0.2, "threshold": 0.9}),
        "train_classifier": (vd.train_classifier, {"patches": patches[:4], "labels": labels[:4],
                                                   "params": small, "C": 1e-4, "gamma": 0.0,
                                                   "random_state": 0, "n_jobs": 1}),
        "write_boxes": (vd.write_boxes, {"boxes": [("a.png", windows)], "path": folder / "b.csv"}),
        "write_image": (vd.write_image, {"path": folder / "i.png", "image": image}),
        "write_labels": (vd.write_labels, {"labels": frame_boxes, "path": folder / "l.csv", "shape": None}),
        "write_tracks": (vd.write_tracks, {"results": rows, "path": folder / "w.csv", "shape": None}),
    }  # fmt: skip


KINDS: dict[str, Callable[[Path, random.Random], Iterator[Case]]] = {
    "arguments": argument_cases,
    "images": image_cases,
    "labels": label_cases,
    "models": model_cases,
    "archives": archive_cases,
    "videos": video_cases,
}
"""Source of the inputs of each kind."""


def fuzz(
    kind: str, *, seed: int = 0, first: int = 0, count: int | None = None, seconds: float | None = None
) -> tuple[int, int, list[str]]:
    """Try inputs of a kind; return the numbers of inputs and of own errors, and what went wrong.

    Wrong are errors of other classes, and files outside the folder of the inputs.
    """
    tried = refused = 0
    problems: list[str] = []
    deadline = None if seconds is None else time.monotonic() + seconds
    with tempfile.TemporaryDirectory(prefix="fuzz.") as outer, contextlib.chdir(outer):
        folder = Path(outer) / "in"
        folder.mkdir()
        cases = KINDS[kind](folder, random.Random(seed))
        stop = None if count is None else first + count
        for number, (name, call) in enumerate(itertools.islice(cases, stop)):
            if number < first:
                continue
            if deadline is not None and time.monotonic() > deadline:
                break
            tried += 1
            try:
                with np.errstate(all="ignore"), _quiet():
                    result = call()
                    del result
            except VehicleDetectionError:
                refused += 1
            except BaseException as error:
                text = " ".join(f"{type(error).__name__}: {error}".split())[:150]
                problems.append(f"{kind} seed {seed} number {number}: {name}: {text}")
                if isinstance(error, KeyboardInterrupt):
                    break
            written = {path.name for path in Path(outer).iterdir()} - {"in"}
            if written:
                problems.append(f"{kind} seed {seed} number {number}: {name}: wrote {written}")
                for path in written:
                    with contextlib.suppress(OSError):
                        (Path(outer) / path).unlink()
    return tried, refused, problems


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seconds", type=float, default=60.0, help="time for all kinds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--count", type=int, help="number of inputs of each kind")
    options = parser.parse_args()
    failed = False
    for kind in options.kinds:
        seconds = options.seconds / len(options.kinds)
        tried, refused, problems = fuzz(
            kind, seed=options.seed, first=options.first, count=options.count, seconds=seconds
        )
        print(f"{kind}: {tried} inputs, {refused} refused, {len(problems)} problems", flush=True)
        for problem in problems:
            print(f"  {problem}")
        failed |= bool(problems)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"largest memory: {peak:.2f} GB (limit {MAX_MEMORY_GB:g})")
    sys.exit(failed or peak > MAX_MEMORY_GB)


if __name__ == "__main__":
    main()
