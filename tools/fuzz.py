"""Feed random and damaged files to the library: only its own errors may come back.

``python -m tools.fuzz --seconds 600`` is a long run; the tests run a small, fixed part. Kind, seed and number
reproduce an input: ``python -m tools.fuzz --kinds images --seed 3 --first 17 --count 1``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import logging
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
from tools import bad_input
from tools.tool_files import tool_cases
from vehicle_detection._common import write_model
from vehicle_detection.errors import VehicleDetectionError

MAX_MEMORY_GB = 4.0
"""Limit of the process's memory in a long run."""

SHORT = {"images": 300, "labels": 300, "models": 150, "archives": 60, "videos": 12, "tools": 300}
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
                file, rng.choice(("patches", "patches", "other")), params, tensors, {"a": rng.choice(odd)}
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
        yield "archive", partial(vd.load_patches, file, label=1, jobs=1)


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


KINDS: dict[str, Callable[[Path, random.Random], Iterator[Case]]] = {
    "images": image_cases,
    "labels": label_cases,
    "models": model_cases,
    "archives": archive_cases,
    "videos": video_cases,
    "tools": tool_cases,
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
            error = bad_input.call_quietly(call)
            if isinstance(error, VehicleDetectionError):
                refused += 1
            elif error is not None:
                text = " ".join(f"{type(error).__name__}: {error}".split())[:150]
                problems.append(f"{kind} seed {seed} number {number}: {name}: {text}")
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
    logging.disable(logging.WARNING)  # such as of damaged frames
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
