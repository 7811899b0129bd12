"""Road scenes, drives and patches with exact ground truth, rendered by the library."""

from vehicle_detection.synthetic.drive import (
    Drive,
    SceneVehicle,
    render_drive,
    render_patches,
    render_scene,
    write_labels,
)
from vehicle_detection.synthetic.render import VehicleTruth

__all__ = [
    "Drive",
    "SceneVehicle",
    "VehicleTruth",
    "render_drive",
    "render_patches",
    "render_scene",
    "write_labels",
]
