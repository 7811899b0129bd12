"""Rendered frames with ground truth, as an additional data set to train on."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check
from vehicle_detection.evaluation import LabelledFrames
from vehicle_detection.scenes import Drive, Scene, SceneVehicle, VehicleTruth, render_drive, render_scene
from vehicle_detection.tables import FrameKey, TrackTable
from vehicle_detection.training import FrameDataset

Rng = np.random.Generator

# Options of `render_drive`; "truncated" chooses frames in which the border truncates a vehicle.
_DRIVES: tuple[dict[str, Any], ...] = (
    {}, {"scenario": "passing", "truncated": True}, {"scenario": "occlusion"}, {"light": "night"},
    {"scenario": "overtaking", "truncated": True}, {"light": "dusk"}, {"scenario": "closing"},
    {"scenario": "passing", "light": "dusk", "truncated": True}, {"rain": 0.6}, {"scenario": "crossing"},
    {"scenario": "cut_in", "light": "overcast"}, {"light": "overcast", "shape": (720, 1280)},
    {"scenario": "passing", "light": "night", "truncated": True}, {"scenario": "empty"},
    {"light": "night", "rain": 0.6}, {"scenario": "occlusion", "shape": (720, 1280)},
    {"scenario": "overtaking", "light": "night", "truncated": True}, {"scenario": "empty", "light": "night"},
)  # fmt: skip

_DRIVE_FRAMES = 200
# Frames from one drive, and single scenes after it: the frames of a drive share scenery and vehicles.
_PER_DRIVE, _SCENES = 4, 2
# Smallest fraction of a truncated vehicle outside the frame; one frame in so many is searched for one.
_MIN_TRUNCATED, _STEP = 0.2, 5

_SHAPES = ((360, 640), (360, 640), (480, 640), (720, 1280))
_LIGHTS = {"day": 0.4, "overcast": 0.2, "dusk": 0.2, "night": 0.2}
_KINDS = {
    "hatchback": 0.14,
    "estate": 0.1,
    "sedan": 0.16,
    "mpv": 0.1,
    "suv": 0.14,
    "van": 0.18,
    "truck": 0.18,
}
_LANE = 3.6  # width (m)
_LANES = 3
# Fraction of the frame's longer side: narrower vehicles are ignored (20 px of 640).
_MIN_WIDTH = 1 / 32


def rendered_source(*, frames: int = 300, random_state: int = 0) -> FrameDataset:
    """Render frames of different roads, cameras, lights and weather, with their vehicles as labels.

    Frames of drives and single scenes take turns. The scenes add what the traffic of the drives lacks:
    trucks, many vans, vehicles seen from the front, vehicles at the shoulder, and vehicles close beside the
    camera, of which the frame shows the side and cuts a part. A vehicle is ignored if it is largely occluded,
    truncated by more than 0.7, or narrower than 1/32 of the frame's longer side.

    >>> rendered_source(frames=2).sets
    (LabelledFrames('rendered', 2 frames, 14 boxes),)
    """
    count = check.integer(frames, "frames", low=1)
    seed = check.integer(random_state, "random_state", low=0, high=2**32 - 1)
    scenes = dict(enumerate(itertools.islice(_scenes(seed), count)))
    images: dict[FrameKey, NDArray[np.uint8]] = {key: scene.image for key, scene in scenes.items()}
    rows = [(key, scene, row) for key, scene in scenes.items() for row in scene.truth]
    labels = TrackTable(
        [key for key, _, _ in rows],
        np.array([row.track for _, _, row in rows], np.intp),
        np.array([row.box for _, _, row in rows], np.float64).reshape(-1, 4),
        occluded=np.array([row.occluded for _, _, row in rows], np.intp),
        truncated=np.array([row.truncated for _, _, row in rows], np.float64),
        ignore=np.array([_is_ignored(row, scene) for _, scene, row in rows], np.bool_),
        frame_keys=list(scenes),
    )
    return FrameDataset("rendered", (LabelledFrames("rendered", images, labels),))


def _scenes(seed: int) -> Iterator[Scene]:
    """Yield scenes without end: some of a drive, then single ones."""
    for number, case in enumerate(itertools.cycle(_DRIVES)):
        # A seed of two numbers differs from every seed of one number that a user may pass to the renderer.
        rng = np.random.default_rng([seed, number])
        yield from _scenes_of_drive(case, rng)
        for _ in range(_SCENES):
            yield _single_scene(rng)


def _scenes_of_drive(case: dict[str, Any], rng: Rng) -> Iterator[Scene]:
    options = {"shape": (360, 640)} | {name: value for name, value in case.items() if name != "truncated"}
    drive = render_drive(frames=_DRIVE_FRAMES, random_state=rng, **options)
    count = 1 if case.get("scenario") == "empty" else _PER_DRIVE
    chosen = np.linspace(0, len(drive) - 1, count + 2)[1:-1].astype(int).tolist()
    if case.get("truncated", False):
        chosen = sorted({_closest_truncation(drive, index) for index in chosen})
    yield from (drive[index] for index in chosen)


def _closest_truncation(drive: Drive, index: int) -> int:
    """Find the closest frame to `index` in which the border truncates a vehicle; `index` if there is none."""
    for other in sorted(range(index % _STEP, len(drive), _STEP), key=lambda other: abs(other - index)):
        if any(_MIN_TRUNCATED < row.truncated <= 0.7 and row.occluded < 2 for row in drive.truth_of(other)):
            return other
    return index


def _single_scene(rng: Rng) -> Scene:
    """Render a scene with a random camera, light and traffic."""
    height, width = _SHAPES[rng.integers(len(_SHAPES))]
    own = int(rng.integers(_LANES))
    return render_scene(
        shape=(height, width),
        vehicles=_traffic(own, rng),
        lane=own,
        horizon=float(rng.uniform(0.4, 0.62)),
        camera_height_m=float(rng.uniform(1.0, 2.4)),
        focal_px=float(rng.uniform(0.6, 1.1)) * width,
        light=_choose(_LIGHTS, rng),
        rain=float(rng.uniform(0.2, 0.8)) if rng.random() < 0.25 else 0.0,
        jpeg_quality=int(rng.integers(50, 96)) if rng.random() < 0.5 else None,
        random_state=rng,
    )


def _traffic(own: int, rng: Rng) -> list[SceneVehicle]:
    """Place up to seven vehicles without overlap in the lanes and at the shoulder."""
    vehicles = []
    for lane in range(_LANES + 1):  # the last one is the shoulder
        lateral = (lane - own) * _LANE
        distance = rng.uniform(5, 30) if lane == own else rng.uniform(2, 22)
        view = "front" if lane != own and rng.random() < 0.3 else "rear"
        for _ in range(rng.integers(3) if lane < _LANES else rng.integers(2)):
            kind = _choose(_KINDS, rng)
            vehicles.append(
                SceneVehicle(
                    distance_m=float(distance),
                    lateral_m=float(lateral + rng.uniform(-0.4, 0.4)),
                    kind=kind,
                    view=view,
                )
            )
            distance += (11 if kind == "truck" else 7) + rng.exponential(12)
    return vehicles


def _choose(weights: dict[str, float], rng: Rng) -> str:
    return str(rng.choice(list(weights), p=list(weights.values())))


def _is_ignored(row: VehicleTruth, scene: Scene) -> bool:
    narrow = row.box[2] - row.box[0] < _MIN_WIDTH * max(scene.image.shape[:2])
    return row.occluded == 2 or row.truncated > 0.7 or narrow
