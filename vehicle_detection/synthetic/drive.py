"""Drives: sequences of road scenes with moving vehicles and ground truth."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property

import numpy as np

from vehicle_detection._common import atomic_write, check_choice, check_integer, check_number
from vehicle_detection.synthetic.camera_light import SceneConfig
from vehicle_detection.synthetic.render import VehiclePose, VehicleTruth
from vehicle_detection.synthetic.scene import RandomState, Scene, SceneRenderer, make_config, make_generator
from vehicle_detection.synthetic.scenery import Road
from vehicle_detection.synthetic.traffic import SCENARIOS, TrafficVehicle, make_traffic
from vehicle_detection.synthetic.vehicles import VehicleBody

_SPEED = 27.0  # of the camera (m/s)

LABEL_COLUMNS = (
    "frame", "track", "x1", "y1", "x2", "y2", "occluded", "truncated", "ignore", "distance_m", "speed_mps",
)  # fmt: skip
"""Columns of a labels file; the first nine are those of manual labels."""


class Drive:
    """A drive whose frames are rendered on demand; `render_drive` creates one.

    ``drive[i]`` and iteration give `Scene` objects. Frames do not depend on each other, and none is kept.
    The attributes are `fps`, `shape` ``(height, width)`` and `scenario`, as given to `render_drive`.
    """

    def __init__(
        self, config: SceneConfig, road: Road, traffic: Sequence[TrafficVehicle], *, frames: int, fps: float,
        scenario: str,
    ) -> None:  # fmt: skip
        self.fps, self.shape, self.scenario = fps, config.shape, scenario
        self._frames, self._traffic = frames, tuple(traffic)
        self._renderer = SceneRenderer(config, road)
        self._bodies: dict[int, VehicleBody] = {}
        self._pitch_phases = np.random.default_rng([config.seed, 8]).uniform(0, 2 * np.pi, 3)

    def __len__(self) -> int:
        return self._frames

    def __getitem__(self, index: int) -> Scene:
        """Render frame `index`; a negative index counts from the end, a slice is an error."""
        frame = check_integer(index, "frame number", low=-self._frames, high=self._frames - 1) % self._frames
        return self._renderer.scene(*self._state(frame), frame)

    def __iter__(self) -> Iterator[Scene]:
        """Render one frame after the other."""
        return (self[index] for index in range(self._frames))

    @cached_property
    def truth(self) -> tuple[tuple[VehicleTruth, ...], ...]:
        """Ground truth of every frame, computed without rendering the images."""
        return tuple(self._renderer.truth(*self._state(frame)) for frame in range(self._frames))

    def _state(self, frame: int) -> tuple[list[VehiclePose], float, int]:
        """Poses of the vehicles that may be visible, distance traveled (m) and pitch offset (rows)."""
        time = frame / self.fps
        poses = [
            VehiclePose(
                self._body(vehicle), vehicle.track, vehicle.lateral(time), vehicle.distance(time),
                vehicle.relative_speed(time), vehicle.oncoming,
            )
            for vehicle in self._traffic
            if -12.0 < vehicle.distance(time) < 230.0
        ]  # fmt: skip
        waves = np.sin(2 * np.pi * frame / self.fps * np.array([1.3, 2.1, 3.7]) + self._pitch_phases)
        pitch_offset = int(np.rint(self._renderer.config.margin * float(waves @ (0.5, 0.3, 0.2))))
        return poses, _SPEED * time, pitch_offset

    def _body(self, vehicle: TrafficVehicle) -> VehicleBody:
        if vehicle.track not in self._bodies:
            light = self._renderer.config.light
            self._bodies[vehicle.track] = VehicleBody(
                vehicle.kind, vehicle.color, vehicle.view, light, vehicle.seed
            )
        return self._bodies[vehicle.track]

    def write_labels(self, path: str | os.PathLike[str]) -> None:
        """Write the ground truth of every frame as CSV; see `write_labels`."""
        write_labels(path, enumerate(self.truth))


def render_drive(
    *,
    frames: int = 250,
    fps: float = 25.0,
    shape: tuple[int, int] = (720, 1280),
    scenario: str = "highway",
    horizon: float = 0.56,
    camera_height_m: float = 1.3,
    focal_px: float | None = None,
    light: str = "day",
    rain: float = 0.0,
    pitch_jitter_px: int = 0,
    jpeg_quality: int | None = None,
    random_state: RandomState = 0,
) -> Drive:
    """Render a drive along a highway at 97 km/h, frame by frame.

    Parameters
    ----------
    frames, fps
        Number of frames, and frames per second.
    shape
        ``(height, width)`` in pixels.
    scenario
        ``"highway"``: vehicles ahead in three lanes, oncoming ones behind a barrier. ``"overtaking"``: a car
        enters at the left or right edge of the image and pulls away. ``"crossing"``: in the middle of the
        drive a car crosses two lanes in front of another. ``"occlusion"``: the same, closer and slower, so
        that the other car is hidden for about a second. ``"empty"``: no vehicles.
    horizon, camera_height_m, focal_px, light, rain, jpeg_quality
        As for `render_scene`.
    pitch_jitter_px
        Largest number of rows by which the pitch of the camera moves the horizon up or down.
    random_state
        Seed or generator; the same seed and options give the same bytes.

    Returns
    -------
    Drive
        ``len(drive)``, ``drive[i]`` and iteration; frames are rendered on demand and not kept.

    Raises
    ------
    InvalidInputError
        If an option is out of range.

    Examples
    --------
    >>> drive = render_drive(frames=50, shape=(180, 320), scenario="overtaking")
    >>> len(drive), drive[0].image.shape
    (50, (180, 320, 3))
    >>> distances = [row.distance_m for rows in drive.truth for row in rows if row.track == 1]
    >>> distances == sorted(distances)
    True
    """
    rng = make_generator(random_state)
    frames = check_integer(frames, "frames", low=1)
    fps = check_number(fps, "fps", low=1.0, high=1000.0)
    check_choice(scenario, "scenario", SCENARIOS)
    margin = check_integer(pitch_jitter_px, "pitch_jitter_px", low=0, high=50)
    config = make_config(shape, horizon, camera_height_m, focal_px, light, rain, jpeg_quality, rng, margin)
    road, traffic = make_traffic(scenario, frames / fps, rng)
    return Drive(config, road, traffic, frames=frames, fps=fps, scenario=scenario)


def write_labels(
    path: str | os.PathLike[str], frames: Iterable[tuple[int | str, Sequence[VehicleTruth]]]
) -> None:
    """Write ground truth as CSV with the columns `LABEL_COLUMNS`, one row per vehicle.

    `frames` are pairs of a frame number or file name and the ground truth of that image. The file is written
    completely or not at all.
    """
    with atomic_write(path, "path") as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(LABEL_COLUMNS)
        for frame, rows in frames:
            for row in rows:
                writer.writerow(
                    [frame, row.track, *row.box, row.occluded, f"{row.truncated:.3f}", row.ignore,
                     f"{row.distance_m:.2f}", f"{row.speed_mps:.2f}"]
                )  # fmt: skip
