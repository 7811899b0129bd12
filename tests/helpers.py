"""Helpers shared by the tests."""

import contextlib
import errno
import functools
import http.server
import signal
import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from tests.network.graphs import own_network
from vehicle_detection import LabelledFrames, TrackTable, clip_boxes, write_image
from vehicle_detection.network import load_network
from vehicle_detection.scenes import render_patches, render_scene
from vehicle_detection.svm import Template, VehicleClassifier

ROOT = Path(__file__).parents[1]
"""Root of the repository."""


def start_interruptible(*command, **options):
    """Start a program that SIGINT and SIGHUP interrupt, even if pytest is a background job or under nohup."""
    before = {each: signal.signal(each, signal.SIG_DFL) for each in (signal.SIGINT, signal.SIGHUP)}
    try:
        return subprocess.Popen(
            [str(word) for word in command],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            **options,
        )
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def wait_until(condition, seconds=60):
    """Wait until a condition holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def failing(error):
    """Make a function that raises an error, whatever its arguments."""

    def fail(*_, **__):
        raise error

    return fail


FULL_DISK = failing(OSError(errno.ENOSPC, "No space left on device"))


@contextlib.contextmanager
def serve(handle):
    """Serve HTTP requests on the loopback interface by a function of the request; yield the address."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            with contextlib.suppress(ConnectionError):
                handle(self)

        do_HEAD = do_GET  # noqa: N815

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


def answer(request, status, body=b"", headers=()):
    """Answer an HTTP request."""
    request.send_response(status)
    for name, value in {"Content-Length": len(body), **dict(headers)}.items():
        request.send_header(name, str(value))
    request.end_headers()
    request.wfile.write(body)


def _random_template(params, seed, bias):
    """A template whose scores are of the order of one, on features of the usual sizes."""
    rng = np.random.default_rng(seed)
    hist = (params.hist_length, 8, 8) if params.hist_sqrt else (params.hist_length, 128, 100)
    parts = ((params.spatial_length, 128, 60), hist, (params.hog_length, 0.1, 0.1))
    mean = np.concatenate([np.full(count, mean) for count, mean, _ in parts])
    scale = np.concatenate([scale * rng.uniform(0.5, 2, count) for count, _, scale in parts])
    coef = rng.normal(0, params.length**-0.5, params.length)
    return Template(mean, scale, coef, bias)


def random_classifier(params, seed=0, *, templates=1, bias=0.0):
    """A classifier that was never trained: its scores are as good as any for comparing two searches."""
    return VehicleClassifier(
        params, tuple(_random_template(params, seed + index, bias) for index in range(templates))
    )


def write_network(path, seed=0):
    """Write a network that was never trained; some of its boxes score above 0."""
    Path(path).write_bytes(own_network(seed))


def random_network(seed=0):
    """A network that was never trained."""
    with tempfile.TemporaryDirectory() as folder:
        write_network(f"{folder}/random.onnx", seed)
        return load_network(f"{folder}/random.onnx")


@functools.cache
def _all_patches():
    return render_patches(160, random_state=7)


def rendered_patches(count):
    """Return patches and labels, vehicles first: the same ones in all tests, rendered once."""
    patches, labels = _all_patches()
    rows = np.r_[: (count + 1) // 2, 80 : 80 + count // 2]
    return patches[rows], labels[rows]


@functools.cache
def scene_of(seed):
    return render_scene(shape=(200, 356), focal_px=420, vehicles=3, random_state=seed)


def drawn(seeds, name="road"):
    """Rendered scenes with the boxes of their vehicles; narrow or largely occluded ones are ignored."""
    scenes = [scene_of(seed) for seed in seeds]
    keys, boxes, ignore = [], [], []
    for key, scene in enumerate(scenes):
        for vehicle in scene.truth:
            x1, _, x2, _ = vehicle.box
            keys.append(key)
            boxes.append(vehicle.box)
            ignore.append(bool(x2 - x1 < 28 or vehicle.occluded_fraction > 0.4 or vehicle.truncated > 0.4))
    return LabelledFrames(
        name, [scene.image for scene in scenes], TrackTable(keys, None, boxes, ignore=ignore)
    )


def check_truth(scene):
    """Assert that the ground truth of a drawn scene is consistent with itself and with the image."""
    height, width = scene.image.shape[:2]
    for row in scene.truth:
        x1, y1, x2, y2 = row.box
        assert 0 <= x1 < x2 <= width
        assert 0 <= y1 < y2 <= height
        full = row.full_box
        assert full[0] <= x1
        assert full[1] <= y1
        assert full[2] >= x2
        assert full[3] >= y2
        np.testing.assert_allclose(clip_boxes([full], (height, width))[0], row.box, atol=1.0)
        assert 0 <= row.truncated < 1
        assert 0 <= row.occluded_fraction <= 1
        assert row.occluded == (2 if row.occluded_fraction > 0.5 else int(row.occluded_fraction >= 0.1))
        assert row.ignore >= (row.occluded == 2 or x2 - x1 < 40 or row.truncated > 0.7)
        pixels = np.argwhere(scene.instance_map == row.track)
        if row.occluded_fraction == 0:
            # Nothing hides the vehicle, so its visible pixels span its box exactly.
            assert (*pixels.min(0)[::-1], *(pixels.max(0)[::-1] + 1)) == row.box
        elif len(pixels):
            assert (pixels.min(0)[::-1] >= [x1, y1]).all()
            assert (pixels.max(0)[::-1] < [x2, y2]).all()


def write_frame_set(folder, name, frames, *, place="frames"):
    """Write drawn frames and their labels as a set of a data folder."""
    target = folder / place / name
    target.mkdir(parents=True)
    (folder / "labels").mkdir(exist_ok=True)
    lines = ["frame,track,x1,y1,x2,y2,occluded,truncated,ignore"]
    for key, image in frames:
        write_image(target / f"{key:03d}.png", image)
        part = frames.labels.frame(key)
        for box, ignore in zip(part.boxes.tolist(), part["ignore"].tolist()):
            lines.append(f"{key:03d}.png,-1,{','.join(map(str, box))},0,0,{int(ignore)}")
    (folder / "labels" / f"{name}.csv").write_text("\n".join(lines) + "\n")


def find_red(image):
    """A detector of red pixels: the box around all of them, with the probability 0.9."""
    rows, columns = np.nonzero((image[..., 0] > 180) & (image[..., 1] < 90))
    if not len(rows):
        return [], []
    return [[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]], [0.9]


SHAPE = (720, 1280)


def boxes_on_a_road(horizon, camera_height, count=40, seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    width = rng.uniform(30, 200, count)
    foot = horizon * SHAPE[0] + width * camera_height / 1.8 + rng.normal(0, noise, count) * width
    center = rng.uniform(300, 980, count)
    return np.stack([center - width / 2, foot - width * 1.5 / 1.8, center + width / 2, foot], axis=1)


@dataclass(frozen=True)
class Result:
    index: int
    brightness: float
    time: float
    tracks: tuple = ()
    frame: object = None
    seconds: dict = field(default_factory=lambda: {"search": 0.0, "heat": 0.001, "track": 0.002})


TENTATIVE = SimpleNamespace(id=0, shown=False)


class StubDetector:
    """Stands in for the detector: the brightness of a frame is what it finds."""

    def __init__(self, *, pause=0.0):
        self.index, self.pause, self.fps = 0, pause, None
        self.shapes = set()
        self.annotator = self

    def reset(self, *, fps):
        self.index, self.fps = 0, fps

    def search(self, frame):
        self.shapes.add(frame.shape)
        if self.pause:  # the later a frame, the sooner it is done: the order is not for free
            time.sleep(self.pause / (1 + self.index))
        return float(frame.mean())

    def track(self, found, *, time, frames, cut):
        confirmed = SimpleNamespace(id=1 + self.index // 6, shown=True)
        self.index += frames if self.index else 1
        return Result(self.index - 1, found, time, (confirmed, TENTATIVE))

    def output_shape(self, shape):
        return shape

    def draw(self, frame, result):
        drawn = frame.copy()
        drawn[:6, :6] = 255
        return drawn

    def __call__(self, frame):
        return self.draw(frame, self.track(self.search(frame), time=None, frames=1, cut=False))
