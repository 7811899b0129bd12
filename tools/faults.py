"""Interrupt, damage and deceive runs: no earlier file may be lost, and no broken one may appear.

``python -m tools.faults --trials 500`` writes videos and results of batches in child processes that are
killed, whose disk is full, whose ffmpeg is another program, or whose results folder holds links and pipes of
somebody else. Afterwards, a video is the old one or a complete new one, records and their outputs are whole,
and files outside are as they were. The source of the library must not change during a run.
"""

from __future__ import annotations

import argparse
import importlib
import json
import logging
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import vehicle_detection as vd
from vehicle_detection.cli.demo import draw_clip
from vehicle_detection.drive import batch_status
from vehicle_detection.video import ffmpeg

FRAMES = 20
_TIMEOUT = 90.0
_SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
# A program in place of ffmpeg, which passes on what it does not falsify: an encoder has a pipe as its input.
_FAKE = """#!/bin/sh
case "$*" in
  *rawvideo*pipe:0*|*"-i pipe:0"*|*"-i -"*) for target in "$@"; do :; done
{action};;
esac
exec {program} "$@"
"""
_ACTIONS = {
    "nothing": "cat > /dev/null; exit 0",
    "nothing at once": "exit 0",
    "garbage": 'cat > /dev/null; head -c 3000 /dev/urandom > "${target#file:}"; exit 0',
    "an empty file": 'cat > /dev/null; : > "${target#file:}"; exit 0',
    "half of the frames": 'head -c 700000 | {program} "$@"; cat > /dev/null; exit 0',
    "a failure": '{program} "$@"; exit 3',
    "a crash": "head -c 100000 > /dev/null; kill -SEGV $$",
}


class Place:
    """A folder of a trial: a source, a good earlier video and a file outside the results."""

    def __init__(self, folder: Path, samples: Path) -> None:
        shutil.copytree(samples, folder)
        self.folder, self.source = folder, folder / "card" / "20260131_081500_F.mp4"
        self.model, self.target, self.results = (
            folder / "model.safetensors",
            folder / "out.mp4",
            folder / "results",
        )
        self.victims = {path: path.read_bytes() for path in (folder / "victim", self.source, self.model)}
        self.old = self.target.read_bytes()
        self.obstructed: Path | None = None  # a place that somebody else has changed

    def write_video(self) -> None:
        """Write a video over the earlier one."""
        vd.process_video(self.source, self.target, vd.VehicleDetector(vd.load_model(self.model)), every=4)

    def run_batch(self) -> None:
        """Process the card into the results folder."""
        with ThreadPoolExecutor(1) as executor:
            vd.run_batch([self.folder / "card"], self.results, executor, model=self.model, progress=False)

    def problems(self) -> list[str]:
        """List what was lost or is broken."""
        found = [
            f"{path.name} was changed" for path, data in self.victims.items() if path.read_bytes() != data
        ]
        if not self.target.is_file():
            found.append("the earlier video is lost")
        elif self.target.read_bytes() != self.old and _count(self.target) != FRAMES:
            found.append("the video is neither the earlier nor a complete one")
        for record in (self.results / "records").glob("[!.]*.json"):
            if record == self.obstructed:  # it holds what somebody else has written
                continue
            if record.is_file() and not record.is_symlink() and record.stat().st_nlink == 1:
                values = json.loads(record.read_text() or "null")
                found += [] if isinstance(values, dict) else [f"{record.name} is incomplete"]
                for path in (values or {}).get("outputs", {}).values():
                    file = self.results / path
                    if self.obstructed is not None and self.obstructed in (file, record, *file.parents):
                        continue
                    whole = file.is_file() and (file.suffix != ".mp4" or _count(file) == FRAMES)
                    found += (
                        [] if whole else [f"{path} is missing or incomplete, but its record says it is done"]
                    )
        return found


def _count(video: Path) -> int:
    """Count the frames that ffmpeg decodes; this process starts no threads, as it is forked."""
    options = [ffmpeg.ffmpeg_binary(), "-v", "info", "-i", str(video), "-map", "0:v", "-f", "null", "-"]
    log = subprocess.run(options, capture_output=True, text=True, check=False).stderr
    return int(re.findall(r"frame= *(\d+)", log)[-1]) if "frame=" in log else -1


def _child(
    call: Callable[[], object], prepare: Callable[[], object], kill: tuple[int, float] | None
) -> int | None:
    """Call a function in a forked process, perhaps kill it; return its status, None if it hung."""
    process = os.fork()
    if not process:
        logging.disable()
        os.setpgid(0, 0)
        with open(os.devnull, "w") as silent:
            os.dup2(silent.fileno(), 2)
        code = 0
        try:
            prepare()
            call()
        except vd.VehicleDetectionError:
            code = 2
        except BaseException as error:
            code = 2 if isinstance(error, (KeyboardInterrupt, SystemExit)) else 9
        finally:
            os._exit(code)
    if kill is not None:
        time.sleep(kill[1])
        os.kill(process, kill[0])
    end = time.monotonic() + _TIMEOUT
    while time.monotonic() < end:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return status
        time.sleep(0.01)
    os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return None


def _obstruct(place: Place, rng: random.Random) -> str:
    """Put a link, a hard link, a pipe or another file where the results of a batch are."""
    files = [path for path in place.results.rglob("*") if path.is_file()]
    path, kind = (
        rng.choice(files),
        rng.choice(("link", "hard link", "pipe", "folder link", "text", "outputs")),
    )
    victim, place.obstructed = place.folder / "victim", path
    if kind == "outputs":
        record = place.obstructed = next((place.results / "records").glob("*.json"))
        wrong = rng.choice(("../victim", str(victim), "tracks/../../victim", "tracks/\0", ""))
        record.write_text(json.dumps(json.loads(record.read_text()) | {"outputs": {"tracks": wrong}}))
        place.source.touch()
        return f"outputs {wrong!r}"
    if kind == "folder link":
        path = place.obstructed = path.parent
        shutil.rmtree(path)
        path.symlink_to(place.folder, target_is_directory=True)
        return f"link {path.name}"
    path.unlink()
    if kind == "link":
        path.symlink_to(victim)
    elif kind == "hard link":
        path.hardlink_to(victim)
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.write_text("notes")
    return f"{kind} {path.relative_to(place.results)}"


def trial(place: Place, rng: random.Random) -> tuple[str, list[str]]:
    """Make one trial; return what was done, and the problems."""
    call = rng.choice((place.write_video, place.run_batch))
    ignore = rng.random() < 0.4
    prepare: Callable[[], object] = partial(signal.signal, signal.SIGCHLD, signal.SIG_IGN) if ignore else int
    note, kill = f"{call.__name__}{', SIGCHLD ignored' if ignore else ''}: ", None
    match rng.choice(("kill", "full disk", "fake ffmpeg", "links")):
        case "kill":
            kill = rng.choice(_SIGNALS), rng.random() * 1.5
            note += f"{signal.Signals(kill[0]).name} after {kill[1]:.2f} s"
        case "full disk":
            size = rng.randrange(1, 60_000)
            prepare = _in_turn(prepare, partial(resource.setrlimit, resource.RLIMIT_FSIZE, (size, size)))
            note += f"files of at most {size} bytes"
        case "fake ffmpeg":
            name, action = rng.choice(list(_ACTIONS.items()))
            program, fake = ffmpeg.ffmpeg_binary(), place.folder / "ffmpeg"
            fake.write_text(_FAKE.replace("{action}", action).replace("{program}", program))
            fake.chmod(0o755)
            prepare = _in_turn(prepare, partial(os.environ.update, FFMPEG_BINARY=str(fake)))
            note += f"ffmpeg writes {name}"
        case _:
            call = place.run_batch
            note = f"run_batch: {_obstruct(place, rng)}"
    status = _child(call, prepare, kill)
    problems = place.problems()
    if status is None:
        problems.append("it hung")
    elif os.WIFEXITED(status) and os.WEXITSTATUS(status) == 9:
        problems.append("an error of another class")
    return note, problems


def _in_turn(*steps: Callable[[], object]) -> Callable[[], object]:
    return lambda: [step() for step in steps]


def prepare_samples(folder: Path) -> None:
    """Write the source, a model, an earlier video and earlier results."""
    (folder / "card").mkdir(parents=True)
    source = folder / "card" / "20260131_081500_F.mp4"
    draw_clip(vd.render_drive(frames=FRAMES, shape=(90, 160), random_state=0), source, folder / "labels.csv")
    patches, labels = vd.render_patches(20)
    small = vd.FeatureParams(hog_channel=0, spatial_feat=False, hist_feat=False, orient=4)
    vd.train_classifier(patches, labels, params=small).save(folder / "model.safetensors")
    (folder / "victim").write_text("precious")
    shutil.copy(source, folder / "out.mp4")
    with (folder / "out.mp4").open("ab") as file:  # so that the earlier video differs from a new one
        file.write(b"\0\0\0\x08free")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=1e9, help="limit of time")
    parser.add_argument("--samples", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    logging.disable()
    if options.samples is not None:
        prepare_samples(options.samples)
        return
    failed = made = 0
    for name in ("numba", "pyarrow.parquet", "scipy.ndimage", "vehicle_detection.detector"):
        importlib.import_module(name)  # once for all children
    end = time.monotonic() + options.seconds
    with tempfile.TemporaryDirectory(prefix="faults.") as outer:
        samples = Path(outer) / "samples"
        # In another process: threads do not survive a fork.
        subprocess.run([sys.executable, "-m", "tools.faults", "--samples", samples], check=True)
        _child(Place(Path(outer) / "first", samples).run_batch, int, None)
        shutil.copytree(Path(outer) / "first" / "results", samples / "results")
        print(f"earlier results: {batch_status(samples / 'results')}")
        for number in range(options.trials):
            if time.monotonic() > end:
                break
            rng = random.Random(f"{options.seed} {number}")
            place = Place(Path(outer) / "trial", samples)
            note, problems = trial(place, rng)
            shutil.rmtree(place.folder)
            made, failed = made + 1, failed + bool(problems)
            if problems:
                print(f"trial {number}: {note}: {'; '.join(problems)}", flush=True)
    print(f"{made} trials, {failed} with problems")
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
